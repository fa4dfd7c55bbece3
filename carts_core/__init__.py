"""CaRTS: correction of a robot's kinematics from camera images.

`fit` corrects the joint positions of robot arms in one image, `fit_frame` in one frame of a recording, `open` opens a
recording, and `view` displays one in a notebook:

    import carts_core as carts

    fit = carts.fit("image.png", K=K, T_camera_base=T, urdf="arm.urdf", joints=q)
    fit.mask, fit.joints, fit.std, fit.verdict
    fit.plot()

These names are imported on first use, since PyTorch takes seconds to import.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from carts_viewer.notebook import view as view

    from .fitting import Fit as Fit
    from .fitting import fit as fit
    from .fitting import fit_frame as fit_frame
    from .fitting import open as open

_IN_FITTING = ("Fit", "fit", "fit_frame", "open")
_IN_VIEWER = ("view",)


def __getattr__(name: str) -> object:
    if name in _IN_FITTING:
        from . import fitting as module  # noqa: PLC0415
    elif name in _IN_VIEWER:
        from carts_viewer import notebook as module  # noqa: PLC0415
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_IN_FITTING, *_IN_VIEWER})
