"""What people take away: one module per format."""

from .files import write_bytes as write_bytes
from .kinematics import KinematicsRow as KinematicsRow
from .kinematics import kinematics_csv as kinematics_csv
from .kinematics import read_kinematics_csv as read_kinematics_csv
from .masks import image_png as image_png
from .masks import mask_png as mask_png

__all__ = ["KinematicsRow", "image_png", "kinematics_csv", "mask_png", "read_kinematics_csv", "write_bytes"]
