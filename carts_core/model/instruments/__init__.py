"""Built-in instruments: URDFs and meshes generated from dimensions, named `builtin:NAME`."""

from .builtin import SCHEME as SCHEME
from .builtin import SHIPPED as SHIPPED
from .builtin import builtin_names as builtin_names
from .builtin import builtin_urdf as builtin_urdf
from .builtin import robot_file as robot_file
from .catalogue import INSTRUMENTS as INSTRUMENTS
from .catalogue import Instrument as Instrument
