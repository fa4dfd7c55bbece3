"""Write the pictures of the examples; each example draws its own.

make pictures
"""

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images" / "examples"


def main(names: list[str]) -> None:
    """Run the examples whose file names begin with one of `names`, or all, and write docs/images/examples/NAME.jpg."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    for path in sorted((ROOT / "examples").glob("[0-9]*.py")):
        if names and not path.name.startswith(tuple(names)):
            continue
        picture = IMAGES / f"{path.stem}.jpg"
        with tempfile.TemporaryDirectory(prefix="carts_") as folder:
            subprocess.run([sys.executable, str(path), "--picture", str(picture)], cwd=folder, check=True)
        print(f"{picture.name}: {picture.stat().st_size // 1024} KiB", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
