"""CaRTS: correction of a robot's kinematics from camera images.

`fit` corrects the joint positions of robot arms in one image, `fit_frame` in one frame of a recording, and `open` opens
a recording:

    import carts_core as carts

    fit = carts.fit("image.png", K=K, T_camera_base=T, urdf="arm.urdf", joints=q)
    fit.mask, fit.joints, fit.std, fit.verdict
    fit.plot()

These names are imported on first use, since PyTorch takes seconds to import.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .fitting import Fit as Fit
    from .fitting import fit as fit
    from .fitting import fit_frame as fit_frame
    from .fitting import open as open

_IN_FITTING = ("Fit", "fit", "fit_frame", "open")


def __getattr__(name: str) -> object:
    if name not in _IN_FITTING:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import fitting  # noqa: PLC0415

    value = globals()[name] = getattr(fitting, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_IN_FITTING})
