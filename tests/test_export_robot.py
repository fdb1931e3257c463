"""Motions by joints for robot learning, ROS 2 and viewers: each read back by the reader of others, or by one of ours
that was written from the format's description."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import polars as pl
import pytest
from arms import JOINTS, write_arm
from commands import run
from test_export import a_pose, write_folder

from wepose_pin import WeposeError, export

RATE_HZ = 50.0
APPROACH_S = 2.0


def write_trajectory_folder(folder: Path, seed: int = 1, seconds: float = 8.0, rate_hz: float = RATE_HZ) -> Path:
    """A folder as `wepose retarget` writes it, of the robot arm of `arms`, with three phases."""
    folder.mkdir()
    write_arm(folder).rename(folder / "robot.urdf")
    (folder / "arm.toml").unlink()
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    rng = np.random.default_rng(seed)
    columns = {"time": time, "recorded_time": np.maximum(time - APPROACH_S, 0.0) + 1.5}
    for name in JOINTS:
        phase, size, speed = rng.uniform(0.0, 6.0), rng.uniform(0.2, 0.8), rng.uniform(0.5, 2.0)
        columns[name] = size * np.sin(speed * time + phase) - 0.4
        columns[f"{name}_velocity"] = size * speed * np.cos(speed * time + phase)
        columns[f"{name}_acceleration"] = -size * speed**2 * np.sin(speed * time + phase)
    pl.DataFrame(columns).write_parquet(folder / "trajectory.parquet")
    w, x, y, z = 0.5, 0.5, -0.5, 0.5
    summary = {
        "robot": "arm",
        "recording": f"session {seed}",
        "joints": list(JOINTS),
        "posture": {},
        "root": {"x": 0.1, "y": 0.0, "z": 0.7, "qx": x, "qy": y, "qz": z, "qw": w},
        "approach_s": APPROACH_S,
        "recorded_phases": {
            "reach": [[1.5, 2.5], [3.0, 4.2]],
            "later": [[90.0, 91.0]],
            "wave": [[1.6, 2.4], [2.6, 3.4], [3.6, 4.4]],
        },
    }
    (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trajectory_folder(tmp_path_factory.mktemp("robot") / "arm")


def read_positions(folder: Path) -> np.ndarray:
    """(n, 7) [rad] of a trajectory's joints."""
    return pl.read_parquet(folder / "trajectory.parquet").select(JOINTS).to_numpy()


def place_by_pinocchio(folder: Path, k: int, root: pin.SE3 | None = None) -> dict[str, np.ndarray]:
    """Link → (4, 4) in W at a sample of a trajectory, or from another root."""
    if root is None:
        at = json.loads((folder / "summary.json").read_text())["root"]
        root = pin.XYZQUATToSE3(np.array([at[name] for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]))
    model = pin.buildModelFromUrdf(str(folder / "robot.urdf"))
    data, q = model.createData(), pin.neutral(model)
    row = dict(zip(JOINTS, read_positions(folder)[k], strict=True))
    for joint in range(1, model.njoints):
        name, first = model.names[joint], model.idx_qs[joint]
        value = row["elbow" if name == "elbow_copy" else name]
        q[first : first + model.nqs[joint]] = value if model.nqs[joint] == 1 else (np.cos(value), np.sin(value))
    pin.framesForwardKinematics(model, data, q)
    links = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    return {link: (root * data.oMf[model.getFrameId(link, pin.FrameType.BODY)]).homogeneous for link in links}


# LeRobot ----------------------------------------------------------------------------------------------------------


def read_frames(folder: Path) -> pl.DataFrame:
    return pl.read_parquet(folder / "data" / "chunk-000" / "file-000.parquet")


