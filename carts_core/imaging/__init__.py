"""Pixels, and nothing of robots."""
