"""CaRTS: correction of a robot's kinematics from camera images."""
