"""Protocol `feet` on simulated legs whose feet stay on the floor: thighs and shanks are found within their ±."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from wepose_pin.calibration import Calibration, assess, calibrate
from wepose_pin.cli import main
from wepose_pin.diagnostics import render_all
from wepose_pin.model import load_table
from wepose_pin.recording import ImuSensor, Recording
from wepose_pin.simulation import MTI_3
from wepose_pin.subject import Subject, population_subject
from wepose_pin.writers import write_session

RATE, SECONDS, BEGIN = 50.0, 70.0, 6.0  # Hz, s, s
LEGS = ("left_thigh", "left_shank", "right_thigh", "right_shank")
SENSOR_AT = np.array([0.03, 0.02, -0.1])  # [m] in its segment
BIAS_STD, ACCEL_BIAS_STD = np.deg2rad(0.2), 0.02  # [rad/s], [m/s²]


def stand_and_squat(seed: int, wobble: float = 0.0) -> tuple[Recording, dict[str, float], Subject]:
    """A recording, the lengths [m] behind it and the prior; thighs, shanks and pelvis wobble by so much [rad]."""
    rng = np.random.default_rng(seed)
    prior = population_subject(1.75, "m", load_table("whole_body"))
    lengths = dict(prior.sample(rng).lengths)
    t = np.arange(0.0, SECONDS, 1.0 / RATE)
    share = np.clip((t - BEGIN) / 2.0, 0.0, 1.0)
    ease = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)

    def wave(amplitude: float) -> np.ndarray:
        frequency, phase = rng.uniform(0.08, 0.35, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
        return amplitude * 0.5 * ease * np.sin(2.0 * np.pi * frequency * t[:, None] + phase).sum(axis=1)

    pelvis = np.stack([wave(0.10), wave(0.18), -ease * (0.14 + 0.10 * np.sin(2.0 * np.pi * 0.11 * t))], axis=1)
    R_WL = {"pelvis": Rotation.from_euler("zyx", np.stack([wave(0.5), wave(0.3), wave(0.15)], axis=1))}
    origin = {"pelvis": pelvis}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        thigh, shank = lengths[f"{side}_thigh"], lengths[f"{side}_shank"]
        out = np.array([0.0, sign * lengths["hip_width"] / 2.0, 0.0])
        hip, ankle = pelvis + R_WL["pelvis"].apply(out), out - [0.0, 0.0, thigh + shank]
        reach = np.minimum(np.linalg.norm(ankle - hip, axis=1), thigh + shank - 1e-9)
        along = (ankle - hip) / np.linalg.norm(ankle - hip, axis=1)[:, None]
        ahead = np.array([1.0, 0.0, 0.0]) + ease[:, None] * [0.0, 0.3 * sign, 0.0]  # the knees go forwards and outwards
        ahead = ahead - (ahead * along).sum(axis=1)[:, None] * along
        ahead /= np.linalg.norm(ahead, axis=1)[:, None]
        cosine = np.clip((thigh**2 + reach**2 - shank**2) / (2.0 * thigh * reach), -1.0, 1.0)[:, None]
        knee = hip + thigh * (cosine * along + np.sqrt(1.0 - cosine**2) * ahead)
        for name, top, bottom in (("thigh", hip, knee), ("shank", knee, ankle)):
            z = (top - bottom) / np.linalg.norm(top - bottom, axis=1)[:, None]
            y = np.cross(z, ahead)
            y /= np.linalg.norm(y, axis=1)[:, None]
            R_WL[f"{side}_{name}"] = Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2))
            origin[f"{side}_{name}"] = top
        R_WL[f"{side}_foot"], origin[f"{side}_foot"] = Rotation.identity(len(t)), np.tile(ankle, (len(t), 1))
    sensors = {}
    for name, R in R_WL.items():
        tissue = np.stack([wave(0.0 if "foot" in name else wobble) for _ in range(3)], axis=1)
        R_WS = R * Rotation.from_rotvec(tissue) * Rotation.random(random_state=rng)
        accel_W = CubicSpline(t, origin[name] + R.apply(SENSOR_AT)).derivative(2)(t)
        gyro, accel = np.zeros((len(t), 3)), R_WS.inv().apply(accel_W + [0.0, 0.0, 9.81])
        gyro[1:] = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * RATE
        gyro += rng.normal(size=3) * BIAS_STD + rng.normal(size=gyro.shape) * MTI_3.gyro_density * np.sqrt(RATE)
        accel += rng.normal(size=3) * ACCEL_BIAS_STD
        accel += rng.normal(size=accel.shape) * MTI_3.accel_density * np.sqrt(RATE)
        sensors[name] = ImuSensor(gyro_S=gyro, accel_S=accel)
    phases = {"start": ((0.5, BEGIN - 0.5),), "feet": ((BEGIN + 2.0, SECONDS - 1.0),)}
    return Recording("legs", t, RATE, sensors, phases=phases), lengths, prior


def calibrate_legs(seed: int, wobble: float) -> tuple[Calibration, np.ndarray]:
    """A calibration with the measured width of the hips, and the errors (4,) of the legs' lengths in their ±."""
    recording, lengths, prior = stand_and_squat(seed, wobble)
    measured = {"hip_width": lengths["hip_width"]}
    calibrated = calibrate(recording, model="whole_body", protocol="feet", prior=prior, measured=measured)
    errors = [(calibrated.subject.lengths[name] - lengths[name]) / calibrated.subject.std(name) for name in LEGS]
    for name, error in zip(LEGS, errors, strict=True):
        now, before = 1e3 * calibrated.subject.std(name), 1e3 * prior.std(name)
        print(f"{wobble:g} {seed} {name} ± {now:.1f} mm, before {before:.1f}; error {error:+.2f}")
    return calibrated, np.array(errors)


