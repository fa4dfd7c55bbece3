"""Weights of what training minimises."""

from dataclasses import dataclass

from ..errors import SettingsError


@dataclass(frozen=True)
class ObjectiveWeights:
    """Weights of the terms of the training loss; zero leaves a term out."""

    cross_entropy: float = 1.0
    """Binary cross-entropy of the instrument's probability, as in the paper."""
    dice: float = 0.5
    """One minus soft Dice per image, so that small instruments count as much as large ones."""
    consistency: float = 1.0
    """Cosine between the features of an observed and a hybrid image: 1 where they show the same, 0 where not."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not getattr(self, name) >= 0:
                raise SettingsError(f"weight {name} is {getattr(self, name)}; give zero or more.")


@dataclass(frozen=True)
class SurfaceWeights:
    """Weights of the terms of the surface network's loss; zero leaves a term out."""

    everywhere: float = 1.0
    """Cross-entropy of coverage, all pixels."""
    near: float = 1.0
    """The same near instruments, where the optimizer compares."""
    dice: float = 0.5
    """One minus soft Dice per image and part, so that small parts count as much as large ones."""
    normals: float = 1.0
    """Smooth L1 of normals near instruments."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not getattr(self, name) >= 0:
                raise SettingsError(f"weight {name} is {getattr(self, name)}; give zero or more.")
