"""OpenSim's files against the rules of its readers, and against OpenSim itself where it is installed."""

import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import polars as pl
import pytest
from commands import run
from opensim_process import start_opensim
from scipy.spatial.transform import Rotation
from test_export import LENGTHS, POINTS, a_pose, smooth, with_gap, write_folder

from wepose_pin import Pose, export, joint_angles, load_model
from wepose_pin.body.configuration import compute_pose

BODIES = {"humerus": "upper_arm", "radius": "forearm", "hand": "hand"}
SEGMENT_OF = {"pelvis": "pelvis", "torso": "torso"}
SEGMENT_OF |= {f"{body}_{side[0]}": f"{side}_{part}" for side in ("right", "left") for body, part in BODIES.items()}
# Of each coordinate the middle and the size of a made motion [rad], within what the joint can do.
MOTION = {
    "pelvis_tilt": (0.0, 0.1), "pelvis_list": (0.0, 0.1), "pelvis_rotation": (0.0, 0.3),
    "lumbar_extension": (-0.1, 0.2), "lumbar_bending": (0.0, 0.1), "lumbar_rotation": (0.0, 0.3),
    "arm_flex": (0.4, 0.3), "arm_add": (-0.4, 0.3), "arm_rot": (0.2, 0.4),
    "elbow_flex": (1.2, 0.5), "pro_sup": (1.2, 0.4), "wrist_flex": (0.1, 0.3), "wrist_dev": (0.05, 0.15),
}  # fmt: skip


@pytest.fixture(scope="module")
def peer() -> Iterator[Callable[..., Any]]:
    with start_opensim() as call:
        yield call


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("opensim") / "result", a_pose())


def motion(n: int) -> dict[str, np.ndarray]:
    """Coordinate → (n,) [rad]."""
    names = [f"{name}{end}" for name in MOTION for end in ([""] if name[:3] in ("pel", "lum") else ["_r", "_l"])]
    values = {}
    for k, name in enumerate(names):
        middle, size = MOTION[name.removesuffix("_r").removesuffix("_l")]
        wave = smooth(n, 100 + k, 1.0)[:, 0]
        values[name] = middle + size * wave / np.abs(wave).max()
    return values


def test_mot_keeps_the_rules(result: Path, tmp_path: Path) -> None:
    export(result, tmp_path / "x.mot")
    text = (tmp_path / "x.mot").read_text(encoding="utf-8")
    lines = text.split("\n")
    end = lines.index("endheader")
    assert lines[0] == "a - made² one"  # Storage.cpp: the name; an equals sign would make it a key
    header, columns = dict(line.split("=") for line in lines[1:end]), str(len(lines[end + 1].split("\t")))
    assert header == {"version": "1", "nRows": "301", "nColumns": columns, "inDegrees": "yes"}
    assert lines[end + 1].split("\t")[0] == "time"
    assert {len(line.split("\t")) for line in lines[end + 1 : -1]} == {int(header["nColumns"])}
    assert (len(lines) - end - 3, lines[-1]) == (301, "")  # an empty line would end the data
    assert '"' not in text
    assert "NaN" not in text


def test_sto_keeps_the_rules(result: Path, tmp_path: Path) -> None:
    export(result, tmp_path / "x.sto")
    lines = (tmp_path / "x.sto").read_text().split("\n")
    head = lines.index("endheader")
    assert lines[:3] == ["DataRate=100.000000", "DataType=Quaternion", "version=3"]
    assert all(re.fullmatch("[^=\t]+=[^=\t]+", line) for line in lines[:head])
    assert lines[head + 1].split("\t") == ["time", *(f"{body}_imu" for body in SEGMENT_OF)]
    for line in lines[head + 2 : -1]:
        time, *cells = line.split("\t")
        assert 2.0 <= float(time) <= 5.0
        quat = np.array([[float(part) for part in cell.split(",")] for cell in cells])
        np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0, atol=1e-8)


