"""The libraries of the extra `baselines`, imported where they are needed."""

import re
from types import ModuleType

import torch

from ...extras import needs_extra

EXTRA = "baselines"
_DECLARED = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
_held: list[torch.library.Library] = []


def segmentation_models() -> ModuleType:
    """segmentation-models-pytorch, on timm and torchvision.

    Raises:
        CartsError: the extra is not installed.
    """
    for module in ("segmentation_models_pytorch", "timm", "torchvision"):
        needs_extra(module, EXTRA)
    _import_torchvision()
    import segmentation_models_pytorch  # noqa: PLC0415

    return segmentation_models_pytorch


def _import_torchvision() -> None:
    """Import torchvision, also beside another build of torch than its own.

    PyPI has torchvision for CUDA alone. Beside a torch for CPUs its compiled operators cannot be loaded, which it takes
    calmly but for those that it describes at once: their names must be known. None of them is used here.
    """
    while True:
        try:
            import torchvision  # noqa: F401, PLC0415
        except RuntimeError as error:
            missing = re.search(r"operator torchvision::(\w+) does not exist", str(error))
            if missing is None or len(_held) > 8:
                raise
            library = torch.library.Library("torchvision", "FRAGMENT")
            library.define(missing[1] + _DECLARED)
            # The declaration lasts as long as its library.
            _held.append(library)
        else:
            return
