"""Files for other programs: each read back by a reader of others, with the numbers that went in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from bodies import RIGID_SHOULDERS, SEGMENTS
from commands import run
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin import BadData, ExistingOutput, Pose, export, load_model
from wepose_pin.body.configuration import compute_pose
from wepose_pin.body.kinematics import build_pose_table

LENGTHS = {"shoulder_width": 0.41, "left_upper_arm": 0.29, "right_forearm": 0.25, "right_hand": 0.07}
POINTS = [f"{side}_{part}" for side in ("left", "right") for part in ("shoulder", "elbow", "wrist", "palm")]


def smooth(n: int, seed: int, size: float) -> np.ndarray:
    """Rotation vectors (n, 3) [rad] that wander."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0.0, 3.0, n)[:, None] * np.arange(1, 4)
    return size * (np.sin(phase + rng.uniform(0.0, 6.0, 3)) @ rng.standard_normal((3, 3)))


def a_pose(segments: tuple[str, ...] = SEGMENTS, n: int = 301, rate_hz: float = 100.0) -> Pose:
    """A pose with covariances, of a person of `LENGTHS`."""
    quat_WL = {
        name: Rotation.from_rotvec(smooth(n, k, 0.2 if name in ("torso", "pelvis") else 0.7)).as_quat()
        for k, name in enumerate(segments)
    }
    pose = compute_pose(load_model(lengths=LENGTHS), 2.0 + np.arange(n) / rate_hz, quat_WL)
    spread = np.linspace(1.0, 2.0, n)[:, None, None] * np.diag([1.0, 2.0, 3.0])
    return replace(
        pose,
        segment_cov=dict.fromkeys(pose.quat_WL, 0.0001 * spread),
        point_cov=dict.fromkeys(pose.points, 1e-06 * spread),
    )


def write_folder(folder: Path, pose: Pose) -> Path:
    """A result folder, as far as an export reads it."""
    folder.mkdir()
    wp.population_subject().save(folder / "subject.toml")
    build_pose_table(pose, covariance=True).write_parquet(folder / "pose.parquet")
    (folder / "subject.urdf").write_text(load_model(lengths=LENGTHS).urdf(), encoding="utf-8")
    (folder / "summary.json").write_text('{"recording": "a = made\\u00b2 one"}', encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def pose() -> Pose:
    return a_pose()


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, pose: Pose) -> Path:
    return write_folder(tmp_path_factory.mktemp("export") / "result", pose)


def codes_of(*arguments: Path, **options: object) -> set[str]:
    return {diagnostic.code for diagnostic in export(*arguments, **options).diagnostics}  # type: ignore[arg-type]


def with_gap(pose: Pose) -> Pose:
    """The same with the right forearm bridged from sample 10 to 19."""
    gap = np.zeros(len(pose.time), dtype=bool)
    gap[10:20] = True
    return replace(pose, gap={"right_forearm": gap})


# Tables -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", ["CSV", "parquet"])
def test_tables_hold_pose_and_angles(result: Path, pose: Pose, tmp_path: Path, format: str) -> None:
    file = tmp_path / f"all.{format}"
    written = export(result, file)
    assert (written.format, {each.code for each in written.diagnostics}) == (format.lower(), {"angles-near-lock"})
    assert export(str(result), str(tmp_path / f"text.{format}")) == written
    table = pl.read_csv(file) if format == "CSV" else pl.read_parquet(file)
    stored = pl.read_parquet(result / "pose.parquet")
    for segment in SEGMENTS:
        for c in ("qx", "qy", "qz", "qw"):
            np.testing.assert_allclose(table[f"{segment}_{c}"], stored[f"{segment}_{c}"], rtol=0, atol=1e-15)
    for point in POINTS:
        for c in "xyz":
            np.testing.assert_array_equal(table[f"{point}_{c}"], stored[f"{point}_{c}"])
        np.testing.assert_array_equal(table[f"{point}_std"], stored[f"{point}_std"])
    angles = wp.joint_angles(pose)
    elbow = angles["right_elbow"]
    np.testing.assert_allclose(table["right_elbow_flexion_deg"], np.degrees(elbow.values[:, 0]), atol=1e-9)
    np.testing.assert_allclose(table["right_elbow_pronation_std_deg"], np.degrees(elbow.std[:, 2]), rtol=1e-9)


