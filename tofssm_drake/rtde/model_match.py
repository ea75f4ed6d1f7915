"""Whether the reporting robot is the modelled one.

A controller computes the pose of its tool from its joints and its own
kinematics. The model's forward kinematics of the same joints must give the
same pose. Another robot, a joint offset or outdated joints do not.

Frames: B is the model's `base`, which is UR's own base frame and not ROS's
`base_link` (which is turned by 180 degrees about z). F is the tool flange, T
the tool centre point as the robot is set up.
"""

import dataclasses as dc
import math

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RotationMatrix

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.errors import UserError, require
from tofssm_drake.messages import RobotReport


@dc.dataclass(kw_only=True)
class ModelConfig:
    """How close the reported and modelled pose of the tool must be."""

    # Distance, m, and angle, rad, between them (assumed: a real UR is
    # calibrated individually, which moves its tool by some millimetres
    # against the published lengths, and UR's safety system itself trusts
    # poses only to 20 mm and 1.15 degrees; the next larger or smaller UR is
    # off by hundreds of millimetres).
    position_tolerance: float = 0.02
    angle_tolerance: float = 0.035

    # If a robot does not report its `tcp_offset`, the offset is taken from
    # the first report, assumed constant and at most this long, m (assumed:
    # longer tools are rare).
    longest_tcp_offset: float = 0.5

    # Period of the comparison, s, and how long a difference must last to end
    # the run, s (assumed: late joints show only while the arm is fast, for
    # some tenths of a second at a time).
    check_period: float = 0.04
    confirm_time: float = 0.2

    # Accept a robot that does not report the pose of its tool.
    allow_no_pose: bool = False

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        for name, most, unit in (
            ("position_tolerance", 0.2, "m"),
            ("angle_tolerance", 0.35, "rad"),
            ("longest_tcp_offset", 2.0, "m"),
            ("check_period", 1.0, "s"),
            ("confirm_time", 10.0, "s"),
        ):
            require(
                0 < getattr(self, name) <= most,
                f"{where}.{name}: must be more than 0 and at most {most:g} "
                f"{unit}, got {getattr(self, name):g}",
            )


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ModelMatch:
    """What is remembered from one comparison to the next."""

    X_FT: np.ndarray | None = None
    """Tool in the flange as implied by the first report, (3, 4); None: unknown
    yet, or the robot reports its `tcp_offset`."""
    checked: float = -math.inf
    """When poses were last compared, s on the robot's clock."""
    session: int = -1
    """Of that report."""
    wrong_since: float = math.nan
    """Since when they differ, s; NaN: they do not."""
    problem: str = ""
    """What has differed for long enough, in one line; else empty."""


def start_model_match(
    config: ModelConfig,
    kinematics: ArmKinematics,
    report: RobotReport,
    arm: str = "the modelled arm",
) -> ModelMatch:
    """Compares the first report; a difference counts at once.

    Args:
        config: Settings; checked.
        kinematics: Of the modelled robot.
        report: Its position is finite.
        arm: What the modelled robot is, for the message.

    Returns:
        The state for `step_model_match`.

    Raises:
        UserError: It is another robot, or cannot be identified.
    """
    if not config.allow_no_pose and not np.isfinite(report.tcp_pose).all():
        raise UserError(
            "robot: reports no pose of its tool (actual_TCP_pose), so nothing "
            "shows whether it is the modelled arm; --allow-no-pose starts "
            "anyway"
        )
    match = _infer_offset(kinematics, ModelMatch(), report)
    problem = find_mismatch(config, kinematics, match, report)
    require(
        not problem, f"robot: {problem}; it is not {arm}, or is set up wrongly"
    )
    return match


def step_model_match(
    config: ModelConfig,
    kinematics: ArmKinematics,
    match: ModelMatch,
    report: RobotReport,
) -> ModelMatch:
    """Compares a report, if a comparison is due.

    Args:
        config: Settings; checked.
        kinematics: Of the modelled robot.
        match: After the report before.
        report: The newest.

    Returns:
        The next state; `problem` says what is wrong.
    """
    now = report.timestamp
    same = report.session == match.session
    if same and now - match.checked < config.check_period - 1e-6:
        return match
    match = _infer_offset(kinematics, match, report)
    mismatch = find_mismatch(config, kinematics, match, report)
    since = math.nan
    if mismatch:
        since = match.wrong_since
        if not same or math.isnan(since):
            since = now
    return dc.replace(
        match,
        checked=now,
        session=report.session,
        wrong_since=since,
        problem=mismatch if now - since >= config.confirm_time else "",
    )


