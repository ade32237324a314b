"""Poses measured, described and drawn."""