def test_csv_leaves_empty_what_is_not_known(tmp_path: Path, pose: Pose) -> None:
    quat = pose.quat_WL["left_hand"].copy()
    quat[5] = np.nan
    holed = replace(pose, quat_WL={**pose.quat_WL, "left_hand": quat})
    export(write_folder(tmp_path / "r", holed), tmp_path / "x.csv")
    table = pl.read_csv(tmp_path / "x.csv")
    assert table["left_hand_qx"].is_null().to_numpy().nonzero()[0].tolist() == [5]
    assert table["left_wrist_flexion_deg"].is_null().sum() == 1
    assert "NaN" not in (tmp_path / "x.csv").read_text()


# C3D --------------------------------------------------------------------------------------------------------------


def test_c3d_by_ezc3d(result: Path, pose: Pose, tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    export(result, tmp_path / "x.c3d")
    file = ezc3d.c3d(str(tmp_path / "x.c3d"))
    about = file["parameters"]["POINT"]
    assert about["LABELS"]["value"] == POINTS
    assert about["UNITS"]["value"] == ["mm"]
    assert about["RATE"]["value"] == [100.0]
    assert (about["X_SCREEN"]["value"], about["Y_SCREEN"]["value"]) == (["+X"], ["+Z"])
    p_mm = file["data"]["points"]
    assert p_mm.shape == (4, 8, 301)
    for k, point in enumerate(POINTS):
        np.testing.assert_allclose(p_mm[:3, k].T, 1e3 * pose.points[point], rtol=2e-7, atol=1e-4)  # single precision
    assert (file["data"]["meta_points"]["residuals"] == 0.0).all()
    assert file["parameters"]["ROTATION"]["LABELS"]["value"] == [f"{segment}_4X4" for segment in pose.quat_WL]
    assert file["parameters"]["ROTATION"]["RATE"]["value"] == [100.0]
    transforms = file["data"]["rotations"].transpose(2, 3, 0, 1)
    np.testing.assert_array_equal(transforms[:, :, 3], np.broadcast_to([0.0, 0.0, 0.0, 1.0], (9, 301, 4)))
    for k, (segment, quat_WL) in enumerate(pose.quat_WL.items()):
        R = transforms[k, :, :3, :3]
        np.testing.assert_allclose(R, Rotation.from_quat(quat_WL).as_matrix(), atol=1e-7)  # single precision
        begin = {"upper_arm": "shoulder", "forearm": "elbow", "hand": "wrist"}.get(segment.partition("_")[2])
        if begin:
            p_mm = 1e3 * pose.points[f"{segment.partition('_')[0]}_{begin}"]
            np.testing.assert_allclose(transforms[k, :, :3, 3], p_mm, atol=1e-4)
    assert [path.name for path in tmp_path.iterdir()] == ["x.c3d"]


def test_c3d_marks_what_hangs_on_a_gap(tmp_path: Path, pose: Pose) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    export(write_folder(tmp_path / "r", with_gap(pose)), tmp_path / "x.c3d")
    data = ezc3d.c3d(str(tmp_path / "x.c3d"))["data"]
    lost = data["meta_points"]["residuals"][0] == -1.0
    hit = {POINTS[k]: np.flatnonzero(row).tolist() for k, row in enumerate(lost) if row.any()}
    assert hit == {name: list(range(10, 20)) for name in ("right_wrist", "right_palm")}  # a hand hangs on its wrist
    assert np.isnan(data["points"][0, POINTS.index("right_wrist"), 10:20]).all()
    lost = np.isnan(data["rotations"])
    hit = {
        segment: np.flatnonzero(lost[0, 0, k]).tolist() for k, segment in enumerate(pose.quat_WL) if lost[:, :, k].any()
    }
    assert hit == {name: list(range(10, 20)) for name in ("right_forearm", "right_hand")}


def test_c3d_on_a_full_disk_leaves_the_earlier_file(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    (tmp_path / "x.c3d").write_text("earlier")
    whole = ezc3d.c3d.write

    def write(file: object, path: str) -> None:
        whole(file, path)
        Path(path).write_bytes(Path(path).read_bytes()[:-512])

    monkeypatch.setattr(ezc3d.c3d, "write", write)
    with pytest.raises(OSError, match="the disk seems to be full"):
        export(result, tmp_path / "x.c3d", force=True)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("x.c3d", "earlier")]


# BVH --------------------------------------------------------------------------------------------------------------


def in_bvh(p_W: np.ndarray) -> np.ndarray:
    """x to the person's left, y up, z forward, cm."""
    return 100.0 * np.stack([p_W[..., 1], p_W[..., 2], p_W[..., 0]], axis=-1)


PARTS = {"Arm": "shoulder", "ForeArm": "elbow", "Hand": "wrist"}
BVH_POINTS = {f"{side}{part}": f"{side.lower()}_{p}" for side in ("Left", "Right") for part, p in PARTS.items()}


def test_bvh_puts_every_joint_where_it_was_and_turns_it_as_it_was(result: Path, pose: Pose, tmp_path: Path) -> None:
    pybvh = pytest.importorskip("pybvh")
    export(result, tmp_path / "x.bvh")
    read = pybvh.read_bvh_file(tmp_path / "x.bvh")
    assert (read.frame_count, read.frame_time) == (301, 0.01)
    assert read.joint_names[:2] == ["Hips", "Spine"]
    assert (read.world_up, read.rest_forward) == ("+y", "+z")
    # Offsets are constant: the shoulders stay where they are at rest, and arms hang on them.
    body = replace(load_model(lengths=LENGTHS), girdles=RIGID_SHOULDERS)
    points = compute_pose(body, pose.time, pose.quat_WL).points
    assert np.linalg.norm(points["left_shoulder"] - pose.points["left_shoulder"], axis=1).max() > 0.02
    positions = read.node_positions()
    names = [node.name for node in read.nodes]
    for joint, point in BVH_POINTS.items():
        np.testing.assert_allclose(positions[:, names.index(joint)], in_bvh(points[point]), atol=1e-4)
    ends = [k for k, name in enumerate(names) if k and names[k - 1] == "RightHand"]
    np.testing.assert_allclose(positions[:, ends[0]], in_bvh(points["right_palm"]), atol=1e-4)
    np.testing.assert_allclose(positions[:, names.index("Hips")], 0.0, atol=1e-4)
    assert {"".join(order) for order in read.euler_orders} == {"ZXY"}
    local = read.to_rotmat()  # (n, joints, 3, 3)
    local = local[1] if isinstance(local, tuple) else local
    to_bvh = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    index = {name: k for k, name in enumerate(read.joint_names)}
    R = local[:, index["Hips"]]
    for joint, segment in {"Hips": "pelvis", "Spine": "torso", "LeftArm": "left_upper_arm"}.items():
        R = R if joint == "Hips" else R @ local[:, index[joint]]
        wanted = to_bvh @ Rotation.from_quat(pose.quat_WL[segment]).as_matrix() @ to_bvh.T
        np.testing.assert_allclose(R, wanted, atol=1e-7)


def test_bvh_of_one_arm_without_its_forearm(tmp_path: Path) -> None:
    pybvh = pytest.importorskip("pybvh")
    some = a_pose(("torso", "left_upper_arm", "left_forearm", "right_upper_arm"), n=20)
    export(write_folder(tmp_path / "r", some), tmp_path / "x.bvh")
    read = pybvh.read_bvh_file(tmp_path / "x.bvh")
    assert read.joint_names == ["Hips", "Spine", "LeftArm", "LeftForeArm", "LeftHand", "RightArm"]
    with pytest.raises(BadData, match="no orientation of a person's torso"):
        export(write_folder(tmp_path / "s", a_pose(("left_forearm",), n=20)), tmp_path / "y.bvh")


# URDF, rates, options -----------------------------------------------------------------------------------------------


def test_urdf_is_the_subject(result: Path, tmp_path: Path) -> None:
    pin = pytest.importorskip("pinocchio")
    export(result, tmp_path / "anna.urdf")
    assert (tmp_path / "anna.urdf").read_bytes() == (result / "subject.urdf").read_bytes()
    model = pin.buildModelFromUrdf(str(tmp_path / "anna.urdf"))
    assert model.existFrame("right_forearm")


def test_what_is_computed_anew_is_of_the_person_whose_shoulders_move_as_theirs(tmp_path: Path) -> None:
    """Of a result with its subject.toml, as at another rate."""
    average = wp.population_subject()
    person = replace(average, lengths={**average.lengths, **LENGTHS}, girdles=RIGID_SHOULDERS)
    upright, body = a_pose(n=40), person.shape(load_model())
    pose = compute_pose(body, upright.time, upright.quat_WL)
    folder = write_folder(tmp_path / "r", pose)
    (folder / "subject.urdf").write_text(body.urdf(), encoding="utf-8")
    person.save(folder / "subject.toml", force=True)
    export(folder, tmp_path / "x.parquet", rate_hz=200.0)
    table = pl.read_parquet(tmp_path / "x.parquet")
    for name, points in pose.points.items():
        again = table.select(f"{name}_x", f"{name}_y", f"{name}_z").to_numpy()[::2]
        np.testing.assert_allclose(again, points, atol=1e-9)


def test_resampling_goes_through_the_body(pose: Pose, tmp_path: Path) -> None:
    export(write_folder(tmp_path / "r", with_gap(pose)), tmp_path / "x.parquet", rate_hz=250.0)
    table = pl.read_parquet(tmp_path / "x.parquet")
    time = table["time"].to_numpy()
    np.testing.assert_allclose(np.diff(time), 0.004, atol=1e-12)
    assert (time[0], time[-1]) == (2.0, pytest.approx(5.0))
    palm, elbow, shoulder = (
        table.select(f"left_{name}_{axis}" for axis in "xyz").to_numpy() for name in ("palm", "elbow", "shoulder")
    )
    np.testing.assert_allclose(palm[::5], pose.points["left_palm"][::2], atol=1e-12)
    arm = np.linalg.norm(elbow - shoulder, axis=1)
    np.testing.assert_allclose(arm, 0.29, atol=1e-12)  # a chord between two points would be shorter
    truth = Rotation.from_rotvec(smooth(3001, 1, 0.7))[4::4][: len(time) - 1]  # of SEGMENTS[1]
    quat = table.select(f"left_upper_arm_{part}" for part in ("qx", "qy", "qz", "qw")).to_numpy()[1:]
    assert (truth * Rotation.from_quat(quat).inv()).magnitude().max() < 1e-3
    lost = time[table["right_forearm_gap"].to_numpy()]
    assert (lost[0], lost[-1]) == (pytest.approx(2.092), pytest.approx(2.196))
    std = np.sqrt(np.trace(pose.point_cov["left_palm"], axis1=1, axis2=2) / 3.0)
    np.testing.assert_allclose(table["left_palm_std"][::5], std[::2], rtol=1e-9)


def test_uneven_times_are_made_even_where_the_format_has_only_a_rate(tmp_path: Path, pose: Pose) -> None:
    late = pose.time + np.where(np.arange(301) > 150, 0.004, 0.0)
    folder = write_folder(tmp_path / "r", replace(pose, time=late))
    assert codes_of(folder, tmp_path / "x.bvh") == set()
    assert "Frame Time: 0.01" in (tmp_path / "x.bvh").read_text(encoding="utf-8")
    assert codes_of(folder, tmp_path / "x.mot") == {"angles-near-lock", "orientation-residual"}  # has times


def test_gaps_that_cannot_be_marked_are_told(tmp_path: Path, pose: Pose) -> None:
    folder = write_folder(tmp_path / "r", with_gap(pose))
    for name in ("x.mot", "x.sto", "x.bvh"):
        unmarked = [d for d in export(folder, tmp_path / name).diagnostics if d.code == "samples-lost"]
        assert [(d.place, d.value) for d in unmarked] == [("right_forearm", 10)]
    for name in ("x.csv", "x.trc"):
        assert "samples-lost" not in codes_of(folder, tmp_path / name)
    assert pl.read_csv(tmp_path / "x.csv")["right_forearm_gap"].sum() == 10


def test_a_sample_without_orientation_is_named(tmp_path: Path, pose: Pose) -> None:
    quat = pose.quat_WL["torso"].copy()
    quat[7] = np.nan
    folder = write_folder(tmp_path / "r", replace(pose, quat_WL={**pose.quat_WL, "torso": quat}))
    for name in ("x.mot", "x.sto", "x.bvh"):
        with pytest.raises(BadData, match=r"torso has no orientation in row 8 of pose\.parquet; .* csv and parquet"):
            export(folder, tmp_path / name)
    with pytest.raises(BadData, match="resampling needs one"):
        export(folder, tmp_path / "x.csv", rate_hz=50.0)
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-o", "x.dat"], "x.dat: '.dat' is no format's suffix; state it by --format; there is: bvh, c3d, csv"),
        (["-o", "x.trc", "--format", "tcr"], "--format tcr: not known; did you mean 'trc'?"),
        (["-o", "x.dat", "--format", "c3d"], "name it x.c3d"),
        (["-o", "x.txt", "--format", "placement"], "name it x.sto"),
        (["-o", "x.trc", "--names", "isb"], "--names isb: not of format trc; only of format mot"),
        (["-o", "x.mot", "--names", "rajagopal"], 'Invalid value "rajagopal" for --names. Choose from: "isb"'),
        (["-o", "x.trc", "--rate-hz", "0"], "--rate-hz 0: between 1 and 10000 samples a second"),
        (["-o", "x.trc", "--rate-hz", "nan"], "--rate-hz nan: between 1 and 10000"),
        (["-o", "x.urdf", "--rate-hz", "50"], "--rate-hz 50.0: not of format urdf; there is no motion in it"),
        (["-o", "no/x.trc"], "no/x.trc: not a file that can be written"),
    ],
)
def test_wrong_options_take_one_line(
    result: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("export", result, *arguments) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_without_force(result: Path, tmp_path: Path) -> None:
    (tmp_path / "x.trc").write_text("mine")
    with pytest.raises(ExistingOutput, match="`force=True` replaces"):
        export(result, tmp_path / "x.trc")
    assert (tmp_path / "x.trc").read_text() == "mine"
    export(result, tmp_path / "x.trc", force=True)
    assert (tmp_path / "x.trc").read_text().startswith("PathFileType\t4\t(X/Y/Z)\tx.trc\n")
    (tmp_path / "d.trc").mkdir()
    with pytest.raises(ExistingOutput, match="not a file"):
        export(result, tmp_path / "d.trc", force=True)


def test_no_result_and_no_points(tmp_path: Path) -> None:
    for name in ("x.trc", "x.urdf"):
        with pytest.raises(wp.MissingFile, match="wepose track"):
            export(tmp_path, tmp_path / name)
    folder = write_folder(tmp_path / "r", a_pose(("head",), n=5))
    for name, expected in (("x.trc", "no points"), ("x.mot", "no joint"), ("x.sto", "no segment")):
        with pytest.raises(BadData, match=expected):
            export(folder, tmp_path / name)
    short = write_folder(tmp_path / "s", a_pose(n=1))
    with pytest.raises(BadData, match="1 samples; a motion has at least 2"):
        export(short, tmp_path / "x.csv")
