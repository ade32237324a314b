"""From calibrated frames to poses: features, model archives and the engines that run them."""
