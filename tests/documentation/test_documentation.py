"""Links of the documentation."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [
    *(path for path in sorted(DOCS.rglob("*.md")) if not {"_generated", "_build"} & set(path.parts)),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md")),
]


def test_relative_links_lead_to_files() -> None:
    missing = []
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        local = {link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text)}
        # Generated pages exist after `make docs`, which refuses dead links to them.
        local = {link for link in local if link and "://" not in link and "_generated" not in link}
        missing += [(page, link) for link in local if not (page.parent / link).exists()]
    assert not missing
