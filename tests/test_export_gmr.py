"""Files for GMR and for robot learning on humanoids, read as their loaders read them.

The readers here were written from a description of GMR's loaders (what their patterns accept, how they compose angles,
turn axes and name bones); the rotations from bones to links of the G1 are numbers of GMR's IK configurations.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import pytest
from bodies import RIGID_SHOULDERS, SEGMENTS
from scipy.spatial.transform import Rotation
from test_export import LENGTHS, a_pose, write_folder

from wepose_pin.errors import BadData
from wepose_pin.kinematics import Pose, compute_pose
from wepose_pin.model import load_model
from wepose_pin.model.meshes import find_example_data
from wepose_pin.writers.export import export
from wepose_pin.writers.gmr import RIGS, write_gmr
from wepose_pin.writers.motion import Motion

H = np.sqrt(0.5)
ARM, FOREARM, WRIST = "{}_shoulder_yaw_link", "{}_elbow_link", "{}_wrist_yaw_link"
LEG_LINKS = ("{}_hip_yaw_link", "{}_knee_link", "{}_ankle_roll_link")
# Link of the G1 → bone and the rotation (wxyz) from it to the link, as GMR's configurations for the G1 have them.
G1_LAFAN1 = {
    "pelvis": ("Hips", (0.5, 0.5, 0.5, 0.5)),
    "torso_link": ("Spine2", (0.5, 0.5, 0.5, 0.5)),
    LEG_LINKS[0]: ("{}UpLeg", (-0.5, 0.5, 0.5, -0.5)),
    LEG_LINKS[1]: ("{}Leg", (-0.5, 0.5, 0.5, -0.5)),
    LEG_LINKS[2]: ("{}FootMod", (-H, H, 0.0, 0.0)),
    ARM: ("{}Arm", (0.5, 0.5, -0.5, -0.5)),
    FOREARM: ("{}ForeArm", (H, H, 0.0, 0.0)),
    WRIST: ("{}Hand", (H, H, 0.0, 0.0)),
}
G1_NOKOV = {
    **{link: (bone, (0.5, -0.5, -0.5, -0.5)) for link, (bone, _) in G1_LAFAN1.items()},
    ARM.format("left"): ("LeftArm", (H, 0.0, -H, 0.0)),
    FOREARM.format("left"): ("LeftForeArm", (1.0, 0.0, 0.0, 0.0)),
    WRIST.format("left"): ("LeftHand", (1.0, 0.0, 0.0, 0.0)),
    ARM.format("right"): ("RightArm", (0.0, H, 0.0, H)),
    FOREARM.format("right"): ("RightForeArm", (0.0, 0.0, 0.0, 1.0)),
    WRIST.format("right"): ("RightHand", (0.0, 0.0, 0.0, 1.0)),
}
G1_XSENS = {
    "pelvis": ("Hips", (1.0, 0.0, 0.0, 0.0)),
    "torso_link": ("Chest4", (1.0, 0.0, 0.0, 0.0)),
    LEG_LINKS[0]: ("{}Hip", (1.0, 0.0, 0.0, 0.0)),
    LEG_LINKS[1]: ("{}Knee", (1.0, 0.0, 0.0, 0.0)),
    LEG_LINKS[2]: ("{}Ankle", (1.0, 0.0, 0.0, 0.0)),
    ARM: ("{}Shoulder", (1.0, 0.0, 0.0, 0.0)),
    FOREARM: ("{}Elbow", (H, 0.0, H, 0.0)),
    WRIST: ("{}Wrist", (H, 0.0, H, 0.0)),
}
G1_SOMA = {
    "pelvis": ("Hips", (-0.49916833, -0.49916833, -0.50083029, -0.50083029)),
    "torso_link": ("Chest", (-0.49911486, -0.49911486, -0.50088357, -0.50088357)),
    "left_hip_yaw_link": ("LeftLeg", (0.45442310, 0.45442310, -0.54175609, -0.54175606)),
    "left_knee_link": ("LeftShin", (0.49999709, 0.49999712, -0.50000293, -0.50000287)),
    "left_ankle_roll_link": ("LeftFoot", (0.69534997, 0.69534997, -0.12840721, -0.12840723)),
    "right_hip_yaw_link": ("RightLeg", (-0.54175607, -0.54175607, -0.45442314, -0.45442308)),
    "right_knee_link": ("RightShin", (-0.50000292, -0.50000286, -0.49999711, -0.49999711)),
    "right_ankle_roll_link": ("RightFoot", (-0.12840721, -0.12840721, -0.69534998, -0.69534998)),
    "left_shoulder_yaw_link": ("LeftArm", (0.45199432, -0.56585624, -0.51306387, 0.46073128)),
    "left_elbow_link": ("LeftForeArm", (0.64502291, -0.76361881, 0.01772480, 0.02275075)),
    "left_wrist_yaw_link": ("LeftHand", (0.69248383, -0.71948264, 0.02659078, 0.04586724)),
    "right_shoulder_yaw_link": ("RightArm", (-0.51306348, 0.46073143, -0.45199405, 0.56585668)),
    "right_elbow_link": ("RightForeArm", (0.01772536, 0.02275101, -0.64502281, 0.76361887)),
    "right_wrist_yaw_link": ("RightHand", (0.02659075, 0.04586791, -0.69248369, 0.71948274)),
}
CONFIGS = {"soma": G1_SOMA, "lafan1": G1_LAFAN1, "nokov": G1_NOKOV, "xsens": G1_XSENS}
BONES = {  # shoulder, elbow, wrist
    "lafan1": ("{}Arm", "{}ForeArm", "{}Hand"),
    "nokov": ("{}Arm", "{}ForeArm", "{}Hand"),
    "soma": ("{}Arm", "{}ForeArm", "{}Hand"),
    "xsens": ("{}Shoulder", "{}Elbow", "{}Wrist"),
}


class Frames(NamedTuple):
    """Bone → orientations and places (n, 3) [m] in the loader's world, z up; seconds a frame."""

    R: dict[str, Rotation]
    p: dict[str, np.ndarray]
    frame_time: float


