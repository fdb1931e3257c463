"""Poses and bows beside joined hands: what they show, and what happens where people do others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.validation.simulated import compute_mount_errors
from wepose_pin.calibration import Calibration, calibrate
from wepose_pin.errors import WeposeError
from wepose_pin.filters import run_filter
from wepose_pin.filters.noise import estimate_noise
from wepose_pin.recording import OrientationSensor, Recording
from wepose_pin.simulation import (
    PEOPLE_MEASURED_STD,
    PEOPLE_PRESET,
    Person,
    Simulation,
    simulate,
    simulate_person,
)
from wepose_pin.simulation import motion as motions
from wepose_pin.simulation.people import Offset

SEED = 5301
BOW = motions.make_bow
WRONG = {
    "a bow to the side": ("clasp+bow", "make_bow", lambda share, _axis: BOW(share, np.pi / 2.0)),
    "a bow 30 deg off": ("clasp+bow", "make_bow", lambda share, _axis: BOW(share, np.deg2rad(30.0))),
    "arms forwards": ("clasp+t_pose", "T_POSE", {**motions.T_POSE, "plane": Offset(45.0, 6.0)}),
    "arms that hang": ("clasp+t_pose", "T_POSE", {**motions.T_POSE, "elevation": Offset(-75.0, 5.0)}),
}


def perform(protocol: str) -> tuple[Person, Simulation]:
    person = simulate_person(SEED, PEOPLE_MEASURED_STD)
    imperfections = replace(PEOPLE_PRESET, mount="any")
    return person, simulate(
        person.lengths,
        seed=SEED,
        rate_hz=50.0,
        imperfections=imperfections,
        clasp_s=50.0,
        circles=0,
        protocol=protocol,
    )


def solve(person: Person, recording: Recording, protocol: str) -> Calibration:
    return calibrate(
        recording, measured=person.measured, prior=person.prior, measured_std=person.measured_std, protocol=protocol
    )


def as_trackers(recording: Recording) -> Recording:
    """The orientations by sensors that give no accelerations, mounts unknown."""
    rest, sensors = recording.span(recording.phases["start"][0]), {}
    for name, sensor in recording.imus.items():
        noise = estimate_noise(sensor.gyro_S[rest], sensor.accel_S[rest], recording.rate_hz)
        settings = "amekf"
        quat_VS = run_filter(sensor.gyro_S, sensor.accel_S, recording.rate_hz, noise, settings).quat_VS
        sensors[name] = OrientationSensor(quat_VS)
    return replace(recording, sensors=sensors, remounted=True)


def torso_heading_std(calibration: Calibration) -> float:
    return float(np.degrees(calibration.subject.std("mounts.torso.z")))


def headings_by_std(calibration: Calibration, simulation: Simulation) -> np.ndarray:
    errors = compute_mount_errors(calibration.subject, simulation)[:, 2]
    return errors / [calibration.subject.std(f"mounts.{name}.z") for name in simulation.quat_LS]


def test_a_bow_shows_where_the_torso_faces_to_sensors_without_accelerations() -> None:
    person, simulation = perform("clasp+bow")
    recording = as_trackers(simulation.recording())
    hands, bowed = (solve(person, recording, protocol) for protocol in ("clasp", "clasp+bow"))
    assert torso_heading_std(bowed) < 0.75 * torso_heading_std(hands)
    for calibration in (hands, bowed):
        assert np.abs(headings_by_std(calibration, simulation)).max() < 2.5
    assert "pose-contradicted" not in [each.code for each in bowed.diagnostics]


SLOW = ("a bow to the side", "arms forwards", "arms that hang")


@pytest.mark.parametrize("what", [pytest.param(what, marks=[pytest.mark.slow] * (what in SLOW)) for what in WRONG])
def test_another_pose_than_the_protocols_is_said_and_left_out(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    protocol, name, value = WRONG[what]
    monkeypatch.setattr(motions, name, value)
    person, simulation = perform(protocol)
    monkeypatch.undo()
    recording = simulation.recording()
    calibration, hands = (solve(person, recording, each) for each in (protocol, "clasp"))
    [left_out] = [each for each in calibration.diagnostics if each.code == "pose-contradicted"]
    assert left_out.place == protocol.removeprefix("clasp+")
    assert left_out.value is not None
    assert left_out.value > 3.0
    assert np.abs(headings_by_std(calibration, simulation)).max() < 2.5
    for length, metres in hands.subject.lengths.items():
        assert calibration.subject.lengths[length] == pytest.approx(metres, abs=2e-3)


def test_without_joined_hands_nobody_knows_which_pose_is_wrong_and_that_is_said() -> None:
    person, simulation = perform("t_pose+bow")
    recording = simulation.recording()
    good = solve(person, recording, "t_pose+bow")
    assert "pose-contradicted" not in [each.code for each in good.quality.reasons]
    hanging = replace(recording, phases={**recording.phases, "t_pose": ((1.0, 4.0),)})
    bad = solve(person, hanging, "t_pose+bow")
    assert ("pose-contradicted", "t_pose") in [(each.code, each.place) for each in bad.quality.reasons]
    assert bad.quality.quality != "pass"


@pytest.mark.parametrize("condition", ['[[axis]]\nsegment = "head"', "[[pose]]\ndirections.head = [0, 0, 1]"])
def test_a_pose_of_a_segment_without_a_sensor_is_one_line(tmp_path: Path, condition: str) -> None:
    person, simulation = perform("t_pose")
    (tmp_path / "own.toml").write_text(f'{condition}\nphase = "t_pose"\nstd_deg = 4.0\n', encoding="utf-8")
    with pytest.raises(WeposeError, match="no sensor on head, which a pose or an axis is about"):
        solve(person, simulation.recording(), str(tmp_path / "own.toml"))
