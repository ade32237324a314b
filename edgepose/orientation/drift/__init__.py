"""Correction, during a run, of the heading drift of sensors that share no north."""

from edgepose.orientation.drift.corrector import DriftCorrector

__all__ = ["DriftCorrector"]
