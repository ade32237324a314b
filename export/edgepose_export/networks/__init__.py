"""Neural networks, as they are trained and as they run in archives."""
