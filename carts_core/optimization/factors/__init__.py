"""What a problem is a sum of: each factor says how badly a state fits, and how that changes with the unknowns."""

from .base import Factor as Factor
from .base import Linearization as Linearization
from .base import Prior as Prior
