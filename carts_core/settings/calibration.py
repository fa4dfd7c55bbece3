"""What a calibration frees, and how it goes about it."""

from . import presets
from .optimization import FreeParameters, SurfaceSolver

CALIBRATION = FreeParameters(joints=False, base_frames=True, extrinsics=True)
"""What a calibration frees by default."""

CALIBRATION_SETTINGS = SurfaceSolver(
    stages=presets.CALIBRATION,
    noise=0.5,
    normals_weight=0.0,
    frame_prior_deg=3.0,
    intrinsics_prior=0.05,
)
"""How a calibration goes about it by default. Normals are left out: where they are wrong by the same angle
in every frame (an encoder's offset, a bias of the network) frames do not average it out, and base frames follow."""
