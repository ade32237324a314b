"""The making of edgepose models: motion capture, synthesis, training, evaluation, export."""
