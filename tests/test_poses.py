"""Poses and bows beside joined hands: what they show, and what happens where people do others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.validation.simulated import compute_mount_errors
from wepose_pin import (
    PEOPLE_PRESET,
    Calibration,
    OrientationSensor,
    Recording,
    Simulation,
    WeposeError,
    calibrate,
    estimate_orientation,
    simulate,
    simulate_person,
)
from wepose_pin.simulation import Person

SEED = 5301


def perform(protocol: str) -> tuple[Person, Simulation]:
    person = simulate_person(SEED, 0.012)
    imperfections = replace(PEOPLE_PRESET, mount="any")
    options = {"rate_hz": 50.0, "clasp_s": 30.0, "circles": 0}
    return person, simulate(person.lengths, seed=SEED, imperfections=imperfections, protocol=protocol, **options)


def solve(person: Person, recording: Recording, protocol: str) -> Calibration:
    return calibrate(
        recording, measured=person.measured, prior=person.prior, measured_std=person.measured_std, protocol=protocol
    )


def torso_heading_std(calibration: Calibration) -> float:
    return float(np.degrees(calibration.subject.std("mounts.torso.z")))


def headings_by_std(calibration: Calibration, simulation: Simulation) -> np.ndarray:
    errors = compute_mount_errors(calibration.subject, simulation)[:, 2]
    return errors / [calibration.subject.std(f"mounts.{name}.z") for name in simulation.quat_LS]


def test_a_bow_shows_where_the_torso_faces_to_sensors_without_accelerations() -> None:
    person, simulation = perform("clasp+bow")
    recording, sensors = simulation.recording(), {}
    rest, rate = recording.phases["start"][0], recording.rate_hz
    for name, sensor in recording.imus.items():
        orientation = estimate_orientation(sensor.gyro_S, sensor.accel_S, rate, static=rest)
        sensors[name] = OrientationSensor(orientation.quat_VS)
    recording = replace(recording, sensors=sensors, remounted=True)
    hands, bowed = (solve(person, recording, protocol) for protocol in ("clasp", "clasp+bow"))
    assert torso_heading_std(bowed) < 0.75 * torso_heading_std(hands)
    for calibration in (hands, bowed):
        assert np.abs(headings_by_std(calibration, simulation)).max() < 2.5
    assert "pose-contradicted" not in [each.code for each in bowed.diagnostics]


def test_another_pose_than_the_protocols_is_said_and_left_out() -> None:
    """Arms that hang in place of a T-pose."""
    person, simulation = perform("clasp+t_pose")
    recording = simulation.recording()
    recording = replace(recording, phases={**recording.phases, "t_pose": ((1.0, 4.0),)})
    calibration, hands = (solve(person, recording, each) for each in ("clasp+t_pose", "clasp"))
    [left_out] = [each for each in calibration.diagnostics if each.code == "pose-contradicted"]
    assert left_out.place == "t_pose"
    assert left_out.value > 3.0
    assert np.abs(headings_by_std(calibration, simulation)).max() < 2.5
    for length, metres in hands.subject.lengths.items():
        assert calibration.subject.lengths[length] == pytest.approx(metres, abs=2e-3)


@pytest.mark.parametrize("condition", ['[[axis]]\nsegment = "head"', "[[pose]]\ndirections.head = [0, 0, 1]"])
def test_a_pose_of_a_segment_without_a_sensor_is_one_line(
    half_minute: Recording, tmp_path: Path, condition: str
) -> None:
    (tmp_path / "own.toml").write_text(f'{condition}\nphase = "clasp"\nstd_deg = 4.0\n', encoding="utf-8")
    with pytest.raises(WeposeError, match="no sensor on head, which a pose or an axis is about"):
        calibrate(half_minute, protocol=str(tmp_path / "own.toml"))
