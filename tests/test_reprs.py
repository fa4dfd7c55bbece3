"""Objects with arrays have a short `repr`."""

import importlib
import inspect
import re
import sys
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path

import numpy as np
import torch

from carts_core.reprs import short_repr

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs" / "_ext"))
from api_pages import PUBLIC  # pyright: ignore


@dataclass(frozen=True)
class Item:
    """Values of all kinds."""

    image: np.ndarray
    vector: torch.Tensor
    named: dict[str, np.ndarray]
    nested: tuple[object, ...]
    number: float
    text: str

    __repr__ = short_repr


def test_arrays_are_shown_by_type_and_shape_and_short_vectors_by_their_values() -> None:
    item = Item(np.zeros((4, 5), np.uint8), torch.tensor([0.5, 1 / 3]), {"a": np.arange(9)}, (1,), 1 / 3, "x" * 500)
    shown = repr(item)
    assert shown.startswith("Item(image=uint8[4, 5], vector=[0.5, 0.3333], named={'a': int64[9]}, nested=(1,), ")
    assert "number=0.333333, text='xxx" in shown and len(shown) < 300


def test_long_and_deep_collections_are_shortened() -> None:
    deep: tuple[object, ...] = ()
    for _ in range(50):
        deep = (deep,)
    item = Item(np.float64(1.5), torch.tensor(2), {}, (deep, list(range(100))), np.nan, "")  # type: ignore[arg-type]
    assert "..." in repr(item) and "94 more" in repr(item) and "image=1.5, vector=2" in repr(item)
    assert len(repr(item)) < 200


def test_public_results_with_arrays_have_a_short_repr() -> None:
    long = []
    for name in PUBLIC:
        for _, value in inspect.getmembers(importlib.import_module(f"carts_core.{name}"), inspect.isclass):
            if not is_dataclass(value) or not value.__module__.startswith("carts_core."):
                continue
            kinds = [str(one.type) for one in fields(value)]
            arrays = any("Callable" not in kind and re.search("ndarray|Tensor", kind) for kind in kinds)
            if arrays and "carts_core" not in value.__repr__.__code__.co_filename:  # The one that dataclass made.
                long.append(value.__name__)
    assert not long
