"""Xsens MVNX: a real export, tracked, against Xsens's own positions; made files of each version, and damaged ones."""

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from device_files import MVN_SEGMENTS, mvnx, turning
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin import BadData, BadSession, track

OURS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")


def session(folder: Path, file: str | Path, segments: tuple[str, ...], data: str = "", each: str = "") -> Path:
    tables = "".join(f"[sensors.{name}]\n{each}\n" for name in segments)
    (folder / "session.toml").write_text(f'[data]\nfile = "{file}"\n{data}\n{tables}', encoding="utf-8")
    return folder / "session.toml"


@pytest.fixture(scope="module")
def xsens(data: Path) -> tuple[Path, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The file, Xsens's own joint positions in the identity pose (3,) and over time (n, 3), by segment."""
    path = data / "mvnx" / "test_mocap.mvnx"
    root = ElementTree.parse(path).getroot()
    name = "{http://www.xsens.com/mvn/mvnx}"
    labels = [segment.get("label") or "" for segment in root.iter(f"{name}segment")]
    at: dict[str, list[np.ndarray]] = {}
    for frame in root.iter(f"{name}frame"):
        text = frame.findtext(f"{name}position") or ""
        at.setdefault(frame.get("type") or "", []).append(np.array(text.split(), dtype=float).reshape(-1, 3))
    still, moving = at["identity"][0], np.array(at["normal"])
    return (
        path,
        {label: still[k] for k, label in enumerate(labels)},
        {label: moving[:, k] for k, label in enumerate(labels)},
    )


@pytest.fixture(scope="module")
def tracked(
    xsens: tuple[Path, dict[str, np.ndarray], dict[str, np.ndarray]], tmp_path_factory: pytest.TempPathFactory
) -> tuple[wp.Pose, dict[str, np.ndarray]]:
    """Our pose with Xsens's lengths, and Xsens's positions (n, 3) turned to our heading."""
    path, still, moving = xsens
    lengths = {}
    for side, name in (("left", "Left"), ("right", "Right")):
        lengths[f"{side}_upper_arm"] = np.linalg.norm(still[f"{name}ForeArm"] - still[f"{name}UpperArm"])
        lengths[f"{side}_forearm"] = np.linalg.norm(still[f"{name}Hand"] - still[f"{name}ForeArm"])
    lengths["shoulder_width"] = np.linalg.norm(still["LeftUpperArm"] - still["RightUpperArm"])
    subject = wp.population_subject()
    subject = replace(subject, lengths={**subject.lengths, **{name: float(v) for name, v in lengths.items()}})
    pose = track(wp.load_session(session(tmp_path_factory.mktemp("mvnx"), path, OURS)), subject)
    turn = Rotation.from_rotvec([0.0, 0.0, pose.segments.heading_offset["torso"]])
    return pose, {label: turn.apply(position) for label, position in moving.items()}


@pytest.mark.parametrize(("side", "name"), [("left", "Left"), ("right", "Right")])
def test_elbow_and_wrist_stand_to_the_shoulder_as_in_xsens(tracked, side: str, name: str) -> None:
    pose, xsens = tracked
    for point, joint in (("elbow", "ForeArm"), ("wrist", "Hand")):
        ours = pose.points[f"{side}_{point}"] - pose.points[f"{side}_shoulder"]
        theirs = xsens[f"{name}{joint}"] - xsens[f"{name}UpperArm"]
        assert np.linalg.norm(ours - theirs, axis=1).max() < 1e-3  # 0.17 mm found


@pytest.mark.parametrize("file", ["test_mocap.mvnx", "Meri-020.mvnx"])
@pytest.mark.parametrize(("side", "name"), [("left", "Left"), ("right", "Right")])
def test_elbow_and_wrist_have_the_joint_angles_of_xsens(
    data: Path, tmp_path: Path, file: str, side: str, name: str
) -> None:
    """Of MVN's three, z, x, y of a Z-X-Y sequence as the ISB has it, abduction (x) has the other sign."""
    path = tmp_path / file
    tree = ElementTree.parse(data / "mvnx" / file)
    frames = tree.getroot().find(".//{*}frames")
    assert frames is not None
    moving = [frame for frame in frames if frame.get("type") == "normal"]
    for k in range(len(moving), 100):  # repeated, one after the other, to 100 at least
        frames.append(deepcopy(moving[k % len(moving)]))
        frames[-1].set("index", str(k))
    tree.write(path)
    angles = wp.joint_angles(
        wp.track(
            wp.load_session(session(tmp_path, path, (*OURS, "left_hand", "right_hand"), 'use = "orientation"'))
        ).pose
    )
    root = ElementTree.parse(path).getroot()
    xmlns = "{http://www.xsens.com/mvn/mvnx}"
    labels = [joint.get("label") for joint in root.iter(f"{xmlns}joint")]
    frames = [frame for frame in root.iter(f"{xmlns}frame") if frame.get("type") == "normal"]
    theirs = np.array([(frame.findtext(f"{xmlns}jointAngle") or "").split() for frame in frames], dtype=float)
    theirs = theirs.reshape(len(frames), len(labels), 3)
    for joint in ("elbow", "wrist"):
        x, y, z = theirs[:, labels.index(f"j{name}{joint.capitalize()}")].T
        turn = Rotation.from_euler("ZXY", np.column_stack([z, -x, y]), degrees=True)
        off = (turn.inv() * Rotation.from_quat(angles[f"{side}_{joint}"].quat)).magnitude()
        assert np.degrees(off.max()) < 0.001
    if side == "right":  # the left elbow goes through gimbal lock
        np.testing.assert_allclose(np.degrees(angles["right_wrist"].values), np.column_stack([z, -x, y]), atol=0.001)


def test_the_torso_faces_x_and_arms_keep_what_they_had_to_it(tracked) -> None:
    pose, _ = tracked
    recording = pose.recording
    assert recording.rate_hz == pytest.approx(60.0)
    assert all(sensor.aligned for sensor in recording.sensors.values())
    assert "start-pose-guessed" not in {each.code for each in pose.diagnostics}
    start = recording.span(pose.segments.start)
    forward = Rotation.from_quat(pose.quat_WL["torso"][start]).mean().apply([1.0, 0.0, 0.0])
    assert abs(np.arctan2(forward[1], forward[0])) < 0.01
    torso, arm = (Rotation.from_quat(recording.sensors[name].quat_VS) for name in ("torso", "left_forearm"))
    ours = Rotation.from_quat(pose.quat_WL["torso"]).inv() * Rotation.from_quat(pose.quat_WL["left_forearm"])
    assert (ours.inv() * torso.inv() * arm).magnitude().max() < 1e-9


def made(folder: Path, path: Path, segments: tuple[str, ...]) -> wp.Recording:
    return wp.load_session(session(folder, path.name, segments))


@pytest.mark.parametrize("version", ["2", "3", "4"])
def test_poses_are_no_motion_and_segment_frames_are_those_of_the_n_pose(version: str, tmp_path: Path) -> None:
    recording = made(tmp_path, mvnx(tmp_path, turning(), version=version), ("torso", "left_forearm", "right_upper_arm"))
    np.testing.assert_allclose(recording.time, np.arange(40) / 50.0)
    # In the T-pose the left arm points along +y of the world: along −z of its segment, palm down, is a quarter turn.
    left = Rotation.from_quat(recording.sensors["left_forearm"].quat_VS[0])
    np.testing.assert_allclose(left.apply([0.0, 0.0, -1.0]), [0.0, 1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(left.apply([1.0, 0.0, 0.0]), [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(left.apply([0.0, -1.0, 0.0]), [0.0, 0.0, -1.0], atol=1e-9)  # the palm, to the thigh
    right = Rotation.from_quat(recording.sensors["right_upper_arm"].quat_VS[0])
    np.testing.assert_allclose(right.apply([0.0, 0.0, -1.0]), [0.0, -1.0, 0.0], atol=1e-9)


ISB = "1 0 0 0  1 0 0 0  0.70711 0.70711 0 0  0.48970 0.51009 0.48970 -0.51009  0.5 0.5 0.5 -0.5  0.70711 -0.70711 0 0"


def test_arms_in_the_frames_of_the_isb(tmp_path: Path) -> None:
    """Told by the T-pose. A hanging palm is at the thigh in our frames."""
    quat, left = turning(), ("left_upper_arm", "left_forearm", "left_hand")
    recording = made(tmp_path, mvnx(tmp_path, quat, t_pose=ISB), left)
    for k, (name, palm) in enumerate(zip(left, (-90.0, 0.0, 0.0), strict=True), 2):
        ours = Rotation.from_quat(recording.sensors[name].quat_VS)
        theirs = Rotation.from_quat(quat[:, k][:, [1, 2, 3, 0]])
        np.testing.assert_allclose(ours.apply([0.0, 0.0, -1.0]), theirs.apply([0.0, 0.0, -1.0]), atol=1e-6)
        inward = [np.cos(np.radians(palm)), np.sin(np.radians(palm)), 0.0]  # what is -y, inward, of our frame
        np.testing.assert_allclose(ours.apply([0.0, -1.0, 0.0]), theirs.apply(inward), atol=1e-6)
    assert recording.diagnostics == ()
    assumed = made(tmp_path, mvnx(tmp_path, quat, t_pose=None), ("torso", "left_hand"))
    assert [each.code for each in assumed.diagnostics] == ["file-assumption"]
    np.testing.assert_allclose(assumed.sensors["torso"].quat_VS, quat[:, 1][:, [1, 2, 3, 0]], atol=1e-8)


def test_raw_data_come_first_and_orientations_when_asked_for(tmp_path: Path) -> None:
    path = mvnx(tmp_path, turning(200), raw=True)
    raw = wp.load_session(session(tmp_path, path.name, ("torso", "left_forearm")))
    np.testing.assert_allclose(raw.sensors["left_forearm"].accel_S[0], [0.0, 9.81, 0.0])
    np.testing.assert_allclose(raw.sensors["left_forearm"].gyro_S[:, 2], 0.001 * np.arange(200))
    np.testing.assert_allclose(raw.sensors["torso"].gyro_S[:, 0], 0.1, atol=2e-4)
    assert not raw.sensors["torso"].aligned
    ready = wp.load_session(session(tmp_path, path.name, ("torso", "left_forearm"), 'use = "orientation"'))
    assert ready.sensors["torso"].aligned
    angle = Rotation.from_quat(ready.sensors["torso"].quat_VS[-1]).magnitude()
    assert angle == pytest.approx(2 * 0.5)


def test_lost_frames_are_gaps(tmp_path: Path) -> None:
    index = [k for k in range(60) if k not in (20, 21)]
    path = mvnx(tmp_path, turning(58), index=index)
    recording = wp.load_session(session(tmp_path, path.name, ("torso",)))
    assert len(recording) == 60
    (lost,) = (each for each in recording.diagnostics if each.code == "samples-lost")
    assert (lost.place, lost.value) == ("torso", pytest.approx(2 / 60))
    path = mvnx(tmp_path, turning(58), index=[k + 40 * (k > 20) for k in range(58)])
    with pytest.raises(BadData, match=r"orientation: samples are missing for 0\.8\d* s .* after row 21"):
        wp.load_session(session(tmp_path, path.name, ("torso",)))


def test_a_mount_beside_aligned_orientations_is_an_error(tmp_path: Path) -> None:
    path = mvnx(tmp_path, turning())
    mount = 'mount = { up = "+x", forward = "-z" }'
    with pytest.raises(BadSession, match=r"sensors\.torso: aligned orientations .* no mount"):
        wp.load_session(session(tmp_path, path.name, ("torso",), each=mount))
    assert (
        not wp.load_session(session(tmp_path, path.name, ("torso",), each=f"aligned = false\n{mount}"))
        .sensors["torso"]
        .aligned
    )


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("</frames></subject></mvnx>", "", r"cannot be read as an MVNX; it is damaged, cut off .* line \d+"),
        ('frameRate="50"', 'frameRate="fast"', "cannot be read as an MVNX; .*fast"),
        ("0.000000000</orientation>", "zero</orientation>", "4 numbers for each of 6 are needed"),
        ("0.000000000</orientation>", "</orientation>", "4 numbers for each of 6 are needed"),
        ('type="normal"', 'type="tpose"', "0 frames of type 'normal'"),
        ('label="', 'label="My', "none of the upper body's segments"),
    ],
)
def test_a_damaged_file_or_one_of_another_content_is_one_line(old: str, new: str, says: str, tmp_path: Path) -> None:
    path = mvnx(tmp_path, np.tile([1.0, 0.0, 0.0, 0.0], (5, len(MVN_SEGMENTS), 1)))
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(BadData, match=says) as error:
        made(tmp_path, path, ("torso",))
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_a_wrong_label(tmp_path: Path) -> None:
    path = mvnx(tmp_path, turning())
    with pytest.raises(BadSession, match=r"sensors\.torso\.label = 'T9' is not known; there is: Pelvis, T8"):
        wp.load_session(session(tmp_path, path.name, ("torso",), each='label = "T9"'))
