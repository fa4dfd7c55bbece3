"""The networks that can be trained, by name."""

from typing import Literal

from .feature_task import FeatureTask
from .surface_task import SurfaceTask
from .task import Task

NetworkName = Literal["feature", "surface"]


def task_of(network: NetworkName) -> Task:
    """How the network of that name is trained."""
    return FeatureTask() if network == "feature" else SurfaceTask()
