"""Steps towards the minimum of an objective."""

from .first_order import FirstOrderDescent as FirstOrderDescent
from .levenberg_marquardt import LevenbergMarquardt as LevenbergMarquardt
from .levenberg_marquardt import bounded_step as bounded_step
from .levenberg_marquardt import shortened as shortened
