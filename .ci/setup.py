"""Create .venv and install the project into it; a stamp file marks a finished installation, which is not repeated.

Usage: python3 .ci/setup.py [--dev]

Only the standard library is used, and the syntax is valid in any Python 3, so that an old interpreter causes a clear
message instead of a syntax error.

TORCH_INDEX selects the package index of torch: a URL, or `pypi`. By default, the CPU build from PyTorch's index is
installed on Linux without an NVIDIA driver, since the build on PyPI requires gigabytes of CUDA libraries. All other
packages are those of requirements.lock (--dev: requirements-dev.lock), whose hashes pip verifies.
"""

import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
VENV_PYTHON = VENV / "bin" / "python"
OLDEST = (3, 11)
TORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"
TORCH_INDEX = os.environ.get("TORCH_INDEX", "")
LOCKS = {"": "requirements.lock", "dev": "requirements-dev.lock"}
WARMUP = "carts_core.rendering.warmup"


def say(text):
    print("[setup] " + text, flush=True)


def run(*command):
    """Run a command; exit without a traceback if it fails."""
    status = subprocess.call([str(part) for part in command], cwd=str(ROOT))
    if status != 0:
        sys.exit("[setup] failed (exit status {}): {}".format(status, " ".join(str(part) for part in command)))


def output(*command):
    """Output of a command; None if it fails."""
    try:
        return subprocess.check_output([str(part) for part in command], stderr=subprocess.DEVNULL).decode().strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def require_a_recent_python():
    """Restart with a newer interpreter on the PATH if this one is too old."""
    if sys.version_info >= OLDEST:
        return
    for name in ("python3.13", "python3.12", "python3.11", "python3.14"):
        newer = shutil.which(name)
        if newer:
            say("{} is Python {}; using {}".format(sys.executable, platform.python_version(), newer))
            os.execv(newer, [newer] + sys.argv)
    sys.exit(
        "[setup] Python {} was found at {}, but CaRTS needs {}.{} or newer. Install it and run, for example:\n"
        "        make view PYTHON=python3.12".format(platform.python_version(), sys.executable, *OLDEST)
    )


def create_venv():
    """Create .venv, or recreate it if its interpreter is missing or too old, as after a system upgrade."""
    version = output(VENV_PYTHON, "-c", "import sys; print(*sys.version_info[:2])")
    if version is not None and tuple(int(part) for part in version.split()) >= OLDEST:
        return
    say("creating {} with Python {}".format(VENV, platform.python_version()))
    if output(sys.executable, "-c", "import ensurepip") is None:
        # Debian and Ubuntu have a separate package for venv.
        package = "python{}.{}-venv".format(*sys.version_info[:2])
        if subprocess.call([str(ROOT / ".ci" / "apt"), package]) != 0:
            sys.exit("[setup] this Python cannot create virtual environments; run: sudo apt-get install " + package)
    run(sys.executable, "-m", "venv", "--clear", VENV)


def stamp(extras):
    """File that marks a finished installation of these packages by this interpreter in this folder."""
    digest = hashlib.sha256()
    for name in ("pyproject.toml", "constraints.txt", LOCKS[extras]):
        digest.update((ROOT / name).read_bytes())
    digest.update(str(output(VENV_PYTHON, "-VV")).encode())
    digest.update(str(ROOT).encode())
    return VENV / ".installed-{}-{}".format(extras or "base", digest.hexdigest()[:16])


def is_installed(stamp_file):
    """Whether the installation is finished and, if an index was requested, used that index."""
    return stamp_file.exists() and TORCH_INDEX in ("", stamp_file.read_text())


def torch_index():
    """Package index of torch; None for pip's default."""
    if TORCH_INDEX:
        return None if TORCH_INDEX == "pypi" else TORCH_INDEX
    has_nvidia = Path("/proc/driver/nvidia").exists() or shutil.which("nvidia-smi")
    if sys.platform != "linux" or has_nvidia:
        return None
    try:
        # Checked first, since pip retries an unreachable index for minutes.
        urllib.request.urlopen(TORCH_CPU_INDEX + "/torch/", timeout=5).close()
    except (OSError, ValueError):
        say("{} cannot be reached; torch comes from pip's default index".format(TORCH_CPU_INDEX))
        return None
    return TORCH_CPU_INDEX


def announce(pip, index):
    """Print before the download whether torch's build is for CPUs or for CUDA, according to the package's metadata."""
    chosen = output(
        *pip, "--dry-run", "--quiet", "--no-deps", "--ignore-installed", "--report", "-",
        "-c", "constraints.txt", *(("--index-url", index) if index else ()), "torch",
    )  # fmt: skip
    try:
        wheel = json.loads(chosen or "")["install"][0]["metadata"]
    except (ValueError, LookupError):
        say("the build of torch is unknown; the build for CUDA downloads 2.7 GB")
        return
    with_cuda = sys.platform == "linux" and any("nvidia" in needed for needed in wheel.get("requires_dist", ()))
    build = "for CUDA, a download of 2.7 GB" if with_cuda else "for CPUs, a download of 0.2 GB"
    say("torch {} is the build {}".format(wheel["version"], build))
    if with_cuda:
        say("for the build for CPUs, stop with Ctrl-C and set TORCH_INDEX={}".format(TORCH_CPU_INDEX))


def install(extras):
    pip = (VENV_PYTHON, "-m", "pip", "install", "--disable-pip-version-check", "--no-input")
    index = torch_index()
    announce(pip, index)
    # All packages except torch, pinned by hash; the list is complete, so dependencies are not resolved.
    run(*pip, "--no-deps", "--require-hashes", "-r", LOCKS[extras])
    pinned = (*pip, "-c", "constraints.txt")
    if index is not None or TORCH_INDEX:
        # Builds differ only in the local version (after +), which pip does not compare.
        anew = ("--force-reinstall",) if TORCH_INDEX else ()
        say("torch comes from {}".format(index or "pip's default index"))
        run(*pinned, "--no-deps", *anew, *(("--index-url", index) if index else ()), "torch")
    run(*pinned, "torch")
    run(*pip, "--no-deps", "--no-build-isolation", *(("-e", ".") if extras else (".",)))
    if (ROOT / (WARMUP.replace(".", "/") + ".py")).is_file():
        say("compiling the kernels")
        run(VENV_PYTHON, "-m", WARMUP)


def main():
    if sys.argv[1:] not in ([], ["--dev"]):
        sys.exit(__doc__)
    extras = "dev" if "--dev" in sys.argv else ""
    require_a_recent_python()
    create_venv()
    # The development installation includes all other packages.
    if is_installed(stamp("dev")) or is_installed(stamp(extras)):
        return
    say("installing CaRTS into {} (some minutes and about 2 GB, only this once)".format(VENV))
    install(extras)
    stamp(extras).write_text(TORCH_INDEX)
    say("installed")


if __name__ == "__main__":
    main()
