"""Numba's `njit`, with a cache that notices changed callees.

Numba compiles a kernel's callees into it, but takes the compiled kernel from
the cache until its own file changes. Here the cache has a folder for each
state of the files with kernels: if any of them changes, all kernels are
recompiled.
"""

import functools
import hashlib
import os
from pathlib import Path
import shutil
from typing import Any

import numba

# Numba makes its settings when it is imported, so mypy does not know them.
_SETTINGS: Any = numba.config

_PACKAGE = Path(__file__).parent
_PREFIX = "kernels-"


def njit(**options):
    """Returns Numba's decorator for a kernel, see `numba.njit`.

    Args:
        options: Numba's; with `cache=True` the compiled kernel is kept for
            later processes, until a file with a kernel changes.
    """

    def decorate(function):
        if not options.get("cache") or _SETTINGS.DISABLE_JIT:
            return numba.njit(**options)(function)
        # Numba reads this setting when a kernel is declared. Kernels of other
        # packages keep the old value.
        before = _SETTINGS.CACHE_DIR
        _SETTINGS.CACHE_DIR = str(find_cache_folder(_PACKAGE))
        try:
            return numba.njit(**options)(function)
        finally:
            _SETTINGS.CACHE_DIR = before

    return decorate


@functools.cache
def find_cache_folder(package: Path) -> Path:
    """Returns the cache folder for the present state of a package's kernels.

    It is in NUMBA_CACHE_DIR if that is set, else in the package's `__pycache__`
    if that is writable, else in the user's cache. In `__pycache__`, which is
    used by nobody else, older states are removed.
    """
    name = _PREFIX + calc_stamp(package)[:16]
    if _SETTINGS.CACHE_DIR:
        return Path(_SETTINGS.CACHE_DIR) / name
    own = package / "__pycache__"
    if not os.access(own if own.exists() else package, os.W_OK):
        return Path.home() / ".cache" / package.name / name
    if not (own / name).exists():
        for old in own.glob(_PREFIX + "*"):
            shutil.rmtree(old, ignore_errors=True)
    return own / name


@functools.cache
def calc_stamp(folder: Path) -> str:
    """Returns a digest of all files in a folder that have kernels.

    It depends on their contents, not their age, which an installer may set.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        source = path.read_bytes()
        if b"njit" in source:
            digest.update(path.relative_to(folder).as_posix().encode())
            digest.update(source)
    return digest.hexdigest()
