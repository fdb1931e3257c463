"""OpenSim's files against the rules of its readers, and against OpenSim itself where it is installed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation
from test_export import LENGTHS, POINTS, a_pose, smooth, with_gap, write_folder

from wepose_pin.angles import joint_angles
from wepose_pin.model import load_model
from wepose_pin.pose import Pose, pose_of
from wepose_pin.writers.export import export
from wepose_pin.writers.rajagopal import coordinates, orientations

SEGMENT_OF = {
    "pelvis": "pelvis",
    "torso": "torso",
    **{
        f"{body}_{s}": f"{side}_{part}"
        for s, side in (("r", "right"), ("l", "left"))
        for body, part in (("humerus", "upper_arm"), ("radius", "forearm"), ("hand", "hand"))
    },
}
# Of each coordinate the middle and the size of a made motion [rad], within what the joint can do.
MOTION = {
    "pelvis_tilt": (0.0, 0.1), "pelvis_list": (0.0, 0.1), "pelvis_rotation": (0.0, 0.3),
    "lumbar_extension": (-0.1, 0.2), "lumbar_bending": (0.0, 0.1), "lumbar_rotation": (0.0, 0.3),
    "arm_flex": (0.4, 0.3), "arm_add": (-0.4, 0.3), "arm_rot": (0.2, 0.4),
    "elbow_flex": (1.2, 0.5), "pro_sup": (1.2, 0.4), "wrist_flex": (0.1, 0.3), "wrist_dev": (0.05, 0.15),
}  # fmt: skip


@pytest.fixture(scope="module")
def osim() -> ModuleType:
    opensim = pytest.importorskip("opensim")
    opensim.Logger.setLevelString("off")
    opensim.Logger.removeFileSink()  # it would leave opensim.log where the tests are run
    return opensim


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("opensim") / "result", a_pose())


def motion(n: int) -> dict[str, np.ndarray]:
    """Coordinate → (n,) [rad]."""
    names = [
        f"{name}{end}"
        for name in MOTION
        for end in (("",) if "_" in name and name[:3] in ("pel", "lum") else ("_r", "_l"))
    ]
    found = {}
    for k, name in enumerate(names):
        middle, size = MOTION[name.removesuffix("_r").removesuffix("_l")]
        wave = smooth(n, 100 + k, 1.0)[:, 0]
        found[name] = middle + size * wave / np.abs(wave).max()
    return found


# Headers ----------------------------------------------------------------------------------------------------------


def test_mot_keeps_the_rules(result: Path, tmp_path: Path) -> None:
    export(result, tmp_path / "x.mot")
    text = (tmp_path / "x.mot").read_text(encoding="utf-8")
    lines = text.split("\n")
    end = lines.index("endheader")
    assert lines[0] == "a - made² one"  # Storage.cpp: the name; an equals sign would make it a key
    header = dict(line.split("=") for line in lines[1:end])
    assert header == {
        "version": "1",
        "nRows": "301",
        "nColumns": str(len(lines[end + 1].split("\t"))),
        "inDegrees": "yes",
    }
    assert lines[end + 1].split("\t")[0] == "time"
    assert {len(line.split("\t")) for line in lines[end + 1 : -1]} == {int(header["nColumns"])}
    assert (len(lines) - end - 3, lines[-1]) == (301, "")  # an empty line would end the data
    assert '"' not in text
    assert "NaN" not in text


def test_sto_keeps_the_rules(result: Path, tmp_path: Path) -> None:
    export(result, tmp_path / "x.sto")
    lines = (tmp_path / "x.sto").read_text().split("\n")
    assert lines[:4] == ["DataRate=100.000000", "DataType=Quaternion", "version=3", "endheader"]
    assert lines[4].split("\t") == ["time", *(f"{body}_imu" for body in SEGMENT_OF)]
    for line in lines[5:-1]:
        time, *cells = line.split("\t")
        assert 2.0 <= float(time) <= 5.0
        quat = np.array([[float(part) for part in cell.split(",")] for cell in cells])
        np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0, atol=1e-8)


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


def test_shoulders_and_thorax_are_the_isbs_of_zxy() -> None:
    pose = a_pose(tuple(name for name in SEGMENT_OF.values() if name.endswith(("torso", "upper_arm"))))
    found, missed = coordinates(orientations(pose.quat_WL))
    isb = joint_angles(pose, "ZXY")
    names = {"thorax": ("lumbar_extension", "lumbar_bending", "lumbar_rotation")}
    names |= {
        f"{side}_shoulder": tuple(f"arm_{of}_{side[0]}" for of in ("flex", "add", "rot")) for side in ("left", "right")
    }
    for joint, of in names.items():
        np.testing.assert_allclose(np.column_stack([found[name] for name in of]), isb[joint].values, atol=1e-12)
    assert missed == {}


# OpenSim itself ---------------------------------------------------------------------------------------------------


def arm_model(osim: Any) -> Any:
    """The joints of Rajagopal_2015.osim from the pelvis up, with the orientations of their frames as they stand there.

    Rotations alone: places of joints do not matter here.
    """
    model = osim.Model()
    vec, none = osim.Vec3, osim.Vec3(0.0)

    def body(name: str) -> Any:
        found = osim.Body(name, 1.0, none, osim.Inertia(0.1))
        model.addBody(found)
        return found

    def custom(name: str, parent: Any, child: Any, coordinates: list[str], signs: tuple[float, float, float]) -> None:
        turn = osim.SpatialTransform()
        axes = (vec(0, 0, signs[0]), vec(signs[1], 0, 0), vec(0, signs[2], 0))
        for k, (coordinate, axis) in enumerate(zip(coordinates, axes, strict=True)):
            of = (turn.upd_rotation1, turn.upd_rotation2, turn.upd_rotation3)[k]()
            names = osim.ArrayStr()
            names.append(coordinate)
            of.setCoordinateNames(names)
            of.setAxis(axis)
            of.set_function(osim.LinearFunction(1.0, 0.0))
        model.addJoint(osim.CustomJoint(name, parent, none, none, child, none, none, turn))

    pelvis, torso = body("pelvis"), body("torso")
    custom("ground_pelvis", model.getGround(), pelvis, ["pelvis_tilt", "pelvis_list", "pelvis_rotation"], (1, 1, 1))
    custom("back", pelvis, torso, ["lumbar_extension", "lumbar_bending", "lumbar_rotation"], (1, 1, 1))
    for s, sign in (("r", 1.0), ("l", -1.0)):
        humerus, ulna, radius, hand = (body(f"{name}_{s}") for name in ("humerus", "ulna", "radius", "hand"))
        custom(f"acromial_{s}", torso, humerus, [f"arm_{of}_{s}" for of in ("flex", "add", "rot")], (1, sign, sign))
        elbow = vec(-0.0228627 * sign, 0.228018 * sign, 0.0051689)
        joint = osim.PinJoint(f"elbow_{s}", humerus, none, elbow, ulna, none, elbow)
        joint.updCoordinate().setName(f"elbow_flex_{s}")
        model.addJoint(joint)
        turn = vec(-1.56884 * sign, 0.056428 * sign, 1.53614)
        joint = osim.PinJoint(f"radioulnar_{s}", ulna, none, turn, radius, none, turn)
        joint.updCoordinate().setName(f"pro_sup_{s}")
        model.addJoint(joint)
        wrist = vec(-1.5708 * sign, 0.0, -1.5708 * sign)
        joint = osim.UniversalJoint(f"radius_hand_{s}", radius, none, wrist, hand, none, wrist)
        joint.updCoordinate(0).setName(f"wrist_flex_{s}")
        joint.updCoordinate(1).setName(f"wrist_dev_{s}")
        model.addJoint(joint)
    model.finalizeConnections()
    return model


def bodies_by_opensim(osim: Any, values: Mapping[str, np.ndarray]) -> dict[str, Rotation]:
    """Body → orientations in ground, with the coordinates at `values` (n,) [rad]."""
    model = arm_model(osim)
    state = model.initSystem()
    handles = {name: model.getCoordinateSet().get(name) for name in values}
    found: dict[str, list[np.ndarray]] = {name: [] for name in SEGMENT_OF}
    for k in range(len(next(iter(values.values())))):
        for name, handle in handles.items():
            handle.setValue(state, float(values[name][k]), False)
        model.realizePosition(state)
        for name, rows in found.items():
            R = model.getBodySet().get(name).getTransformInGround(state).R().asMat33()
            rows.append(np.array([[R.get(i, j) for j in range(3)] for i in range(3)]))
    return {name: Rotation.from_matrix(np.array(rows)) for name, rows in found.items()}


def pose_by_opensim(osim: Any, values: Mapping[str, np.ndarray], noise: float = 0.0) -> Pose:
    """The model's pose: segments are W where it stands with palms at the thighs, and turn with its bodies."""
    n_pose = {name: np.full(1, np.pi / 2 if name.startswith("pro_sup") else 0.0) for name in values}
    stands, moves = bodies_by_opensim(osim, n_pose), bodies_by_opensim(osim, values)
    R_GW = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # x forward, y up, z right
    n = len(next(iter(values.values())))
    quat_WL = {}
    for k, (body, segment) in enumerate(SEGMENT_OF.items()):
        R_WL = R_GW.inv() * moves[body] * stands[body][0].inv() * R_GW
        quat_WL[segment] = (R_WL * Rotation.from_rotvec(noise * smooth(n, 200 + k, 1.0))).as_quat()
    return pose_of(load_model(lengths=LENGTHS), 0.01 * np.arange(n), quat_WL)


