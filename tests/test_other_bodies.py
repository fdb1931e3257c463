"""The rooms after tracking on a body that is no upper body: legs, by a URDF and a table made here."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin import (
    BodyModel,
    OrientationSensor,
    Recording,
    Subject,
    TrackResult,
    WeposeError,
    evaluate,
    export,
    joint_angles,
    load_model,
    load_result,
    track,
)
from wepose_pin.body.configuration import compute_pose

ROOT = Path(__file__).resolve().parents[1]
THIGH, SHANK, FOOT, HIP = 0.42, 0.40, 0.18, 0.09  # [m]
SEGMENTS = ("pelvis", "left_thigh", "left_shank", "left_foot", "right_thigh", "right_shank", "right_foot")

LEFT = """
urdf = "legs.urdf"
[segments]
pelvis = { spine = true, labels = "pelvis|sacrum" }
left_thigh = { labels = "thigh|femur" }
left_shank = { labels = "shank|tibia" }
left_foot = { along = "+x", without_sensor = "rigid", labels = "foot" }
[points]
left_hip = "left_thigh"
left_knee = "left_shank"
left_ankle = "left_foot"
left_toe = "left_toe"
[lengths]
hip_width = { segment = "pelvis", from = "right_hip", to = "left_hip" }
left_thigh = { segment = "left_thigh", from = "left_hip", to = "left_knee" }
left_shank = { segment = "left_shank", from = "left_knee", to = "left_ankle" }
left_foot = { segment = "left_foot", from = "left_ankle", to = "left_toe" }
[hinges]
left_knee = { on = "left_thigh", moves = "left_shank", axis = [0.0, 1.0, 0.0], range_deg = [-10.0, 150.0] }
[pairs]
left_thigh = "right_thigh"
left_shank = "right_shank"
left_foot = "right_foot"
left_hip = "right_hip"
left_knee = "right_knee"
left_ankle = "right_ankle"
left_toe = "right_toe"
[draw]
limbs = [
    ["right_hip", "left_hip"],
    ["left_hip", "left_knee", "left_ankle", "left_toe"],
    ["right_hip", "right_knee", "right_ankle", "right_toe"],
]
paths = ["left_toe", "right_toe"]
"""
TABLE = re.sub(r"(?m)(^left_(?!.*right).*\n)+", lambda lines: lines[0] + lines[0].replace("left", "right"), LEFT)


def spherical(parent: str, child: str, origin: str) -> str:
    """Three revolute joints between two links of a URDF."""
    links = [parent, f"{child}_x_link", f"{child}_y_link", child]
    text = "".join(f'<link name="{link}"/>' for link in links[1:3])
    for k, axis in enumerate(("1 0 0", "0 1 0", "0 0 1")):
        text += (
            f'<joint name="{child}_{"xyz"[k]}" type="revolute">'
            f'<parent link="{links[k]}"/><child link="{links[k + 1]}"/>'
            f'<origin xyz="{origin if k == 0 else "0 0 0"}"/><axis xyz="{axis}"/>'
            '<limit lower="-3.14" upper="3.14" effort="100" velocity="40"/></joint>'
        )
    return text


def cylinder(link: str, length: float) -> str:
    return (
        f'<link name="{link}"><visual><origin xyz="0 0 {-length / 2}"/><geometry><cylinder radius="0.05" '
        f'length="{length}"/></geometry></visual></link>'
    )


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> BodyModel:
    urdf = '<robot name="legs"><link name="ground"/>' + cylinder("pelvis", 0.1) + spherical("ground", "pelvis", "0 0 0")
    for side, y in (("left", HIP), ("right", -HIP)):
        urdf += spherical("pelvis", f"{side}_thigh", f"0 {y} 0") + cylinder(f"{side}_thigh", THIGH)
        urdf += spherical(f"{side}_thigh", f"{side}_shank", f"0 0 {-THIGH}") + cylinder(f"{side}_shank", SHANK)
        urdf += spherical(f"{side}_shank", f"{side}_foot", f"0 0 {-SHANK}") + cylinder(f"{side}_foot", 0.05)
        urdf += (
            f'<link name="{side}_toe"/><joint name="{side}_toe" type="fixed"><parent link="{side}_foot"/>'
            f'<child link="{side}_toe"/><origin xyz="{FOOT} 0 0"/></joint>'
        )
    folder = tmp_path_factory.mktemp("legs")
    (folder / "legs.urdf").write_text(urdf + "</robot>", encoding="utf-8")
    (folder / "legs.toml").write_text(TABLE, encoding="utf-8")
    return load_model(folder / "legs.toml")


def squats(time: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Flexion of the knees [deg], and the orientations of the segments; it begins with 4 s of standing."""
    flexion = 45.0 * (1.0 - np.cos(2.0 * np.pi * 0.3 * np.clip(time - 4.0, 0.0, None)))
    tilts = {"pelvis": 0.2 * flexion, "thigh": -0.5 * flexion, "shank": 0.5 * flexion, "foot": 0.0 * flexion}
    return flexion, {
        name: Rotation.from_euler("y", tilts[name.split("_")[-1]][:, None], degrees=True).as_quat() for name in SEGMENTS
    }


