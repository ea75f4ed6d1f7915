"""Compiled kernels are those of the present sources."""

import ast
import importlib
import os
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile
import unittest
from unittest import mock

import numba
from numba.extending import is_jitted

import tofssm_drake.kernels as mut

PACKAGE = Path(mut.__file__).parent

CALLEE = """
from tofssm_drake.kernels import njit
STEP = 1.0
@njit(cache=True, error_model="numpy", forceinline=True)
def step(x):
    return x + STEP
"""
CALLER = """
from tofssm_drake.kernels import njit
from tofssm_drake.callee import step
@njit(cache=True)
def walk(x):
    return step(step(x))
"""
PROGRAM = """
from tofssm_drake.caller import walk
y = walk(0.0)
print(y, sum(walk.stats.cache_hits.values()))
"""


class TestCache(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.package = Path(folder.name) / "tofssm_drake"
        self.package.mkdir()
        for name in ("__init__.py", "kernels.py"):
            shutil.copy(PACKAGE / name, self.package)
        (self.package / "caller.py").write_text(CALLER)

    def run_program(self, **settings):
        """Returns the walk from 0, and how often the cache was of use."""
        environment = {
            name: value
            for name, value in os.environ.items()
            if name != "NUMBA_CACHE_DIR"
        }
        result = subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env=environment
            | {"PYTHONPATH": str(self.package.parent)}
            | settings,
            cwd=self.package.parent,
            capture_output=True,
            text=True,
            check=False,
        )
        self.assertEqual(result.returncode, 0, result.stderr)
        value, hits = result.stdout.split()
        return float(value), int(hits)

    def test_changed_callee_is_compiled_into_its_caller(self):
        callee = self.package / "callee.py"
        callee.write_text(CALLEE)
        self.assertEqual(self.run_program(), (2.0, 0))
        # A new age is not a new source.
        os.utime(callee, (0, 0))
        self.assertEqual(self.run_program(), (2.0, 1))
        # Of the same length and age, as an installer may leave it.
        callee.write_text(CALLEE.replace("1.0", "3.0"))
        os.utime(callee, (0, 0))
        self.assertEqual(self.run_program(), (6.0, 0))
        # The older state is gone.
        folders = list((self.package / "__pycache__").glob("kernels-*"))
        self.assertEqual(len(folders), 1)

    def test_folder_of_the_users_choice(self):
        (self.package / "callee.py").write_text(CALLEE)
        folder = self.package.parent / "cache"
        setting = {"NUMBA_CACHE_DIR": str(folder)}
        self.assertEqual(self.run_program(**setting), (2.0, 0))
        self.assertEqual(self.run_program(**setting), (2.0, 1))
        self.assertEqual(len(list(folder.glob("kernels-*/**/*.nbi"))), 2)
        self.assertFalse(list((self.package / "__pycache__").glob("kernels-*")))

    def test_package_that_cannot_be_written(self):
        with mock.patch.object(mut.os, "access", return_value=False):
            mut.find_cache_folder.cache_clear()
            self.addCleanup(mut.find_cache_folder.cache_clear)
            with mock.patch.object(mut.numba.config, "CACHE_DIR", ""):
                folder = mut.find_cache_folder(self.package)
        self.assertTrue(folder.is_relative_to(Path.home() / ".cache"))

    def test_kernels_of_others_are_kept_where_they_were(self):
        before = numba.config.CACHE_DIR
        mut.njit(cache=True)(lambda x: x)
        self.assertEqual(numba.config.CACHE_DIR, before)


class TestKernelsOfThePackage(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.kernels = {}
        for path in sorted(PACKAGE.rglob("*.py")):
            if "njit" not in path.read_text("utf-8") or path == Path(
                mut.__file__
            ):
                continue
            parts = path.relative_to(PACKAGE).with_suffix("").parts
            module = importlib.import_module(".".join(["tofssm_drake", *parts]))
            cls.kernels[module] = [
                value
                for value in vars(module).values()
                if is_jitted(value)
                and value.py_func.__module__ == module.__name__
            ]

    def test_each_is_kept_in_the_folder_of_this_state(self):
        folder = mut.find_cache_folder(PACKAGE)
        self.assertTrue(folder.name.endswith(mut.calc_stamp(PACKAGE)[:16]))
        self.assertGreater(len(self.kernels), 15)
        for module, kernels in self.kernels.items():
            self.assertTrue(kernels, module.__name__)
            for kernel in kernels:
                with self.subTest(kernel=kernel):
                    path = Path(kernel.stats.cache_path)
                    self.assertTrue(path.is_relative_to(folder), path)

    def test_they_take_nothing_from_files_without_kernels(self):
        """Such a constant is compiled in, but is not part of the stamp."""
        checked = 0
        for module, kernels in self.kernels.items():
            used = {
                name
                for kernel in kernels
                for name in kernel.py_func.__code__.co_names
            }
            for node in ast.parse(Path(module.__file__).read_text()).body:
                if not isinstance(node, ast.ImportFrom) or not (
                    node.module.startswith("tofssm_drake.")
                ):
                    continue
                source = importlib.import_module(node.module)
                for alias in node.names:
                    if (alias.asname or alias.name) in used:
                        checked += 1
                        with self.subTest(module=module, name=alias.name):
                            self.assertIn(source, self.kernels)
        self.assertGreater(checked, 20)


if __name__ == "__main__":
    unittest.main()
