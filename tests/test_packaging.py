"""Installation: the wheel is complete and works outside of the checkout, and its metadata are consistent."""

import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path, PurePosixPath

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SHIPPED = ("static", "sample_data")

_DATA_FILTER: dict = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
"""Python before 3.11.4 cannot filter archives; this one is our own."""


def _run(*command: str | Path, cwd: Path) -> str:
    finished = subprocess.run(
        [str(part) for part in command], cwd=cwd, capture_output=True, text=True, check=False, timeout=240
    )
    assert finished.returncode == 0, f"{command} failed:\n{finished.stdout}\n{finished.stderr}"
    return finished.stdout


def _build(target: str, source: Path, destination: Path) -> Path:
    """Build a distribution from a source tree, with the hatchling that is installed and so without a network."""
    _run(sys.executable, "-m", "hatchling", "build", "-t", target, "-d", destination, cwd=source)
    (built,) = destination.iterdir()
    return built


def _shipped_files() -> set[PurePosixPath]:
    """Every file of the checkout that belongs into the wheel, by its path in the checkout."""
    files = (path for name in SHIPPED for path in (ROOT / name).rglob("*") if path.is_file())
    return {PurePosixPath(path.relative_to(ROOT)) for path in files if path.name != ".DS_Store"}


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _build("sdist", ROOT, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _build("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh virtual environment with the wheel in it, which reads the dependencies from the present one.

    A line in a .pth file adds a folder without obeying the .pth files in it, so the editable checkout stays unseen.
    """
    folder = tmp_path_factory.mktemp("fresh") / "venv"
    _run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
    site_packages = Path(
        _run(_python(folder), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip()
    )
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    pip = (sys.executable, "-m", "pip", "--python", _python(folder), "install", "--no-index", "--no-deps")
    _run(*pip, "--ignore-installed", "--disable-pip-version-check", wheel, cwd=folder.parent)
    return folder


def _python(environment: Path) -> Path:
    return environment / "bin" / "python"


def test_the_wheel_holds_every_shipped_file(wheel: Path) -> None:
    inside = set(zipfile.ZipFile(wheel).namelist())
    shipped = _shipped_files()
    assert shipped
    missing = {str(path) for path in shipped if f"carts_core/{path}" not in inside}
    assert not missing


def test_the_wheel_holds_both_packages_typed_and_the_licence_but_no_tests(wheel: Path) -> None:
    inside = set(zipfile.ZipFile(wheel).namelist())
    assert {"carts_core/py.typed", "carts_core/cli/command_line.py", "carts_viewer/app.py"} <= inside
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in inside)
    assert {PurePosixPath(name).parts[0] for name in inside if ".dist-info/" not in name} == {
        "carts_core",
        "carts_viewer",
    }
    assert not [name for name in inside if "__pycache__" in name]


def test_the_sdist_builds_the_same_wheel(sdist: Path, wheel: Path, tmp_path: Path) -> None:
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, **_DATA_FILTER)
    (source,) = tmp_path.iterdir()
    (tmp_path / "wheel").mkdir()
    rebuilt = _build("wheel", source, tmp_path / "wheel")
    assert set(zipfile.ZipFile(rebuilt).namelist()) == set(zipfile.ZipFile(wheel).namelist())


def test_what_is_shipped_stays_small() -> None:
    megabyte = 1_000_000
    sizes = {path: (ROOT / path).stat().st_size for path in _shipped_files()}
    assert sum(size for path, size in sizes.items() if path.parts[0] == "sample_data") <= 15 * megabyte
    assert sum(size for path, size in sizes.items() if path.suffix == ".safetensors") <= 10 * megabyte


def test_the_installed_command_describes_itself(environment: Path, tmp_path: Path) -> None:
    printed = _run(environment / "bin" / "carts", "--help", cwd=tmp_path)
    for command in ("view", "optimize", "evaluate", "render", "export", "synthesize", "train"):
        assert command in printed


def test_the_installed_wheel_opens_its_own_sample_and_weights(environment: Path, tmp_path: Path) -> None:
    program = """
from pathlib import Path
import carts_core, carts_viewer
from carts_core.recording import Sequence
from carts_core.networks import FeatureExtractor
from carts_core.resources import sample_sequence, shipped_robot, shipped_weights, static_dir

sequence = Sequence.open(sample_sequence())
frame = sequence.frame(0)
FeatureExtractor.load()
assert len(sequence) > 0 and frame.images
modules = (carts_core.__file__, carts_viewer.__file__)
for path in (*modules, sample_sequence(), shipped_robot(), *shipped_weights(), static_dir()):
    assert Path(path).exists(), path
    print("PATH", path)
"""
    printed = _run(_python(environment), "-c", program, cwd=tmp_path).splitlines()
    paths = [Path(line.removeprefix("PATH ")) for line in printed if line.startswith("PATH ")]
    assert len(paths) == 7
    assert [path for path in paths if not path.is_relative_to(environment)] == []


def test_the_command_starts_without_the_extras(environment: Path, tmp_path: Path) -> None:
    """`make view` installs no extras, so the start must not require their packages."""
    hidden = [name for names in PROJECT["optional-dependencies"].values() for name in names]
    modules = {Requirement(name).name.replace("-", "_") for name in hidden} - {PROJECT["name"], "packaging"}
    program = f"""
import sys
sys.modules.update(dict.fromkeys({sorted(modules)!r}))
sys.argv = ["carts", "--help"]
from carts_core.cli import main
main()
"""
    assert "view" in _run(_python(environment), "-c", program, cwd=tmp_path)


def _pins(name: str) -> dict[str, str]:
    """Versions that a file pins, by the names of packages."""
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    named = (line.partition(";")[0].rstrip(" \\").split("==") for line in lines if re.match(r"[\w-]", line))
    return {canonicalize_name(package): version.strip() for package, version in named}


def test_every_direct_dependency_is_pinned_within_its_bounds() -> None:
    pins = _pins("constraints.txt")
    extras = (requirement for extra in PROJECT["optional-dependencies"].values() for requirement in extra)
    for text in (*PROJECT["dependencies"], *extras):
        requirement = Requirement(text)
        if requirement.name != PROJECT["name"]:
            assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), text


@pytest.mark.parametrize("extra", ["", "dev"])
def test_what_is_installed_is_pinned_by_hashes_but_for_torch(extra: str) -> None:
    """Fails for an outdated lock file; run `make lock`."""
    name = f"requirements-{extra}.lock" if extra else "requirements.lock"
    groups = PROJECT["optional-dependencies"]
    needed = [*PROJECT["dependencies"], *((text for group in groups.values() for text in group) if extra else ())]
    names = {canonicalize_name(Requirement(text).name) for text in needed} - {PROJECT["name"], "torch"}
    pins, locked = _pins("constraints.txt"), _pins(name)
    assert {package: locked.get(package) for package in names} == {package: pins[package] for package in names}
    assert "hatchling" in locked and "torch" not in locked
    entries = re.split(r"\n(?=\S)", (ROOT / name).read_text(encoding="utf-8").strip())
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", entry) for entry in entries)


def test_the_version_is_the_same_wherever_it_is_written() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.findall(r"^## \[(\d[^\]]*)\]", changelog, flags=re.MULTILINE)
    assert str(citation["version"]) == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]
    assert not released or released[0] == PROJECT["version"]
