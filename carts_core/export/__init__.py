"""What people take away: one module per format."""

from ..settings import FormatName as FormatName
from ..settings import Images as Images
from ..settings import Parts as Parts
from .dataset import Dataset as Dataset
from .formats import FORMATS as FORMATS
from .formats import ExportFormat as ExportFormat
from .formats import export as export
from .frames import ExportFrame as ExportFrame
from .frames import corrected_frames as corrected_frames
from .frames import measured_frames as measured_frames
from .kinematics import KinematicsRow as KinematicsRow
from .kinematics import kinematics_csv as kinematics_csv
from .kinematics import read_kinematics_csv as read_kinematics_csv
from .monitor import ExportCancelled as ExportCancelled
from .monitor import Monitor as Monitor
from .overlay import image_and_mask as image_and_mask
from .overlay import outlined as outlined
from .overlay import overlay as overlay
from .png import image_png as image_png
from .png import mask_png as mask_png
from .project_frames import project_frame as project_frame
