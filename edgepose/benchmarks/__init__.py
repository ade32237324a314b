"""How fast and how accurate the parts are, on data with known truth."""
