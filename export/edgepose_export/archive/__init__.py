"""TorchScript archives of trained networks, and model cards."""
