"""Import of masks and keypoints from annotation formats."""

from .images import Annotations as Annotations
from .images import FrameAnnotation as FrameAnnotation
from .label_studio import brush_of_mask as brush_of_mask
from .reader import find_frame as find_frame
from .reader import read_annotations as read_annotations