@pytest.mark.parametrize(("wobble", "share"), [(0.0, 0.45), (0.03, 0.85)])
def test_lengths_of_legs_are_found_within_their_deviation(wobble: float, share: float) -> None:
    calibrated, errors = calibrate_legs(0, wobble)
    assert np.abs(errors).max() < 3.0
    for name in LEGS:
        assert calibrated.subject.std(name) < share * calibrated.prior.std(name)


@pytest.mark.monte_carlo
def test_stated_deviations_of_legs_are_right_over_seeds() -> None:
    z = [calibrate_legs(seed, 0.03)[1] for seed in range(8)]
    rms = np.sqrt(np.mean(np.square(z)))
    print(f"rms of z over {len(z)} people: {rms:.2f}")
    assert 0.5 < rms < 1.5


def test_advice_is_of_feet() -> None:
    """Nine seconds are too few: what to do is not said in the words of hands."""
    recording, lengths, _ = stand_and_squat(1)
    ((begin, _),) = recording.phases["feet"]
    short = replace(recording, phases={**recording.phases, "feet": ((begin, begin + 9.0),)})
    measured = {"hip_width": lengths["hip_width"]}
    quality = assess(calibrate(short, model="whole_body", protocol="feet", measured=measured))
    assert "motion-too-short" in {diagnostic.code for diagnostic in quality.reasons}
    words = " ".join(text.line() for _, text in render_all(quality.reasons))
    assert not re.search("hand|palm|arm", words)


def test_feet_by_the_command_and_on_a_body_without_legs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, lengths, _ = stand_and_squat(1)
    (tmp_path / "session").mkdir()
    write_session(tmp_path / "session", recording)
    words = ["calibrate", str(tmp_path / "session"), "--protocol", "feet", "--no-report", "-o", str(tmp_path / "out")]
    hips = ["--measured", f"hip_width={lengths['hip_width']:.4f}", "--stature", "1.75", "--sex", "m"]
    with pytest.raises(SystemExit) as stopped:
        main([*words, "--model", "whole_body", *hips])
    assert stopped.value.code in (0, 3)
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main([*words, "--force"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