def read_lafan(file: Path, toe: str) -> Frames:
    """As GMR's `lafan1` and `nokov`: patterns that know no sign of plus and single spaces, one order for all bones."""
    names: list[str] = []
    parents, offsets, rows = [], [], []
    active, end, order, count, frame_time = -1, False, "", 0, 0.0
    for line in file.read_text().splitlines():
        if "HIERARCHY" in line or "MOTION" in line or "{" in line:
            continue
        if joint := re.match(r"\s*(?:ROOT|JOINT)\s+([\w:]+)", line):
            names.append(joint[1])
            parents.append(active)
            offsets.append([0.0, 0.0, 0.0])
            active = len(names) - 1
        elif "}" in line:
            end, active = False, active if end else parents[active]
        elif match := re.match(r"\s*OFFSET\s+([\-\d\.e]+)\s+([\-\d\.e]+)\s+([\-\d\.e]+)", line):
            if not end:
                offsets[active] = [float(number) for number in match.groups()]
        elif match := re.match(r"\s*CHANNELS\s+(\d+)", line):
            count = int(match[1])
            order = order or "".join(name[0] for name in line.split()[-3:])
        elif "End Site" in line:
            end = True
        elif match := re.match(r"\s*Frames:\s+(\d+)", line):
            expected = int(match[1])
        elif match := re.match(r"\s*Frame Time:\s+([\d\.]+)", line):
            frame_time = float(match[1])
        else:
            rows.append([float(number) for number in line.strip().split(" ")])
    numbers = np.array(rows)
    assert (count, len(numbers)) == (3, expected)
    angles = numbers[:, 3:].reshape(len(numbers), len(names), 3)
    to_world = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    R: dict[str, Rotation] = {}
    p: dict[str, np.ndarray] = {}
    for k, name in enumerate(names):
        local = Rotation.from_euler(order, angles[:, k], degrees=True)
        above = names[parents[k]]
        R[name] = R[above] * local if k else to_world * local
        p[name] = p[above] + R[above].apply(offsets[k]) / 100.0 if k else to_world.apply(numbers[:, :3]) / 100.0
    for side in ("Left", "Right"):
        R[f"{side}FootMod"], p[f"{side}FootMod"] = R[f"{side}{toe}"], p[f"{side}Foot"]
    return Frames(R, p, frame_time)


