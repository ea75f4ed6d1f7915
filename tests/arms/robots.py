"""Arms for tests: small descriptions, and a public one."""

from tofssm_drake.arms.arm import Arm

PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"


def make_panda(**settings):
    """Returns the Panda of example-robot-data with its fingers fixed."""
    return Arm(
        **{
            "file": PANDA,
            "flange_frame": "panda_hand_tcp",
            "tool": "",
            "fixed_joints": {
                "panda_finger_joint1": 0.02,
                "panda_finger_joint2": 0.02,
            },
            "joint_acceleration": [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
            "sensed": "capsules",
        }
        | settings
    )


def make_body(name, mass=1.0):
    return (
        f'<link name="{name}"><inertial><mass value="{mass}"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        '</inertial><collision name="c"><geometry><box size="0.1 0.2 0.3"/>'
        '</geometry></collision><visual name="v"><geometry>'
        '<cylinder radius="0.04" length="0.2"/></geometry></visual></link>'
    )


def make_joint(name, kind, parent, child, xyz, rpy, axis="0 0 1"):
    limits = "" if kind == "continuous" else 'lower="-2" upper="1.5" '
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
        f'<axis xyz="{axis}"/><limit {limits}velocity="2" effort="50"/>'
        "</joint>"
    )


def make_urdf(joints, *, tool):
    """Returns a URDF whose joints are the rows (kind, xyz, rpy, axis)."""
    text = '<robot name="arm">' + make_body("link_0")
    for i, (kind, xyz, rpy, axis) in enumerate(joints, start=1):
        text += make_body(f"link_{i}")
        text += make_joint(
            f"joint_{i}", kind, f"link_{i - 1}", f"link_{i}", xyz, rpy, axis
        )
    return text + f'<frame name="tcp" link="{tool}" xyz="0.1 0.2 0.3"/></robot>'


# Axes along and across the links' own, and tilted; welds in between.
CHAINS = {
    "one joint": [("revolute", "0 0 1", "0.1 0 0", "0 1 0")],
    "tilted": [
        ("prismatic", "0.1 0 0.2", "0.3 -0.2 0.1", "0.6 0 0.8"),
        ("fixed", "0 0.3 0", "0 0.4 0", "0 0 1"),
        ("revolute", "0 0 0.3", "1 2 -0.5", "-0.48 0.6 -0.64"),
        ("prismatic", "0.1 -0.2 0", "-0.3 0 0.7", "0 0 -1"),
        ("continuous", "0.2 0 0.1", "0 0.2 0", "0 1 0"),
        ("fixed", "0 0 0.1", "0 0 1", "0 0 1"),
    ],
    "seven joints": [
        ("revolute", "0 0 0.3", "0 0 0", "0 0 1"),
        ("revolute", "0 0 0", "-1.57 0 0", "0 0 1"),
        ("revolute", "0 -0.3 0", "1.57 0 0", "0 0 1"),
        ("revolute", "0.1 0 0", "1.57 0 0", "0 0 1"),
        ("revolute", "-0.1 0.4 0", "-1.57 0 0", "0 0 1"),
        ("revolute", "0 0 0", "1.57 0 0", "0 0 1"),
        ("revolute", "0.1 0 0", "1.57 0 0", "0 0 1"),
    ],
}