def test_each_result_is_an_episode(trajectory: Path, tmp_path: Path) -> None:
    other = write_trajectory_folder(tmp_path / "other", seed=2, seconds=3.0)
    assert export([trajectory, str(other)], tmp_path / "data", "lerobot") == ("lerobot", [])
    frames, info = read_frames(tmp_path / "data"), json.loads((tmp_path / "data/meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 50, "arm")
    assert (info["total_episodes"], info["total_frames"], info["splits"]) == (2, 550, {"train": "0:2"})
    assert info["features"]["action"] == {"dtype": "float32", "shape": [7], "names": list(JOINTS)}
    assert not any("/" in feature for feature in info["features"])
    state, action = (frames[name].to_numpy() for name in ("observation.state", "action"))
    np.testing.assert_array_equal(state[:400], read_positions(trajectory).astype(np.float32))
    np.testing.assert_array_equal(action[:399], state[1:400])
    np.testing.assert_array_equal(action[399], state[399])  # and not the first of the next episode
    assert frames["index"].to_list() == list(range(550))
    assert frames["frame_index"].to_list() == [*range(400), *range(150)]
    np.testing.assert_allclose(frames["timestamp"][400:], np.arange(150) / 50.0, atol=1e-6)
    episodes = pl.read_parquet(tmp_path / "data/meta/episodes/chunk-000/file-000.parquet")
    assert episodes["tasks"].to_list() == [["follow session 1"], ["follow session 2"]]
    assert episodes["dataset_to_index"].to_list() == [400, 550]


def test_intervals_of_a_phase_are_episodes(trajectory: Path, tmp_path: Path) -> None:
    """The recording's 1.5 s are at 2 s of the trajectory: the approach before belongs to no phase."""
    position = read_positions(trajectory)
    export(trajectory, tmp_path / "r", "lerobot", episodes="wave", instruction="wave")
    frames = read_frames(tmp_path / "r")
    assert frames["episode_index"].value_counts(sort=True)["count"].to_list() == [41, 41, 41]
    np.testing.assert_array_equal(frames["observation.state"].to_numpy()[0], position[105].astype(np.float32))
    np.testing.assert_array_equal(frames["action"].to_numpy()[40], position[146].astype(np.float32))
    assert pl.read_parquet(tmp_path / "r/meta/tasks.parquet")["__index_level_0__"].to_list() == ["wave"]
    export([trajectory], tmp_path / "p", "lerobot", episodes="reach", rate_hz=25.0)
    frames = read_frames(tmp_path / "p")
    assert frames["episode_index"].value_counts(sort=True)["count"].to_list() == [30, 26]
    np.testing.assert_allclose(frames["observation.state"].to_numpy()[0], position[100], atol=1e-6)


def test_an_interval_outside_is_left_out_and_the_others_are_episodes(trajectory: Path, tmp_path: Path) -> None:
    exported = export(trajectory, tmp_path / "data", "lerobot", episodes="reach", interval=(1.5, 2.6))
    assert [(each.code, each.value) for each in exported.diagnostics] == [("episodes-cut", 1.0)]
    assert json.loads((tmp_path / "data" / "meta" / "info.json").read_text())["total_episodes"] == 1


def test_an_earlier_data_set_goes_as_a_whole(trajectory: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    export(trajectory, data, "lerobot")
    stale = data / "data" / "chunk-000" / "file-001.parquet"
    stale.write_bytes(b"")
    (data / "notes.txt").write_text("mine")
    with pytest.raises(WeposeError, match="exists and is not empty"):
        export(trajectory, data, "lerobot")
    export(trajectory, data, "lerobot", force=True)
    assert not stale.exists()
    assert (data / "notes.txt").read_text() == "mine"


def find_lerobot() -> str:
    """The Python that has lerobot; the test is skipped without one."""
    python = os.environ.get("WEPOSE_LEROBOT", sys.executable)
    process = subprocess.run([python, "-c", "import importlib.util as u, sys; sys.exit(not u.find_spec('lerobot'))"])
    if process.returncode:
        pytest.skip("lerobot is not installed; WEPOSE_LEROBOT names a Python that has it")
    return python


# What is wrong ----------------------------------------------------------------------------------------------------


def change_summary(folder: Path, **values: object) -> None:
    file = folder / "summary.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


def change_table(folder: Path, change: pl.Expr) -> None:
    file = folder / "trajectory.parquet"
    pl.read_parquet(file).with_columns(change).write_parquet(file)


def change_urdf(folder: Path, old: str, new: str) -> None:
    file = folder / "robot.urdf"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda f: (f / "robot.urdf").unlink(), "no robot.urdf in it; a folder that `wepose retarget` wrote is needed"),
        (lambda f: (f / "summary.json").write_text('{"robot": "arm"'), "summary.json: cannot be read as the summary"),
        (lambda f: change_summary(f, root={"x": 0.0}), "summary.json: cannot be read as the summary of a trajectory"),
        (lambda f: change_summary(f, joints=[*JOINTS, "gripper"]), "trajectory.parquet: no column 'gripper'"),
        (lambda f: change_table(f, pl.lit("fast").alias("elbow_velocity")), "'elbow_velocity' holds text in row 1"),
        (lambda f: change_table(f, pl.lit(float("nan")).alias("elbow")), "a number in each cell, and times that grow"),
        (lambda f: change_table(f, pl.lit(1.0).alias("time")), "a number in each cell, and times that grow"),
        (lambda f: change_table(f, pl.col("time") ** 1.5 + pl.col("time")), "times that are uneven; a data set"),
        (lambda f: change_urdf(f, "</robot>", ""), "robot.urdf: is no complete XML file"),
        (lambda f: (f / "trajectory.parquet").write_bytes(b"PAR1"), "trajectory.parquet"),
    ],
)  # fmt: skip
def test_a_spoiled_trajectory_takes_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], object], said: str
) -> None:
    folder = write_trajectory_folder(tmp_path / "arm", seconds=3.0)
    spoil(folder)
    assert_refused(capsys, [str(folder), "-o", str(tmp_path / "data"), "--format", "lerobot"], said)
    assert [path.name for path in tmp_path.iterdir()] == ["arm"]


