"""Trained networks as archives, and their cards."""
