"""Layers, overlays, strokes, and the 3D scene."""