def test_sto_holds_the_bodies_in_ground_and_is_no_recording(result: Path, tmp_path: Path, capsys) -> None:
    """In the N-pose bodies are parallel to ground, but for the forearm and hand, which are pronated by 90°."""
    export(result, tmp_path / "x.sto")
    lines = (tmp_path / "x.sto").read_text().split("\n")
    rows = np.array([line.replace(",", "\t").split("\t") for line in lines[lines.index("endheader") + 2 : -1]], float)
    R_GW = Rotation.from_euler("x", -90, degrees=True)
    for k, (body, segment) in enumerate(SEGMENT_OF.items()):
        R_GB = Rotation.from_quat(rows[:, 1 + 4 * k : 5 + 4 * k][:, [1, 2, 3, 0]])
        n_pose = R_GW * Rotation.from_quat(a_pose().quat_WL[segment]).inv() * R_GW.inv() * R_GB
        angle = 90.0 if body.startswith(("radius", "hand")) else 0.0
        np.testing.assert_allclose(np.degrees(n_pose.magnitude()), angle, atol=1e-5)
        if angle:
            np.testing.assert_allclose(np.abs(n_pose.as_rotvec() / n_pose.magnitude()[:, None])[:, 1], 0.998, atol=1e-3)
    assert run("info", tmp_path / "x.sto") == 2
    assert "was written by `wepose export`" in capsys.readouterr().err


def test_trc_keeps_the_rules(tmp_path: Path) -> None:
    export(write_folder(tmp_path / "r", with_gap(a_pose())), tmp_path / "x.trc")
    lines = (tmp_path / "x.trc").read_text().split("\n")
    assert lines[0] == "PathFileType\t4\t(X/Y/Z)\tx.trc"
    keys = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames"
    assert lines[1].split("\t") == keys.split()
    assert lines[2].split("\t") == ["100", "100", "301", "8", "mm", "100", "1", "301"]
    assert lines[3].split("\t")[:2] == ["Frame#", "Time"]
    assert lines[3].split("\t")[2::3] == POINTS
    assert [cell for cell in lines[4].split("\t") if cell] == [f"{axis}{k}" for k in range(1, 9) for axis in "XYZ"]
    assert lines[5] == ""
    rows = [line.split("\t") for line in lines[6:-1]]
    assert [row[0] for row in rows] == [str(k) for k in range(1, 302)]
    assert {len(row) for row in rows} == {2 + 3 * 8 + 1}  # a tab ends each row
    wrist = 2 + 3 * POINTS.index("right_wrist")
    assert [k for k, row in enumerate(rows) if row[wrist : wrist + 3] == ["", "", ""]] == list(range(10, 20))


def test_mot_with_the_isbs_angles(result: Path, tmp_path: Path) -> None:
    export(result, tmp_path / "x.mot", names="isb")
    table = pl.read_csv(tmp_path / "x.mot", separator="\t", skip_lines=6)
    elbow = joint_angles(a_pose())["left_elbow"]
    np.testing.assert_allclose(table["left_elbow_flexion"], np.degrees(elbow.values[:, 0]), atol=1e-6)
    shoulder = joint_angles(a_pose())["left_shoulder"]
    assert table["left_shoulder_near_lock"].to_list() == shoulder.near_lock.astype(int).tolist()
    export(result, tmp_path / "model.mot", names="opensim")
    export(result, tmp_path / "both.mot")
    model, both = (pl.read_csv(tmp_path / name, separator="\t", skip_lines=6) for name in ("model.mot", "both.mot"))
    marks = [name for name in table.columns if name.endswith("_near_lock")]
    own = [name for name in table.columns if name not in marks]
    assert both.columns == [*own, *model.columns[1:], *marks]  # the ISB's first
    assert both.select(table.columns).equals(table)
    assert both.select(model.columns).equals(model)


