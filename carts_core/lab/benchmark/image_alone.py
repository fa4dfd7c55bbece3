"""Networks that see an image and no kinematics, against the default solver: who wins in which domain, by how much."""

from dataclasses import dataclass
from statistics import mean

from ...html import Cell, Table
from ...settings import DOMAINS
from ...wording import counted
from .methods import METHODS
from .statistics import Measurements
from .tables import DOMAIN_LABELS
from .target import Target, make_target

_SHIFTED = tuple(domain for domain in DOMAINS if domain != "regular")
"""Domains that differ from what networks are trained on."""
_AHEAD = 5.0
"""Dice points by which ours is to be ahead in the worst of them."""


@dataclass(frozen=True)
class _Row:
    """A method on one source's frames, those that ours was evaluated on, too."""

    method: str
    dice: dict[str, float]
    """Domain -> mean Dice in percent."""
    frames: int

    @property
    def worst(self) -> str:
        """The shifted domain in which it is worst."""
        return min((domain for domain in _SHIFTED if domain in self.dice), key=lambda domain: self.dice[domain])

    def in_words(self) -> str:
        """Its worst shifted domain, for people."""
        return f"{self.dice[self.worst]:.1f} ({METHODS[self.method].label}, {DOMAIN_LABELS[self.worst]})"


def image_alone_table(data: Measurements) -> Table | None:
    """For each domain the best network that sees the image alone, and ours."""
    rows = []
    for source in data.sources():
        ours, *others = _rows(data, source)
        for domain in DOMAINS:
            known = [row for row in others if domain in row.dice]
            if not known or domain not in ours.dice:
                continue
            best = max(known, key=lambda row: row.dice[domain])
            ahead = ours.dice[domain] - best.dice[domain]
            wins = "neither" if round(ahead, 1) == 0 else "ours" if ahead > 0 else METHODS[best.method].label
            cells = (source, DOMAIN_LABELS[domain], METHODS[best.method].label)
            figures = (f"{best.dice[domain]:.1f}", f"{ours.dice[domain]:.1f}", f"{wins}, by {abs(ahead):.1f}")
            rows.append((*map(Cell, cells), *map(Cell, figures)))
    header = ("frames", "domain", "best network that sees the image alone", "its Dice", "ours", "who wins")
    caption = (
        "Networks that see the image and no kinematics, the best one of each domain, and the default solver from the "
        "measured kinematics. Mean Dice in percent over the same frames."
    )
    return Table("Networks that see the image alone", caption, header, tuple(rows)) if rows else None


def image_alone_targets(data: Measurements) -> list[Target]:
    """How far ours is ahead in the worst domain that networks are not trained on, for each source."""
    found = []
    for source in data.sources():
        ours, *others = _rows(data, source)
        others = [row for row in others if set(row.dice) & set(_SHIFTED)]
        known = bool(others) and bool(set(ours.dice) & set(_SHIFTED))
        best = max(others, key=lambda row: row.dice[row.worst]) if known else None
        found.append(
            make_target(
                f"{source} frames: ahead of the best network that sees the image alone, worst shifted domain of each",
                _AHEAD,
                None if best is None else ours.dice[ours.worst] - best.dice[best.worst],
                "no runs of both"
                if best is None
                else f"{ours.in_words()} against {best.in_words()}; {counted(best.frames, 'frame')}, "
                f"{counted(len(others), 'network')}",
                at_least=True,
                text=lambda value: f"{value:.1f} Dice points",
                reference="paper: 76.5 to 96.6",
                complete=best is not None and all(set(_SHIFTED) <= set(row.dice) for row in (ours, best)),
            )
        )
    return found


def _rows(data: Measurements, source: str) -> list[_Row]:
    """Ours, then the networks that were measured."""
    methods = ["ours", *(name for name, method in METHODS.items() if method.image_alone)]
    runs = {name: data.of(source=source, method=name, error_deg=None) for name in methods}
    ours = {(m.run.domain, m.run.frame) for m in runs["ours"]}
    seen = [m for name in methods[1:] for m in runs[name]]
    common = ours & {(m.run.domain, m.run.frame) for m in seen}
    rows = []
    for name in methods:
        by_domain: dict[str, list[float]] = {}
        for m in runs[name]:
            if (m.run.domain, m.run.frame) in common:
                by_domain.setdefault(m.run.domain, []).append(100.0 * m.final.dice)
        if by_domain or name == "ours":
            frames = len({frame for _, frame in common})
            rows.append(_Row(name, {domain: mean(values) for domain, values in by_domain.items()}, frames))
    return rows
