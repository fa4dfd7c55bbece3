"""Results are bit-identical for any number of torch threads."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from carts_core.evaluation import start_positions
from carts_core.networks.extractor import FeatureExtractor
from carts_core.optimization import FrameOptimizer
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence
from carts_core.settings import SurfaceSolver
from carts_core.threads import one_thread, total


def corrected(sequence: Sequence, index: int, threads: int, iterations: int) -> dict[str, np.ndarray]:
    """Joint positions and standard deviations of the solver, from an initial error of 5 degrees, after some steps."""
    torch.set_num_threads(threads)
    frame = sequence.frame(index)
    optimizer = FrameOptimizer(
        sequence.scene,
        frame,
        {},
        FeatureExtractor.load(),
        start=start_positions(sequence, frame, 5.0, 0),
        settings=SurfaceSolver(iterations=iterations),
        live=False,
    )
    list(optimizer)
    assert optimizer.best is not None
    positions, deviations = optimizer.best.joint_positions(), optimizer.best.joint_std()
    return {**positions, **{f"{arm}.std": values for arm, values in deviations.items()}}


def differing(sequence: Sequence, index: int, counts: tuple[int, ...], iterations: int) -> list[str]:
    """Results that differ between numbers of threads."""
    first, *others = (corrected(sequence, index, threads, iterations) for threads in counts)
    return [name for name in first for other in others if first[name].tobytes() != other[name].tobytes()]


def test_a_block_runs_in_one_thread_and_gives_the_others_back_even_after_an_error() -> None:
    torch.set_num_threads(3)
    with pytest.raises(ValueError, match="inside"), one_thread():
        assert torch.get_num_threads() == 1
        raise ValueError("inside")
    assert torch.get_num_threads() == 3


def test_a_total_is_the_same_with_any_number_of_threads_where_a_sum_is_not() -> None:
    values = torch.rand(1, 176, 240, generator=torch.Generator().manual_seed(0))
    sums, totals = set(), set()
    for threads in range(1, 9):
        torch.set_num_threads(threads)
        sums.add(float(values.sum()))
        totals.add(total(values))
    assert len(totals) == 1
    assert len(sums) > 1, "torch adds up in the same order now; `total` may go"


def test_a_frame_has_the_same_bits_with_one_and_two_threads(tiny_sequence: Callable[..., Path]) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1, width=480, height=360))
    assert differing(sequence, 0, (1, 2), 4) == []


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_shipped_sequence_has_the_same_bits_with_one_two_and_four_threads() -> None:
    sequence = Sequence.open(sample_sequence())
    found = {index: differing(sequence, index, (1, 2, 4), 40) for index in range(len(sequence))}
    assert {index: names for index, names in found.items() if names} == {}
