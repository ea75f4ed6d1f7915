"""Directed speeds, critical and reduced distance, Distance Safety Index.

Source: the 2019 paper, II-A-2 to II-A-4. Every public function takes a number
or an array with one element per link. What the filter needs at every tick is
compiled; the public functions run the same source on arrays.
"""

from typing import NamedTuple

import numpy as np

from tofssm_drake.kernels import njit
from tofssm_drake.laws.config import SsmConfig


class DistanceConstants(NamedTuple):
    """The part of a SsmConfig that compiled code needs."""

    fixed: bool
    """True for "sm": the distances are d_C_sm and d_R_sm."""
    use_k_o: bool
    """True for "vo": k is the relative directed speed, else the link's."""
    literal: bool
    k_max: float
    T_stop: float
    T_red: float
    T_R: float
    V_lmax: float
    B_min: float
    C_dC: float
    d_C_sm: float
    d_R_sm: float
    alpha_I: float
    alpha_D: float


def make_distance_constants(config: SsmConfig) -> DistanceConstants:
    """Returns the settings that compiled code needs."""
    return DistanceConstants(
        fixed=config.configuration == "sm",
        use_k_o=config.configuration == "vo",
        literal=bool(config.literal),
        k_max=float(config.k_max()),
        T_stop=float(config.T_stop),
        T_red=float(config.T_red),
        T_R=float(config.T_R),
        V_lmax=float(config.V_lmax),
        B_min=float(config.B_min),
        C_dC=float(config.C_dC),
        d_C_sm=float(config.d_C_sm),
        d_R_sm=float(config.d_R_sm),
        alpha_I=float(config.alpha_I),
        alpha_D=float(config.alpha_D),
    )


def make_link_constants(
    config: SsmConfig, name: tuple[str, ...], offset: np.ndarray | None = None
) -> tuple[DistanceConstants, ...]:
    """Returns the constants of each link, (m,).

    Args:
        config: Settings.
        name: The m watched links.
        offset: See `SsmConfig.grow`, m, (m,); None: 0.
    """
    offset = np.zeros(len(name)) if offset is None else offset
    return tuple(
        make_distance_constants(config.grow(float(more)))
        for _, more in zip(name, offset, strict=True)
    )


@njit(cache=True)
def critical_distance(c, k, link_speed):
    """Returns Eq. 5b; see calc_critical_distance()."""
    if c.fixed:
        return 0.0 * k + c.d_C_sm
    d_C = (
        c.k_max * c.T_R / 2.0
        + np.minimum(np.maximum(k, -c.k_max), c.k_max) * c.T_stop / 2.0
        + np.maximum(c.B_min, link_speed * c.T_stop / 2.0)
        + c.C_dC
    )
    return d_C if c.literal else np.maximum(d_C, c.C_dC)


@njit(cache=True)
def reduced_distance(c, k, robot_state, d_C):
    """Returns Eq. 5a; see calc_reduced_distance()."""
    if c.fixed:
        return 0.0 * k + c.d_R_sm
    R_buffer = (2.0 - robot_state) * c.V_lmax * c.T_red / 4.0
    d_R = (
        c.k_max * c.T_R
        + np.minimum(np.maximum(k, -c.k_max), c.k_max) * 0.75 * c.T_red
        + R_buffer
        + d_C
    )
    return d_R if c.literal else np.maximum(d_R, d_C)


def calc_directed_speeds(*, p_LO, v_WL, v_WO):
    """Projects the velocities onto the line from the link to the obstacle.

    The paper's Eqs. 4a and 4b with the *unit* vector of that line. A positive
    speed is closing. Neither is saturated.

    Args:
        p_LO: From the link's centre to the obstacle, in world, m, (..., 3).
        v_WL: Velocity of the link's centre, m/s, (..., 3).
        v_WO: Velocity of the obstacle, m/s, (..., 3).

    Returns:
        k_l and k_o, m/s: of the link alone, and relative.
    """
    p_LO = np.asarray(p_LO, dtype=float)
    v_WL = np.asarray(v_WL, dtype=float)
    u = p_LO / np.linalg.norm(p_LO, axis=-1, keepdims=True)
    k_l = np.sum(v_WL * u, axis=-1)
    k_o = np.sum((v_WL - np.asarray(v_WO, dtype=float)) * u, axis=-1)
    return k_l, k_o


def calc_critical_distance(*, config: SsmConfig, k, link_speed):
    """Returns the distance within which the robot must stand still, m.

    The paper's Eq. 5b,

        d_C = k_max T_R / 2 + k T_stop / 2
              + max(B_min, |V_l| T_stop / 2) + C_dC,

    with k saturated to +-k_max, and never less than C_dC unless
    `config.literal`. With configuration "sm" it is `config.d_C_sm`.

    Args:
        config: Settings.
        k: Directed speed of the configuration ("vo": k_o, "vr": k_l), m/s.
        link_speed: ||V_l|| of the link's centre, m/s.
    """
    return critical_distance.py_func(
        make_distance_constants(config),
        np.asarray(k, dtype=float),
        np.asarray(link_speed, dtype=float),
    )


def calc_reduced_distance(*, config: SsmConfig, k, robot_state, d_C):
    """Returns the distance within which the robot must be slow, m.

    The paper's Eq. 5a,

        d_R = k_max T_R + k (3/4) T_red + R_buffer + d_C,
        R_buffer = (2 - psi) V_lmax T_red / 4,

    with k saturated to +-k_max, and never less than d_C unless
    `config.literal`. R_buffer is the recovery distance: a slower state needs
    more room to return to normal. With configuration "sm" it is
    `config.d_R_sm`.

    Args:
        config: Settings.
        k: Directed speed as for calc_critical_distance(), m/s.
        robot_state: psi, the *previous* state of the robot (`RobotState`).
        d_C: Critical distance, m.
    """
    return reduced_distance.py_func(
        make_distance_constants(config),
        np.asarray(k, dtype=float),
        np.asarray(robot_state, dtype=float),
        np.asarray(d_C, dtype=float),
    )


def calc_distance_safety_index(*, C_dC: float, distance):
    """Returns the Distance Safety Index (C_dC / distance)^2.

    The paper's Eqs. 6a to 6c, for a measured distance or a threshold. It is 0
    if the link is clear (inf) and 1 at the cushioning distance; it is not
    clipped, because the filter needs the difference.

    Args:
        C_dC: Cushioning constant, m.
        distance: ||D|| from the link's centre, d_C or d_R, m.
    """
    return (C_dC / np.asarray(distance, dtype=float)) ** 2
