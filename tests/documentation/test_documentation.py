"""What the documentation promises of itself: short where it must be, links that lead somewhere, words of the field."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [
    *(path for path in sorted(DOCS.rglob("*.md")) if not {"_generated", "_build"} & set(path.parts)),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md")),
]
GUIDES = [path for path in PAGES if "experiments" not in path.parts]
PRIVATE_WORDS = re.compile(r"\b(glanc\w*|veil\w*|unveil\w*|opinions?|slid|looks? again|believed|second eye)\b", re.I)


def named(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_the_architecture_is_800_words_and_one_picture() -> None:
    text = (DOCS / "explanation" / "architecture.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 800 and len(re.findall(r"\.(?:svg|png|jpg)\b", text)) == 1


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_relative_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL))
    local = {link.partition("#")[0] for link in links if "://" not in link and not link.startswith("#")}
    # Generated pages are there after `make docs`, which refuses links that lead nowhere.
    missing = [link for link in local if "_generated" not in link and not (page.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("page", GUIDES, ids=named)
def test_guides_use_the_words_of_the_field(page: Path) -> None:
    found = PRIVATE_WORDS.findall(page.read_text(encoding="utf-8"))
    assert not found, f"{found}: the glossary has the standard words"


@pytest.mark.parametrize("page", sorted((DOCS / "experiments").glob("20*.md")), ids=named)
def test_an_experiment_names_its_date_commit_command_and_data(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert text.startswith(f"# {page.name[:10]}: ")
    for row in ("commit", "command", "data"):
        assert re.search(rf"^\| {row}s? \| .+ \|$", text, re.MULTILINE), row
