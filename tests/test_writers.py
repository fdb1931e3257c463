"""Folders that appear whole or not at all; sessions and results that read back as they were."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from wepose_pin.body import load_model
from wepose_pin.body.kinematics import build_pose_table, parse_pose_table
from wepose_pin.body.subject import population_subject
from wepose_pin.documents import whole_folder
from wepose_pin.errors import BadData, ExistingOutput, MissingFile
from wepose_pin.readers import load_session
from wepose_pin.simulation import Simulation
from wepose_pin.tracking import summarize, track
from wepose_pin.writers import read_result, write_result, write_session
from wepose_pin.writers.result import write_subject


def test_a_folder_appears_when_all_of_it_is_there(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    with whole_folder(out) as folder:
        (folder / "deep").mkdir()
        (folder / "deep" / "a").write_text("1")
        assert not out.exists()
    assert (out / "deep" / "a").read_text() == "1"
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_nothing_is_overwritten_without_force_and_nothing_else_with_it(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").write_text("old")
    (tmp_path / "out" / "mine").write_text("keep")
    with pytest.raises(ExistingOutput, match="--force"), whole_folder(tmp_path / "out"):
        pass
    with whole_folder(tmp_path / "out", force=True) as folder:
        (folder / "a").write_text("new")
    assert (tmp_path / "out" / "a").read_text() == "new"
    assert (tmp_path / "out" / "mine").read_text() == "keep"
    with pytest.raises(ExistingOutput, match="is a file"), whole_folder(tmp_path / "out" / "a", force=True):
        pass


def test_a_folder_in_the_way_of_a_file_leaves_everything_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "out" / "b").mkdir(parents=True)
    (tmp_path / "out" / "a").write_text("old")
    with pytest.raises(ExistingOutput, match="b: is in the way"), whole_folder(tmp_path / "out", True) as folder:  # noqa: PT012
        for name in "ab":
            (folder / name).write_text("new")
    assert (tmp_path / "out" / "a").read_text() == "old"


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ExistingOutput, match="is a file"), whole_folder(tmp_path / "file" / "out"):
        pass


def test_two_runs_at_once_do_not_mix(tmp_path: Path) -> None:
    with pytest.raises(ExistingOutput, match="not empty"), whole_folder(tmp_path / "out") as first:  # noqa: PT012
        (first / "a").write_text("first")
        with whole_folder(tmp_path / "out") as second:
            (second / "a").write_text("second")
    assert (tmp_path / "out" / "a").read_text() == "second"
    assert len(list(tmp_path.rglob("*"))) == 2


def test_a_session_reads_back_to_the_bit(simulation: Simulation, tmp_path: Path) -> None:
    recording = simulation.recording("made")
    write_session(tmp_path, recording, simulation.truth())
    again = load_session(tmp_path / "session.toml")
    assert again.name == "made"
    np.testing.assert_array_equal(again.time, recording.time)
    for name, sensor in recording.sensors.items():
        np.testing.assert_array_equal(again.sensors[name].gyro_S, sensor.gyro_S)
        np.testing.assert_array_equal(again.sensors[name].accel_S, sensor.accel_S)
        np.testing.assert_allclose(again.sensors[name].stated_quat_LS, sensor.stated_quat_LS, atol=1e-15)
    for name, spans in recording.phases.items():
        np.testing.assert_allclose(again.phases[name], spans, atol=1e-3)
    assert again.truth == tmp_path / "truth.parquet"
    truth = parse_pose_table(pl.read_parquet(again.truth), "truth.parquet")
    np.testing.assert_array_equal(truth.points["left_palm"], simulation.points["left_palm"])


def test_ready_orientations_are_written_too(simulation: Simulation, tmp_path: Path) -> None:
    from dataclasses import replace

    from wepose_pin.recording import OrientationSensor

    ready = {name: OrientationSensor(quat_VS=quat) for name, quat in simulation.quat_WL.items()}
    write_session(tmp_path, replace(simulation.recording(), sensors=ready))
    again = load_session(tmp_path)
    np.testing.assert_allclose(again.sensors["torso"].quat_VS, simulation.quat_WL["torso"], atol=1e-15)
    assert again.truth is None


def test_a_result_reads_back(simulation: Simulation, tmp_path: Path) -> None:
    pose = track(simulation.recording("made"))
    write_result(tmp_path, pose, summarize(pose))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "pose.parquet",
        "subject.toml",
        "subject.urdf",
        "summary.json",
    ]
    again, model, summary = read_result(tmp_path)
    np.testing.assert_array_equal(again.points["right_palm"], pose.points["right_palm"])
    np.testing.assert_allclose(again.quat_WL["torso"], pose.quat_WL["torso"], atol=1e-15)
    assert model.lengths == pytest.approx(dict(pose.subject.lengths), abs=1e-12)
    assert summary == json.loads((tmp_path / "summary.json").read_text())
    assert summary["versions"]["wepose-pin"]


def test_the_subjects_urdf_opens_in_other_tools_and_says_how_sure_it_is(tmp_path: Path) -> None:
    import pinocchio as pin
    import yourdfpy

    person = replace(population_subject(1.7, "f"), name="Anna --> <test>")
    write_subject(tmp_path, person, load_model(lengths=person.lengths))
    path = tmp_path / "subject.urdf"
    assert f"left_forearm {person.lengths['left_forearm']:.4f} ± {person.std('left_forearm'):.4f}" in path.read_text()
    model = pin.buildModelFromUrdf(str(path))
    robot = yourdfpy.URDF.load(path)
    assert model.nq == len(robot.actuated_joints)
    reach = pin.neutral(model)
    data = model.createData()
    pin.framesForwardKinematics(model, data, reach)
    upper, fore = (data.oMf[model.getFrameId(f"left_{part}")].translation for part in ("upper_arm", "forearm"))
    assert fore[2] - upper[2] == pytest.approx(-person.lengths["left_upper_arm"], abs=1e-12)


def test_a_folder_that_is_no_result_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match=r"no pose\.parquet in it"):
        read_result(tmp_path)


def test_tables_that_are_no_pose_are_named(simulation: Simulation) -> None:
    table = build_pose_table(simulation.truth())
    with pytest.raises(BadData, match="no column 'time'"):
        parse_pose_table(table.drop("time"), "t.csv")
    with pytest.raises(BadData, match="neither orientations nor points"):
        parse_pose_table(table.select("time"), "t.csv")
    with pytest.raises(BadData, match="torso_qx … _qw is no unit quaternion in row"):
        parse_pose_table(table.with_columns(pl.lit(2.0).alias("torso_qw")), "t.csv")
    with pytest.raises(BadData, match="holds text"):
        parse_pose_table(table.with_columns(pl.lit("a").alias("torso_qw")), "t.csv")
