"""Metrics, and evaluation of results against ground truth."""

from typing import TYPE_CHECKING

from ..package_imports import names_on_first_use
from .metrics import dice as dice
from .metrics import joint_mae_deg as joint_mae_deg
from .metrics import joint_std_deg as joint_std_deg
from .metrics import normalized_surface_distance as normalized_surface_distance

if TYPE_CHECKING:
    from .calibration import FrameResidual as FrameResidual
    from .calibration import calibration_json as calibration_json
    from .calibration import calibration_warning as calibration_warning
    from .calibration import frame_residuals as frame_residuals
    from .calibration import mean_dice as mean_dice
    from .calibration import write_calibration as write_calibration
    from .scores import FrameScore as FrameScore
    from .scores import Setup as Setup
    from .scores import camera_groups as camera_groups
    from .scores import evaluate as evaluate
    from .scores import mean_score as mean_score
    from .scores import start_positions as start_positions
    from .scores import to_json as to_json

__getattr__, __dir__ = names_on_first_use(
    __name__,
    {
        "calibration": (
            "FrameResidual",
            "calibration_json",
            "calibration_warning",
            "frame_residuals",
            "mean_dice",
            "write_calibration",
        ),
        "scores": ("FrameScore", "Setup", "camera_groups", "evaluate", "mean_score", "start_positions", "to_json"),
    },
)
