"""What is in front of the lens: robots, their kinematics and meshes, cameras, scenes."""
