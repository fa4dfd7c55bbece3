"""Import of masks and keypoints from annotation formats."""

from .formats import Annotations as Annotations
from .formats import FrameAnnotation as FrameAnnotation
from .reader import read_annotations as read_annotations
