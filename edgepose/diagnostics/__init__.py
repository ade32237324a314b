"""What is wrong with a sensor, from its samples."""
