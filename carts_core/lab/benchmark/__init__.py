"""Benchmark: tables and figures of the paper for our data, and targets of the default solver."""

from .measurement import Measurement as Measurement
from .measurement import ResultsFile as ResultsFile
from .measurement import Score as Score
from .report import Facts as Facts
from .report import write_report as write_report
from .runner import Benchmark as Benchmark
from .runner import plan as plan
from .scope import FULL as FULL
from .scope import QUICK as QUICK
from .scope import Run as Run
from .scope import Scope as Scope
from .sources import TEST_SEED as TEST_SEED
from .sources import Source as Source
from .sources import family_sources as family_sources
from .sources import real_source as real_source
from .sources import room_sources as room_sources
from .sources import synthetic_room_source as synthetic_room_source
from .sources import synthetic_source as synthetic_source
from .targets import Target as Target
from .targets import targets as targets
