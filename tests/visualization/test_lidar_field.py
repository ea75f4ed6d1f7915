"""What is drawn of a planar lidar."""

from fake_meshcat import FakeMeshcat
import numpy as np
from pydrake.math import RigidTransform
import pytest

from tofssm_drake.sensors.lidar_2d import Lidar2dConfig, calc_lidar_angles
import tofssm_drake.visualization.lidar_field as mut


def calc_area(vertices, faces):
    a, b, c = (vertices[:, corner] for corner in faces)
    return 0.5 * np.cross((b - a).T, (c - a).T)[:, 2].sum()


@pytest.mark.parametrize(("low", "high"), [(-180, 180), (-90, 90), (0, 30)])
def test_the_field_is_what_it_scans(low, high):
    angles = calc_lidar_angles(
        Lidar2dConfig(angle_min_deg=low, angle_max_deg=high)
    )
    vertices, faces = mut.make_field_mesh(angles, 2.0)
    assert calc_area(vertices, faces) == pytest.approx(
        np.radians(high - low) * 2.0, rel=1e-3
    )
    assert not vertices[2].any()


def test_one_beam_has_no_area():
    vertices, faces = mut.make_field_mesh(np.array([0.3]), 2.0)
    assert vertices.shape == (3, 2)
    assert faces.shape == (3, 0)


def test_it_is_drawn_where_it_stands():
    meshcat = FakeMeshcat()
    X_WS = RigidTransform([1.0, 2.0, 0.3])
    mut.draw_lidar(
        meshcat,
        "lidars/front",
        X_WS=X_WS,
        angles=np.linspace(0.0, 1.0, 20),
        max_range=5.0,
    )
    assert set(meshcat.objects) == {
        "lidars/front/housing",
        "lidars/front/field",
    }
    ((path, X, _),) = meshcat.transforms
    assert path == "lidars/front"
    assert X.IsExactlyEqualTo(X_WS)
