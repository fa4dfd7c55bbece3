"""Built-in instruments: names, published kinematics, and shapes of the tips.

Wrist lengths are those of the dVRK's tool files. Shapes are simplified and of approximately correct size.
"""

from dataclasses import dataclass

from .shapes import ClipApplier, Electrode, Hub, Jaws, Scissors, Tip

SI_SUFFIX = "_si"

_SLIM = Hub(2.4, 2.0)


@dataclass(frozen=True)
class Instrument:
    """Type of instrument, available for the classic and the Si arm."""

    name: str
    title: str
    numbers: str
    """Last three digits of the model numbers of this type."""
    wrist_length: float
    """Distance from the pitch axis to the yaw axis [mm]."""
    tip: Tip | None
    """Shape of the tip; None for the shape of the shipped Large Needle Driver."""
    opening: float = 1.39626
    """Maximum angle between the jaws [rad]."""

    @property
    def has_jaws(self) -> bool:
        """Whether the instrument has a joint `jaw`."""
        return not isinstance(self.tip, Electrode)

    @property
    def length(self) -> float:
        """Distance from the yaw axis to the end of the tip [mm]."""
        if self.tip is None:
            return 9.65
        if isinstance(self.tip, Electrode):
            return max(y for _, y in self.tip.path) + (self.tip.paddle[0] - 0.4 if self.tip.paddle else 0.0)
        return self.tip.length


def _forceps(length: float, width: float, end: float, thick: float = 1.5, hub: Hub = _SLIM, **changes: object) -> Jaws:
    widths = ((0.0, width), (0.5, 0.75 * width + 0.25 * end), (1.0, end))
    thickness = ((0.0, thick), (0.6, 0.8 * thick), (1.0, 0.5 * thick))
    return Jaws(length, widths, thickness, hub, **changes)  # pyright: ignore[reportArgumentType]


_MARYLAND = Jaws(
    21.1,
    ((0.0, 0.8), (0.2, 1.6), (0.45, 1.75), (0.7, 1.25), (0.9, 0.9), (1.0, 0.8)),
    ((0.0, 1.4), (0.4, 1.6), (0.75, 1.3), (1.0, 0.6)),
    root=5.0,
    arch=1.4,
    turn=-1.5,
    windows=((0.18, 0.5),),
    rim=0.7,
)
_PROGRASP = Jaws(
    28.6,
    ((0.0, 1.3), (0.18, 2.55), (1.0, 2.55)),
    ((0.0, 2.2), (0.4, 1.6), (1.0, 1.2)),
    root=11.0,
    windows=((0.26, 0.88),),
    rim=0.85,
    pivot=7.7,
)
_HOOK = (
    (0.0, 7.0),
    (0.0, 9.3),
    (-0.5, 10.2),
    (-1.6, 10.9),
    (-2.25, 12.0),
    (-2.2, 13.2),
    (-1.3, 14.3),
    (0.2, 14.9),
    (1.1, 15.8),
)

INSTRUMENTS = (
    Instrument("large_needle_driver", "Large needle driver", "006", 9.1, None),
    Instrument(
        "mega_needle_driver",
        "Mega needle driver",
        "194",
        11.2,
        Jaws(12.9, ((0.0, 1.75), (0.5, 1.55), (1.0, 1.2)), ((0.0, 2.6), (1.0, 1.35)), Hub(3.7, 2.6), 5.0, insert=0.55),
    ),
    Instrument(
        "suturecut_needle_driver",
        "Suturecut needle driver",
        "296 309",
        10.0,
        Jaws(15.2, ((0.0, 1.7), (0.4, 1.7), (1.0, 1.1)), ((0.0, 2.7), (1.0, 1.3)), Hub(3.6, 2.6), 5.0, insert=0.55),
    ),
    Instrument("debakey_forceps", "DeBakey forceps", "036", 9.1, _forceps(19.5, 1.35, 0.9, 1.7, root=3.2)),
    Instrument("micro_forceps", "Micro forceps", "033", 9.1, _forceps(12.5, 1.2, 0.35, 1.4, root=3.0)),
    Instrument(
        "long_tip_forceps",
        "Long tip forceps",
        "048",
        9.1,
        _forceps(20.5, 1.3, 0.7, 1.6, root=3.2, turn=-2.6, arch=0.7),
    ),
    Instrument(
        "tooth_forceps",
        "Round tooth forceps",
        "035 181",
        9.1,
        _forceps(16.0, 1.5, 1.5, 1.7, root=3.2, windows=((0.55, 0.85),)),
    ),
    Instrument("maryland_bipolar_forceps", "Maryland bipolar forceps", "172", 10.7, _MARYLAND),
    Instrument(
        "fenestrated_bipolar_forceps",
        "Fenestrated bipolar forceps",
        "205",
        10.7,
        Jaws(
            23.5,
            ((0.0, 0.9), (0.2, 2.0), (0.85, 1.8), (1.0, 1.5)),
            ((0.0, 1.6), (1.0, 0.9)),
            root=5.0,
            windows=((0.25, 0.82),),
        ),
    ),
    Instrument(
        "cadiere_forceps",
        "Cadiere forceps",
        "049",
        9.1,
        Jaws(
            20.5,
            ((0.0, 1.3), (0.2, 2.1), (1.0, 1.9)),
            ((0.0, 1.6), (1.0, 0.9)),
            _SLIM,
            3.2,
            windows=((0.25, 0.85),),
        ),
    ),
    Instrument("prograsp_forceps", "ProGrasp forceps", "093", 10.7, _PROGRASP, 1.047),
    Instrument(
        "double_fenestrated_grasper",
        "Double fenestrated grasper",
        "127 189 208",
        10.7,
        Jaws(
            33.0,
            ((0.0, 1.2), (0.15, 2.5), (1.0, 2.3)),
            ((0.0, 1.9), (1.0, 0.9)),
            root=5.5,
            windows=((0.18, 0.5), (0.58, 0.92)),
        ),
    ),
    Instrument(
        "curved_scissors",
        "Curved scissors",
        "178 179",
        9.1,
        Scissors(14.5, ((0.0, 0.9), (0.4, 0.8), (1.0, 0.45)), turn=-1.6),
    ),
    Instrument(
        "round_tip_scissors",
        "Round tip scissors",
        "007",
        9.1,
        Scissors(12.5, ((0.0, 1.0), (0.6, 0.9), (1.0, 0.75)), 1.1),
    ),
    Instrument(
        "potts_scissors", "Potts scissors", "001", 9.1, Scissors(13.0, ((0.0, 0.7), (0.3, 0.5), (1.0, 0.2)), 0.7)
    ),
    Instrument("cautery_hook", "Cautery hook", "183", 9.3, Electrode(_HOOK)),
    Instrument(
        "cautery_spatula",
        "Cautery spatula",
        "184",
        9.3,
        Electrode(((0.0, 7.5), (0.0, 9.5), (0.0, 11.8)), collar=7.6, paddle=(4.8, 1.1, 0.27), height=1.05),
    ),
    Instrument("clip_applier", "Clip applier", "230 327", 10.7, ClipApplier(), 0.733),
    Instrument("small_clip_applier", "Small clip applier", "003", 9.1, ClipApplier(18.5, 2.7, 0.9, _SLIM), 0.733),
)
"""Built-in instruments, in the order of lists."""

BY_NAME = {instrument.name: instrument for instrument in INSTRUMENTS}
