"""Viewer of poses in the browser."""
