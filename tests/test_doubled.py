"""Two sensors on one segment: both are read, used and calibrated, and what they differ by is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin import load_session
from wepose_pin.calibration import calibrate
from wepose_pin.cli import main
from wepose_pin.errors import BadSession
from wepose_pin.recording import DoubledSensor, ImuSensor, Recording
from wepose_pin.simulation import Person, Simulation, simulate, simulate_person
from wepose_pin.subject import parse_subject, subject_toml
from wepose_pin.tracking import summarize, track, track_chunks
from wepose_pin.tracking.doubled import FOLLOW_S, _average_angle
from wepose_pin.writers import write_session

TURN = Rotation.from_euler("xyz", [90, 0, 30], degrees=True)  # the second sensor against the first


@pytest.fixture(scope="module")
def made() -> tuple[Person, Simulation, Recording]:
    """A second, worse sensor on the torso."""
    person = simulate_person(3)
    simulation = simulate(person.lengths, seed=3, clasp_s=20.0, circles=1)
    recording, rng = simulation.recording(), np.random.default_rng(0)
    first = recording.imus["torso"]
    assert first.stated_quat_LS is not None
    second = ImuSensor(
        gyro_S=TURN.apply(first.gyro_S) + rng.normal(size=first.gyro_S.shape) * 0.01 + np.deg2rad(0.3),
        accel_S=TURN.apply(first.accel_S) + rng.normal(size=first.accel_S.shape) * 0.05,
        stated_quat_LS=(Rotation.from_quat(first.stated_quat_LS) * TURN.inv()).as_quat(),
    )
    return person, simulation, replace(recording, doubled={"torso": DoubledSensor("torso_back", second)})


def errors_deg(simulation: Simulation, time: np.ndarray, quat_WL: np.ndarray) -> np.ndarray:
    truth = simulation.truth()
    at = np.searchsorted(truth.time, time).clip(0, len(truth.time) - 1)
    return np.degrees((Rotation.from_quat(quat_WL).inv() * Rotation.from_quat(truth.quat_WL["torso"][at])).magnitude())


def test_both_are_used_and_their_difference_is_said(made: tuple[Person, Simulation, Recording]) -> None:
    _, simulation, recording = made
    both = track(recording)
    alone = replace(recording, sensors={**recording.sensors, "torso": recording.doubled["torso"].sensor})
    second = track(alone, open_loop=True)
    error, worse = (errors_deg(simulation, each.time, each.quat_WL["torso"]) for each in (both, second))
    # Soft tissue turns each of them by more than either is noisy: both count nearly alike.
    assert error.mean() < 0.85 * worse.mean()
    std = np.degrees(np.sqrt(np.trace(both.pose.segment_cov["torso"], axis1=1, axis2=2) / 3.0))
    assert np.all(error < 3.0 * std)
    [diagnostic] = [each for each in summarize(both).diagnostics if each.code == "sensors-differ"]
    assert (diagnostic.place, diagnostic.facts["sensor"]) == ("torso", "torso_back")
    assert diagnostic.value == pytest.approx(np.deg2rad(worse.mean()), rel=0.5)
    chunks = list(track_chunks(lambda: recording.chunks(10.0)))
    np.testing.assert_array_equal(np.concatenate([c.quat_WL["torso"] for c in chunks]), both.quat_WL["torso"])


@pytest.mark.slow
def test_the_drift_of_the_second_sensor_is_not_in_corrected_headings() -> None:
    simulation = simulate(simulate_person(3).lengths, seed=3, clasp_s=60.0, circles=1)
    recording = simulation.recording()
    first = recording.imus["left_forearm"]
    rate = np.deg2rad(0.06) * (recording.time > recording.phases["start"][0][1])  # [rad/s] about the vertical
    R_WS = Rotation.from_quat(simulation.quat_WS["left_forearm"])
    drifting = replace(first, gyro_S=first.gyro_S + R_WS.inv().apply(rate[:, None] * [0.0, 0.0, 1.0]))
    both = replace(recording, doubled={"left_forearm": DoubledSensor("left_forearm_2", drifting)})
    off = {}
    for how in ("open_loop", "causal", ""):
        options = {how: True} if how else {}
        one, two = (track(each, **options).quat_WL["left_forearm"] for each in (recording, both))
        off[how] = np.degrees((Rotation.from_quat(one).inv() * Rotation.from_quat(two)).magnitude())[-100:].mean()
    drift = np.degrees(rate.sum() / recording.rate_hz)
    assert drift > 4.0
    assert off["open_loop"] == pytest.approx(0.5 * drift, rel=0.1)
    # The mean of `FOLLOW_S` is behind by what it drifts in that time.
    assert max(off["causal"], off[""]) < 0.55 * 0.06 * FOLLOW_S


def test_the_mounts_of_both_are_calibrated(made: tuple[Person, Simulation, Recording]) -> None:
    person, simulation, recording = made
    bare = {name: replace(sensor, stated_quat_LS=None) for name, sensor in recording.sensors.items()}
    unknown = replace(recording.doubled["torso"].sensor, stated_quat_LS=None)
    recording = replace(recording, sensors=bare, doubled={"torso": DoubledSensor("torso_back", unknown)})
    subject = calibrate(recording, prior=person.prior).subject
    true = Rotation.from_quat(simulation.quat_LS["torso"]) * TURN.inv()
    off = (Rotation.from_quat(subject.mounts["torso_back"]) * true.inv()).magnitude()
    covariance = subject.mount_covariance("torso_back")
    assert covariance is not None
    assert off < min(np.deg2rad(1.0), 2.0 * np.sqrt(np.trace(covariance)))
    assert set(parse_subject(subject_toml(subject), Path("subject.toml")).mounts) == set(subject.mounts)
    assert errors_deg(simulation, recording.time, track(recording, subject).quat_WL["torso"]).max() < 5.0


def test_a_session_is_written_with_both(made: tuple[Person, Simulation, Recording], tmp_path: Path) -> None:
    write_session(tmp_path, made[2])
    read = load_session(tmp_path)
    assert set(read.sensors) == set(made[2].sensors)
    second = read.doubled["torso"]
    assert second.name == "torso_back"
    assert isinstance(second.sensor, ImuSensor)
    expected = made[2].doubled["torso"].sensor
    assert isinstance(expected, ImuSensor)
    np.testing.assert_allclose(second.sensor.gyro_S, expected.gyro_S, atol=1e-12)


def test_a_session_names_the_segment_of_both(made: tuple[Person, Simulation, Recording], tmp_path: Path) -> None:
    recording = made[2]
    write_session(tmp_path, replace(recording, doubled={}))
    table = pl.read_parquet(tmp_path / "recording.parquet")
    columns = [name for name in table.columns if name.startswith("torso_")]
    rng = np.random.default_rng(1)
    noise = {name: pl.Series(rng.normal(scale=1e-3, size=table.height)) for name in columns}
    table = table.with_columns([(pl.col(c) + noise[c]).alias(c.replace("torso_", "back_")) for c in columns])
    table.write_parquet(tmp_path / "recording.parquet")
    session = tmp_path / "session.toml"
    text = session.read_text(encoding="utf-8")
    begin = text.index("[sensors.torso]")
    end = text.find("[sensors.", begin + 1)
    second = text[begin:end].replace("torso", "back").replace("[sensors.back]", '[sensors.back]\nsegment = "torso"')
    session.write_text(f"{text}\n{second}", encoding="utf-8")
    read = load_session(session)
    assert read.doubled["torso"].name == "back"
    assert set(read.sensors) == set(recording.sensors)
    with pytest.raises(SystemExit) as stopped:
        main(["track", str(session), "-o", str(tmp_path / "out"), "--no-report", "--no-view"])
    assert not stopped.value.code
    session.write_text(f"{text}\n{second}\n{second.replace('sensors.back', 'sensors.third')}", encoding="utf-8")
    with pytest.raises(BadSession, match="a segment bears two sensors at most"):
        load_session(session)


def test_the_mean_difference_goes_on_beyond_half_a_turn_and_after_lost_samples() -> None:
    angle = np.linspace(0.0, 4.0 * np.pi, 4000)
    wrapped = np.angle(np.exp(1j * angle))
    wrapped[1000:1020] = np.nan
    means = np.empty(len(angle))
    last = _average_angle(wrapped, 0.1, 0.0, means)
    assert last == means[-1]
    np.testing.assert_allclose(means[-1], angle[-1], atol=0.05)
    assert np.isfinite(means).all()
