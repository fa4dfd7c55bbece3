"""Masks and keypoints that others made, read from their own formats."""

from .found import Annotations as Annotations
from .found import FrameAnnotation as FrameAnnotation
from .reader import read_annotations as read_annotations
