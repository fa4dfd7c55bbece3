"""The annotation project: one SQLite file that keeps every correction, with undo and redo across restarts."""

from .identity import SequenceIdentity as SequenceIdentity
from .keys import Edits as Edits
from .keys import Key as Key
from .keys import Kind as Kind
from .layers import IgnoreRegion as IgnoreRegion
from .layers import MaskCorrection as MaskCorrection
from .place import default_path as default_path
from .project import Change as Change
from .project import Project as Project
from .queries import between_kept as between_kept
from .queries import frames_in as frames_in
from .queries import next_unreviewed as next_unreviewed
from .queries import worst_first as worst_first
from .state import ExportRecord as ExportRecord
from .state import ProjectState as ProjectState
from .state import Step as Step
from .values import CorrectedIntrinsics as CorrectedIntrinsics
from .values import CorrectedTransform as CorrectedTransform
from .values import Figures as Figures
from .values import JointCorrection as JointCorrection
from .values import Keyframe as Keyframe
from .values import Provenance as Provenance
from .values import Review as Review
from .values import ReviewState as ReviewState
from .values import Source as Source
from .values import TimeOffset as TimeOffset
