"""Outputs for poses: one module per kind; `base` has the interface and the table of kinds."""
