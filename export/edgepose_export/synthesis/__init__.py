"""Virtual sensors, their errors, and augmentation of motion."""
