"""Benchmarks of speed, and of accuracy on data with ground truth."""
