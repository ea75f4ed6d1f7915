"""Imports point one way: docs/design.md, Imports."""

import ast
import collections
import graphlib
from pathlib import Path
import unittest

import pytest

_ROOT = Path(__file__).parents[1]

# Folder in the repository by package.
_FOLDERS = {
    "tofssm_drake": _ROOT / "tofssm_drake",
    "tofssm_drake.diagrams": _ROOT / "diagrams",
    "tofssm_drake.models": _ROOT / "models",
    "tofssm_drake.scripts": _ROOT / "scripts",
}

_FOR_ALL = (
    *("carried_objects", "device_clock", "errors", "factory"),
    *("kernels", "messages", "path_times", "poses", "user_files"),
)

# What each room may use of the others.
_MAY_USE = {
    "raycast": (),
    "arms": ("models", "raycast", "sensors"),
    "tasks": ("arms",),
    "people": (),
    "sensors": ("raycast",),
    "perception": ("arms", "raycast", "sensors"),
    "laws": (),
    "robots": ("tasks",),
    "rtde": ("arms", "robots", "tasks"),
    "ringlink": ("sensors",),
    "recording": ("people", "robots", "rtde"),
    "metrics": ("arms", "laws", "recording"),
    "studies": ("metrics", "recording"),
    "reports": ("metrics", "recording", "studies"),
    "visualization": ("arms", "recording", "reports"),
    "paper": ("laws", "metrics", "recording", "reports", "studies"),
}


def find_modules():
    """Yields (module name, path) of everything that is installed."""
    for package, folder in _FOLDERS.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            if parts[-1] == "__init__":
                parts = parts[:-1]
            yield ".".join((package, *parts)), path


def find_imports(path):
    """Yields (module, level) of every import in a file, also in functions."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, 0
        elif isinstance(node, ast.ImportFrom):
            yield node.module or "", node.level
            for alias in node.names:
                yield f"{node.module}.{alias.name}", node.level


def get_room(module):
    """Returns the part of the package that a module is in."""
    return module.split(".")[1] if "." in module else ""


class TestImports(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.imports = collections.defaultdict(set)
        cls.modules = dict(find_modules())
        for module, path in cls.modules.items():
            for name, level in find_imports(path):
                assert level == 0, f"{path}: relative import of {name}"
                cls.imports[module].add(name)
        cls.rooms = collections.defaultdict(set)
        for module, names in cls.imports.items():
            for name in names:
                if name.startswith("tofssm_drake."):
                    cls.rooms[get_room(module)].add(get_room(name))
        for room, names in cls.rooms.items():
            names.discard(room)

    def test_everything_is_looked_at(self):
        self.assertGreater(len(self.modules), 50)
        for room in (*_MAY_USE, "diagrams", "scripts", "models"):
            self.assertIn(room, {get_room(name) for name in self.modules})
        self.assertIn("raycast", self.rooms["sensors"])
        self.assertIn("diagrams", self.rooms["scripts"])

    def test_the_package_knows_neither_diagrams_nor_scripts(self):
        for room, names in self.rooms.items():
            with self.subTest(room=room):
                if room not in ("diagrams", "scripts"):
                    self.assertNotIn("diagrams", names)
                if room != "scripts":
                    self.assertNotIn("scripts", names)

    def test_what_is_for_all_knows_nobody(self):
        for room in ("errors", "kernels", "user_files"):
            self.assertEqual(self.rooms[room], set())
        self.assertLessEqual(self.rooms["messages"], {"errors"})

    def test_rooms(self):
        for room, others in _MAY_USE.items():
            with self.subTest(room=room):
                self.assertLessEqual(
                    self.rooms[room] - set(_FOR_ALL), set(others)
                )

    def test_only_the_command_that_runs_it_knows_the_paper(self):
        """A study of one's own needs nothing of the paper."""
        knows = {
            module
            for module, names in self.imports.items()
            if get_room(module) != "paper"
            and any(get_room(name) == "paper" for name in names)
        }
        self.assertEqual(knows, {"tofssm_drake.scripts.paper_experiment"})

    def test_no_circle(self):
        order = list(graphlib.TopologicalSorter(self.rooms).static_order())
        self.assertEqual(order[-1], "scripts")
        modules = {
            module: {n for n in names if n in self.modules and n != module}
            for module, names in self.imports.items()
        }
        graphlib.TopologicalSorter(modules).prepare()

    def test_no_pydrake_all(self):
        for module, names in self.imports.items():
            self.assertFalse(
                any(name.startswith("pydrake.all") for name in names), module
            )

    def test_everything_imported_is_a_dependency(self):
        """The package can be imported without extras."""
        import sys

        known = {
            *("cobs", "pydrake", "jinja2", "matplotlib", "numba", "numpy"),
            *("pyarrow", "rich", "ruckig", "serial", "typer", "yaml"),
            *("collada", "dask", "distributed", "mcap", "tofssm_drake"),
            *("scipy", "trimesh"),
        }
        extras = {"tofssm_drake.arms.meshes": {"example_robot_data"}}
        for module, names in self.imports.items():
            tops = {name.partition(".")[0] for name in names}
            with self.subTest(module=module):
                self.assertLessEqual(
                    tops - set(sys.stdlib_module_names),
                    known | extras.get(module, set()),
                )


class TestLoading(unittest.TestCase):
    """A stranger takes one room and gets no other's libraries."""

    def check(self, room, *others):
        import subprocess
        import sys

        program = (
            f"import sys, tofssm_drake.{room} as room\n"
            "assert all(hasattr(room, n) for n in room.__all__)\n"
            f"print(*(n for n in {others} if n in sys.modules))"
        )
        done = subprocess.run(
            [sys.executable, "-c", program],
            capture_output=True,
            text=True,
            check=False,
        )
        self.assertEqual(done.stdout.split(), [], done.stderr)
        self.assertEqual(done.returncode, 0, done.stderr)

    def test_of_the_rooms_most_often_taken_alone(self):
        self.check(
            *("raycast", "matplotlib", "mcap", "pyarrow", "ruckig", "serial")
        )
        for room in ("laws", "rtde"):
            with self.subTest(room):
                self.check(
                    *(room, "matplotlib", "mcap", "pyarrow", "serial"),
                    "trimesh",
                )

    @pytest.mark.long
    def test_of_the_others(self):
        for room, *others in (
            ("arms", "matplotlib", "mcap", "pyarrow", "ruckig", "serial"),
            ("metrics", "matplotlib", "mcap", "serial", "trimesh"),
            ("people", "matplotlib", "mcap", "pyarrow", "serial", "trimesh"),
            ("perception", "matplotlib", "mcap", "pyarrow", "serial"),
            ("recording", "matplotlib", "mcap", "serial", "trimesh"),
            ("ringlink", "matplotlib", "mcap", "pyarrow", "ruckig"),
            ("robots", "matplotlib", "mcap", "pyarrow", "serial"),
            ("sensors", "matplotlib", "mcap", "pyarrow", "serial"),
            ("tasks", "matplotlib", "mcap", "pyarrow", "serial"),
            ("visualization", "matplotlib", "mcap", "serial"),
        ):
            with self.subTest(room):
                self.check(room, *others)
