"""Pose estimation from calibrated frames: features, model archives and the engines that run them."""
