"""Formats of pose files."""