def find_mismatch(
    config: ModelConfig,
    kinematics: ArmKinematics,
    match: ModelMatch,
    report: RobotReport,
) -> str:
    """Returns by how much model and report differ, in one line; else "".

    Args:
        config: Settings; checked.
        kinematics: Of the modelled robot.
        match: Has the tool if the report does not.
        report: The report to compare.
    """
    if not np.isfinite(report.tcp_pose).all():
        return "" if config.allow_no_pose else "reports no pose of its tool"
    if np.isfinite(report.tcp_offset).all():
        X_FT = make_pose(report.tcp_offset)
    elif match.X_FT is None:
        raise ValueError("match: does not know the tool")
    else:
        X_FT = match.X_FT
        length = float(np.linalg.norm(X_FT[:, 3]))
        if not length <= config.longest_tcp_offset:
            return (
                f"reported tool is {1e3 * length:.0f} mm from the modelled "
                f"arm's flange, more than {1e3 * config.longest_tcp_offset:.0f}"
                ": is it another robot?"
            )
    X_BT = compose(calc_flange_pose(kinematics, report.position), X_FT)
    distance, angle = calc_difference(X_BT, make_pose(report.tcp_pose))
    if distance <= config.position_tolerance and (
        angle <= config.angle_tolerance
    ):
        return ""
    return (
        f"reported tool is {1e3 * distance:.0f} mm and "
        f"{math.degrees(angle):.1f} deg from where the modelled arm has it "
        f"with these joints; {1e3 * config.position_tolerance:.0f} mm and "
        f"{math.degrees(config.angle_tolerance):.1f} deg are allowed"
    )


def describe_tool(
    config: ModelConfig, kinematics: ArmKinematics, report: RobotReport
) -> str:
    """Returns a line if the robot's tool is not the modelled one; else "".

    Args:
        config: Settings; checked.
        kinematics: Of the modelled robot with its tool.
        report: The robot's.
    """
    if not np.isfinite(report.tcp_pose).all():
        return (
            "robot: reports no pose of its tool: nothing shows whether it is "
            "the modelled arm (--allow-no-pose)"
        )
    X_FB = invert(calc_flange_pose(kinematics, report.position))
    p_FT = compose(X_FB, make_pose(report.tcp_pose))[:, 3]
    distance = float(np.linalg.norm(p_FT - kinematics.X_AS[-1][:, 3]))
    if distance <= config.position_tolerance:
        return ""
    return (
        f"robot: its tool centre point is set {1e3 * distance:.0f} mm from "
        "the modelled tool's: is it the modelled tool?"
    )


def _infer_offset(kinematics, match, report):
    """Returns a match with the tool that the report implies."""
    if (
        match.X_FT is not None
        or np.isfinite(report.tcp_offset).all()
        or not np.isfinite(report.tcp_pose).all()
    ):
        return match
    X_FB = invert(calc_flange_pose(kinematics, report.position))
    return dc.replace(match, X_FT=compose(X_FB, make_pose(report.tcp_pose)))


def calc_flange_pose(kinematics: ArmKinematics, q: np.ndarray) -> np.ndarray:
    """Returns X_BF (3, 4), the flange in UR's base frame.

    Args:
        kinematics: Of the robot.
        q: Joint angles, rad, (6,).
    """
    return kinematics.calc_link_poses_in_base(q)[-1]


def make_pose(vector: np.ndarray) -> np.ndarray:
    """Returns X (3, 4) of a pose as UR writes it.

    Args:
        vector: x, y, z in m, rotation vector in rad, (6,).
    """
    angle = float(np.linalg.norm(vector[3:]))
    if angle < 1e-12:
        R = np.eye(3)
    else:
        R = RotationMatrix(AngleAxis(angle, vector[3:] / angle)).matrix()
    return np.column_stack([R, vector[:3]])


def compose(X_AB: np.ndarray, X_BC: np.ndarray) -> np.ndarray:
    """Returns X_AC; all are (3, 4)."""
    R = X_AB[:, :3]
    return np.column_stack([R @ X_BC[:, :3], R @ X_BC[:, 3] + X_AB[:, 3]])


def invert(X_AB: np.ndarray) -> np.ndarray:
    """Returns X_BA; both are (3, 4)."""
    R = X_AB[:, :3].T
    return np.column_stack([R, -R @ X_AB[:, 3]])


def calc_difference(X_A: np.ndarray, X_B: np.ndarray) -> tuple[float, float]:
    """Returns distance, m, and angle, rad, between two poses, (3, 4) each."""
    cosine = 0.5 * (float(np.sum(X_A[:, :3] * X_B[:, :3])) - 1.0)
    return (
        math.dist(X_A[:, 3], X_B[:, 3]),
        math.acos(min(max(cosine, -1.0), 1.0)),
    )
