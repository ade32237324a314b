"""Outputs of poses: one module for each kind; `base` has the interface and the table."""
