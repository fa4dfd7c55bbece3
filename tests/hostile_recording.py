"""Hostile names, a recording with such a name, and commands that are run on it."""

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from planted import contents, treasure

from carts_core.cli.command_line import BAD_INPUT, main

Attack = Callable[[Path, int, str], tuple[list[list[str]], tuple[str, ...]]]
"""Function that prepares a working folder with a hostile name; returns command lines and their allowed outputs."""

PARTS = [
    *("..", ".", "/", "//", "\\", "~", "home", "out", "tmp", "\0", "\n", "\t", "\x1b[2J", "\x7f", "\u2028", "\u202e"),
    *("=1+1", "-rf", "--output", "*", "?", "[red]", "%s", "{frame}", "$HOME", "`id`", ";", "|", "&", "<b>", "'", '"'),
    *(" ", "ü", "手術", "e\u0301", "\ufeff", "\U0001f600", "CON", "a" * 120, "ü" * 130, ":", "#", "@", "+", ","),
    *("001", "left"),
]
WHERE = ("sequence", "camera", "domain", "arm", "frame")


def hostile_names(count: int, sandbox: Path) -> Iterator[str]:
    """Names from a seed: paths into the sandbox, then mixtures of special characters of paths, consoles and tables."""
    dice = random.Random(21)
    for number in range(count):
        if number % 4 == 0:
            up = "../" * dice.randint(1, 8)
            yield dice.choice([f"{sandbox}/evil{number}", f"{up}evil{number}", f"a/{up}home/evil", f"{up}home/bashrc"])
        else:
            yield "".join(dice.choice(PARTS) for _ in range(dice.randint(1, 4)))


def with_name(text: str, where: str, name: str) -> str:
    """Sequence file with a hostile name; images are given by a glob, so that they exist."""
    before, after = {
        "sequence": ('name = "tiny"', f"name = {json.dumps(name, ensure_ascii=False)}"),
        "camera": ('name = "left"', f"name = {json.dumps(name, ensure_ascii=False)}"),
        "domain": ("['regular']", f"[{json.dumps(name, ensure_ascii=False)}]"),
        "arm": ('name = "PSM1"', f"name = {json.dumps(name, ensure_ascii=False)}"),
        "frame": ('frame_id = "{frame:03d}"\n', ""),
    }[where]
    assert before in text
    return text.replace(before, after).replace('"{domain}/{camera}/{frame}.png"', '"regular/left/*.png"')


def campaign(sandbox: Path, monkeypatch: pytest.MonkeyPatch, count: int, attack: Attack) -> int:
    """Run commands with hostile names and check that nothing else is written; returns the number of accepted runs."""
    treasure(sandbox / "home")
    work, accepted = sandbox / "work", 0
    for number, name in enumerate(hostile_names(count, sandbox)):
        work.mkdir()
        monkeypatch.chdir(work)
        commands, outputs = attack(work, number, name)
        allowed, before = tuple(f"work/{output}" for output in outputs), contents(sandbox)
        for words in commands:
            try:
                main(words)
                accepted += 1
            except SystemExit as stop:
                assert stop.code == BAD_INPUT, (words, name)
            after = contents(sandbox)
            changed = [path for path in after.keys() | before.keys() if after.get(path) != before.get(path)]
            above = [path for path in changed if any(output.startswith(f"{path}/") for output in allowed)]
            assert all(path.startswith(allowed) or path in above for path in changed), (words, name, changed)
        monkeypatch.chdir(sandbox)
        shutil.rmtree(work)
    print(f"{count} names, {accepted} runs accepted; 0 writes outside")
    assert os.listdir(sandbox) == ["home"]
    return accepted
