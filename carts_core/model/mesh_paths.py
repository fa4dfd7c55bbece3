"""Where the mesh that a URDF names lies: beside the URDF, or inside a ROS package."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

from ..files.reading import is_regular

_PACKAGE_LEVELS = 6
"""How many folders above the URDF's own a ROS package is looked for in."""


def mesh_path(urdf_folder: Path, name: str) -> Path:
    """The file that a `<mesh filename=...>` means; it need not exist.

    `package://NAME/REST` is looked for as ROS lays packages out: `REST` inside the folder of the URDF or one above it
    (`NAME/urdf` beside `NAME/meshes`), or inside a folder `NAME` in one of these. `file://` and plain paths are taken
    as they are; relative ones belong to the URDF's folder.

    Args:
        urdf_folder: folder of the URDF, absolute.
        name: as the URDF has it.
    """
    scheme, mark, rest = name.partition("://")
    if not mark:
        return urdf_folder / name
    if scheme == "package":
        package, _, inside = rest.partition("/")
        folder = urdf_folder.resolve()
        for parent in (folder, *folder.parents[:_PACKAGE_LEVELS]):
            for candidate in (parent / inside, parent / package / inside):
                if is_regular(candidate):
                    return candidate
        return folder / inside
    return urdf_folder / (unquote(urlsplit(name).path) if scheme == "file" else rest)
