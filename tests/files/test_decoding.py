"""Untrusted files are decoded in a child process within bounded memory and time, or by parsers that cannot grow."""

import importlib
import io
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from carts_core.decoders import tables
from carts_core.files.decoding import Decoder, Limits, decoded
from carts_core.files.reading import parse_ini, parse_yaml

SMALL = Limits(seconds=1, memory=100 * 2**20)
ALIASES = "a0: &a0 [1]\n" + "\n".join(f"a{n + 1}: &a{n + 1} [{','.join([f'*a{n}'] * 9)}]" for n in range(9))
MERGES = "a0: &a0 {k: 1}\n" + "\n".join(f"a{n + 1}: &a{n + 1} {{<<: [{','.join([f'*a{n}'] * 9)}]}}" for n in range(9))


@pytest.fixture
def decoder() -> Iterator[Decoder]:
    decoder = Decoder()
    yield decoder
    decoder.close()


def test_values_arrays_and_errors_come_back_as_the_decoder_gave_them(decoder: Decoder, tmp_path: Path):
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    assert np.array_equal(decoder.call(np.transpose, array, limits=SMALL), array.T)
    assert decoder.call(np.transpose, np.empty((0, 4)), limits=SMALL).shape == (4, 0)
    assert decoder.call(os.path.isdir, tmp_path, limits=SMALL)
    with pytest.raises(FileNotFoundError, match=r"No such file .*ä"):
        decoder.call(os.listdir, tmp_path / "ä\udcff", limits=SMALL)
    with pytest.raises(FileNotFoundError, match="No such file"):
        decoded(tables.read_arrays, tmp_path / "missing.npz")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(OSError, match=r"folder\.npz is a folder"):
        decoded(tables.read_arrays, tmp_path / "folder.npz")
    with pytest.raises(ValueError, match="flow sequence"):
        decoder.call(parse_yaml, "a: [wrong", limits=SMALL)
    with pytest.raises(ValueError, match="cannot be passed between processes"):
        decoder.call(io.BytesIO, limits=SMALL)


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (np.ones, [10**9], "more than 100 MiB"),
        (pow, [3, 10**8], "longer than 1 s"),
        (os.abort, [], "more than 100 MiB"),
        (signal.raise_signal, [int(signal.SIGSEGV)], "ended with status -11"),
    ],
)
def test_limits_and_crashes_are_errors(
    decoder: Decoder, function: Callable[..., Any], arguments: list[int], message: str
):
    with pytest.raises(ValueError, match=message):
        decoder.call(function, *arguments, limits=SMALL)
    assert decoder.call(abs, -1, limits=SMALL) == 1


def test_imports_do_not_count_as_decoding(decoder: Decoder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "slow_to_import.py").write_text(
        "import sys, time\nwhile sys.argv[0] == '-c' and time.process_time() < 1.5: pass\ndef answer(): return 42\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert decoder.call(abs, -1, limits=SMALL) == 1
    assert decoder.call(importlib.import_module("slow_to_import").answer, limits=SMALL) == 42


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ALIASES, "alias"),
        (MERGES, "alias"),
        ("a: {<<: {b: 1}}", "merge"),
        (f"%TAG ! tag:{'a' * 100_000}:\n---\n" + "- !c 1\n" * 1000, "%TAG"),
        (f"a: 0x{'f' * 300}", "64 bits"),
        (f"a: {'9' * 5000}", "limit"),
        ("!!bool x", "x"),
        ("- 1\n" * 600_000, "more than 500,000 values"),
        ("[" * 100, "nested more than 32"),
    ],
)
def test_yaml_that_grows_is_refused(text: str, message: str):
    with pytest.raises(ValueError, match=message):
        parse_yaml(text)


def test_yaml_has_the_numbers_of_the_standard_and_no_dates_or_sexagesimals():
    text = "[1, 0x1F, 017, -0b11, 1_000, 1.5e+3, -.inf, true, ~, 1:30, !!int 1:30, !!float 1:1.5, 2001-01-01]"
    numbers = [1, 31, 15, -3, 1000, 1500.0, -np.inf, True, None]
    assert parse_yaml(text) == [*numbers, "1:30", "1:30", "1:1.5", "2001-01-01"]
    assert parse_yaml(f"!!int 1:{'1:' * 10**6}1") == f"1:{'1:' * 10**6}1"


def test_ini_is_not_interpolated_and_costs_what_its_length_does():
    levels = "".join(f"x{n + 1} = {'%(x' + str(n) + ')s' * 8}\n" for n in range(30))
    assert parse_ini(f"[a]\nx0 = 1\n{levels}")["a"]["x30"].startswith("%(x29)s")
    with pytest.raises(ValueError, match=r"^.{1,300}$"):
        parse_ini(f"[a]\nb{' ' * 2_000_000}x")
    with pytest.raises(ValueError, match="more than 10,000 lines"):
        parse_ini("[a]\n" * 10_001)
