"""Baselines of the benchmark: segmentation networks with the image, or image and rendering, as input."""
