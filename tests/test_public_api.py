"""Only public API of Drake, Numba, Python and others, and no tricks on it."""

import ast
from pathlib import Path
import textwrap

import pytest

_ROOT = Path(__file__).parents[1]
_FOLDERS = ("tofssm_drake", "diagrams", "scripts")
_OURS = "tofssm_drake"

# Modules that reach below Python.
_MODULES = {"ctypes", "cffi"}
# Settings of the whole interpreter: they are the user's.
_SETTINGS = {
    "gc.disable",
    "gc.freeze",
    "gc.set_threshold",
    "gc.unfreeze",
    "sys.setswitchinterval",
}


# Public in spite of its name: Python's manual has it.
_PUBLIC = {"os._exit"}


def is_private(name):
    """Returns whether a name is its owner's own; `__doc__` and such are not."""
    return name.startswith("_") and not name.endswith("__")


def find_imported(tree):
    """Returns the dotted names that others' modules and objects go by."""
    imported = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                name = alias.name if alias.asname else alias.name.split(".")[0]
                imported[alias.asname or name] = name
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                imported[alias.asname or alias.name] = (
                    f"{node.module}.{alias.name}"
                )
    return {
        name: origin
        for name, origin in imported.items()
        if origin.split(".")[0] != _OURS
    }


def get_dotted(node, imported):
    """Returns the dotted name of an expression, None if it is not another's."""
    if isinstance(node, ast.Name):
        return imported.get(node.id)
    if isinstance(node, ast.Attribute):
        owner = get_dotted(node.value, imported)
        return owner and f"{owner}.{node.attr}"
    # What is made of another's class or function is another's as well.
    return (
        get_dotted(node.func, imported) if isinstance(node, ast.Call) else None
    )


def find_made(tree, imported):
    """Returns the names of objects that another's call has made."""
    made = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            origin = get_dotted(node.value, imported)
            for target in node.targets if origin else ():
                if isinstance(target, ast.Name):
                    made[target.id] = f"{origin}()"
    return made


def find_tricks(source):
    """Yields (line, what) of each access that is not public."""
    tree = ast.parse(source)
    imported = find_imported(tree)
    known = find_made(tree, imported) | imported
    for name, origin in imported.items():
        parts = origin.split(".")
        if parts[0] in _MODULES or any(map(is_private, parts)):
            yield 0, f"import of {origin} as {name}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            dotted = get_dotted(node, known)
            if dotted is None or dotted in _PUBLIC:
                continue
            if is_private(node.attr) or dotted in _SETTINGS:
                yield node.lineno, dotted
        elif isinstance(node, ast.Assign):
            for target in node.targets:
                name = getattr(target, "id", getattr(target, "attr", ""))
                if name.startswith("Do") and name[2:3].isupper():
                    yield node.lineno, f"assignment to {name}"
        elif isinstance(node, ast.Call):
            if getattr(node.func, "id", "") in ("getattr", "setattr"):
                name = node.args[1]
                if isinstance(name, ast.Constant) and is_private(name.value):
                    yield node.lineno, f"{node.func.id} of {name.value}"
    for name in imported.values():
        if name in _SETTINGS:
            yield 0, name


def list_files():
    return sorted(
        path for folder in _FOLDERS for path in (_ROOT / folder).rglob("*.py")
    )


def test_public_api_only():
    found = [
        f"{path.relative_to(_ROOT)}:{line}: {what}"
        for path in list_files()
        for line, what in find_tricks(path.read_text("utf-8"))
    ]
    assert found == []


@pytest.mark.parametrize(
    "source",
    [
        "import ctypes",
        "from ctypes import c_double",
        "import gc\ngc.freeze()",
        "from gc import disable",
        "import sys as s\ns.setswitchinterval(1)",
        "import numba.core.caching as c\nc._CacheLocator",
        "from numba.core.caching import _CacheLocator",
        "import threading\nthreading._shutdown()",
        "import numpy\nnumpy.random._generator",
        "from pydrake.systems.framework import LeafSystem\n"
        "class A(LeafSystem):\n    DoGetWitnessFunctions = LeafSystem.get_name",
        "import numba\nf = numba.njit(abs)\nf._cache = None",
        "import numba\nnumba.njit(abs)._cache = None",
        "import numba\nsetattr(numba, '_x', 1)",
    ],
)
def test_finds(source):
    assert list(find_tricks(textwrap.dedent(source)))


@pytest.mark.parametrize(
    "source",
    [
        "import gc\ngc.collect()",
        "import sys\nsys.__stdout__",
        "class A:\n    def f(self):\n        return self._x",
        "from tofssm_drake.rtde import _x\n_x._y",
        "import numba\nnumba.njit(abs).py_func",
    ],
)
def test_lets_pass(source):
    assert list(find_tricks(source)) == []
