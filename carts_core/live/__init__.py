"""Live tracking: sources of frames, the tracker, and sinks of results."""

from typing import TYPE_CHECKING

from ..package_imports import names_on_first_use
from .messages import Assembler as Assembler
from .messages import FrameMessage as FrameMessage
from .messages import ImageMessage as ImageMessage
from .messages import ResultMessage as ResultMessage
from .messages import Source as Source
from .messages import StreamError as StreamError
from .messages import StreamFrame as StreamFrame
from .messages import packed as packed
from .sources import Camera as Camera
from .sources import Folder as Folder
from .sources import OpenStream as OpenStream
from .sources import Replay as Replay
from .sources import StreamServer as StreamServer
from .sources import open_stream as open_stream

if TYPE_CHECKING:
    from .loop import LiveStatistics as LiveStatistics
    from .loop import Results as Results
    from .loop import Tracked as Tracked
    from .loop import follow as follow
    from .overlay import KeyedOverlay as KeyedOverlay
    from .recorder import Recorder as Recorder
    from .tracker import Effort as Effort
    from .tracker import LiveEstimate as LiveEstimate
    from .tracker import LiveTracker as LiveTracker
    from .tracker import LiveVerdict as LiveVerdict

__getattr__, __dir__ = names_on_first_use(
    __name__,
    {
        "loop": ("LiveStatistics", "Results", "Tracked", "follow"),
        "overlay": ("KeyedOverlay",),
        "recorder": ("Recorder",),
        "tracker": ("Effort", "LiveEstimate", "LiveTracker", "LiveVerdict"),
    },
)
