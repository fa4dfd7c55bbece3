"""Robots, their kinematics and meshes, cameras, and scenes."""
