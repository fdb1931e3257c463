"""Sessions and results read back as they were; what is in the way of a result leaves everything as it was."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import polars as pl
import pytest
import yourdfpy

import wepose_pin as wp
from wepose_pin import OrientationSensor, Simulation, load_session
from wepose_pin.writers import write_session


@pytest.fixture(scope="module")
def result(half_minute: wp.Recording) -> wp.TrackResult:
    return wp.track(half_minute)


@pytest.fixture
def out(saved: Path, tmp_path: Path) -> Path:
    """A folder with a result."""
    return Path(shutil.copytree(saved, tmp_path / "out"))


@pytest.fixture(scope="module")
def saved(result: wp.TrackResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return result.save(tmp_path_factory.mktemp("saved") / "out")


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
    truth = pl.read_parquet(again.truth).select("left_palm_x", "left_palm_y", "left_palm_z")
    np.testing.assert_array_equal(truth, simulation.points["left_palm"])


def test_ready_orientations_are_written_too(simulation: Simulation, tmp_path: Path) -> None:
    ready = {name: OrientationSensor(quat_VS=quat) for name, quat in simulation.quat_WL.items()}
    write_session(tmp_path, replace(simulation.recording(), sensors=ready))
    again = load_session(tmp_path)
    np.testing.assert_allclose(again.sensors["torso"].quat_VS, simulation.quat_WL["torso"], atol=1e-15)
    assert again.truth is None


def test_a_file_in_the_way_of_a_folder_and_the_other_way_round_leaves_all_as_it_was(
    result: wp.TrackResult, out: Path
) -> None:
    (out / "mine").write_text("keep")
    (out / "summary.json").unlink()
    (out / "summary.json").mkdir()
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    with pytest.raises(wp.ExistingOutput, match=r"summary\.json: is in the way"):
        result.save(out, force=True)
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
    (out / "summary.json").rmdir()
    result.save(out, force=True)
    assert (out / "mine").read_text() == "keep"
    for place in (out / "mine", out / "mine" / "deeper"):
        with pytest.raises(wp.ExistingOutput, match="is a file"):
            result.save(place, force=True)


def test_the_subjects_urdf_opens_in_other_tools_and_says_how_sure_it_is(
    half_minute: wp.Recording, tmp_path: Path
) -> None:
    person = replace(wp.population_subject(1.7, "f"), name="Anna --> <test>")
    path = wp.track(half_minute, person).save(tmp_path / "out") / "subject.urdf"
    assert f"left_forearm {person.lengths['left_forearm']:.4f} ± {person.std('left_forearm'):.4f}" in path.read_text()
    model = pin.buildModelFromUrdf(str(path))
    assert model.nq == len(yourdfpy.URDF.load(path).actuated_joints)
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    upper, fore = (data.oMf[model.getFrameId(f"left_{part}")].translation for part in ("upper_arm", "forearm"))
    assert fore[2] - upper[2] == pytest.approx(-person.lengths["left_upper_arm"], abs=1e-12)


def test_what_is_no_result_is_named(out: Path, tmp_path: Path) -> None:
    with pytest.raises(wp.MissingFile, match=r"no pose\.parquet in it"):
        wp.load_result(tmp_path)
    table = pl.read_parquet(out / "pose.parquet")
    for changed, says in (
        (table.drop("time"), "no column 'time'"),
        (table.select("time"), "neither orientations nor points"),
        (table.with_columns(pl.lit(2.0).alias("torso_qw")), "torso_qx … _qw is no unit quaternion in row"),
        (table.with_columns(pl.lit(1e200).alias("torso_std")), "column 'torso_std' holds 1e\\+200 in row 1"),
        (table.with_columns(pl.lit("a").alias("torso_qw")), "holds text"),
    ):
        changed.write_parquet(out / "pose.parquet")
        with pytest.raises(wp.WeposeError, match=says):
            wp.load_result(out)
