"""Sensors that do not measure: named while reading, lost from where they stop, never believed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_bad_input import refused

from wepose_pin import load_session
from wepose_pin.errors import BadData, BadSession
from wepose_pin.readers import iter_session
from wepose_pin.readers.faults import SensorScan, faults_of
from wepose_pin.recording import Recording
from wepose_pin.simulation import Simulation, simulate, simulated_person
from wepose_pin.tracking import track, track_pieces
from wepose_pin.writers import write_session

BROKEN = "left_forearm"
RATE = 100.0


@pytest.fixture(scope="module")
def made() -> Simulation:
    """Twenty-five seconds: start pose from 0.5 to 4.5 s, then the arms move."""
    return simulate(simulated_person(1).lengths, seed=1, clasp_s=5.0, circles=1)


def with_sensor(recording: Recording, name: str, **changes: object) -> Recording:
    return replace(recording, sensors={**recording.sensors, name: replace(recording.sensors[name], **changes)})


def stopped(recording: Recording, signals: str, first: float, last: float = np.inf, value: float | None = None):
    """The recording with a sensor that stays at its value, or at this one, in these seconds."""
    sensor, stands = recording.sensors[BROKEN], (recording.time >= first) & (recording.time <= last)
    changes = {}
    for name in signals.split():
        values = getattr(sensor, f"{name}_S").copy()
        values[stands] = values[int(np.argmax(stands))] if value is None else value
        changes[f"{name}_S"] = values
    return with_sensor(recording, BROKEN, **changes)


def written(folder: Path, recording: Recording) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_session(folder, recording)
    return folder


def errors_deg(recording: Recording, made: Simulation, segment: str, **options: object) -> tuple[np.ndarray, np.ndarray]:
    """Angle to the truth, and one standard deviation of an axis, of each sample [deg]."""
    pose, truth = track(recording, **options), made.truth()
    off = Rotation.from_quat(truth.quat_WL[segment][-len(pose.time) :]).inv() * Rotation.from_quat(pose.quat_WL[segment])
    std = pose.segment_std[segment] if hasattr(pose, "segment_std") else None
    return np.degrees(off.magnitude()), np.degrees(std)


@pytest.mark.parametrize(
    ("signals", "value"),
    [("gyro", 0.0), ("gyro", None), ("accel", None), ("gyro accel", None), ("gyro accel", 0.0)],
)
def test_a_sensor_that_never_measures_is_refused_by_name(
    signals: str, value: float | None, made: Simulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path / "in", stopped(made.recording("dead"), signals, 0.0, value=value))
    line = refused(["track", str(path), "-o", str(tmp_path / "out")], capsys)
    assert f"sensors.{BROKEN}: " in line
    assert all(name in line for name in signals.split())
    assert f"take [sensors.{BROKEN}] out" in line
    with pytest.raises(BadData, match=f"sensors.{BROKEN}: "):
        next(iter_session(path, 5.0))


@pytest.mark.parametrize(("signals", "since"), [("gyro accel", 9.0), ("gyro accel", 16.3), ("gyro", 9.0), ("accel", 9.0)])
def test_a_sensor_that_freezes_is_lost_from_there(signals: str, since: float, made: Simulation, tmp_path: Path) -> None:
    whole = made.recording("frozen")
    path = written(tmp_path / "in", stopped(whole, signals, since))
    read = load_session(path)
    gap = read.sensors[BROKEN].gap
    assert gap is not None
    assert read.time[np.argmax(gap)] == pytest.approx(since + 0.01, abs=0.011)
    assert gap[read.time > since + 0.02].all()
    (note,) = (note for note in read.notes if BROKEN in note and "lost" in note and "from" in note)
    assert f"from {since:g} to " in note
    assert all(sensor.gap is None for name, sensor in read.sensors.items() if name != BROKEN)
    pieces = [piece.sensors[BROKEN].gap for piece in iter_session(path, 3.7)]
    np.testing.assert_array_equal(np.concatenate(pieces), gap)
