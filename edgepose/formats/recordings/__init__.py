"""Formats of sensor recordings, one module each."""
