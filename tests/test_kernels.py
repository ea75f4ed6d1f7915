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

from numba.core.dispatcher import Dispatcher

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

    def run_program(self):
        """Returns the walk from 0, and how often the cache was of use."""
        result = subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env=os.environ
            | {
                "PYTHONPATH": str(self.package.parent),
                "NUMBA_CACHE_DIR": str(self.package.parent / "cache"),
            },
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
        # A new age is no new source.
        os.utime(callee, (0, 0))
        self.assertEqual(self.run_program(), (2.0, 1))
        # Of the same length and age, as an installer may leave it.
        callee.write_text(CALLEE.replace("1.0", "3.0"))
        os.utime(callee, (0, 0))
        self.assertEqual(self.run_program(), (6.0, 0))


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
                if isinstance(value, Dispatcher)
                and value.py_func.__module__ == module.__name__
            ]

    def test_each_has_the_stamp_of_all(self):
        stamp = mut.calc_stamp(PACKAGE)
        self.assertGreater(len(self.kernels), 15)
        for module, kernels in self.kernels.items():
            self.assertTrue(kernels, module.__name__)
            for kernel in kernels:
                with self.subTest(kernel=kernel):
                    self.assertEqual(
                        kernel._cache._cache_file._source_stamp, stamp
                    )

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