@pytest.fixture(scope="module")
def tracked(body: BodyModel) -> TrackResult:
    time = np.arange(0.0, 20.0, 0.02)
    sensors: Mapping[str, OrientationSensor] = {
        name: OrientationSensor(quat_VS=quat, stated_quat_LS=np.array([0.0, 0.0, 0.0, 1.0]))
        for name, quat in squats(time)[1].items()
    }
    return track(Recording("squats", time, 50.0, sensors, phases={"start": ((0.5, 3.5),)}), model=body)


def test_knees_bend_forwards(tracked: TrackResult) -> None:
    flexion, _ = squats(tracked.time)
    knee = joint_angles(tracked)["left_knee"]
    np.testing.assert_allclose(np.degrees(knee["flexion"]), flexion, atol=0.01)
    np.testing.assert_allclose(tracked.points["left_toe"][0], [FOOT, HIP, -THIGH - SHANK], atol=1e-6)


def test_its_result_is_read_exported_and_evaluated(tracked: TrackResult, tmp_path: Path) -> None:
    result = load_result(tracked.save(tmp_path / "result"))
    assert result.model.table.draw.paths == ("left_toe", "right_toe")
    for suffix in ("bvh", "csv", "trc"):
        export(result, tmp_path / f"m.{suffix}")
    bvh = (tmp_path / "m.bvh").read_text(encoding="utf-8")
    bones = re.findall(r"(?:ROOT|JOINT) (\w+)", bvh)
    assert bones == ["Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot"]
    errors = evaluate(result, tracked)
    assert set(errors.position_on_limb) == {
        f"{side}_{p}" for side in ("left", "right") for p in ("knee", "ankle", "toe")
    }
    assert max(error.worst for error in errors.position_on_limb.values()) < 0.01


def test_a_waist_above_the_hips_is_there_in_a_bvh(tmp_path: Path) -> None:
    pybvh = pytest.importorskip("pybvh")
    text = (ROOT / "urdf" / "whole_body.urdf").read_text(encoding="utf-8")
    for parent, child, new, origin in (("root", "torso", "pelvis", "0 0 0.1"), ("torso", "pelvis", "root", "0 0 0")):
        joint = '<parent link="{}"/><child link="{}_x_link"/><origin xyz="{}"/>'
        text = text.replace(joint.format(parent, child, "0 0 0"), joint.format(new, child, origin))
    (tmp_path / "high.urdf").write_text(text, encoding="utf-8")
    body = load_model(tmp_path / "high.urdf")
    quat_WL = {segment: np.tile([0.0, 0.0, 0.0, 1.0], (9, 1)) for segment in body.table.segments}
    quat_WL["pelvis"] = Rotation.from_rotvec(np.linspace(0.0, 1.0, 9)[:, None] * [0.3, 0.8, 0.5]).as_quat()
    pose = compute_pose(body, np.arange(9) / 50.0, quat_WL)
    export(TrackResult("high", pose, body, Subject("high", {}, (), np.zeros((0, 0)))), tmp_path / "x.bvh")
    read = pybvh.read_bvh_file(tmp_path / "x.bvh")
    placed = dict(zip((node.name for node in read.nodes), read.node_positions().swapaxes(0, 1), strict=True))
    for joint, point in {"LeftUpLeg": "left_hip", "LeftArm": "left_shoulder"}.items():
        np.testing.assert_allclose(placed[joint], 100.0 * pose.points[point][:, [1, 2, 0]], atol=1e-4)


# A robot --------------------------------------------------------------------------------------------------------------

ROBOT = """<robot name="arm"><link name="base"/><link name="upper"/><link name="lower"/><link name="tip"/>
<joint name="lift" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.3" rpy="0.5 0 0"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="10" velocity="3"/></joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.4 0 0"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="10" velocity="3"/></joint>
<joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0.3 0 0"/></joint></robot>"""
ROBOT_TABLE = """
urdf = "arm.urdf"
kind = "mechanism"
[segments]
upper = { along = "+x" }
lower = { along = "+x" }
[points]
shoulder = "upper"
elbow = "lower"
tip = "tip"
[draw]
limbs = [["shoulder", "elbow", "tip"]]
paths = ["tip"]
"""


def as_result(model: BodyModel, lift: np.ndarray, bend: np.ndarray) -> TrackResult:
    R_upper = Rotation.from_euler("x", 0.5) * Rotation.from_euler("z", lift[:, None])
    quat_WL = {"upper": R_upper.as_quat(), "lower": (R_upper * Rotation.from_euler("y", bend[:, None])).as_quat()}
    pose = compute_pose(model, np.arange(len(lift)) / 50.0, quat_WL)
    return TrackResult("arm", pose, model, Subject("arm", {}, (), np.zeros((0, 0))))


def test_a_robots_joints_are_in_a_csv_and_not_in_a_mot(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(ROBOT, encoding="utf-8")
    (tmp_path / "arm.toml").write_text(ROBOT_TABLE, encoding="utf-8")
    swing = np.sin(np.arange(0.0, 2.0, 0.02))
    result = as_result(load_model(tmp_path / "arm.toml"), swing, np.full(len(swing), 0.3))
    result = replace(result, pose=replace(result.pose, joints=result.joints))
    with pytest.raises(WeposeError, match="is of a mechanism"):
        export(result, tmp_path / "m.mot")
    export(result, tmp_path / "m.csv")
    table = pl.read_csv(tmp_path / "m.csv")
    for name, each in result.joints.items():
        np.testing.assert_allclose(table[name], each, atol=1e-6)
