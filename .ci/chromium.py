"""Print the path of a Chromium for the browser tests; get one where there is none.

In this order: $CARTS_CHROMIUM, a Chromium or Chrome that is installed, one that Playwright put into .browser earlier,
Debian's package (as root or with a sudo that asks nothing), Playwright's download. Only the last two need a network.

Run by the environment's Python, which has Playwright: .venv/bin/python .ci/chromium.py
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parent.parent
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
MAC_APPS = (
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
)
HELP = """[setup] The browser tests need Chromium or Chrome, and none was found or could be installed. Either
        - install one:                  sudo apt-get install chromium
        - or name one:                  CARTS_CHROMIUM=/path/to/chromium make test
        - or leave these tests out:     .venv/bin/pytest -m "not browser and not slow and not gpu\""""


def installed() -> str | None:
    """A Chromium that the system already has and that starts."""
    for candidate in (*map(shutil.which, NAMES), *MAC_APPS):
        if candidate and starts(candidate):
            return candidate
    return None


def starts(path: str) -> bool:
    """Ubuntu's `chromium-browser` may be a stub that only asks for snap, so being there is not enough."""
    try:
        return subprocess.run([path, "--version"], capture_output=True, timeout=60, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def playwrights() -> str | None:
    """The Chromium that Playwright downloaded into .browser, if it did."""
    with sync_playwright() as playwright:
        path = playwright.chromium.executable_path
    return path if Path(path).is_file() and starts(path) else None


def install_debian_package() -> bool:
    """Only on Debian itself: the package of that name on Ubuntu is a stub for snap."""
    release = Path("/etc/os-release")
    is_debian = release.is_file() and "ID=debian" in release.read_text().splitlines()
    return is_debian and subprocess.run([ROOT / ".ci" / "apt", "chromium"], check=False).returncode == 0


def download() -> bool:
    """Playwright's own build, into the checkout and not into the home directory."""
    print("[setup] downloading Chromium into .browser", file=sys.stderr)
    command = [sys.executable, "-m", "playwright", "install", "chromium"]
    return subprocess.run(command, stdout=sys.stderr, check=False).returncode == 0


def main() -> int:
    os.environ["PLAYWRIGHT_BROWSERS_PATH"] = str(ROOT / ".browser")
    named = os.environ.get("CARTS_CHROMIUM", "")
    if named and not starts(named):
        print(f"[setup] CARTS_CHROMIUM is {named}, which does not start; name a Chromium or unset it", file=sys.stderr)
        return 1
    path = named or installed() or playwrights()
    if not path and install_debian_package():
        path = installed()
    if not path and download():
        path = playwrights()
    print(path or HELP, file=sys.stdout if path else sys.stderr)
    return 0 if path else 1


if __name__ == "__main__":
    sys.exit(main())
