"""Factors: terms of an objective, with a cost and a quadratic model in the unknowns."""

from .base import Factor as Factor
from .base import Linearization as Linearization
from .base import Prior as Prior
