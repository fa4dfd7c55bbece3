"""Manifest of a batch: a TOML file with recordings, cameras, domains and steps."""

import glob
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

from ..errors import SettingsError
from ..files import resolved_paths, unique_file_names
from ..files.reading import SETTINGS, parse_toml, read_text
from ..wording import listed, shown

FORMAT = "carts-batch/1"
Step = Literal["import", "calibrate", "optimize", "sequence", "evaluate", "export"]
STEPS: tuple[Step, ...] = get_args(Step)
_KEYS = {"recordings", "cameras", "domains", "steps", "options"}


@dataclass(frozen=True)
class Job:
    """Steps for one recording in one domain, with one or all cameras."""

    name: str
    """Name of the job's folder, unique in the manifest."""
    recording: Path
    """Sequence file, or source of `carts import` if `import` is the first step."""
    camera: str
    """Name of a camera, or `all`."""
    domain: str
    """Name of a domain; empty for the first domain of the sequence."""
    steps: tuple[Step, ...]
    """Steps in order; each step uses the results of the previous steps."""
    options: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Step -> additional options of its command."""


def read_manifest(path: Path, output: Path | None = None) -> list[Job]:
    """Read the jobs of a manifest, in order.

    Args:
        path: path of the manifest.
        output: folder of the batch, if any; patterns do not match files in this folder.

    Raises:
        SettingsError: the manifest cannot be read or has an invalid key, step or value, or a pattern matches no file.
    """
    try:
        content = parse_toml(read_text(path, SETTINGS))
    except (OSError, ValueError) as error:
        raise SettingsError(f"manifest {path} cannot be read: {error}. Give a TOML file (docs: batch).") from error
    if content.get("format") != FORMAT:
        has = f"the format {shown(content['format'])}" if "format" in content else "no format"
        raise SettingsError(f"manifest {path} has {has}; write format = {FORMAT!r}.")
    tables = content.get("jobs")
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise SettingsError(f"manifest {path} has no [[jobs]]. Add at least one, with recordings and steps.")
    strangers = set(content) - {"format", "jobs"}
    if strangers:
        raise SettingsError(f"manifest {path} contains {listed(sorted(strangers))}; allowed: format and [[jobs]].")
    found = [
        job for number, table in enumerate(tables, 1) for job in _jobs(path, output, f"{path}, jobs {number}", table)
    ]
    names = unique_file_names([job.name for job in found])
    return [job if job.name == name else replace(job, name=name) for name, job in zip(names, found, strict=True)]


def _jobs(manifest: Path, output: Path | None, where: str, table: dict[str, Any]) -> Iterator[Job]:
    if strangers := set(table) - _KEYS:
        raise SettingsError(f"{where} contains {listed(sorted(strangers))}; allowed: {listed(sorted(_KEYS))}.")
    steps = _steps(where, _texts(where, table, "steps", None))
    options = _options(where, table.get("options", {}), steps)
    recordings = _recordings(manifest, output, where, _texts(where, table, "recordings", None))
    cameras, domains = _texts(where, table, "cameras", ("all",)), _texts(where, table, "domains", ("",))
    for recording, domain, camera in product(recordings, domains, cameras):
        yield Job(_name(recording, domain, camera), recording, camera, domain, steps, options)


def _texts(where: str, table: dict[str, Any], key: str, default: tuple[str, ...] | None) -> tuple[str, ...]:
    value = table.get(key, default)
    if isinstance(value, (list, tuple)) and value and all(isinstance(text, str) for text in value):
        return tuple(dict.fromkeys(value))
    raise SettingsError(f"{where}: {key} is {shown(value)}; give a list of at least one string.")


def _steps(where: str, given: tuple[str, ...]) -> tuple[Step, ...]:
    steps: tuple[Step, ...] = tuple(step for step in STEPS if step in given)
    if unknown := [step for step in given if step not in STEPS]:
        raise SettingsError(f"{where}: step {unknown[0]!r} is unknown; allowed: {', '.join(STEPS)}.")
    if steps != given:
        raise SettingsError(
            f"{where}: steps are {', '.join(given)}; write them in the order in which they run: {', '.join(steps)}."
        )
    return steps


def _options(where: str, given: Any, steps: tuple[Step, ...]) -> dict[str, tuple[str, ...]]:
    if not isinstance(given, dict):
        raise SettingsError(f"{where}: options is {shown(given)}; give a table with a list of strings per step.")
    if strangers := [name for name in given if name not in steps]:
        raise SettingsError(f"{where}: options are given for {strangers[0]!r}, but the steps are {', '.join(steps)}.")
    return {step: _texts(f"{where}, options", given, step, None) for step in given}


def _recordings(manifest: Path, output: Path | None, where: str, patterns: tuple[str, ...]) -> list[Path]:
    """Files and folders matched by patterns, sorted by name for each pattern."""
    folder, found = manifest.absolute().parent, []
    for pattern in patterns:
        matched = sorted(glob.glob(os.path.join(glob.escape(str(folder)), pattern), recursive=True))
        if output is not None and glob.has_magic(pattern):
            made = f"{output.resolve()}{os.sep}"
            real = resolved_paths(matched)
            matched = [
                path for path, place in zip(matched, real, strict=True) if not f"{place}{os.sep}".startswith(made)
            ]
        if not matched:
            raise SettingsError(f"{where}: recording {pattern!r} matches no file in {folder}. Correct or remove it.")
        found += map(Path, matched)
    return list(dict.fromkeys(found))


def _name(recording: Path, domain: str, camera: str) -> str:
    """Name of a job: recording, domain and camera, joined by hyphens.

    A recording is named by the folder of its `sequence.toml`, or by the stem of any other file.
    """
    stem = recording.parent.name if recording.name == "sequence.toml" else recording.stem
    return "-".join(part for part in (stem, domain, camera if camera != "all" else "") if part)


def shard(jobs: list[Job], text: str) -> list[Job]:
    """Shard `i/n` of the jobs: every n-th job, starting with the i-th (1 <= i <= n). Each job is in one shard."""
    first, _, count = text.partition("/")
    if not (first.isdecimal() and count.isdecimal() and 1 <= int(first) <= int(count)):
        raise SettingsError(f"--shard {text!r} is invalid. Give I/N with 1 <= I <= N, such as 2/8.")
    return jobs[int(first) - 1 :: int(count)]
