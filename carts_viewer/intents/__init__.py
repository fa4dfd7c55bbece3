"""What a person can ask for.

A control that streams values (a slider that is being dragged) gives its intents a key: a newer one replaces the older
one that nobody has looked at yet, so work never piles up and the last value is always the one that counts.
"""

from .annotating import AcceptAndNext as AcceptAndNext
from .annotating import Annotation as Annotation
from .annotating import ChooseKeypoint as ChooseKeypoint
from .annotating import CopyCorrection as CopyCorrection
from .annotating import ForgetPins as ForgetPins
from .annotating import GoToStep as GoToStep
from .annotating import PointAt as PointAt
from .annotating import Redo as Redo
from .annotating import SetNote as SetNote
from .annotating import SetReview as SetReview
from .annotating import ShowKeypoints as ShowKeypoints
from .annotating import ShowUnreviewed as ShowUnreviewed
from .annotating import ShowWorse as ShowWorse
from .annotating import Undo as Undo
from .base import DismissError as DismissError
from .base import Drawn as Drawn
from .base import Intent as Intent
from .base import Latest as Latest
from .base import Refresh as Refresh
from .base import Released as Released
from .browsing import Browsing as Browsing
from .browsing import MoveFrame as MoveFrame
from .browsing import Play as Play
from .browsing import SetOpacity as SetOpacity
from .browsing import SetSpeed as SetSpeed
from .browsing import ShowCamera as ShowCamera
from .browsing import ShowDomain as ShowDomain
from .browsing import ShowFrame as ShowFrame
from .browsing import ShowLayer as ShowLayer
from .exporting import CancelExport as CancelExport
from .exporting import ExportAll as ExportAll
from .exporting import Exporting as Exporting
from .exporting import ExportMask as ExportMask
from .optimizing import Optimizing as Optimizing
from .optimizing import Pause as Pause
from .optimizing import Reset as Reset
from .optimizing import Run as Run
from .optimizing import RunOrPause as RunOrPause
from .optimizing import SetCameras as SetCameras
from .optimizing import SetFreeGroup as SetFreeGroup
from .optimizing import SetFreeJoint as SetFreeJoint
from .optimizing import SetSetting as SetSetting
from .optimizing import Step as Step
from .posing import BackToMeasured as BackToMeasured
from .posing import ChooseJoint as ChooseJoint
from .posing import Nudge as Nudge
from .posing import Perturb as Perturb
from .posing import Posing as Posing
from .posing import SetJoint as SetJoint
