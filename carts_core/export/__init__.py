"""Exports of frames, with one function per format."""

from ..settings import FormatName as FormatName
from ..settings import Images as Images
from ..settings import Parts as Parts
from .dataset import Dataset as Dataset
from .dataset import ExportCancelled as ExportCancelled
from .dataset import ExportFrame as ExportFrame
from .dataset import ExportProgress as ExportProgress
from .dataset import corrected_frames as corrected_frames
from .dataset import measured_frames as measured_frames
from .dataset import network_refiner as network_refiner
from .dataset import project_frame as project_frame
from .encodings import image_png as image_png
from .encodings import mask_png as mask_png
from .formats import FORMATS as FORMATS
from .formats import ExportFormat as ExportFormat
from .formats import export as export
from .formats import formats_of as formats_of
from .kinematics import KinematicsRow as KinematicsRow
from .kinematics import kinematics_csv as kinematics_csv
from .kinematics import read_kinematics_csv as read_kinematics_csv
from .video import image_and_mask as image_and_mask
from .video import outlined as outlined
from .video import overlay as overlay