def read_xsens(file: Path) -> Frames:
    """As GMR's `3DSM` with `--scale 1`: numbers with a point, always Ry Rx Rz, the first place to zero."""
    number = r"[-+]?\d*\.\d+|[-+]?\d+\.\d*"
    names: list[str] = []
    parents, offsets, rows = [], [], []
    stack: list[int] = []
    for line in map(str.strip, file.read_text().strip().split("\n")):
        if line.startswith(("ROOT", "JOINT", "End Site")):
            parents.append(stack[-1] if stack else -1)
            names.append(f"{names[stack[-1]]}_end_site" if line == "End Site" else line.split()[1])
            stack.append(len(names) - 1)
        elif line == "}":
            stack.pop()
        elif line.startswith("OFFSET"):
            x, y, z = map(float, re.findall(number, line))
            offsets.append([z, x, y])
        elif line.startswith("CHANNELS"):
            assert line.endswith("Yrotation Xrotation Zrotation")
        elif line.startswith("Frames:"):
            expected = int(line.split()[1])
        elif line.startswith("Frame Time:"):
            frame_time = float(line.split()[2])
        elif line not in ("HIERARCHY", "MOTION", "{"):
            rows.append([float(each) for each in re.findall(number, line)])
    numbers = np.array(rows)
    assert len(numbers) == expected
    root = numbers[:, [2, 0, 1]]
    root[:, :2] -= root[0, :2]
    R: dict[str, Rotation] = {}
    p: dict[str, np.ndarray] = {}
    column = 3
    for k, name in enumerate(names):
        local = Rotation.identity(len(numbers))
        if not name.endswith("_end_site"):
            y, x, z = numbers[:, column : column + 3].T
            local = Rotation.from_euler("xyz", np.column_stack([z, x, y]), degrees=True)  # x, y, z are file z, x, y
            column += 3
        above = names[parents[k]]
        R[name] = R[above] * local if k else local
        p[name] = p[above] + R[above].apply(offsets[k]) if k else root
    assert column == numbers.shape[1]
    for side in ("Left", "Right"):
        R[f"{side}FootMod"], p[f"{side}FootMod"] = R[f"{side}Ankle"], p[f"{side}Ankle"]
    return Frames(R, p, frame_time)


def read_soma(file: Path) -> Frames:
    """As GMR's `soma`: channels of each joint as they are listed, composed from left to right."""
    names: list[str] = []
    parents, offsets, channels, rows = [], [], [], []
    stack: list[int] = []
    end, frame_time = False, 0.0
    for line in file.read_text().splitlines():
        if joint := re.match(r"\s*(?:ROOT|JOINT)\s+(\S+)", line):
            names.append(joint[1])
            parents.append(stack[-1] if stack else -1)
            stack.append(len(names) - 1)
        elif "End Site" in line:
            end = True
        elif "}" in line:
            if not end:
                stack.pop()
            end = False
        elif (match := re.match(r"\s*OFFSET\s+([\-\d\.eE]+)\s+([\-\d\.eE]+)\s+([\-\d\.eE]+)", line)) and not end:
            offsets.append([float(number) for number in match.groups()])
        elif match := re.match(r"\s*CHANNELS\s+(\d+)\s+(.+)", line):
            channels.append(match[2].split())
        elif match := re.match(r"\s*Frame Time:\s+([\d\.eE]+)", line):
            frame_time = float(match[1])
        elif re.match(r"-?\d", line):
            rows.append([float(number) for number in line.split()])
    numbers = np.array(rows)
    to_world = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    R: dict[str, Rotation] = {}
    p: dict[str, np.ndarray] = {}
    column = 0
    for k, name in enumerate(names):
        at = np.tile(offsets[k], (len(numbers), 1))
        local = Rotation.identity(len(numbers))
        for channel in channels[k]:
            values, axis = numbers[:, column], "XYZ".index(channel[0])
            if channel.endswith("position"):
                at[:, axis] = values
            else:
                local = local * Rotation.from_rotvec(np.radians(values)[:, None] * np.eye(3)[axis])
            column += 1
        above = names[parents[k]]
        p[name] = p[above] + R[above].apply(at) / 100.0 if k else to_world.apply(at) / 100.0
        R[name] = R[above] * local if k else to_world * local
    assert column == numbers.shape[1]
    for side in ("Left", "Right"):
        R[f"{side}FootMod"], p[f"{side}FootMod"] = R[f"{side}Foot"], p[f"{side}Foot"]
    return Frames(R, p, frame_time)


