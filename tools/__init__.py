"""Measurements of the packages, and a tab without a browser. None of it is installed."""
