"""CaRTS: correct a robot's kinematics from what its camera sees."""
