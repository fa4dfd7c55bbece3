"""`carts optimize`: correct the kinematics of frames and write masks and kinematics."""

from dataclasses import dataclass

from .optimize_options import OptimizeOptions


@dataclass(frozen=True)
class Optimize(OptimizeOptions):
    """Correct the kinematics of frames; write masks (PNG) and kinematics (CSV). Run it again to go on."""

    def run(self) -> None:
        """Optimize what is not there yet."""
        from .optimizing import Optimizing

        Optimizing(self).run()
