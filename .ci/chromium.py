"""Print the path of a Chromium for the browser tests; install it if necessary.

Candidates, in this order: $CARTS_CHROMIUM, an installed Chromium or Chrome, an earlier download of Playwright in
.browser, Debian's package (as root or with passwordless sudo), a download by Playwright. The last two need a network.

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
        - or give its path:             CARTS_CHROMIUM=/path/to/chromium make test
        - or leave these tests out:     .venv/bin/pytest -m "not browser and not slow and not gpu\""""


def installed() -> str | None:
    """Path of a Chromium that is installed and starts; None if there is none."""
    for candidate in (*map(shutil.which, NAMES), *MAC_APPS):
        if candidate and starts(candidate):
            return candidate
    return None


def starts(path: str) -> bool:
    """Whether a browser starts; Ubuntu's `chromium-browser` may be a stub for snap."""
    try:
        return subprocess.run([path, "--version"], capture_output=True, timeout=60, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def playwrights() -> str | None:
    """Path of the Chromium that Playwright has downloaded into .browser; None if there is none."""
    with sync_playwright() as playwright:
        path = playwright.chromium.executable_path
    return path if Path(path).is_file() and starts(path) else None


def install_debian_package() -> bool:
    """Install the package on Debian, not on Ubuntu, where it is a stub for snap; returns whether it was installed."""
    release = Path("/etc/os-release")
    is_debian = release.is_file() and "ID=debian" in release.read_text().splitlines()
    return is_debian and subprocess.run([ROOT / ".ci" / "apt", "chromium"], check=False).returncode == 0


def download() -> bool:
    """Download Playwright's build into the checkout; returns whether this succeeded."""
    print("[setup] downloading Chromium into .browser", file=sys.stderr)
    command = [sys.executable, "-m", "playwright", "install", "chromium"]
    return subprocess.run(command, stdout=sys.stderr, check=False).returncode == 0


def main() -> int:
    os.environ["PLAYWRIGHT_BROWSERS_PATH"] = str(ROOT / ".browser")
    named = os.environ.get("CARTS_CHROMIUM", "")
    if named and not starts(named):
        print(f"[setup] CARTS_CHROMIUM is {named}, which does not start; change or unset it", file=sys.stderr)
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
