"""Metrics, and the evaluation of optimized frames against known masks and kinematics."""

from .evaluate import FrameScore as FrameScore
from .evaluate import evaluate as evaluate
from .evaluate import mean_score as mean_score
from .evaluate import start_positions as start_positions
from .evaluate import to_json as to_json
from .metrics import dice as dice
from .metrics import joint_mae_deg as joint_mae_deg
from .metrics import joint_std_deg as joint_std_deg
from .sequence import Starts as Starts
from .sequence import evaluate_sequence as evaluate_sequence

__all__ = [
    "FrameScore",
    "Starts",
    "dice",
    "evaluate",
    "evaluate_sequence",
    "joint_mae_deg",
    "joint_std_deg",
    "mean_score",
    "start_positions",
    "to_json",
]
