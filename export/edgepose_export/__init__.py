"""Where edgepose models come from: motion capture, synthesis, training, export."""
