"""Names that try to lead elsewhere, and a recording that carries one."""

import json
import random
from collections.abc import Iterator
from pathlib import Path

PARTS = [
    *("..", ".", "/", "//", "\\", "~", "home", "out", "tmp", "\0", "\n", "\t", "\x1b[2J", "\x7f", "\u2028", "\u202e"),
    *("=1+1", "-rf", "--output", "*", "?", "[red]", "%s", "{frame}", "$HOME", "`id`", ";", "|", "&", "<b>", "'", '"'),
    *(" ", "ü", "手術", "e\u0301", "\ufeff", "\U0001f600", "CON", "a" * 120, "ü" * 130, ":", "#", "@", "+", ","),
    *("001", "left"),
]
WHERE = ("sequence", "camera", "domain", "arm", "frame")


def hostile_names(count: int, sandbox: Path) -> Iterator[str]:
    """Names from a seed: paths into the sandbox first, then mixtures of all that paths, consoles and tables know."""
    dice = random.Random(21)
    for number in range(count):
        if number % 4 == 0:
            up = "../" * dice.randint(1, 8)
            yield dice.choice([f"{sandbox}/evil{number}", f"{up}evil{number}", f"a/{up}home/evil", f"{up}home/bashrc"])
        else:
            yield "".join(dice.choice(PARTS) for _ in range(dice.randint(1, 4)))


def with_name(text: str, where: str, name: str) -> str:
    """The sequence file with a hostile name in it; images are found by a glob, so that they are there."""
    before, after = {
        "sequence": ('name = "tiny"', f"name = {json.dumps(name, ensure_ascii=False)}"),
        "camera": ('name = "left"', f"name = {json.dumps(name, ensure_ascii=False)}"),
        "domain": ("['regular']", f"[{json.dumps(name, ensure_ascii=False)}]"),
        "arm": ('name = "PSM1"', f"name = {json.dumps(name, ensure_ascii=False)}"),
        "frame": ('frame_id = "{frame:03d}"\n', ""),
    }[where]
    assert before in text
    return text.replace(before, after).replace('"{domain}/{camera}/{frame}.png"', '"regular/left/*.png"')
