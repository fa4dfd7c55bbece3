"""A page for each numbered example: its docstring, its picture and its source."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"


def example_pages() -> dict[str, str]:
    """File name -> Markdown."""
    pages, cards = {}, []
    for path in sorted(EXAMPLES.glob("[0-9]*.py")):
        summary, rest = _docstring(path)
        number, _, name = path.stem.partition("_")
        title = f"{int(number)}. {_title(name)}"
        picture = f"../../images/examples/{path.stem}.jpg"
        pages[f"{path.stem}.md"] = "\n\n".join(
            [
                f"# {title}",
                summary,
                rest,
                f"![{_alternative(summary)}]({picture})",
                f"```{{literalinclude}} ../../../examples/{path.name}\n:language: python\n```",
            ]
        )
        options = f":link: {path.stem}\n:link-type: doc\n:img-top: {picture}"
        cards.append(f"::::{{grid-item-card}} {title}\n{options}\n\n{summary}\n::::")
    pages["gallery.md"] = ":orphan:\n\n# Examples\n" if not cards else _gallery(cards, list(pages))
    return pages


def _gallery(cards: list[str], pages: list[str]) -> str:
    lead = (
        "Each is one file of at most 80 lines in the folder `examples`. It runs on shipped or synthetic data within "
        "seconds, and a test runs it. Start one with `python examples/NAME.py`; `--help` lists its few options."
    )
    tree = "\n".join(page.removesuffix(".md") for page in pages)
    grid = "\n\n".join(cards)
    return (
        f"# Examples\n\n{lead}\n\n:::::{{grid}} 1 2 2 3\n:gutter: 3\n\n{grid}\n:::::\n\n"
        f"```{{toctree}}\n:hidden:\n\n{tree}\n```\n"
    )


def _title(name: str) -> str:
    """A file's name as a title."""
    words = name.replace("_", " ").capitalize()
    return words.replace("papers", "paper's").replace("urdf", "URDF")


def _docstring(path: Path) -> tuple[str, str]:
    """The first paragraph of a module's docstring, and the rest with its commands as code."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    summary, _, rest = text.partition("\n\n")
    return " ".join(summary.split()), re.sub(
        r"^(python examples/.*)$", r"```console\n$ \1\n```", rest, flags=re.MULTILINE
    )


def _alternative(summary: str) -> str:
    return re.sub(r"[`\[\]]", "", summary)