READERS: dict[str, Any] = {
    "soma": read_soma,
    "lafan1": lambda file: read_lafan(file, "Toe"),
    "nokov": lambda file: read_lafan(file, "ToeBase"),
    "xsens": read_xsens,
}


def find_targets(frames: Frames, config: dict[str, Any]) -> dict[str, Rotation]:
    """Link of the G1 → the orientations that GMR's IK asks of it."""
    targets = {}
    for link, (bone, (w, x, y, z)) in config.items():
        sides = ("left", "right") if "{}" in link else ("",)
        for side in sides:
            offset = Rotation.from_quat([x, y, z, w])
            targets[link.format(side)] = frames.R[bone.format(side.capitalize())] * offset
    return targets


def upright(**flexed: float) -> Pose:
    """A person who stands with hanging arms, forearms bent forward by so much [deg]; two samples."""
    quat = {name: np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)) for name in SEGMENTS if name not in ("pelvis", "head")}
    for side, angle in flexed.items():
        bent = np.tile(Rotation.from_euler("y", -angle, degrees=True).as_quat(), (2, 1))
        quat |= {f"{side}_forearm": bent, f"{side}_hand": bent}
    return compute_pose(load_model(lengths=LENGTHS), np.array([0.0, 0.01]), quat)


@pytest.mark.parametrize("loader", ["lafan1", "nokov", "soma", "xsens"])
def test_the_zero_pose_of_the_g1_is_asked_of_it(tmp_path: Path, loader: str) -> None:
    """At zero the G1 stands with hanging arms and forearms ahead. A person who does so must ask just that of it."""
    data = find_example_data()
    if data is None:
        pytest.skip("example-robot-data is not installed")
    model = pin.buildModelFromUrdf(str(data / "g1_description/urdf/g1_29dof_rev_1_0.urdf"))
    placed = model.createData()
    pin.framesForwardKinematics(model, placed, pin.neutral(model))
    file = tmp_path / "x.bvh"
    export(write_folder(tmp_path / "r", upright(left=90.0, right=90.0)), file, f"bvh-{loader}")
    targets = find_targets(READERS[loader](file), CONFIGS[loader])
    assert len(targets) == 14
    for link, R in targets.items():
        zero = Rotation.from_matrix(placed.oMf[model.getFrameId(link)].rotation)
        # The links of the hips' third joints are tilted by 10 deg in this G1, which only the configuration for SOMA
        # has; no other link by more than 0.02.
        tilted = "hip_yaw" in link and loader != "soma"
        assert (zero.inv() * R).magnitude().max() < np.radians(10.1 if tilted else 0.02), link


