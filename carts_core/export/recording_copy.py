"""Copies of a recording's files beside its rewritten tables; images and videos may be linked instead."""

from collections.abc import Collection
from pathlib import Path
from shutil import copyfileobj

from ..errors import SequenceError
from ..files import OutputPath, output_stream, write_link
from ..files.reading import VIDEO, is_regular, open_regular
from ..settings import Images


def below(folder: OutputPath, root: Path, file: Path) -> OutputPath:
    """Path of a recorded file in the copy of the recording."""
    for name in file.relative_to(root).parts:
        folder = folder / name
    return folder


def copy_files(
    root: Path, folder: OutputPath, images: Images, *, parts: Collection[str], media: Collection[str], skip: set[Path]
) -> None:
    """Copy files of a recording; hidden files are left out.

    Args:
        root: folder of the recording.
        folder: folder of the copy.
        images: whether the files in `media` are linked (`named`), copied, or left out (`none`).
        parts: files and folders in `root` to copy; those that do not exist are left out.
        media: folders of `parts` with images and videos.
        skip: files that are not copied.

    Raises:
        SequenceError: a file outside of `media` is a link that leaves the recording, since copies of data sets are
            often shared.
    """
    home = root.resolve()
    # The cache of the Hugging Face Hub consists of links from `snapshots/REVISION` to `blobs`.
    allowed = [home, *([home.parents[1] / "blobs"] if home.parent.name == "snapshots" else [])]
    for part in parts:
        found = [root / part] if (root / part).is_file() else sorted((root / part).rglob("*"))
        for file in found:
            hidden = any(name.startswith(".") for name in file.relative_to(root).parts)
            if hidden or file in skip or not is_regular(file):
                continue
            if part not in media and not any(file.resolve().is_relative_to(place) for place in allowed):
                raise SequenceError(
                    f"{file} is a link to a file outside of the recording, which is not copied. Replace it by a copy."
                )
            target = below(folder, root, file)
            if part not in media or images == "copied":
                with open_regular(file, VIDEO) as source, output_stream(target) as stream:
                    copyfileobj(source, stream)
            elif images == "named":
                write_link(target, file)
