"""aMEKF and its smoother: honest covariances, bad data, what smoothing gains, and real recordings."""

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.trials import read_broad
from benchmarks.validation.single import SingleSensor, simulate_paper_dynamic
from wepose_pin import IDEAL_PRESET, WeposeWarning, estimate_orientation
from wepose_pin.filters import AmekfParams

RATE = 100.0
REST = (0.5, 4.5)  # [s]


class Case(NamedTuple):
    """A simulated trial: 5 s rest, 50 s motion, 5 s rest at 100 Hz."""

    gyro: np.ndarray
    accel: np.ndarray
    true: Rotation
    moving: np.ndarray  # (n,) bool


def as_case(sensor: SingleSensor, gyro: np.ndarray) -> Case:
    moving = (sensor.time >= sensor.moving[0]) & (sensor.time <= sensor.moving[1])
    return Case(gyro, sensor.accel_S, Rotation.from_quat(sensor.quat_WS), moving)


@lru_cache
def case(seed: int) -> Case:
    sensor = simulate_paper_dynamic(seed, RATE, imperfections=IDEAL_PRESET)
    return as_case(sensor, sensor.gyro_S)


@lru_cache
def drawn(seed: int) -> Case:
    """A trial whose sensor is drawn from what `AmekfParams` says: matrix, bias, drift and noise in motion."""
    p = AmekfParams()
    rng = np.random.default_rng([seed, 5])
    sensor = simulate_paper_dynamic(seed, RATE)
    of = as_case(sensor, sensor.gyro_S)
    rate = np.vstack([np.zeros(3), (of.true[:-1].inv() * of.true[1:]).as_rotvec() * RATE])
    n = len(rate)
    walk = p.gyro_bias_walk / np.sqrt(RATE) * np.cumsum(rng.standard_normal((n, 3)), axis=0)
    gyro = sensor.gyro_S + walk + p.gyro_matrix_std * rate @ rng.standard_normal((3, 3))
    gyro += p.rate_noise * np.sqrt(RATE) * np.linalg.norm(rate, axis=1)[:, None] * rng.standard_normal((n, 3))
    drift = p.drift_rate_std * rng.standard_normal() * of.moving
    return of._replace(gyro=gyro + of.true.inv().apply(np.outer(drift, [0.0, 0.0, 1.0])))


def run(of: Case, method: str = "amekf", **options: Any) -> Any:
    return estimate_orientation(of.gyro, of.accel, RATE, method=method, **{"static": REST, **options})


def errors(of: Case, quat_VS: np.ndarray) -> Rotation:
    """Error on the left, in W; heading aligned at rest as the validation does."""
    R_VS = Rotation.from_quat(quat_VS)
    return align_heading(R_VS, of.true, slice(50, 450)) * of.true.inv()


def align_heading(R_VS: Rotation, true: Rotation, rest: Any) -> Rotation:
    off = (true[rest] * R_VS[rest].inv()).mean().as_matrix()
    return Rotation.from_euler("z", np.arctan2(off[1, 0] - off[0, 1], off[0, 0] + off[1, 1])) * R_VS


def heading_deg(error: Rotation) -> np.ndarray:
    M = error.as_matrix()
    return np.degrees(np.arctan2(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1]))


def tilt_deg(error: Rotation) -> np.ndarray:
    tilt: np.ndarray = np.degrees(np.arccos(np.clip(error.as_matrix()[:, 2, 2], -1.0, 1.0)))
    return tilt


def within(of: Case, result: Any, after: int, sigmas: float = 3.0) -> bool:
    """Errors in W from a sample on are within so many of the stated standard deviations."""
    R = Rotation.from_quat(result.quat_VS).as_matrix()
    std = np.sqrt(np.diagonal(R @ result.attitude_cov @ R.transpose(0, 2, 1), axis1=1, axis2=2))
    return bool((np.abs(errors(of, result.quat_VS).as_rotvec()) <= sigmas * std)[after:].all())


# Consistency and accuracy on simulated trials ----------------------------------------------------------------------


