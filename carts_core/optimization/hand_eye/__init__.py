"""Hand-eye calibration from points that a person has found in a few images, without any initial pose."""

from .agreement import PointAgreement as PointAgreement
from .agreement import agreement_with_points as agreement_with_points
from .files import RESULT_FILE as RESULT_FILE
from .files import HandEyePrior as HandEyePrior
from .files import read_points as read_points
from .files import read_prior as read_prior
from .files import result_json as result_json
from .moving_cameras import mounts_of_points as mounts_of_points
from .moving_cameras import moved_cameras as moved_cameras
from .points import ImagePoint as ImagePoint
from .result import HandEyeResult as HandEyeResult
from .result import PoseDeviation as PoseDeviation
from .settings import HandEyeSettings as HandEyeSettings
from .solve import solve_hand_eye as solve_hand_eye
