"""Guidance of a wearer through a calibration: on the terminal, and on a page for a phone."""