@pytest.mark.parametrize("loader", ["lafan1", "nokov", "soma", "xsens"])
def test_gmr_gets_every_bone_where_and_as_it_was(tmp_path: Path, loader: str) -> None:
    pose = a_pose(tuple(name for name in SEGMENTS if name != "pelvis"))
    file = tmp_path / "x.bvh"
    export(write_folder(tmp_path / "r", pose), file, f"bvh-{loader}")
    frames = READERS[loader](file)
    assert frames.frame_time == pytest.approx(0.01)
    body = replace(load_model(lengths=LENGTHS), girdles=RIGID_SHOULDERS)
    points = compute_pose(body, pose.time, pose.quat_WL).points  # offsets are constant: shoulders stay on the torso
    for side in ("left", "right"):
        for bone, point in zip(BONES[loader], ("shoulder", "elbow", "wrist"), strict=True):
            expected = points[f"{side}_{point}"] + [0.0, 0.0, 0.95]
            np.testing.assert_allclose(frames.p[bone.format(side.capitalize())], expected, atol=2e-6)
        ankle = frames.p[f"{side.capitalize()}FootMod"]
        np.testing.assert_allclose(ankle, np.tile([0.0, 0.09 if side == "left" else -0.09, 0.09], (301, 1)), atol=1e-6)
    targets = find_targets(frames, CONFIGS[loader])
    bent = Rotation.from_euler("y", 90, degrees=True)  # the G1's forearm is ahead at zero
    for link, segment, zero in (
        ("torso_link", "torso", Rotation.identity()),
        ("left_shoulder_yaw_link", "left_upper_arm", Rotation.identity()),
        ("right_shoulder_yaw_link", "right_upper_arm", Rotation.identity()),
        ("left_elbow_link", "left_forearm", bent),
        ("right_elbow_link", "right_forearm", bent),
        ("right_wrist_yaw_link", "right_hand", bent),
    ):
        off = (targets[link].inv() * Rotation.from_quat(pose.quat_WL[segment]) * zero).magnitude()
        assert off.max() < 3e-7, link
    if loader == "xsens":
        height = frames.p["Head_end_site"][0, 2] - frames.p["LeftToe_end_site"][0, 2]
        assert 1.6 < height < 1.9  # GMR scales the person by it


def test_a_walk_on_the_spot_keeps_the_heading_of_the_pelvis(tmp_path: Path) -> None:
    pose = a_pose(n=50)
    export(write_folder(tmp_path / "r", pose), tmp_path / "x.bvh", "bvh-lafan1")
    pelvis = find_targets(read_lafan(tmp_path / "x.bvh", "Toe"), CONFIGS["lafan1"])["pelvis"]
    forward = Rotation.from_quat(pose.quat_WL["pelvis"]).apply([1.0, 0.0, 0.0])
    yaw = pelvis.as_euler("ZYX")
    np.testing.assert_allclose(yaw[:, 1:], 0.0, atol=1e-7)
    np.testing.assert_allclose(yaw[:, 0], np.arctan2(forward[:, 1], forward[:, 0]), atol=0.05)


def test_measured_legs_move_on_the_floor(tmp_path: Path) -> None:
    """A person who squats: hips go down by as much as the knees take, feet stay where the ankles let them."""
    angle = np.radians(np.linspace(0.0, 60.0, 30))

    def bent(sign: float) -> np.ndarray:
        return Rotation.from_rotvec(sign * angle[:, None] * [0.0, 1.0, 0.0]).as_quat()

    model = load_model("whole_body")
    quat = {name: np.tile([0.0, 0.0, 0.0, 1.0], (30, 1)) for name in ("torso", "pelvis", "left_foot", "right_foot")}
    for side in ("left", "right"):
        quat |= {f"{side}_thigh": bent(-1.0), f"{side}_shank": bent(1.0)}
    pose = compute_pose(model, np.arange(30) / 100.0, quat)
    write_gmr(tmp_path / "x.bvh", Motion(pose, model, "x", "x"), RIGS["lafan1"])
    frames = read_lafan(tmp_path / "x.bvh", "Toe")
    hips = frames.p["Hips"][:, 2]
    thigh, shank = model.lengths["left_thigh"], model.lengths["left_shank"]
    np.testing.assert_allclose(hips, hips[0] - (thigh + shank) * (1.0 - np.cos(angle)), atol=2e-6)
    np.testing.assert_allclose(frames.p["LeftToe"][:, 2], frames.p["LeftToe"][0, 2], atol=2e-6)
    for bone, point in (("LeftLeg", "left_knee"), ("RightFoot", "right_ankle")):
        np.testing.assert_allclose(frames.p[bone] - frames.p["Hips"], pose.points[point], atol=2e-6)
    targets = find_targets(frames, CONFIGS["lafan1"])
    off = targets["left_knee_link"].inv() * Rotation.from_quat(quat["left_shank"])
    assert off.magnitude().max() < 1e-7


def test_gmr_needs_the_torso_of_a_person(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", a_pose(("left_upper_arm", "left_forearm"), n=5))
    with pytest.raises(BadData, match="no orientation of the torso"):
        export(folder, tmp_path / "x.bvh", "bvh-xsens")
    assert not (tmp_path / "x.bvh").exists()
