"""A made-up run, quick to make and rich enough to look at."""

import numpy as np

from tofssm_drake.laws.law import describe_law
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.recording.samples import Samples, make_ring_metadata

RINGS = ("base", "elbow", "tool")
PERIOD = 0.008


def make_steps(t, *pairs):
    """Returns a staircase: value v from time s on, for (s, v) in pairs."""
    result = np.full(len(t), pairs[0][1])
    for start, value in pairs[1:]:
        result[t >= start - 1e-9] = value
    return result


def make_run(duration=10.0, *, sensors=8, geometry=True) -> Samples:
    """Returns a run in which nothing happens: normal speed, nobody there.

    Starts stopped for 0.04 s.
    """
    n = round(duration / PERIOD)
    t = np.arange(n) * PERIOD
    inf, nan, zero = np.full(n, np.inf), np.full(n, np.nan), np.zeros(n)
    state = make_steps(t, (0, 0), (0.04, 2)).astype(np.int8)
    column = {"t": t}
    column |= {f"q_{i}": zero.copy() for i in range(6)}
    column |= {f"qd_{i}": zero.copy() for i in range(6)}
    column |= {
        "tcp_speed": zero.copy(),
        "speed_fraction": np.ones(n),
        "robot_state": state,
        "products_placed": np.zeros(n, dtype=np.int16),
        "true_distance": inf.copy(),
    }
    for ring in RINGS:
        column |= {
            f"{ring}_state": state.copy(),
            f"{ring}_measured_distance": inf.copy(),
            f"{ring}_true_distance": inf.copy(),
            f"{ring}_closing_speed": np.full(n, 1.6),
            f"{ring}_link_closing_speed": zero.copy(),
            f"{ring}_d_C": np.full(n, 0.6),
            f"{ring}_d_R": np.full(n, 1.1),
            f"{ring}_dsi_raw": zero.copy(),
            f"{ring}_dsi": zero.copy(),
            f"{ring}_dsi_C": np.full(n, 0.25),
            f"{ring}_dsi_R": np.full(n, 0.07),
            f"{ring}_clear": np.full(n, sensors, dtype=np.int8),
            f"{ring}_valid": np.zeros(n, dtype=np.int8),
            f"{ring}_masked": np.zeros(n, dtype=np.int8),
            f"{ring}_faulted": np.zeros(n, dtype=np.int8),
            f"{ring}_sensor": np.full(n, -1, dtype=np.int8),
            f"{ring}_health": np.zeros(n, dtype=np.int8),
            f"{ring}_sequence": np.arange(n, dtype=np.int32) // 3,
            f"{ring}_sample_time": t - 0.02,
            f"{ring}_true_azimuth": nan.copy(),
            f"{ring}_true_elevation": nan.copy(),
        }
    column |= {
        "contact_speed": zero.copy(),
        "robot_body": np.full(n, -1, dtype=np.int16),
        "person_part": np.full(n, -1, dtype=np.int16),
    }
    for part in ("robot_point", "person_point", "tcp"):
        column |= {f"{part}_{axis}": nan.copy() for axis in "xyz"}
    column |= {"person_x": nan.copy(), "person_y": nan.copy()}
    column["reason"] = np.array([""] * n, dtype=object)
    metadata = {
        "rings": list(RINGS),
        "period": PERIOD,
        "robot_bodies": ["base_link", "forearm_link", "wrist_3_link"],
        "person_parts": ["torso", "left_forearm"],
    }
    if geometry:
        metadata["ring_geometry"] = {
            ring: make_ring_metadata(
                azimuth=np.arange(sensors) * 2 * np.pi / sensors,
                fov=np.deg2rad(25),
                radius=0.075,
                max_range=1.3,
            )
            for ring in RINGS
        }
    scan = {
        ring: {
            "time": t[i::3].copy(),
            "distance": np.full((len(t[i::3]), sensors), np.inf, np.float32),
            "reading": np.zeros((len(t[i::3]), sensors), dtype=np.int8),
        }
        for i, ring in enumerate(RINGS)
    }
    return Samples(column=column, scan=scan, metadata=metadata)


