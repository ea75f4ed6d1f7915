"""What the ray caster takes of a computer: memory, and time to compile."""

import json
import os
from pathlib import Path
import subprocess
import sys
import unittest

from numba.extending import is_jitted
import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import FramePoseVector
from pydrake.math import RigidTransform
import pytest
import ray_oracle as oracle

from tofssm_drake.raycast import (
    mesh_kernels,
    mesh_parts,
    ray_kernels,
    triangle_tree,
)
from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayCaster

WARM_UP = 2000
SCANS = 100_000


class Scanner:
    """A scene of all shapes, two small sensors, and a few single rays."""

    def __init__(self):
        rng = np.random.default_rng(0)
        self.scene = oracle.make_random_scene(rng, oracle.ALL_KINDS)
        self.caster = RayCaster(self.scene.inspector)
        self.bundles = self.caster.make_bundles(
            frame_id=self.scene.frame_ids,
            X_FS=[RigidTransform([0.0, 0.0, 1.0])] * 2,
            fan_S=make_cone_fan(0.5, 3),
            max_range=3.0,
        )
        self.p_WR = rng.uniform(-1.0, 1.0, (2, 3))
        self.n_WR = oracle.make_unit_vectors(rng, 2)
        self.scene.query_object()
        port = self.scene.scene_graph.get_source_pose_port(self.scene.source_id)
        self.poses = port.FixValue(self.scene.context, Value(FramePoseVector()))
        self.moves = [FramePoseVector() for _ in range(2)]
        for poses in self.moves:
            for frame_id in self.scene.frame_ids:
                poses.set_value(frame_id, oracle.make_random_pose(rng))
        self.query_port = self.scene.scene_graph.get_query_output_port()

    def scan(self, i):
        """Moves the frames and casts; now and then single rays, too."""
        self.poses.GetMutableData().set_value(self.moves[i % 2])
        query_object = self.query_port.Eval(self.scene.context)
        X_WF = self.caster.poses_from_query_object(query_object)
        self.caster.cast_bundles(self.bundles, X_WF)
        if i % 10:
            return
        hits = self.caster.cast(X_WF, self.p_WR, self.n_WR)
        self.caster.calc_normals(X_WF, self.p_WR, self.n_WR, *hits)


def report_growth():
    """Prints how many bytes more are resident after all scans."""
    scanner = Scanner()
    for i in range(WARM_UP):
        scanner.scan(i)
    before = read_resident_bytes()
    for i in range(SCANS):
        scanner.scan(i)
    print(json.dumps(read_resident_bytes() - before))


def read_resident_bytes():
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def report_cache():
    """Prints (hits, misses) of each kernel that a scan has used."""
    Scanner().scan(0)
    stats = {}
    for module in (ray_kernels, mesh_kernels, mesh_parts, triangle_tree):
        for name, value in vars(module).items():
            if is_jitted(value):
                hits = sum(value.stats.cache_hits.values())
                misses = sum(value.stats.cache_misses.values())
                if hits or misses:
                    stats[name] = hits, misses
    print(json.dumps(stats))


def run_in_new_process(function):
    """Returns what a function of this module prints, in another process."""
    result = subprocess.run(
        [sys.executable, "-c", f"import test_ray_resources as t; t.{function}"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


class TestResources(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        # From here on the kernels are compiled.
        Scanner().scan(0)

    @pytest.mark.long
    def test_many_scans_take_no_more_memory(self):
        """Not even 20 bytes a scan, less than any object of Python's."""
        self.assertLess(run_in_new_process("report_growth()"), 20 * SCANS)

    def test_kernels_are_compiled_once_for_all_processes(self):
        stats = run_in_new_process("report_cache()")
        for name in (
            *("cast_bundles", "cast_rays", "calc_normals"),
            *("_join", "_build_tree"),
        ):
            self.assertIn(name, stats)
        for name, (hits, misses) in stats.items():
            self.assertGreater(hits, 0, name)
            self.assertEqual(misses, 0, name)


if __name__ == "__main__":
    unittest.main()