def test_mot_gives_opensims_model_the_pose_back(osim: Any, tmp_path: Path) -> None:
    values = motion(60)
    pose = pose_by_opensim(osim, values)
    assert export(write_folder(tmp_path / "r", pose), tmp_path / "x.mot").notes == []  # the model reaches all of it
    table = osim.TimeSeriesTable(str(tmp_path / "x.mot"))
    assert set(table.getColumnLabels()) == set(values)
    assert table.getTableMetaDataString("inDegrees") == "yes"
    np.testing.assert_allclose(table.getIndependentColumn(), pose.time, atol=1e-9)
    for name, value in values.items():
        # the .osim states the axes of the forearm to five digits, and its right angles too
        np.testing.assert_allclose(
            table.getDependentColumn(name).to_numpy(), np.degrees(value), atol=2e-3, err_msg=name
        )
    storage = osim.Storage(str(tmp_path / "x.mot"))
    assert (storage.getSize(), storage.isInDegrees(), storage.getColumnLabels().getSize()) == (
        60,
        True,
        1 + len(values),
    )


def test_opensense_finds_the_same_angles_from_the_sto(osim: Any, tmp_path: Path) -> None:
    pose = pose_by_opensim(osim, motion(12), noise=0.15)  # what no elbow of two axes follows
    folder = write_folder(tmp_path / "r", pose)
    notes = export(folder, tmp_path / "x.mot").notes
    assert "humerus_r" in notes[0]
    export(folder, tmp_path / "x.sto")
    export(folder, tmp_path / "placement.sto", "placement")
    arm_model(osim).printToXML(str(tmp_path / "model.osim"))

    placer = osim.IMUPlacer()
    placer.set_model_file(str(tmp_path / "model.osim"))
    placer.set_orientation_file_for_calibration(str(tmp_path / "placement.sto"))
    placer.set_sensor_to_opensim_rotations(osim.Vec3(0.0))
    placer.set_output_model_file(str(tmp_path / "placed.osim"))
    assert placer.run(False)
    tool = osim.IMUInverseKinematicsTool()
    tool.set_model_file(str(tmp_path / "placed.osim"))
    tool.set_orientations_file(str(tmp_path / "x.sto"))
    tool.set_sensor_to_opensim_rotations(osim.Vec3(0.0))
    tool.set_results_directory(str(tmp_path / "ik"))
    tool.set_accuracy(1e-9)
    assert tool.run(False)
    solved = osim.TimeSeriesTable(str(next((tmp_path / "ik").glob("*.mot"))))
    ours = osim.TimeSeriesTable(str(tmp_path / "x.mot"))
    for name in ours.getColumnLabels():
        theirs = solved.getDependentColumn(name).to_numpy()
        np.testing.assert_allclose(theirs, ours.getDependentColumn(name).to_numpy(), atol=0.05, err_msg=name)


