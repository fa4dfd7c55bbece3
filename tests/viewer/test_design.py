"""Design tokens: contrast of text in both themes."""

import re

import pytest

from carts_core.resources import static_dir

_TOKEN = re.compile(r"--carts-([\w-]+): (?:light-dark\((#\w{6}), (#\w{6})\)|(#\w{6}));")
_SURFACES = ("page", "card", "raised", "hover", "inset")
_TEXTS = [(text, surface) for text in ("text", "strong", "dim", "accent") for surface in _SURFACES]
_TEXTS += [(state, surface) for state in ("good", "doubtful", "failed", "running") for surface in ("page", "card")]
_TEXTS += [(state, f"{state}-soft") for state in ("good", "doubtful", "failed", "running")]
_TEXTS += [("text", f"{state}-soft") for state in ("accent", "good", "doubtful", "failed", "running")]
_TEXTS += [("accent", "accent-soft"), ("on-accent", "accent-fill"), ("on-accent", "accent-hover")]


def _colors(theme: int) -> dict[str, str]:
    css = (static_dir() / "tokens.css").read_text(encoding="utf-8")
    return {name: both or (light, dark)[theme] for name, light, dark, both in _TOKEN.findall(css)}


def _contrast(one: str, other: str) -> float:
    """Contrast ratio of WCAG 2.2."""

    def luminance(color: str) -> float:
        shares = [int(color[at : at + 2], 16) / 255 for at in (1, 3, 5)]
        linear = [share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
def test_texts_have_the_contrast_of_wcag_aa_on_their_backgrounds(theme: int) -> None:
    colors = _colors(theme)
    weak = {
        (text, surface): round(ratio, 2)
        for text, surface in _TEXTS
        if (ratio := _contrast(colors[text], colors[surface])) < 4.5
    }
    assert not weak


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
def test_edges_of_controls_have_the_contrast_of_wcag_aa(theme: int) -> None:
    colors = _colors(theme)
    for surface in ("page", "card", "raised"):
        assert _contrast(colors["edge"], colors[surface]) >= 3.0, surface
