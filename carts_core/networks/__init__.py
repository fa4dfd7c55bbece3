"""Inference of the networks, and hybrid images."""

from typing import TYPE_CHECKING

from ..package_imports import names_on_first_use

if TYPE_CHECKING:
    from .extractor import FeatureExtractor as FeatureExtractor
    from .extractor import hybrid as hybrid

__getattr__, __dir__ = names_on_first_use(
    __name__,
    {
        "extractor": ("FeatureExtractor", "hybrid"),
    },
)
