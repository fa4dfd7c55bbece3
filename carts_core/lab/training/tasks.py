"""The networks that can be trained, by name."""

from ...settings import NetworkName
from .feature_task import FeatureTask
from .surface_task import SurfaceTask
from .task import Task


def task_of(network: NetworkName) -> Task:
    """How the network of that name is trained."""
    return FeatureTask() if network == "feature" else SurfaceTask()