def test_an_ordinary_arm_is_no_warning_and_one_with_a_wrong_heading_is(tmp_path: Path) -> None:
    """A forearm that bends about the lateral axis, as ordinary people's nearly do; the model's axis is oblique."""
    time = np.arange(0.0, 5.0, 0.01)
    bend, swing = np.radians(60.0 - 50.0 * np.cos(time)), np.radians(30.0 * np.sin(2.0 * time))
    upper = Rotation.from_rotvec(-swing[:, None] * [0.0, 1.0, 0.0])
    fore = upper * Rotation.from_rotvec(-bend[:, None] * [0.0, 1.0, 0.0])
    turned = Rotation.from_euler("z", 50.0, degrees=True) * fore
    for name, forearm, codes in (("right", fore, set()), ("wrong", turned, {"orientation-residual"})):
        quat_WL = {"torso": np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1)), "left_upper_arm": upper.as_quat()}
        quat_WL["left_forearm"] = forearm.as_quat()
        folder = write_folder(tmp_path / name, compute_pose(load_model(lengths=LENGTHS), time, quat_WL))
        exported = export(folder, tmp_path / f"{name}.mot", names="opensim")
        assert {each.code for each in exported.diagnostics} == codes


def test_the_scale_tool_is_told_the_subjects_lengths(result: Path, tmp_path: Path) -> None:
    assert not export(result, tmp_path / "anna.xml", "scale").diagnostics
    tool = ElementTree.parse(tmp_path / "anna.xml").getroot()[0]
    assert tool.tag == "ScaleTool"
    assert tool.findtext("GenericModelMaker/model_file") == "Rajagopal_2015.osim"
    assert tool.findtext("ModelScaler/output_model_file") == "anna.osim"
    scales = {each.findtext("segment"): np.fromstring(each.findtext("scales"), sep=" ") for each in tool.iter("Scale")}
    lengths = load_model(lengths=LENGTHS).lengths
    trunk, width = lengths["trunk"] / 0.53309, lengths["shoulder_width"] / 0.34
    np.testing.assert_allclose(scales["torso"], [trunk, trunk, width], rtol=1e-5)
    np.testing.assert_allclose(scales["pelvis"], [trunk, trunk, 1.0], rtol=1e-5)
    np.testing.assert_array_equal(scales["ulna_l"], scales["radius_l"])


def test_the_setups_of_opensense_name_each_other(result: Path, tmp_path: Path) -> None:
    assert export(result, tmp_path / "a.sto", osim_model="anna.osim").diagnostics == []
    assert {path.name for path in tmp_path.iterdir()} == {"a.sto", "a_placement.sto", "a_placer.xml", "a_ik.xml"}
    placer, ik = (ElementTree.parse(tmp_path / f"a_{tool}.xml").getroot()[0] for tool in ("placer", "ik"))
    assert placer.findtext("model_file") == "anna.osim"
    assert placer.findtext("orientation_file_for_calibration") == "a_placement.sto"
    assert placer.findtext("output_model_file") == ik.findtext("model_file")
    assert ik.findtext("orientations_file") == "a.sto"
    begin, end = map(float, (ik.findtext("time_range") or "").split())
    assert (begin, end) == pytest.approx((1.995, 5.005))


def pose_by_opensim(peer: Callable[..., Any], values: Mapping[str, np.ndarray], noise: float = 0.0) -> Pose:
    """The model's pose: segments are W where it stands with palms at the thighs, and turn with its bodies."""
    n_pose = {name: np.full(1, np.pi / 2 if name.startswith("pro_sup") else 0.0) for name in values}
    stands, moves = (peer("bodies", of, list(SEGMENT_OF)) for of in (n_pose, values))
    R_GW = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # x forward, y up, z right
    n = len(next(iter(values.values())))
    quat_WL = {}
    for k, (body, segment) in enumerate(SEGMENT_OF.items()):
        R_WL = Rotation.from_matrix(R_GW.T @ moves[body] @ stands[body][0].T @ R_GW)
        quat_WL[segment] = (R_WL * Rotation.from_rotvec(noise * smooth(n, 200 + k, 1.0))).as_quat()
    return compute_pose(load_model(lengths=LENGTHS), 0.01 * np.arange(n), quat_WL)


