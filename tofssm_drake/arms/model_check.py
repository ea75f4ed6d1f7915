"""Checks the meshes that a model names, before Drake's readers see them.

Drake's readers end the process on some broken meshes, and its viewers load
whatever a glTF file refers to. So what a URDF, SDF, MJCF or model directives
name is found in their text and read here first.
"""

from collections.abc import Iterator
from pathlib import Path
import re

from pydrake.geometry import Mesh
from pydrake.multibody.parsing import PackageMap

from tofssm_drake.errors import UserError
from tofssm_drake.raycast.triangle_mesh import check_mesh_file
from tofssm_drake.user_files import MEGABYTE, read_file

_LARGEST_MODEL = 20 * MEGABYTE
_MESHES = (".obj", ".gltf", ".vtk")
_NAMED = re.compile(
    r"""[^\s"'<>=(){}\[\],]+\.(?:obj|gltf|vtk|urdf|sdf|xml|dmd\.yaml)\b""",
    re.IGNORECASE,
)
_MESH_FOLDER = re.compile(r"""meshdir\s*=\s*["']([^"']*)["']""")


def check_model(path: Path, packages: PackageMap, where: str) -> None:
    """Checks the meshes of a model, and of the models that it names.

    What cannot be found is left to the parser.

    Args:
        path: The model.
        packages: Where package:// URLs lead.
        where: What the user calls the model, for the message.

    Raises:
        UserError: A mesh is broken, or the model is not a file of text.
    """
    pending, seen = [path.resolve()], set()
    while pending:
        path = pending.pop()
        if path in seen:
            continue
        seen.add(path)
        if path.suffix.lower() not in _MESHES:
            pending.extend(_find_named(path, packages, where))
            continue
        try:
            check_mesh_file(Mesh(str(path)))
        except ValueError as error:
            raise UserError(f"{where}: mesh {path}: {error}") from None


def _find_named(path, packages, where) -> Iterator[Path]:
    """Yields the files that a model names and that there are."""
    try:
        text = read_file(path, most=_LARGEST_MODEL).decode(errors="replace")
    except OSError as error:
        raise UserError(f"{where}: {path}: {error.strerror}") from None
    folders = [path.parent]
    folders += [path.parent / name for name in _MESH_FOLDER.findall(text)]
    for name in dict.fromkeys(_NAMED.findall(text)):
        found = _resolve(name, folders, packages)
        if found is not None:
            yield found.resolve()


def _resolve(name, folders, packages):
    """Returns the path of what a model names; None: there is none."""
    for prefix in ("package://", "model://"):
        if name.startswith(prefix):
            package, _, rest = name.removeprefix(prefix).partition("/")
            if not packages.Contains(package):
                return None
            path = Path(packages.GetPath(package)) / rest
            return path if path.exists() else None
    name = name.removeprefix("file://")
    for folder in folders:
        if (folder / name).exists():
            return folder / name
    return None
