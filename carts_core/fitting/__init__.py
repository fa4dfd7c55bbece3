"""Fits of robot arms to single images, in one call; `carts_core` re-exports these names."""

from .fit import fit as fit
from .fit import fit_frame as fit_frame
from .fit import open as open
from .result import Fit as Fit
from .result import JointRow as JointRow
