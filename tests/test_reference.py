"""C3D, TRC and MVNX as references: joints from markers, and their clock, world and frames brought to a result's."""

import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from scipy.spatial.transform import Rotation, Slerp
from test_info import info

from wepose_pin import Pose, Simulation, TrackResult, WeposeError, evaluate, load_model, population_subject, track
from wepose_pin.evaluation import register
from wepose_pin.readers.reference import read_reference
from wepose_pin.simulation import Person, simulate

# The laboratory: y is up, turned by 70 deg, its origin somewhere, its clock late.
R_VW = Rotation.from_euler("x", -90, degrees=True) * Rotation.from_euler("z", -70, degrees=True)
PLACE_V = np.array([1.2, 0.93, -0.4])
LATE_S = 3.217
LAB_HZ = 60.0
SEGMENTS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")


@pytest.fixture(scope="module")
def simulation(person: Person) -> Simulation:
    return simulate(person.lengths, seed=3)


@pytest.fixture(scope="module")
def pose(simulation: Simulation) -> Pose:
    """A minute of circles, at 50 Hz, as the truth has it."""
    return rows_of(simulation.truth(), slice(6000, 12000, 2))


@pytest.fixture(scope="module")
def brief(pose: Pose) -> Pose:
    """Ten seconds of it."""
    return rows_of(pose, slice(0, 500))


def rows_of(pose: Pose, rows: slice) -> Pose:
    quats, points = ({name: v[rows] for name, v in each.items()} for each in (pose.quat_WL, pose.points))
    return Pose(pose.time[rows], {name: quats[name] for name in SEGMENTS}, points)


