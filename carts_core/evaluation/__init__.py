"""Metrics, and evaluation of results against ground truth."""

from .calibration import FrameResidual as FrameResidual
from .calibration import calibration_json as calibration_json
from .calibration import calibration_warning as calibration_warning
from .calibration import frame_residuals as frame_residuals
from .calibration import mean_dice as mean_dice
from .calibration import write_calibration as write_calibration
from .evaluate import FrameScore as FrameScore
from .evaluate import Setup as Setup
from .evaluate import camera_groups as camera_groups
from .evaluate import dice as dice
from .evaluate import evaluate as evaluate
from .evaluate import joint_mae_deg as joint_mae_deg
from .evaluate import joint_std_deg as joint_std_deg
from .evaluate import mean_score as mean_score
from .evaluate import normalized_surface_distance as normalized_surface_distance
from .evaluate import start_positions as start_positions
from .evaluate import to_json as to_json
