"""Accuracy of models: baselines, measures, tables, plots."""
