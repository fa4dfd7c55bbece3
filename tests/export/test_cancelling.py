"""An export that is cancelled leaves nothing."""

import os
import threading
from pathlib import Path

import pytest

from carts_core.export import FORMATS, Dataset, ExportCancelled, FormatName, Monitor, export


@pytest.mark.parametrize("name", FORMATS)
def test_a_cancelled_export_leaves_nothing(dataset: Dataset, name: FormatName, tmp_path: Path) -> None:
    cancel, steps = threading.Event(), []

    def progress(done: int, total: int) -> None:
        steps.append((done, total))
        cancel.set()

    folder = tmp_path / "exports"
    folder.mkdir()
    with pytest.raises(ExportCancelled):
        export(dataset, name, folder / "out", monitor=Monitor(progress, cancel.is_set))
    assert steps == [(1, len(dataset.scene.arms) if name.startswith("dvrk") else 3)]
    assert os.listdir(folder) == []
