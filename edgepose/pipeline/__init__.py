"""The steps of a run joined, for one wearer and for several."""