def assert_refused(capsys: pytest.CaptureFixture[str], arguments: list[str], said: str) -> None:
    assert run("export", *arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    assert said in error


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-o", "d", "--format", "lerobot", "--episodes", "reachh"], "it has no such phase; did you mean 'reach'?"),
        (["-o", "d", "--format", "lerobot", "--episodes", "later"], "the trajectory follows none of it"),
        (["-o", "d", "--format", "lerobot", "--phase", "reach"], "reach has 2 intervals; choose reach:1"),
        (["-o", "d", "--format", "lerobot", "--rate-hz", "33.3"], "33.3 samples a second"),
        (["-o", "d", "--format", "lerobot", "--interval", "50", "60"], "the recording runs from 1.5 to"),
        (["-o", "x.mcap", "--episodes", "reach"], "--episodes reach: not of format mcap; only of format lerobot"),
        (["-o", "x.trc"], "is a robot's trajectory, for lerobot"),
        (["-o", "x.bag", "--format", "rosbag"], "x.bag: format rosbag is a folder; name it x"),
        (["{arm}", "-o", "x.mcap"], "--format mcap: a file of 2 results; only lerobot takes several, as episodes"),
        (["{slow}", "-o", "d", "--format", "lerobot"], "robot arm, 25 Hz, joints"),
        (["{other}", "-o", "d", "--format", "lerobot"], "50 Hz, joints flexion; a data set has one robot"),
        (["-o", "{arm}/summary.json", "--format", "lerobot", "--force"], "summary.json is a file; a folder is needed"),
    ],
)
def test_a_wrong_export_of_a_robot_takes_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    folders = {name: write_trajectory_folder(tmp_path / name) for name in ("arm", "other")}
    folders["slow"] = write_trajectory_folder(tmp_path / "slow", rate_hz=25.0)
    change_summary(folders["other"], joints=["flexion"])
    before = sorted(tmp_path.rglob("*"))
    assert_refused(capsys, [str(folders["arm"]), *(word.format(**folders) for word in arguments)], said)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_person_is_no_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "r", a_pose(n=5))
    arguments = [str(folder), "-o", str(tmp_path / "d"), "--format", "lerobot"]
    assert_refused(capsys, arguments, "is of robots, as `wepose retarget` writes them")
    assert [path.name for path in tmp_path.iterdir()] == ["r"]