def make_rich_run(duration=62.0, *, sensors=8, seed=1) -> Samples:
    """Returns a run with a walking person, stops and recoveries.

    Kinematics and law are caricatures: a beam that turns about z and a
    person on a figure of eight.
    """
    rng = np.random.default_rng(seed)
    run = make_run(duration, sensors=sensors)
    c = run.column
    t = c["t"]
    n = len(t)
    person = 1.15 * np.stack(
        [
            0.85 + 0.9 * np.sin(0.42 * t),
            0.9 * np.sin(0.84 * t) * 1.1,
        ],
        axis=1,
    )
    centre = np.array([0.31, 0.75, 0.95])
    state, rho, phase = 0, 0.0, 0.0
    measured = np.full(3, np.inf)
    for i in range(n):
        angle = np.pi / 2 * np.sin(phase)
        rate = np.pi / 2 * np.cos(phase) * 1.05 * rho
        c["q_0"][i], c["qd_0"][i] = angle, rate
        direction = np.array([np.cos(angle), np.sin(angle)])
        tcp = 0.82 * direction
        c["tcp_x"][i], c["tcp_y"][i], c["tcp_z"][i] = *tcp, 0.3
        c["tcp_speed"][i] = abs(rate) * 0.82
        c["speed_fraction"][i] = rho
        c["person_x"][i], c["person_y"][i] = person[i]
        true, states = [], []
        for k, ring in enumerate(RINGS):
            offset = person[i] - centre[k] * direction
            d = max(np.hypot(*offset) - 0.22, 0.0)
            azimuth = np.arctan2(offset[1], offset[0]) - angle
            j = int(np.round(azimuth / (2 * np.pi / sensors))) % sensors
            gap = np.abs(np.mod(azimuth * sensors / (2 * np.pi) + 0.5, 1) - 0.5)
            true.append(d)
            c[f"{ring}_true_distance"][i] = d
            c[f"{ring}_true_azimuth"][i] = np.mod(azimuth + 3, 6.28) - 3
            c[f"{ring}_true_elevation"][i] = 0.1
            if i % 3 == k:
                scan = run.scan[ring]
                row = i // 3
                masked = (row // 40 + np.arange(sensors)) % 7 == 0
                scan["reading"][row][masked] = 2
                scan["distance"][row][masked] = 0.2 + 0.1 * rng.random()
                hit = d < 1.3 and gap < 0.42 and not masked[j]
                measured[k] = np.inf
                if hit:
                    measured[k] = d + rng.normal(0.02, 0.02)
                    scan["reading"][row][j] = 1
                    scan["distance"][row][j] = measured[k] - 0.075
                if k == 1 and 20 < t[i] < 24:
                    scan["reading"][row][5] = 3
                    scan["distance"][row][5] = np.nan
                for value, name in enumerate(
                    ("clear", "valid", "masked", "faulted")
                ):
                    c[f"{ring}_{name}"][i:] = (
                        scan["reading"][row] == value
                    ).sum()
                c[f"{ring}_sensor"][i:] = j if hit else -1
            c[f"{ring}_measured_distance"][i] = measured[k]
            v = abs(rate) * centre[k]
            closing = 1.6 + v if np.isinf(measured[k]) else 0.8 + v
            c[f"{ring}_closing_speed"][i] = closing
            d_c = 0.465 + 0.2 * closing + max(0.2, 0.2 * v) - 0.2
            d_r = d_c + 0.33 + 0.3 * closing + 0.17 * (2 - state)
            c[f"{ring}_d_C"][i], c[f"{ring}_d_R"][i] = d_c, d_r
            raw = (0.3 / measured[k]) ** 2
            c[f"{ring}_dsi_raw"][i] = raw
            old = c[f"{ring}_dsi"][max(i - 1, 0)]
            gain = 0.3 if raw < old else 0.9
            c[f"{ring}_dsi"][i] = dsi = old + gain * (raw - old)
            c[f"{ring}_dsi_C"][i] = (0.3 / d_c) ** 2
            c[f"{ring}_dsi_R"][i] = (0.3 / d_r) ** 2
            s = 2 - int(dsi >= (0.3 / d_r) ** 2) - int(dsi >= (0.3 / d_c) ** 2)
            states.append(s)
            c[f"{ring}_state"][i] = s
        state = min(states) if i > 5 else 0
        c["robot_state"][i] = state
        if state < 2:
            c["reason"][i] = (
                f"{RINGS[int(np.argmin(states))]}: "
                f"{measured[int(np.argmin(states))]:.2f} m"
            )
        target = state / 2
        rho += np.clip(target - rho, -2.5 * PERIOD, 2.5 * PERIOD)
        phase += 1.05 * rho * PERIOD
        c["products_placed"][i] = min(int(phase / 4.4), 10)
        surface = max(min(true) - 0.08, 0.0)
        c["true_distance"][i] = surface
        k = int(np.argmin(true))
        point = min(centre[k], 0.9) * direction
        c["robot_point_x"][i], c["robot_point_y"][i] = point
        c["person_point_x"][i], c["person_point_y"][i] = person[i]
        c["robot_body"][i], c["person_part"][i] = k, 1
        if surface <= 0:
            c["contact_speed"][i] = abs(rate) * centre[k]
    run.metadata |= {
        "scenario_name": "Paper",
        "seed": seed,
        "law": describe_law(TriSsm()),
        "products": 10,
        "scenario": "Paper:\n  random_seed: 1\n  law: {configuration: vo}\n",
        "versions": {"tofssm-drake": "0.1.0", "drake": "1.51.1"},
        "plan": {
            "robot": [0, 0],
            "boxes": [
                {"name": "pick", "x": 0.0, "y": -0.85, "dx": 0.6, "dy": 0.5},
                {"name": "place", "x": 0.0, "y": 0.85, "dx": 0.6, "dy": 0.5},
            ],
        },
    }
    return run