def test_trc_by_opensim(osim: Any, tmp_path: Path) -> None:
    pose = with_gap(replace(a_pose(), gap={}))
    export(write_folder(tmp_path / "r", pose), tmp_path / "x.trc")
    table = osim.TimeSeriesTableVec3(str(tmp_path / "x.trc"))
    assert list(table.getColumnLabels()) == POINTS
    assert table.getTableMetaDataString("Units") == "mm"
    np.testing.assert_allclose(table.getIndependentColumn(), pose.time, atol=1e-9)
    for k, point in enumerate(POINTS):
        read = np.array([table.getRowAtIndex(i)[k].to_numpy() for i in range(0, 301, 5)])
        x, y, z = pose.points[point][::5].T
        wanted = 1e3 * np.column_stack([x, z, -y])
        if point in ("right_wrist", "right_hand"):
            wanted[2:4] = np.nan  # samples 10 and 15
        np.testing.assert_allclose(read, wanted, atol=1e-6)
    assert osim.MarkerData(str(tmp_path / "x.trc")).getNumFrames() == 301


def test_sto_by_opensim(osim: Any, result: Path, tmp_path: Path) -> None:
    export(result, tmp_path / "x.sto")
    table = osim.TimeSeriesTableQuaternion(str(tmp_path / "x.sto"))
    assert (table.getNumRows(), list(table.getColumnLabels())) == (301, [f"{body}_imu" for body in SEGMENT_OF])
    torso = table.getRowAtIndex(100).getElt(0, 1)
    wxyz = [torso.get(k) for k in range(4)]
    x, y, z, w = a_pose().quat_WL["torso"][100]
    np.testing.assert_allclose(np.abs(np.dot(wxyz, [w, x, z, -y])), 1.0, atol=1e-8)
