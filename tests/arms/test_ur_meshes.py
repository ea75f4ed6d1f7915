"""Capsules along UR's links against the public meshes of the CB3 arms."""

import dataclasses as dc
import unittest
import xml.etree.ElementTree as ElementTree

import numpy as np
from pydrake.geometry import Capsule
from pydrake.math import RigidTransform
import trimesh

from tofssm_drake.arms.meshes import _LINKS as PUBLIC_LINKS
from tofssm_drake.arms.meshes import _read_mesh_frames, find_ur10_urdf
from tofssm_drake.arms.tool_down import calc_ur_joint_poses
import tofssm_drake.arms.ur_arm as mut
from tofssm_drake.arms.ur_data import read_ur_data

# By CB3 arm: the e-Series arm of its size, how many mm may be outside, its
# Denavit-Hartenberg lengths d1, a2, a3, d4, d5, d6, and the tubes' offsets, m.
ARMS = {
    "ur3": (
        *("ur3e", 8),
        (0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
        (0.1198, 0.0273),
    ),
    "ur5": (
        *("ur5e", 8),
        (0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
        (0.13585, 0.01615),
    ),
    "ur10": (
        *("ur10e", 16),
        (0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
        (0.1759, 0.0482),
    ),
}


def make_data(name):
    """Returns a CB3 arm's figures with the radii of its successor."""
    model, _, lengths, offsets = ARMS[name]
    names = ("d1", "a2", "a3", "d4", "d5", "d6")
    return dc.replace(
        read_ur_data(model),
        shoulder_offset=offsets[0],
        elbow_offset=offsets[1],
        **dict(zip(names, lengths, strict=True)),
    )


def calc_outside(points, shapes):
    """Returns how far the farthest point is outside of all shapes, m."""
    found = []
    for shape, X_BG in shapes:
        half = shape.length() / 2 if isinstance(shape, Capsule) else 0.0
        p = X_BG.inverse().multiply(points.T).T
        along = np.clip(p[:, 2], -half, half)
        p = p - along[:, None] * [0, 0, 1]
        found.append(np.linalg.norm(p, axis=1) - shape.radius())
    return np.min(found, axis=0).max()


class TestUrMeshes(unittest.TestCase):
    def test_capsules_cover_the_meshes(self):
        """The base is apart: its connector sticks out, and does not move."""
        for name, (_, most, *_) in ARMS.items():
            data = make_data(name)
            for link, points, shapes in self.list_links(name, data):
                with self.subTest(name, link=link):
                    outside = 1e3 * calc_outside(points, shapes)
                    self.assertLess(outside, 34 if link == "base" else most)

    def list_links(self, name, data):
        """Yields each link, its mesh's vertices in its body, its shapes."""
        file = find_ur10_urdf().parent / f"{name}_robot.urdf"
        share = file.parents[4]
        root = ElementTree.parse(file).getroot()
        X_BM = _read_mesh_frames(root)
        X_BA = RigidTransform()
        poses = [np.eye(3, 4), *calc_ur_joint_poses(mut.get_ur_lengths(data))]
        for link, X_PA, shapes in zip(
            PUBLIC_LINKS, poses, mut.make_ur_shapes(data), strict=True
        ):
            X_BA = X_BA.multiply(
                RigidTransform(np.vstack([X_PA, [0, 0, 0, 1]]))
            )
            public = PUBLIC_LINKS[link]
            (element,) = (
                x for x in root.findall("link") if x.get("name") == public
            )
            mesh = element.find("collision/geometry/mesh").get("filename")
            vertices = trimesh.load(
                share / mesh.removeprefix("package://"), force="mesh"
            ).vertices
            X_AM = X_BA.InvertAndCompose(X_BM[public])
            yield link, X_AM.multiply(np.asarray(vertices).T).T, shapes
