"""Commands and Python blocks of the documentation, as a reader meets them.

A block that cannot run on shipped or made data has a comment before it in the page's source:

    <!-- not run: needs a GPU -->
"""

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))

_MARK = re.compile(r"<!-- not run: (.+?) -->")
_FENCE = re.compile(r"^(`{3,})(\S*)")
_PROGRAMS = ("carts ", "uvx ", "uv ", "pipx ", "docker ", "make", "python", "ssh ", "git ", ".venv/", "cd ")
_IMPORTS = ("import ", "from ")


@dataclass(frozen=True)
class Block:
    """One block of a page."""

    page: str
    """Path of the page from the root of the checkout."""
    line: int
    """Where it begins, counted from 1."""
    language: str
    """`python`, `console` for commands, or the language of the fence."""
    text: str
    reason: str | None
    """Reason why the block is not run; None if it is run."""

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    def commands(self) -> list[str]:
        """The lines of a block of commands, continued lines joined, comments left out."""
        joined = self.text.replace("\\\n", " ")
        lines = (re.sub(r"\s+#\s.*", "", line).strip() for line in joined.splitlines())
        return [line for line in lines if line]


def blocks(page: Path) -> list[Block]:
    """Every block of a page: fenced ones, and indented ones that hold commands or begin with imports."""
    lines, found, reason, number = page.read_text(encoding="utf-8").splitlines(), [], None, 0
    name = page.relative_to(ROOT).as_posix()
    while number < len(lines):
        line, begin = lines[number], number
        fence, mark = _FENCE.match(line), _MARK.fullmatch(line.strip())
        if fence:
            number = next(i for i in range(begin + 1, len(lines)) if lines[i].startswith(fence[1]))
            found.append(Block(name, begin + 1, fence[2], "\n".join(lines[begin + 1 : number]), reason))
        elif line.startswith("    ") and not (begin and lines[begin - 1].strip() and not _is_mark(lines[begin - 1])):
            while number + 1 < len(lines) and lines[number + 1].startswith("    "):
                number += 1
            text = "\n".join(indented[4:] for indented in lines[begin : number + 1])
            language = "console" if text.startswith(_PROGRAMS) else "python" if text.startswith(_IMPORTS) else None
            if language is not None:
                found.append(Block(name, begin + 1, language, text, reason))
        if line.strip():
            reason = mark[1] if mark else None
        number += 1
    return found


def _is_mark(line: str) -> bool:
    return _MARK.fullmatch(line.strip()) is not None


def all_blocks() -> list[Block]:
    """The blocks of the README and of every page of the documentation that is not generated."""
    return [block for page in PAGES if "_generated" not in page.parts for block in blocks(page)]
