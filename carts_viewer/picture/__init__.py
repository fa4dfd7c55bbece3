"""What the picture shows: layers, overlays, the 3D scene, and strokes."""
