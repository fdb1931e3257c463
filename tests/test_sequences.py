"""Protocols joined in one session, free motion, and an earlier calibration of the person."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import SUBJECT

import wepose_pin as wp
from wepose_pin import WeposeError, calibrate, simulate, simulate_person
from wepose_pin.calibration import load_protocol

CLASP = Path(__file__).parents[1] / "calibration" / "clasp.toml"


def test_protocols_join(tmp_path: Path) -> None:
    protocol = load_protocol("clasp+t_pose")
    assert [step.phase for step in protocol.steps] == ["start", "clasp", "t_pose"]
    assert protocol.conditions == load_protocol("clasp").conditions + load_protocol("t_pose").conditions
    assert protocol.needs == load_protocol("clasp").needs
    own = tmp_path / "a+b.toml"  # a path is one protocol
    own.write_text(CLASP.read_text(encoding="utf-8"), encoding="utf-8")
    assert load_protocol(own).steps == load_protocol("clasp").steps
    with pytest.raises(WeposeError, match="protocol 't_poes' is not known; did you mean 't_pose'"):
        load_protocol("clasp+t_poes")
    with pytest.raises(WeposeError, match=r"protocol 'clasp\+table' is not simulated"):
        simulate(SUBJECT, seed=3, protocol="clasp+table")


def test_free_motion_shows_headings_and_keeps_lengths() -> None:
    person = simulate_person(4)
    options = {"imperfections": replace(wp.IDEAL_PRESET, mount="any"), "lengths": person.lengths}
    simulation = wp.simulate_activity("tasks", seed=4, seconds=40.0, **options)
    recording = simulation.recording()
    calibration = calibrate(recording, prior=person.prior, protocol="free")
    mounts = calibration.subject.mounts
    off = [Rotation.from_quat(mounts[name]) * Rotation.from_quat(simulation.quat_LS[name]).inv() for name in mounts]
    errors = np.array([each.as_rotvec(degrees=True)[2] for each in off])
    std = max(calibration.subject.std(f"mounts.{name}.z") for name in mounts)
    assert np.abs(errors).max() < 2.0 * np.degrees(std) < 40.0
    assert np.ptp(errors) < 4.0  # against each other by the accelerations of the joints
    assert calibration.subject.lengths == pytest.approx(person.prior.lengths, rel=1e-9)
    assert "lengths-not-observed" in {diagnostic.code for diagnostic in calibration.diagnostics}
    assert calibration.quality.quality != "pass"
    still = replace(recording, phases={"start": ((0.5, 1.5),)}).cut(recording.span((0.0, 4.9)))
    assert calibrate(still, prior=person.prior, protocol="free").quality.quality == "fail"
    arm = replace(recording, sensors={name: recording.imus[name] for name in ("left_upper_arm", "left_forearm")})
    assert list(calibrate(arm, prior=person.prior, protocol="free").subject.mounts) == list(arm.sensors)
    with pytest.raises(WeposeError, match="free motion needs sensors on left_upper_arm and left_forearm, or on right"):
        calibrate(replace(arm, sensors={"left_forearm": arm.imus["left_forearm"]}), protocol="free")


def test_an_earlier_calibration_adds_what_it_knows() -> None:
    person = simulate_person(11)
    options = {"circles": 0, "clasp_s": 20.0, "rate_hz": 50.0, "imperfections": replace(wp.MILD_PRESET, mount="any")}
    sessions = [simulate(person.lengths, seed=seed, **options).recording() for seed in (11, 12)]
    first, second = (calibrate(each, measured=person.measured).subject for each in sessions)
    both = calibrate(replace(sessions[1], remounted=True), prior=first, measured=person.measured).subject
    names = tuple(person.lengths)
    before, after = (np.sqrt(np.trace(subject.lengths_covariance(names))) for subject in (second, both))
    assert after < before  # of the later session alone
    for name, quat in both.mounts.items():  # those of this session, moved by what is known better of lengths
        own, other = (Rotation.from_quat(subject.mounts[name]) for subject in (second, first))
        assert (Rotation.from_quat(quat) * own.inv()).magnitude() < np.deg2rad(2.0)
        assert (Rotation.from_quat(quat) * other.inv()).magnitude() > np.deg2rad(5.0)