@pytest.mark.parametrize("seeds", [8, pytest.param(24, marks=pytest.mark.monte_carlo)])
@pytest.mark.parametrize("method", ["amekf", "smoother"])
def test_the_covariance_is_right(method: str, seeds: int) -> None:
    """Normalised squared errors of the attitude in motion, of sensors drawn from the stated priors: 3 is right."""
    values = []
    for of in map(drawn, range(seeds)):
        result = run(of, method)
        k = np.flatnonzero(of.moving)[300::25]
        error = (
            align_heading(Rotation.from_quat(result.quat_VS), of.true, np.array([50]))[k].inv() * of.true[k]
        ).as_rotvec()
        values.append(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(result.attitude_cov[k]), error)))
    assert abs(np.mean(values) - 3.0) < (0.9 if seeds > 20 else 1.5)


def test_the_gyroscope_s_scale_is_learned_in_motion() -> None:
    """One per cent on each axis: the heading gains by it."""
    off: list[list[float]] = []
    for seed in range(4, 10):
        of = case(seed)
        bias = of.gyro[50:450].mean(axis=0)
        wrong = of._replace(gyro=of.gyro + (of.gyro - bias) * [0.01, -0.01, 0.01])
        end = of.moving.nonzero()[0][-1000:]
        off.append([])
        for std in (0.01, 0.0):
            error = errors(of, run(wrong, params=AmekfParams(gyro_matrix_std=std)).quat_VS)
            off[-1].append(np.abs(heading_deg(error[end])).mean())
    learned_deg, fixed_deg = np.mean(off, axis=0)
    assert learned_deg < 0.6 * fixed_deg


def test_a_rest_at_the_end_tells_the_smoother_the_bias_of_the_beginning() -> None:
    """The sensor's bias is not known at the start, and it rests only at the end."""
    bias = np.array([0.01, -0.01, 0.005])
    for seed in range(4):
        of = Case(*(part[1000:6001] for part in case(seed)))
        true_bias = case(seed).gyro[50:450].mean(axis=0) + bias
        wrong, tilt = {}, {}
        for method in ("amekf", "smoother"):
            with pytest.warns(WeposeWarning, match="There is no static phase"):
                result = run(of._replace(gyro=of.gyro + bias), method, static=None)
            wrong[method] = np.abs(result.gyro_bias[100] - true_bias).max()
            tilt[method] = tilt_deg(Rotation.from_quat(result.quat_VS) * of.true.inv())[:500].mean()
        assert wrong["smoother"] < 0.2 * wrong["amekf"]
        assert tilt["smoother"] < 0.5 < tilt["amekf"]


# Bad data ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["amekf", "smoother"])
def test_a_clipped_gyroscope_is_known_to_be_wrong(method: str) -> None:
    of = case(6)
    limit = 0.6 * np.abs(of.gyro).max()
    result = run(of._replace(gyro=np.clip(of.gyro, -limit, limit)), method)
    assert within(of, result, 500)
    assert np.abs(errors(of, result.quat_VS).as_rotvec()).max() > np.deg2rad(5.0)


def test_an_impact_does_not_tip_the_attitude() -> None:
    """150 m/s² for 20 ms, a velocity change of 3 m/s that never was."""
    of = case(7)
    accel = of.accel.copy()
    accel[2500:2502] += [150.0, -100.0, 50.0]
    assert tilt_deg(errors(of, run(of._replace(accel=accel)).quat_VS))[2500:].max() < 1.0


def test_a_vehicle_that_accelerates_turns_little() -> None:
    """2 m/s² for 10 s, 20 m/s for 4 s, and back: no motion that the filter expects of a person."""
    second = np.arange(6001) / RATE % 28.0
    pushed = 2.0 * (second < 10.0) - 2.0 * ((second >= 14.0) & (second < 24.0))
    turned = []
    for of in map(drawn, range(4)):
        force = np.outer(pushed[: len(of.gyro)] * of.moving, [1.0, 0.0, 0.0])
        error = errors(of, run(of._replace(accel=of.accel + of.true.inv().apply(force))).quat_VS)[of.moving]
        turned.append((rms(tilt_deg(error)), rms(heading_deg(error))))
    assert np.mean(turned, axis=0).max() < 3.0


