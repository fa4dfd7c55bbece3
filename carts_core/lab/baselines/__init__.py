"""Baselines of the benchmark: segmentation networks whose input is the image, or image and rendering."""
