"""Diagnosis of sensor faults from samples."""
