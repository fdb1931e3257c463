"""A robot arm of our own, in the forms that retargeting must cope with, and a person who moves."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin import retargeting
from wepose_pin.body.kinematics import Pose

UPPER, FORE, HAND = 0.30, 0.27, 0.08  # [m] of the person

MAP = """format = 1
urdf = "arm.urdf"
{base}up = "{up}"
forward = "{forward}"

[rest]
elbow = -1.2

[limits.acceleration]
{acceleration}

[arms.right]
joints = [{joints}]
shoulder = {{ link = "upper_arm", offset = [0.0, 0.0, 0.0] }}
elbow = {{ link = "forearm" }}
hand = {{ link = "hand", offset = [0.0, 0.0, -0.1], fingers = "-z", thumb = "+x" }}
"""
JOINTS = ("flexion", "abduction", "rotation", "elbow", "roll", "pitch", "yaw")


def write_arm(
    folder: Path,
    *,
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0),
    base: str = "base",
    up: str = "+z",
    forward: str = "+x",
    continuous: str = "",
    mimic: bool = False,
    without: str = "",
    acceleration: float = 12.0,
    torso: bool = True,
) -> Path:
    """``arm.urdf`` and ``arm.toml``: a right arm of seven joints beside a box of a torso; the path of the URDF.

    `turned`: how the base is fixed to the root [rad]. `continuous`: that joint turns without end. `mimic`: half of the
    elbow is a second joint that copies it. `without`: "JOINT.limit", "JOINT.velocity" or "JOINT.acceleration"
    is missing.
    """
    axes = {"flexion": "0 1 0", "abduction": "1 0 0", "rotation": "0 0 1", "elbow": "0 1 0", "roll": "0 0 1",
            "pitch": "0 1 0", "yaw": "1 0 0"}  # fmt: skip
    ends = {"flexion": (-3.0, 1.5), "abduction": (-2.5, 1.0), "rotation": (-2.5, 2.5), "elbow": (-2.6, -0.02),
            "roll": (-2.8, 2.8), "pitch": (-1.6, 1.6), "yaw": (-1.6, 1.6)}  # fmt: skip
    links = {"flexion": "s1", "abduction": "s2", "rotation": "upper_arm", "elbow": "forearm", "roll": "w1",
             "pitch": "w2", "yaw": "hand"}  # fmt: skip
    shapes = {"upper_arm": 0.36, "forearm": 0.30, "hand": 0.1}
    text = ['<robot name="arm"><link name="world"/>', '<link name="base">']
    if torso:
        text.append('<collision><origin xyz="0 0 -0.25"/><geometry><box size="0.24 0.3 0.6"/></geometry></collision>')
        text.append('<visual><origin xyz="0 0 -0.25"/><geometry><box size="0.24 0.3 0.6"/></geometry></visual>')
    text.append("</link>")
    r, p, y = turned
    text.append(
        '<joint name="stand" type="fixed"><parent link="world"/><child link="base"/>'
        f'<origin xyz="0.2 0.1 0.5" rpy="{r!r} {p!r} {y!r}"/></joint>'
    )
    parent, at = "base", "0 -0.28 0"
    for name in JOINTS:
        link = links[name]
        text.append(f'<link name="{link}">')
        if link in shapes:
            length = shapes[link]
            shape = f'<origin xyz="0 0 {-length / 2}"/>'
            shape += f'<geometry><cylinder radius="0.035" length="{length - 0.06}"/></geometry>'
            text += [f"<collision>{shape}</collision>", f"<visual>{shape}</visual>"]
        text.append("</link>")
        low, high = ends[name]
        kind = "revolute"
        limit = f'<limit lower="{low}" upper="{high}" velocity="3.0" effort="50"/>'
        if name == continuous:
            kind, limit = "continuous", '<limit velocity="3.0" effort="50"/>'
        if without == f"{name}.limit":
            limit = '<limit velocity="3.0" effort="50"/>'
        if without == f"{name}.velocity":
            limit = f'<limit lower="{low}" upper="{high}" velocity="0" effort="50"/>'
        if name == "elbow" and mimic:
            half = f'<limit lower="{low / 2}" upper="{high / 2}" velocity="3.0" effort="50"/>'
            text.append(_joint("elbow", "revolute", parent, "half", at, axes[name], half))
            copy = half + '<mimic joint="elbow" multiplier="1.0" offset="0.0"/>'
            text += ['<link name="half"/>', _joint("elbow_copy", "revolute", "half", link, "0 0 0", axes[name], copy)]
        else:
            text.append(_joint(name, kind, parent, link, at, axes[name], limit))
        parent = link
        at = {"rotation": "0 0 -0.36", "roll": "0 0 -0.30"}.get(name, "0 0 0")
    (folder / "arm.urdf").write_text("\n".join([*text, "</robot>"]), encoding="utf-8")
    named = [name for name in JOINTS if without != f"{name}.acceleration"]
    (folder / "arm.toml").write_text(
        MAP.format(
            base=f'base = "{base}"\n' if base else "",
            up=up,
            forward=forward,
            acceleration="\n".join(f"{name} = {acceleration}" for name in named),
            joints=", ".join(f'"{name}"' for name in JOINTS),
        ).replace("elbow = -1.2", "elbow = -0.6" if mimic else "elbow = -1.2"),
        encoding="utf-8",
    )
    return folder / "arm.urdf"


def _joint(name: str, kind: str, parent: str, child: str, at: str, axis: str, limit: str) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/>{limit}</joint>'
    )


def is_sound(trajectory: retargeting.Trajectory) -> None:
    """Limits against the URDF and the map, and no contact; none of it by the solver's code."""
    robot = trajectory.robot
    limits = retargeting.check_limits(retargeting.build_table(trajectory), robot.map)
    assert limits.passed, limits
    contacts = retargeting.find_self_collisions(robot, trajectory.time, trajectory.joint_position)
    assert contacts.samples == 0, contacts.first
    assert contacts.pairs > 1
    assert np.isfinite(trajectory.joint_position).all()


def person(
    seconds: float = 8.0,
    *,
    side: str = "right",
    size: float = 1.0,
    swing: float = 25.0,
    flexion: float = 70.0,
    abduction: float = 15.0,
    rate_hz: float = 100.0,
) -> Pose:
    """An arm that swings and bends: angles in deg, `size` scales the person."""
    time = np.arange(0.0, seconds, 1.0 / rate_hz)
    wave = np.sin(2.0 * np.pi * 0.4 * time)
    out = -1.0 if side == "right" else 1.0
    R_upper = _about("y", -20.0 - swing * wave) * _about("x", np.full(len(time), out * abduction))
    R_fore = R_upper * _about("y", -flexion - 0.8 * swing * np.cos(2.0 * np.pi * 0.3 * time))
    shoulder = np.tile([0.0, out * 0.19, 0.45], (len(time), 1))
    elbow = shoulder + R_upper.apply([0.0, 0.0, -UPPER * size])
    wrist = elbow + R_fore.apply([0.0, 0.0, -FORE * size])
    hand = wrist + R_fore.apply([0.0, 0.0, -HAND * size])
    quat = {
        "torso": np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1)),
        f"{side}_upper_arm": R_upper.as_quat(),
        f"{side}_forearm": R_fore.as_quat(),
    }
    points = dict(zip(("shoulder", "elbow", "wrist", "palm"), (shoulder, elbow, wrist, hand), strict=True))
    return Pose(time, quat, {f"{side}_{name}": p for name, p in points.items()})


def _about(axis: str, angle_deg: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(np.radians(angle_deg)[:, None] * np.eye(3)["xyz".index(axis)])
