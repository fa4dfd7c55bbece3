"""Hand-eye calibration from points clicked in a few images, or from masks, without an initial pose."""

from ..results import PoseDeviation as PoseDeviation
from .files import RESULT_FILE as RESULT_FILE
from .files import HandEyePrior as HandEyePrior
from .files import mounts_of_points as mounts_of_points
from .files import moved_cameras as moved_cameras
from .files import read_points as read_points
from .files import read_prior as read_prior
from .files import result_json as result_json
from .problem import HandEyeSettings as HandEyeSettings
from .problem import ImagePoint as ImagePoint
from .result import HandEyeResult as HandEyeResult
from .result import PointAgreement as PointAgreement
from .result import agreement_with_points as agreement_with_points
from .result import solve_hand_eye as solve_hand_eye
