"""Import of masks and keypoints from annotation formats."""

from .images import Annotations as Annotations
from .images import FrameAnnotation as FrameAnnotation
from .reader import read_annotations as read_annotations