@pytest.mark.peer
def test_mot_gives_opensims_model_the_pose_back(peer: Callable[..., Any], tmp_path: Path) -> None:
    values = motion(60)
    pose = pose_by_opensim(peer, values)
    folder = write_folder(tmp_path / "r", pose)
    assert export(folder, tmp_path / "x.mot", names="opensim").diagnostics == []  # the model reaches all of it
    table = peer("read", tmp_path / "x.mot")
    assert set(table["labels"]) == set(values)
    assert table["header"]["inDegrees"] == "yes"
    np.testing.assert_allclose(table["time"], pose.time, atol=1e-9)
    wanted = np.degrees(np.column_stack([values[label] for label in table["labels"]]))
    # The .osim has the axes of the forearm and its right angles to five digits.
    np.testing.assert_allclose(table["values"], wanted, atol=2e-3)


@pytest.mark.peer
def test_opensense_finds_the_same_angles_from_the_sto(peer: Callable[..., Any], tmp_path: Path) -> None:
    pose = pose_by_opensim(peer, motion(12), noise=0.15)  # what no elbow of two axes follows
    folder = write_folder(tmp_path / "r", pose)
    diagnostics = export(folder, tmp_path / "x.mot", names="opensim").diagnostics
    assert "orientation-residual" in {each.code for each in diagnostics}
    export(folder, tmp_path / "x.sto")
    export(folder, tmp_path / "placement.sto", "placement")
    solved, ours = peer("opensense", tmp_path), peer("read", tmp_path / "x.mot")
    theirs = solved["values"][:, [solved["labels"].index(label) for label in ours["labels"]]]
    np.testing.assert_allclose(theirs, ours["values"], atol=0.05)


@pytest.mark.peer
def test_the_scaled_model_has_the_subjects_lengths(
    peer: Callable[..., Any], result: Path, data: Path, tmp_path: Path
) -> None:
    shutil.copy(data / "osim" / "Rajagopal_2015.osim", tmp_path)
    export(result, tmp_path / "anna.xml", "scale")
    centre = peer("run_scale_tool", tmp_path / "anna.xml", "anna.osim")
    middle = {part: 0.5 * (centre[f"{part}_r"] + centre[f"{part}_l"]) for part in ("femur", "humerus")}
    spans = {"trunk": middle["humerus"] - middle["femur"], "shoulder_width": centre["humerus_r"] - centre["humerus_l"]}
    for side in ("left", "right"):
        shoulder, elbow, wrist = (centre[f"{body}_{side[0]}"] for body in ("humerus", "ulna", "hand"))
        spans |= {f"{side}_upper_arm": elbow - shoulder, f"{side}_forearm": wrist - elbow}
    for length, span in spans.items():
        assert np.linalg.norm(span) == pytest.approx(load_model(lengths=LENGTHS).lengths[length], abs=1e-6), length


@pytest.mark.peer
def test_trc_by_opensim(peer: Callable[..., Any], tmp_path: Path) -> None:
    pose = with_gap(a_pose())
    export(write_folder(tmp_path / "r", pose), tmp_path / "x.trc")
    table = peer("read", tmp_path / "x.trc")
    assert table["labels"] == POINTS
    assert (table["header"]["Units"], table["header"]["DataRate"]) == ("mm", "100")
    np.testing.assert_allclose(table["time"], pose.time, atol=1e-9)
    for k, point in enumerate(POINTS):
        x, y, z = pose.points[point].T
        wanted = 1e3 * np.column_stack([x, z, -y])
        if point in ("right_wrist", "right_palm"):  # the last of a row among them
            wanted[10:20] = np.nan
        np.testing.assert_allclose(table["values"][:, k], wanted, atol=1e-6)