def in_laboratory(
    pose: Pose, rate_hz: float = LAB_HZ
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Times, orientations and points as the laboratory's system samples them; it saw less of the beginning."""
    time = np.arange(pose.time[0] + 2.0, pose.time[-1], 1.0 / rate_hz)
    quats = {
        name: (R_VW * Slerp(pose.time, Rotation.from_quat(quat))(time)).as_quat() for name, quat in pose.quat_WL.items()
    }
    points = {
        name: R_VW.apply(np.column_stack([np.interp(time, pose.time, axis) for axis in p.T])) + PLACE_V
        for name, p in pose.points.items()
    }
    return time, quats, points


def markers(pose: Pose) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Markers of Plug-in Gait with medial ones on the elbows, about the joints of the pose."""
    time, quats, points = in_laboratory(pose)
    R = {name: Rotation.from_quat(quat) for name, quat in quats.items()}
    middle = 0.5 * (points["left_shoulder"] + points["right_shoulder"])
    trunk = {"C7": (-0.06, 0.05), "CLAV": (0.06, 0.05), "T10": (-0.06, -0.2), "STRN": (0.06, -0.2)}
    places = {name: middle + R["torso"].apply([x, 0.0, z]) for name, (x, z) in trunk.items()}
    for side, letter, out in (("left", "L", 0.04), ("right", "R", -0.04)):
        places[f"{letter}SHO"] = points[f"{side}_shoulder"]
        arm, forearm = R[f"{side}_upper_arm"], R[f"{side}_forearm"]
        places[f"{letter}ELB"] = points[f"{side}_elbow"] + arm.apply([0.0, out, 0.0])
        places[f"{letter}MELB"] = points[f"{side}_elbow"] - arm.apply([0.0, out, 0.0])
        places[f"{letter}WRA"] = points[f"{side}_wrist"] + forearm.apply([0.03, 0.0, 0.0])
        places[f"{letter}WRB"] = points[f"{side}_wrist"] - forearm.apply([0.03, 0.0, 0.0])
    return time, places


def c3d(path: Path, pose: Pose, unit: str = "mm", **parameters: list[object]) -> Path:
    """As Nexus writes it, by ezc3d: names with the subject's; some markers are lost for a while."""
    ezc3d = pytest.importorskip("ezc3d")
    _, places = markers(pose)
    file = ezc3d.c3d()
    group = file["parameters"]["POINT"]
    group["UNITS"]["value"] = [unit]
    group["RATE"]["value"] = [LAB_HZ]
    group["LABELS"]["value"] = [f"Anna:{name}" for name in places]
    for name, value in parameters.items():
        group[name]["value"] = value
    p = np.stack([each.T for each in places.values()], axis=1) * {"mm": 1e3, "m": 1.0}.get(unit, 1.0)
    p[:, 5, 300:360] = np.nan
    file["data"]["points"] = np.concatenate([p, np.ones((1, *p.shape[1:]))])
    file["data"]["meta_points"]["residuals"] = np.where(np.isfinite(p).all(axis=0), 0.0, -1.0)[None]
    file.write(str(path))
    return path


def theia(path: Path, pose: Pose, ratio: int = 1) -> Path:
    """Rotations without points, by ezc3d; frames as another model has them."""
    ezc3d = pytest.importorskip("ezc3d")
    _, quats, _ = in_laboratory(pose)
    parts = {"upper_arm": "uarm", "forearm": "larm"}
    names = {"torso": "torso"} | {f"{s}_{p}": f"{s[0]}_{n}" for s in ("left", "right") for p, n in parts.items()}
    file = ezc3d.c3d()
    transforms = np.zeros((4, 4, len(names) + 1, len(quats["torso"])))
    transforms[3, 3] = 1.0
    transforms[:3, :3, 0] = np.eye(3)[:, :, None]  # worldbody
    for k, segment in enumerate(names, 1):
        other = Rotation.from_rotvec([0.3 * k, 1.0, -0.5 * k])
        transforms[:3, :3, k] = (Rotation.from_quat(quats[segment]) * other).as_matrix().transpose(1, 2, 0)
    file["parameters"]["POINT"]["RATE"]["value"] = [LAB_HZ]
    file.add_parameter("ROTATION", "RATE", [ratio * LAB_HZ])
    file.add_parameter("ROTATION", "RATIO", [ratio])
    file.add_parameter("ROTATION", "LABELS", [f"{name}_4X4" for name in ("worldbody", *names.values())])
    file["data"]["points"] = np.ones((4, 0, len(quats["torso"]) // ratio))
    file["data"]["rotations"] = transforms[..., : len(quats["torso"]) // ratio * ratio]
    file.write(str(path))
    return path


def trc(path: Path, pose: Pose) -> Path:
    """As OpenSim's own writer has it, by lines: y is up."""
    time, places = markers(pose)
    n = len(time)
    head = ["PathFileType\t4\t(X/Y/Z)\ta.trc"]
    head += ["DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"]
    head += [f"60\t60\t{n}\t{len(places)}\tmm\t60\t1\t{n}"]
    head += ["Frame#\tTime\t" + "\t\t\t".join(places) + "\t\t"]
    head += ["\t\t" + "\t".join(f"{a}{k}" for k in range(1, len(places) + 1) for a in "XYZ"), ""]
    rows = []
    for k in range(n):
        cells = [f"{1e3 * v:.5f}" for p in places.values() for v in p[k]]
        if 300 <= k < 360:
            cells[15:18] = ["", "", ""]
        rows.append("\t".join([str(k + 1), f"{k / LAB_HZ:.6f}", *cells]) + "\t")
    path.write_text("\n".join(head + rows) + "\n")
    return path


def to_pose(reference: Any) -> Pose:
    return Pose(reference.time, reference.quat_VT, reference.points)


def test_wepose_info_says_what_joints_there_are(
    brief: Pose, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = info(capsys, c3d(tmp_path / "a.c3d", brief))
    assert "markers, a reference for `wepose evaluate`" in out
    assert "at 60 Hz" in out
    assert "left_elbow" in out


@pytest.mark.parametrize(("write", "name"), [(c3d, "a.c3d"), (trc, "a.trc")])
def test_joints_and_segments_follow_from_markers(
    write: Callable[[Path, Pose], Path], name: str, brief: Pose, tmp_path: Path
) -> None:
    reference = read_reference(write(tmp_path / name, brief))
    time, quats, points = in_laboratory(brief)
    np.testing.assert_allclose(reference.time, time - time[0], atol=1e-5)
    for segment in SEGMENTS:
        known = np.isfinite(reference.quat_VT[segment]).all(axis=1)
        off = Rotation.from_quat(reference.quat_VT[segment][known]).inv() * Rotation.from_quat(quats[segment][known])
        assert np.degrees(off.magnitude().max()) < 0.1, segment
    assert np.isfinite(reference.quat_VT["torso"]).all()
    lost = ~np.isfinite(reference.points["left_elbow"]).all(axis=1)
    assert np.flatnonzero(lost).tolist() == list(range(300, 360))
    for point in ("left_shoulder", "left_elbow", "right_wrist"):
        difference = reference.points[point] - points[point]
        assert np.nanmax(np.abs(difference)) < 1e-4


@pytest.mark.parametrize(("write", "name"), [(c3d, "a.c3d"), (trc, "a.trc"), (theia, "b.c3d")])
def test_clock_and_world_are_found_on_seconds_that_are_not_scored(
    write: Callable[[Path, Pose], Path], name: str, pose: Pose, tmp_path: Path
) -> None:
    """Nothing is left but the rounding of files; the offset to a millisecond, the heading to a few hundredths."""
    reference = read_reference(write(tmp_path / name, pose))
    truth, registration = register(pose, to_pose(reference), up=reference.up, frames=reference.own_frames)
    assert registration.offset_s == pytest.approx(pose.time[0] + 2.0, abs=1e-3)
    assert registration.correlation > 0.99
    assert registration.up == "+y"
    assert registration.heading_deg % 360.0 == pytest.approx(70.0, abs=0.2)
    assert registration.scored[0] >= registration.fitted[1] == pytest.approx(pose.time[0] + 20.0, abs=1.5)
    errors = evaluate(pose, truth, registration.scored)
    assert max(each.total_rmse for each in errors.attitude.values()) < 0.3
    if reference.points:
        assert max(each.rmse for each in errors.position.values()) < 2.0  # [mm]
        np.testing.assert_allclose(registration.shift_m, -R_VW.inv().apply(PLACE_V), atol=5e-3)
    most = max((each for joint in errors.joints.values() for each in joint.values()), key=lambda each: each.range)
    assert most.range > 60.0
    assert abs(most.mean) < 0.2
    assert most.icc > 0.999


def test_what_is_wrong_in_the_scored_seconds_is_not_fitted_away(pose: Pose, tmp_path: Path) -> None:
    """A heading that is off by 5 deg after the fit stays, one that is off throughout goes: it cannot be known."""
    reference = to_pose(read_reference(c3d(tmp_path / "a.c3d", pose)))
    late = pose.time > pose.time[0] + 21.0
    turn = Rotation.from_rotvec(np.outer(late, [0.0, 0.0, np.radians(5.0)]))
    drifted = turn * Rotation.from_quat(pose.quat_WL["torso"])
    off = replace(pose, quat_WL={**pose.quat_WL, "torso": drifted.as_quat()})
    truth, registration = register(off, reference)
    error = evaluate(off, truth, (pose.time[0] + 22.0, registration.scored[1])).attitude["torso"]
    assert error.heading_rmse == pytest.approx(5.0, abs=0.2)
    turned = Rotation.from_euler("z", 33.0, degrees=True)
    quat_WL = {name: (turned * Rotation.from_quat(q)).as_quat() for name, q in pose.quat_WL.items()}
    _, registration = register(replace(pose, quat_WL=quat_WL), reference)
    assert registration.heading_deg % 360.0 == pytest.approx(103.0, abs=0.2)


def test_what_cannot_be_aligned_is_said(pose: Pose) -> None:
    time, quats, points = in_laboratory(pose)
    still = {name: np.tile(quat[:1], (len(time), 1)) for name, quat in quats.items()}
    with pytest.raises(WeposeError, match=r"no offset of the clocks fits .* `time_offset`"):
        register(pose, Pose(time, still, {}))
    with pytest.raises(WeposeError, match="no segment in common, whose orientation is needed"):
        register(pose, Pose(time, {}, {"left_palm": points["left_palm"]}))
    with pytest.raises(WeposeError, match=r"the pose lasts 2\.0 s; .* 6 s are needed"):
        register(rows_of(pose, slice(0, 100)), Pose(time, quats, {}))
    tilted = Rotation.from_rotvec([0.7, 0.0, 0.7])
    leaning = {name: (tilted * Rotation.from_quat(q)).as_quat() for name, q in quats.items()}
    with pytest.raises(WeposeError, match=r"no axis of the reference's world is up: .* `fit` segments"):
        register(pose, Pose(time, leaning, {}))


def run_evaluate(capsys: pytest.CaptureFixture[str], *argv: object, code: int = 0) -> str:
    ended = run("evaluate", *argv)
    out, err = capsys.readouterr()
    assert ended == code, err
    return out if code == 0 else err


@pytest.fixture(scope="module")
def result(person: Person, simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is tracked of the first 45 s."""
    recording = simulation.recording("made").cut(slice(0, 4500))
    recording = replace(recording, phases={"start": recording.phases["start"]})
    return track(recording, person.prior).save(tmp_path_factory.mktemp("tracked") / "result")


def write_pose(path: Path, pose: Pose) -> None:
    TrackResult("reference", pose, load_model(), population_subject()).to_dataframe().write_parquet(path)


def test_wepose_evaluate_says_what_was_fitted(
    result: Path, simulation: Simulation, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The laboratory's file gives the errors that the truth gives in the same seconds, but for its heading."""
    truth = simulation.truth()
    whole = rows_of(truth, slice(0, 5000, 2))
    time, quats, points = in_laboratory(whole)
    write_pose(tmp_path / "laboratory.parquet", Pose(time + LATE_S, quats, points))
    write_pose(tmp_path / "truth.parquet", whole)
    aligned = run_evaluate(capsys, result, tmp_path / "laboratory.parquet", "--fit", "world", "--interval", "20", "40")
    assert "The reference was aligned by 2 to 16." in aligned
    assert "s, which are not scored:" in aligned
    assert "its clock -3.217 s (speeds correlate by " in aligned
    assert "its world: +y is up, rotated by +" in aligned
    assert "limits of agreement (Bland-Altman, 95 %)" in aligned
    plain = run_evaluate(capsys, result, tmp_path / "truth.parquet", "--interval", "20", "40")
    assert "aligned" not in plain
    assert "Agreement" not in plain
    elbows = [re.findall(r"left_elbow .*", out)[0].split()[-4:] for out in (aligned, plain)]
    assert elbows[0] == elbows[1]
    words = ("--fit", "world", "--time-offset", f"{-LATE_S}")
    stated = run_evaluate(capsys, result, tmp_path / "laboratory.parquet", *words)
    assert "its clock -3.217 s (stated)" in stated


@pytest.mark.parametrize(
    ("options", "says"),
    [(("--fit", "world", "--interval", "1", "5"), "seconds after"), (("--markers", "m.toml"), "has no markers")],
)
def test_options_that_do_not_go_together(
    options: tuple[str, ...], says: str, result: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert says in run_evaluate(capsys, result, result / "pose.parquet", *options, code=2)


def test_a_table_of_markers_of_ones_own(brief: Pose, tmp_path: Path) -> None:
    path = trc(tmp_path / "a.trc", brief)
    path.write_text(path.read_text().replace("LSHO", "Schulter li"))
    assert "left_shoulder" not in read_reference(path).points
    (tmp_path / "m.toml").write_text('[points]\nleft_shoulder = [["Schulter li"]]\n')
    assert "left_shoulder" in read_reference(path, tmp_path / "m.toml").points
    for text, says in (
        ("[points]\nleft_shoulder = 'A'\n", "points.left_shoulder = A"),
        ("[segments]\ntorso = [{ up = [['A'], ['B']] }]\n", "each of two directions"),
        ("[punkte]\n", "punkte"),
        ('[points]\nleft_shoulder = [["Schulter re"]]\n', "no marker 'Schulter re', by which left_shoulder is stated"),
    ):
        (tmp_path / "m.toml").write_text(text)
        with pytest.raises(WeposeError, match=says):
            read_reference(path, tmp_path / "m.toml")


SPOILED_TRC = {
    "no TRC": (("PathFileType", "Path"), "does not begin with PathFileType"),
    "an unknown unit": (("\tmm\t", "\tinch\t"), "Units 'inch'; there is: mm, cm, m"),
    "text": (("2\t0.016667\t", "2\tnow\t"), "column 'Time' holds text in row 2: 'now'"),
    "a marker twice": (("\tCLAV\t", "\tC7\t"), "names a marker twice"),
    "a cell too many": (("3\t0.033333\t", "3\t0.033333\t1\t"), "row 4 has 46 fields, the line of names has 45"),
    "time that goes back": (("3\t0.033333\t", "3\t0.000001\t"), "times of its rows do not increase"),
}


@pytest.mark.parametrize("spoil", SPOILED_TRC)
def test_a_spoiled_trc_is_one_line(spoil: str, brief: Pose, tmp_path: Path) -> None:
    change, says = SPOILED_TRC[spoil]
    path = trc(tmp_path / "a.trc", brief)
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change, 1))
    with pytest.raises(WeposeError, match=says) as error:
        read_reference(path)
    assert "\n" not in str(error.value)


def spoil_bytes(path: Path, old: bytes, new: bytes) -> None:
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda path, pose: spoil_bytes(c3d(path, pose), struct.pack("<f", LAB_HZ), bytes(4)), "POINT:RATE is 0"),
        (lambda path, pose: c3d(path, pose, unit="furlong"), "POINT:UNITS is furlong; there is: mm, cm, m"),
        (lambda path, pose: c3d(path, pose, LABELS=[f"M{k}" for k in range(14)]), "no joint follows from its markers"),
        (lambda path, _: path.write_bytes(b"\x02\x50" + bytes(2000)), r"a\.c3d: cannot be read as a C3D; .* processor"),
        (lambda path, pose: spoil_bytes(theia(path, pose), b"_4X4", b"_9X9"), "its rotations are of no known segment"),
        (lambda path, _pose: path.write_bytes(b"hello"), r"a\.c3d: cannot be read as a C3D"),
    ],
)
def test_a_spoiled_c3d_is_one_line(
    spoil: Callable[[Path, Pose], object], says: str, brief: Pose, tmp_path: Path
) -> None:
    spoil(tmp_path / "a.c3d", brief)
    with pytest.raises(WeposeError, match=says) as error:
        read_reference(tmp_path / "a.c3d")
    assert "\n" not in str(error.value)
