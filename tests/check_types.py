"""Checks the types of everything that is installed, with mypy.

diagrams/, models/ and scripts/ are folders of their own that are installed
into the package. mypy cannot be told so. It is given a folder of links that
looks like the installed package.
"""

from pathlib import Path
import sys
import tomllib

from mypy import api

ROOT = Path(__file__).parents[1]
_LINKS = ROOT / "build" / "types"


def find_folders() -> dict[str, str]:
    """Returns the folder in the repository by package: pyproject.toml's."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    return project["tool"]["setuptools"]["package-dir"]


def link(source: Path, target: Path) -> None:
    """Makes or mends one link; another process may do the same."""
    if target.is_symlink() and target.readlink() == source:
        return
    target.unlink(missing_ok=True)
    target.symlink_to(source)


def link_package() -> None:
    """Lays out the sources as they are installed."""
    package = _LINKS / "tofssm_drake"
    package.mkdir(parents=True, exist_ok=True)
    wanted = {
        path.name: path
        for path in (ROOT / "tofssm_drake").iterdir()
        if path.name != "__pycache__"
    }
    for name, folder in find_folders().items():
        if "." in name:
            wanted[name.rpartition(".")[2]] = ROOT / folder
    for name, source in wanted.items():
        link(source, package / name)
    for path in package.iterdir():
        if path.name not in wanted:
            path.unlink(missing_ok=True)


def check_types(*arguments: str) -> tuple[str, int]:
    """Runs mypy with pyproject.toml's settings.

    Args:
        arguments: mypy's, e.g. a file. Without any, the package is checked.

    Returns:
        (what mypy says, with the sources' own paths; its exit code).
    """
    link_package()
    said, failed, code = api.run(
        ["--config-file", str(ROOT / "pyproject.toml"), *arguments]
    )
    for name, folder in find_folders().items():
        linked = _LINKS.relative_to(ROOT).joinpath(*name.split("."))
        if "." in name:
            said = said.replace(f"{linked}/", f"{folder}/")
    said = said.replace(f"{_LINKS.relative_to(ROOT)}/", "")
    return said + failed, code


def main() -> int:
    """Prints what mypy says and returns its exit code."""
    said, code = check_types()
    print(said, end="")
    return code


if __name__ == "__main__":
    sys.exit(main())