def test_a_person_who_sways_at_rest_does_not_pass_for_bias() -> None:
    """0.1 deg/s of sway, as a standing person has: at its end the rest knows the bias to a third of that, not less."""
    rng = np.random.default_rng(8)
    time = np.arange(500) / RATE
    bias = np.deg2rad([0.2, -0.1, 0.3])
    sway = np.deg2rad(0.14) * np.sin(2.0 * np.pi * 0.4 * time[:, None] + [0.3, 1.7, 4.0])
    gyro = bias + sway + np.deg2rad(0.05) * rng.normal(size=(500, 3))
    accel = [0.0, 0.0, 9.81] + 0.02 * rng.normal(size=(500, 3))
    result = estimate_orientation(gyro, accel, RATE, method="amekf", static=(0.0, 3.99))
    assert np.degrees(np.abs(result.gyro_bias[400:] - bias)).max() < 0.04


@pytest.mark.parametrize("method", ["amekf", "smoother"])
def test_a_sensor_that_never_rests_converges_and_says_so(method: str) -> None:
    """From within the motion, no static phase, a bias of 0.4 deg/s: starts from its own accelerometer, degrees off."""
    tilts = []
    for seed in range(6):
        of = Case(*(part[1000:5400] for part in case(seed)))
        with pytest.warns(WeposeWarning, match="There is no static phase"):
            orientation = run(of._replace(gyro=of.gyro + np.deg2rad([0.4, -0.3, 0.2])), method, static=None)
        assert [each.code for each in orientation.diagnostics] == ["static-phase-missing"]
        tilts.append(tilt_deg(Rotation.from_quat(orientation.quat_VS) * of.true.inv()))
        assert not orientation.static.any()
    by = np.mean(tilts, axis=0)
    assert by[0] > 3.0 or method == "smoother"
    assert by[1500:].max() < 1.5
    assert by[-500:].mean() < 0.6


def test_hours_leave_the_covariance_a_covariance() -> None:
    """Half a million samples of trials in a row, motion and rest."""
    of = case(10)
    result = estimate_orientation(
        *(np.tile(v, (85, 1)) for v in (of.gyro, of.accel)), RATE, method="amekf", static=REST
    )
    cov = result.attitude_cov[-6000:]
    np.testing.assert_allclose(cov, cov.transpose(0, 2, 1), atol=1e-15)
    assert np.linalg.eigvalsh(cov).min() > 0.0
    assert np.abs(np.linalg.norm(result.quat_VS[-6000:], axis=1) - 1.0).max() < 1e-12


# Real recordings ---------------------------------------------------------------------------------------------------

# VQF 2.1.2 with its defaults on these trials, scored alike (`vqf.VQF(dt).updateBatch`, `vqf.offlineVQF`): RMSE of
# inclination and of the whole [deg].
VQF = {"amekf": (0.705, 4.17), "smoother": (0.524, 4.11)}


@pytest.mark.parametrize("method", VQF)
def test_broad_against_vqf(method: str, data: Path) -> None:
    """Parameters were chosen on simulated trials and on every other trial, the first, third, … by name.

    Errors are what is stated.
    """
    paths = sorted((data / "broad").glob("*.mat"))
    if not paths:
        pytest.skip(f"no real recordings at {data / 'broad'}")
    rows = []
    for path in paths:
        trial = read_broad(path)
        seen = np.isfinite(trial.quat_true).all(axis=1)
        rest = np.flatnonzero(seen[trial.static]) + trial.static.start
        scored = np.flatnonzero(trial.scored)[::3]
        true = Rotation.from_quat(np.where(seen[:, None], trial.quat_true, [0, 0, 0, 1]))
        static = trial.static.start / trial.rate_hz, (trial.static.stop - 1) / trial.rate_hz
        out = estimate_orientation(trial.gyro_S, trial.accel_S, trial.rate_hz, method=method, static=static)
        error = align_heading(Rotation.from_quat(out.quat_VS), true, rest)[scored] * true[scored].inv()
        stated = np.sqrt(np.mean(np.trace(out.attitude_cov[scored], axis1=1, axis2=2)))
        rows.append(np.degrees([rms(np.deg2rad(tilt_deg(error))), rms(error.magnitude()), stated]))
    everywhere, held = np.mean(rows, axis=0), np.mean(rows[1::2], axis=0)
    assert everywhere[0] <= VQF[method][0]
    assert everywhere[1] <= 0.9 * VQF[method][1]
    assert held[1] <= VQF[method][1]
    _, error_rms, stated_rms = np.sqrt(np.mean(np.square(rows), axis=0))
    assert 0.8 < error_rms / stated_rms < 1.25


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
