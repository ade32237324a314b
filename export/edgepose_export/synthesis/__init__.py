"""Virtual sensors, and what makes them like real ones."""
