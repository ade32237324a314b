"""File formats of motion capture and of recordings."""
