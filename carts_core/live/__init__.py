"""Live streams: sources of frames, a tracker that follows the arms forwards, and where results go."""

from .estimate import Effort as Effort
from .estimate import LiveEstimate as LiveEstimate
from .estimate import LiveVerdict as LiveVerdict
from .loop import LiveStatistics as LiveStatistics
from .loop import Results as Results
from .loop import Tracked as Tracked
from .loop import follow as follow
from .messages import FrameMessage as FrameMessage
from .messages import ImageMessage as ImageMessage
from .messages import ResultMessage as ResultMessage
from .messages import StreamError as StreamError
from .messages import packed as packed
from .moments import Assembler as Assembler
from .moments import Moment as Moment
from .moments import Source as Source
from .opening import OpenStream as OpenStream
from .opening import open_stream as open_stream
from .recorder import Recorder as Recorder
from .server import StreamServer as StreamServer
from .sources import Camera as Camera
from .sources import Folder as Folder
from .sources import Replay as Replay
from .tracker import LiveTracker as LiveTracker
