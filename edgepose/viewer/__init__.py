"""Poses as a figure in the browser."""
