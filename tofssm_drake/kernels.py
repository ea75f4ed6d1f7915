"""Numba's `njit`, with a cache that knows which kernel calls which.

Numba compiles a kernel's callees into it, but takes its compiled form from
the cache until the kernel's own file changes. Here all of them are compiled
anew if any file with a kernel does.
"""

import functools
import hashlib
from pathlib import Path

import numba

_PACKAGE = Path(__file__).parent


def njit(**options):
    """Returns Numba's decorator for a kernel, see `numba.njit`.

    Args:
        options: Numba's; with `cache=True` the compiled kernel is kept for
            later processes, as long as no file with a kernel changes.
    """

    def decorate(function):
        kernel = numba.njit(**options)(function)
        if options.get("cache") and not numba.config.DISABLE_JIT:
            # Numba compares this with what an index in its cache holds. Its
            # own stamp is age and size of the one file.
            kernel._cache._cache_file._source_stamp = calc_stamp(_PACKAGE)
        return kernel

    return decorate


@functools.cache
def calc_stamp(folder: Path) -> str:
    """Returns a digest of all files in a folder that have kernels.

    The contents count and not their age: an installer may set any.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        source = path.read_bytes()
        if b"njit" in source:
            digest.update(path.relative_to(folder).as_posix().encode())
            digest.update(source)
    return digest.hexdigest()
