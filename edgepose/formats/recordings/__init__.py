"""Recordings of sensors: one module for each format."""
