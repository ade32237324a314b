"""File formats: motion capture, poses, recordings, body models."""
