"""Frame numbers in the names of annotated images."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping

from ...errors import SequenceError

_DIGITS = re.compile(r"\d+")
_LONGEST = 18
"""Number of digits from which a number is not compared by value."""
_PADDED = 4
"""Minimum length of an id that other numbers in a name do not equal by chance."""
_LAST = -1


class FrameNumbers:
    """Finds the frame number among the numbers in the names of a camera's images.

    It is the last number, unless that repeats in different names or is shorter than an exact frame id in the name, as
    the number of an instance is in `frame_000012_mask0`.

    Args:
        ids: frame id -> index.
    """

    def __init__(self, ids: Mapping[str, int]) -> None:
        self._ids = ids
        self._values = {int(name): index for name, index in ids.items() if name.isdecimal()}
        self._lengths = {len(name) for name in ids}
        self._places: dict[str, int] = {}

    def learn(self, names: Iterable[str], remarks: Counter[str]) -> None:
        """Choose the number of each pattern of names (without folder and suffix) from all of them.

        Raises:
            SequenceError: two numbers may be that of the frame.
        """
        patterns: dict[str, dict[str, list[str]]] = {}
        for name in filter(_DIGITS.search, names):
            patterns.setdefault(_DIGITS.sub("#", name), {})[name] = _DIGITS.findall(name)
        for pattern, rows in patterns.items():
            place = self._places[pattern] = self._chosen(rows)
            example, numbers = next(iter(rows.items()))
            if place != _LAST:
                remarks[f"the frame number is {numbers[place]} in names such as {example}"] += 1
            elif len(patterns) == len(rows) == 1 and self._is_doubtful(numbers):
                remarks[f"the last number of {example}, {numbers[_LAST]}, is taken as its frame number"] += 1

    def find(self, name: str) -> int | None:
        """Index of the frame whose id is a name, or the number in it; None without such a frame."""
        return self._ids[name] if name in self._ids else self._index(self._text(name))

    def begin_at_one(self, names: Iterable[str]) -> bool:
        """Whether images of frames that begin at 0 seem to be numbered from 1: none has the number 0, and one has 1
        or the number after the last frame."""
        found = {int(text) for text in map(self._text, names) if 0 < len(text) < _LONGEST}
        frames = self._values.keys()
        return 0 in frames and bool(found) and 0 not in found and (1 in found or max(frames) + 1 in found)

    def _text(self, name: str) -> str:
        """Frame number in a name; empty without a number."""
        numbers = _DIGITS.findall(name)
        if not numbers:
            return ""
        place = self._places.get(_DIGITS.sub("#", name))
        return numbers[self._chosen({name: numbers}) if place is None else place]

    def _index(self, text: str) -> int | None:
        by_value = self._values.get(int(text)) if 0 < len(text) < _LONGEST else None
        return self._ids.get(text, by_value)

    def _chosen(self, rows: Mapping[str, list[str]]) -> int:
        """Place of the frame number, counted from the last number."""
        columns = [*zip(*rows.values(), strict=True)]
        *others, last = range(-len(columns), 0)
        if not others:
            return last
        exact = {place for place in (*others, last) if self._has_ids(columns[place])}
        longest = max(map(len, columns[last]))
        padded = [place for place in others if place in exact and longest < min(map(len, columns[place])) >= _PADDED]
        if padded and last not in exact:
            return padded[-1]
        counts = {place: len(set(columns[place])) for place in (*others, last)}
        if counts[last] == len(rows):
            return last
        varying = [place for place in (*others, last) if counts[place] > 1]
        possible = [*varying, last] if last in exact and last not in varying else varying
        known = [place for place in possible if any(self._index(text) is not None for text in columns[place])]
        ranks = {place: (place in exact, counts[place]) for place in known or varying}
        best = [place for place, rank in ranks.items() if rank == max(ranks.values())]
        if len(best) > 1:
            first, second = list(rows)[:2]
            raise SequenceError(
                f"which number in {first}, {second} ... is that of the frame is ambiguous. Name the images after their "
                f"frames, such as {next(iter(self._ids))}."
            )
        return best[0]

    def _has_ids(self, column: Iterable[str]) -> bool:
        """Whether numbers have the lengths of ids, and some are ids."""
        return all(len(text) in self._lengths for text in column) and any(text in self._ids for text in column)

    def _is_doubtful(self, numbers: list[str]) -> bool:
        *others, last = numbers
        return last not in self._ids and any(self._index(text) is not None for text in others)
