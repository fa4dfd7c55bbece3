"""Steps of the Dockerfile that can be run without Docker."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import sysconfig
import urllib.error
import urllib.request
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def steps() -> list[tuple[str, str]]:
    """Instruction and arguments of every step, continued lines joined."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1]) for line in lines]


def arguments_of(instruction: str) -> list[str]:
    return [arguments for name, arguments in steps() if name == instruction]


def command() -> list[str]:
    """Command of the container."""
    (arguments,) = arguments_of("CMD")
    return [part.strip().strip('"') for part in arguments.strip("[]").split(",")]


def test_it_opens_one_port_as_a_user_without_rights_with_a_volume() -> None:
    assert arguments_of("EXPOSE") == ["8080"] and command()[-2:] == ["--port", "8080"]
    assert arguments_of("USER") == ["carts"] and steps()[-1][0] == "CMD"
    (volume,) = arguments_of("VOLUME")
    variables = dict(word.split("=", 1) for line in arguments_of("ENV") for word in line.split())
    for name in ("CARTS_DATA", "CARTS_CACHE", "NUMBA_CACHE_DIR"):
        assert variables[name].startswith(volume)


def test_everything_that_is_copied_exists_and_is_sent_to_docker() -> None:
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {source for line in arguments_of("COPY") for source in line.split()[:-1]}
    assert copied == sent and all((ROOT / source).exists() for source in copied)


def test_what_is_installed_is_pinned_and_torch_is_the_build_without_cuda() -> None:
    installs = [line for line in arguments_of("RUN") if line.startswith("pip ")]
    packages, torch, ours = installs
    assert "--require-hashes -r requirements.lock" in packages and all("--no-deps" in line for line in installs)
    assert "https://download.pytorch.org/whl/cpu" in torch and torch.endswith("-c constraints.txt torch")
    assert ours.endswith("--no-build-isolation .")


def test_the_image_it_builds_on_is_named_by_its_digest() -> None:
    (image,) = arguments_of("FROM")
    assert re.fullmatch(r"python:3\.\d+-slim@sha256:[0-9a-f]{64}", image)


def follow(folder: Path, environment: dict[str, str], variables: Path) -> None:
    """Run the steps in `folder` instead of an image, as the current user."""
    (folder / "image").mkdir()
    for instruction, arguments in steps():
        if instruction == "COPY":
            *sources, target = arguments.split()
            for source in sources:
                place = folder / "image" / (source if target == "./" else target)
                copy = shutil.copytree if (ROOT / source).is_dir() else shutil.copy
                copy(ROOT / source, place)
        elif instruction == "ENV":
            pairs = (word.split("=", 1) for word in arguments.split())
            environment |= {name: re.sub(r"^/data", str(variables), value) for name, value in pairs}
        elif instruction == "RUN" and arguments.startswith("pip "):
            subprocess.run(shlex.split(arguments), cwd=folder / "image", env=environment, check=True, timeout=600)


def status(address: str) -> int:
    try:
        with urllib.request.urlopen(address, timeout=60) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_its_steps_install_a_command_that_starts_and_asks_for_the_token(tmp_path: Path) -> None:
    """Use the packages of the current environment, to avoid large downloads."""
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True, timeout=120)
    # Python before 3.12 puts an old setuptools there, which would hide the one that torch needs.
    subprocess.run([tmp_path / "venv" / "bin" / "pip", "uninstall", "-qy", "setuptools"], check=True, timeout=120)
    (site_packages,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "CARTS_", "XDG_"))}
    environment = kept | {"PATH": f"{tmp_path / 'venv' / 'bin'}:{os.environ['PATH']}", "HOME": str(tmp_path)}
    data = tmp_path / "data"
    data.mkdir()
    follow(tmp_path, environment, data)

    program = tmp_path / "venv" / "bin" / "carts"
    assert str(tmp_path) in program.read_text().splitlines()[0]
    # As the container does, which shows the start page; and with a recording, whose project is kept in the volume.
    _start_and_stop([program, *command()[1:-1], "0"], data, environment)
    (sample,) = site_packages.rglob("sample_data/sequence/sequence.toml")
    _start_and_stop([program, *command()[1:-1], "0", sample], data, environment)
    assert list(data.rglob("*.carts"))


def _start_and_stop(arguments: list[str | Path], data: Path, environment: dict[str, str]) -> None:
    with subprocess.Popen(arguments, cwd=data, env=environment, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        lines = (line for line in server.stdout if "http://" in line)
        (address,) = re.findall(r"http://\S+", next(lines))
        port = re.findall(r":(\d+)/", address)[0]
        token = address.partition("?token=")[2]
        assert len(token) > 20
        assert status(f"http://127.0.0.1:{port}/") == 403
        assert status(f"http://127.0.0.1:{port}/?token={token}") == 200
        server.send_signal(signal.SIGINT)
        assert server.wait(60) in (0, 130)
