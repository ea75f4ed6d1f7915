"""What a scan of the rings costs, alone and beside other ray casters."""

from pathlib import Path

import numpy as np
import pytest
from ray_comparison import (
    HOLD,
    FastPath,
    QueryObjectPath,
    compare,
    find_missing_peers,
    find_ratios,
    format_table,
)
from ray_scene import NUM_STATES, Scene

TABLES = Path("out/bench/ray_casters.md")


@pytest.fixture(scope="module", params=["shapes", "meshes"])
def scene(request):
    return Scene(sensors=8, meshes=request.param == "meshes")


@pytest.fixture
def next_state():
    """Returns a function that returns another state at each call."""
    state = {"i": 0}

    def step():
        state["i"] = (state["i"] + 1) % NUM_STATES
        return state["i"]

    return step


@pytest.mark.parametrize("caster", [FastPath, QueryObjectPath])
def test_scan_of_600_rays(benchmark, scene, next_state, caster):
    """A new state, its poses, and the rays of all three rings."""
    dut = caster(scene)

    def scan(i):
        dut.update(i)
        return dut.cast(i)

    benchmark.pedantic(
        scan,
        setup=lambda: ((next_state(),), {}),
        rounds=5000,
        warmup_rounds=100,
    )


def test_rays_alone(benchmark, scene, next_state):
    def cast(i):
        return scene.caster.cast_bundles(scene.bundles, scene.X_WF[i])

    benchmark.pedantic(
        cast,
        setup=lambda: ((next_state(),), {}),
        rounds=5000,
        warmup_rounds=100,
    )


def test_600_single_rays_alone(benchmark, scene):
    rng = np.random.default_rng(1)
    p_WR = np.tile([0.5, 0.0, 1.2], (600, 1))
    n_WR = rng.normal(size=(600, 3))
    n_WR /= np.linalg.norm(n_WR, axis=1, keepdims=True)
    benchmark(scene.caster.cast, scene.X_WF[0], p_WR, n_WR, 1.5)


@pytest.mark.parametrize("meshes", [False, True], ids=["shapes", "meshes"])
@pytest.mark.parametrize("sensors", [8, 16])
def test_beside_other_ray_casters(benchmark, tables, sensors, meshes):
    """Checks whether the ratios of the medians hold, all from one run."""
    scene = Scene(sensors=sensors, meshes=meshes)
    rows = benchmark.pedantic(
        lambda: compare(scene, meshes=meshes), rounds=1, iterations=1
    )
    what = "shapes, meshes among them" if meshes else "primitive shapes"
    rays = scene.rays[0][1].shape[0] * scene.rays[0][1].shape[1]
    lines = [f"{rays} rays, {len(scene.caster.geometry_ids)} {what}", ""]
    lines += [format_table(rows), ""]
    for caster, libraries in HOLD[meshes].items():
        ratios = find_ratios(rows, caster)
        for library, wanted in libraries.items():
            if library not in ratios:
                continue
            held = ratios[library] >= wanted
            lines.append(
                f"- {caster}: {ratios[library]:.1f} times faster than"
                f" {library}, {wanted:g} wanted:"
                f" {'held' if held else 'NOT REACHED'}"
            )
    missing = find_missing_peers()
    if missing:
        lines.append(f"- not installed: {', '.join(missing)}")
    tables.append("\n".join(lines))
    assert not any(row.differing >= 0.005 for row in rows)


@pytest.fixture(scope="module")
def tables(request):
    """Collects what is printed at the end and kept in a file."""
    tables = []
    yield tables
    text = "\n\n".join(tables) + "\n"
    TABLES.parent.mkdir(parents=True, exist_ok=True)
    TABLES.write_text(text)
    request.config.ray_caster_tables = text
