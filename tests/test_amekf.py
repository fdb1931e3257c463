"""aMEKF: its algebra against textbook matrices, its consistency, its answers to bad data, and real recordings."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.trials import read_broad
from benchmarks.validation.single import simulate_paper_dynamic
from wepose_pin import rotations
from wepose_pin.errors import WeposeError, WeposeWarning
from wepose_pin.evaluation import attitude_error, uncertainty
from wepose_pin.filters import (
    Amekf,
    AmekfParams,
    FilterRun,
    Smoother,
    estimate_orientation,
    run_filter,
)
from wepose_pin.filters.amekf import BLOCK, ERROR, STATES, fill_transition_rows
from wepose_pin.filters.noise import SensorNoise, estimate_noise
from wepose_pin.filters.static import StaticDetector
from wepose_pin.simulation import IDEAL_PRESET, MILD_PRESET

RATE = 100.0
GRAVITY = 9.81
V, P, B, M, F, D = (states.start for states in ERROR[1:])


class Case(NamedTuple):
    """A simulated trial as the filters take it: 5 s rest, 50 s motion, 5 s rest at 100 Hz."""

    gyro: np.ndarray
    accel: np.ndarray
    static: np.ndarray
    true: np.ndarray  # (n, 4)
    noise: SensorNoise
    start: np.ndarray
    moving: np.ndarray  # (n,) bool


@lru_cache
def case(seed: int, realistic: bool = False) -> Case:
    sensor = simulate_paper_dynamic(seed, RATE, imperfections=MILD_PRESET if realistic else IDEAL_PRESET)
    moving = (sensor.time >= sensor.moving[0]) & (sensor.time <= sensor.moving[1])
    return as_case(sensor.gyro_S, sensor.accel_S, sensor.quat_WS, moving)


def as_case(gyro: np.ndarray, accel: np.ndarray, true: np.ndarray, moving: np.ndarray) -> Case:
    noise = estimate_noise(gyro[50:450], accel[50:450], RATE)
    static = StaticDetector(noise, RATE).run(gyro, accel)
    return Case(gyro, accel, static, true, noise, rotations.quat_from_gravity(accel[:50].mean(axis=0)), moving)


@lru_cache
def drawn(seed: int) -> Case:
    """A trial whose sensor is drawn from what `AmekfParams` says of sensors: matrix, biases and noise in motion."""
    p = AmekfParams()
    rng = np.random.default_rng([seed, 5])
    sensor = simulate_paper_dynamic(seed, RATE)
    R_WS = Rotation.from_quat(sensor.quat_WS)
    rate = np.vstack([np.zeros(3), (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * RATE])
    n = len(rate)
    moving = (sensor.time >= sensor.moving[0]) & (sensor.time <= sensor.moving[1])
    walk = p.motion_bias_walk / np.sqrt(RATE) * np.cumsum(rng.standard_normal((n, 3)), axis=0)
    gyro = sensor.gyro_S + p.gyro_matrix_std * rate @ rng.standard_normal((3, 3))
    gyro += moving[:, None] * (p.motion_bias_std * rng.standard_normal(3) + walk)
    gyro += p.rate_noise * np.sqrt(RATE) * np.linalg.norm(rate, axis=1)[:, None] * rng.standard_normal((n, 3))
    return as_case(gyro, sensor.accel_S, sensor.quat_WS, moving)


def run(of: Case, params: AmekfParams | None = None, kind: Any = Amekf) -> FilterRun:
    result: FilterRun = kind(of.noise, RATE, of.start, params).run(of.gyro, of.accel, of.static)
    return result


def cov(result: FilterRun) -> np.ndarray:
    assert result.attitude_cov is not None
    return result.attitude_cov


def errors(of: Case, quat_VS: np.ndarray) -> Rotation:
    """Error on the left, in W; heading aligned at rest as the validation does."""
    R_VS, true = Rotation.from_quat(quat_VS), Rotation.from_quat(of.true)
    psi = rotations.heading((true[50:450] * R_VS[50:450].inv()).mean().as_quat())
    return Rotation.from_rotvec([0.0, 0.0, float(psi)]) * R_VS * true.inv()


def tilt_deg(error: Rotation) -> np.ndarray:
    tilt: np.ndarray = np.degrees(np.arccos(np.clip(error.as_matrix()[:, 2, 2], -1.0, 1.0)))
    return tilt


def nees(of: Case, result: FilterRun) -> float:
    """Mean normalised squared error of the attitude in the motion; the heading is exact at the first sample."""
    true, R_VS = Rotation.from_quat(of.true), Rotation.from_quat(result.quat_VS)
    psi = rotations.heading((true[0] * R_VS[0].inv()).as_quat())
    k = np.flatnonzero(of.moving)[300::25]
    error = ((Rotation.from_rotvec([0, 0, float(psi)]) * R_VS[k]).inv() * true[k]).as_rotvec()
    return uncertainty(error, cov(result)[k]).nees


# Algebra -----------------------------------------------------------------------------------------------------------


def strapdown(x: np.ndarray, gyro: np.ndarray, moving: np.ndarray, force_S: np.ndarray, dt: float) -> np.ndarray:
    """Attitude (as a rotation vector), horizontal velocity and position after a block, from perturbed states `x`."""
    R, v, p = Rotation.from_rotvec(x[:3]), x[V : V + 2].copy(), x[P : P + 2].copy()
    matrix = np.eye(3) - x[M : M + 9].reshape(3, 3)
    for k in range(len(gyro)):
        before = R
        R = R * Rotation.from_rotvec(matrix @ (gyro[k] - x[B : B + 3] - moving[k] * x[D : D + 3]) * dt)
        a = 0.5 * (before.apply(force_S[k]) + R.apply(force_S[k + 1])) - R.apply(x[F : F + 3])
        p += v * dt + 0.5 * a[:2] * dt**2
        v += a[:2] * dt
    return np.concatenate([R.as_rotvec(), v, p])


def block_of(R: np.ndarray, rate: np.ndarray, moving: np.ndarray, dt: float) -> np.ndarray:
    """(1,) of `BLOCK` with the sums of samples with orientations (n, 3, 3) and rates (n, 3)."""
    block = np.zeros(1, BLOCK)
    block["R"], block["R_moving"] = dt * R.sum(axis=0), dt * R[moving.astype(bool)].sum(axis=0)
    block["R_rate"] = dt * np.einsum("kij,kc->cij", R, rate)
    block["length"] = len(R) * dt
    return block


def test_the_transition_is_the_derivative_of_the_strapdown() -> None:
    """Of a sensor that turns on the spot, by finite differences; the block sums leave only terms of second order."""
    rng = np.random.default_rng(1)
    n, dt = 25, 0.01
    rate = np.cumsum(rng.normal(scale=0.5, size=(n, 3)), axis=0)
    moving = (np.arange(n) >= 10).astype(float)
    R, turns = Rotation.identity(), [Rotation.identity()]
    for k in range(n):
        R = R * Rotation.from_rotvec(rate[k] * dt)
        turns.append(R)
    force = np.array([turn.inv().apply([0.0, 0.0, GRAVITY]) for turn in turns])
    block = block_of(np.array([turn.as_matrix() for turn in turns[1:]]), rate, moving, dt)
    rows = np.empty((7, STATES))
    fill_transition_rows(block[0], GRAVITY, np.eye(STATES), rows)
    step, expected = 1e-6, np.empty((7, STATES))
    for j in range(STATES):
        ends = [strapdown(sign * step * np.eye(STATES)[j], rate, moving, force, dt) for sign in (1.0, -1.0)]
        turned = (Rotation.from_rotvec(ends[0][:3]) * Rotation.from_rotvec(ends[1][:3]).inv()).as_rotvec()
        expected[:, j] = np.concatenate([turned, ends[0][3:] - ends[1][3:]]) / (2.0 * step)
    # θ to a sample's turn; velocity and position to what a trapezoid over the block leaves of the gyroscope's share.
    np.testing.assert_allclose(rows[:3], expected[:3], atol=0.01 * np.abs(expected[:3]).max())
    np.testing.assert_allclose(rows[3:, :M], expected[3:, :M], atol=0.02)
    np.testing.assert_allclose(rows[3:5, F:D], expected[3:5, F:D], atol=1e-6)


@pytest.mark.parametrize("still", [False, True])
def test_a_block_is_the_textbook_filter(still: bool) -> None:
    """P after one block against F P Fᵀ + Q and the joint correction, with full matrices."""
    of = case(0)
    of = of._replace(noise=replace(of.noise, gyro_half_second_cov=None))  # white, to the last digit
    at = slice(100, 125) if still else slice(2000, 2025)
    params = AmekfParams(tilt_std=0.02, force_noise=0.0, rate_noise=0.0, speed_std=0.5)
    filter_ = Amekf(of.noise, RATE, of.true[at.start - 1], params)
    rng = np.random.default_rng(2)
    half = 0.05 * rng.normal(size=(STATES, STATES))
    scale = np.sqrt(np.diag(filter_.state["P"][0, :, :STATES]))
    filter_.state["P"][0, :, :STATES][:] = np.outer(scale, scale) * (np.eye(STATES) + half @ half.T)
    filter_.state["x"][0][V : P + 2] = 0.1, -0.2, 0.05, 0.02
    x_before, P_start = filter_.state["x"][0].copy(), filter_.state["P"][0, :, :STATES].copy()
    filter_.blocks = blocks = np.empty(1, BLOCK)
    result = filter_.run(of.gyro[at], of.accel[at], np.full(25, still))

    rows, T = np.empty((7, STATES)), 0.25
    fill_transition_rows(blocks[0], of.noise.gravity, np.eye(STATES), rows)
    whole = np.eye(STATES)
    whole[:7] = rows
    variance = float(np.trace(of.noise.gyro_cov)) / 3.0
    q = np.zeros(STATES)
    q[:3] = variance * T / RATE
    q[2] += still * params.static_turn_noise**2 * T
    q[V : V + 2] = float(np.trace(of.noise.accel_cov)) / 3.0 * of.noise.gravity**2 * T / RATE
    q[B : B + 3], q[M : M + 9] = params.gyro_bias_walk**2 * T, params.gyro_matrix_walk**2 * T
    q[F : F + 3], q[D:] = params.accel_bias_walk**2 * T, params.motion_bias_walk**2 * T
    P_before = whole @ P_start @ whole.T + np.diag(q)
    of_state = [V, V + 1, B, B + 1, B + 2] if still else [V, V + 1, P, P + 1]
    H = np.eye(STATES)[of_state]
    r = [params.static_speed_std**2] * 2 if still else [params.speed_std**2 / T] * 2
    r += [params.static_bias_std**2 + variance / 25] * 3 if still else [params.position_std**2 / T] * 2
    gain = P_before @ H.T @ np.linalg.inv(H @ P_before @ H.T + np.diag(r))
    np.testing.assert_allclose(filter_.state["P"][0, :, :STATES], P_before - gain @ H @ P_before, atol=1e-12, rtol=1e-7)
    # The correction, from the strapdown's own end: the filter on a copy of which a block is a sample longer has it.
    open_ = Amekf(of.noise, RATE, of.true[at.start - 1], replace(params, block_s=0.26))
    open_.state["x"][0][:] = x_before
    end = open_.run(of.gyro[at], of.accel[at], np.full(25, still)).quat_VS[-1]
    expected = np.array([0.0, 0.0, 0.0, 0.0, 0.0]) if still else np.zeros(4)
    innovation = expected - H @ open_.state["x"][0]
    if still:
        innovation[2:] += of.gyro[at].mean(axis=0)
    d = gain @ innovation
    np.testing.assert_allclose(filter_.state["x"][0][3:] - open_.state["x"][0][3:], d[3:], atol=1e-12)
    turned = (Rotation.from_quat(result.quat_VS[-1]) * Rotation.from_quat(end).inv()).as_rotvec()
    np.testing.assert_allclose(turned, d[:3], atol=1e-12)
    R = Rotation.from_quat(result.quat_VS[-1]).as_matrix()
    np.testing.assert_allclose(cov(result)[-1], R.T @ filter_.state["P"][0, :, :STATES][:3, :3] @ R, atol=1e-15)


def test_wrong_parameters_are_named() -> None:
    for wrong in ({"block_s": 0.0}, {"speed_std": -1.0}, {"gyro_matrix_std": np.nan}):
        with pytest.raises(WeposeError, match=next(iter(wrong))):
            AmekfParams(**wrong)


# Consistency and accuracy on simulated trials ----------------------------------------------------------------------


@pytest.mark.monte_carlo
@pytest.mark.parametrize("kind", [Amekf, Smoother])
def test_the_covariance_is_right(kind: Any) -> None:
    """Over sensors drawn from the stated priors; a NEES of 3 is right."""
    values = [nees(drawn(seed), run(drawn(seed), kind=kind)) for seed in range(24)]
    print(f"{kind.__name__}: NEES {np.mean(values):.2f} of 3, sd of the mean {np.std(values) / 24**0.5:.2f}")
    assert abs(np.mean(values) - 3.0) < 0.9


def test_the_gyroscope_s_scale_is_learned_in_motion() -> None:
    """One per cent on each axis: found to a third of it within the minute; the heading gains by it."""
    scale = np.array([0.01, -0.01, 0.01])
    headings: list[list[float]] = []
    for seed in range(4, 10):
        of = case(seed)
        wrong = of._replace(gyro=of.gyro + (of.gyro - of.noise.gyro_bias) * scale)
        filter_ = Amekf(of.noise, RATE, of.start, AmekfParams(gyro_matrix_std=0.01))
        learned = errors(of, filter_.run(wrong.gyro, wrong.accel, wrong.static).quat_VS)
        fixed = errors(of, run(wrong, AmekfParams(gyro_matrix_std=0.0)).quat_VS)
        np.testing.assert_allclose(filter_.state["x"][0][[M, M + 4, M + 8]], scale, atol=0.0035)
        end = of.moving.nonzero()[0][-1000:]
        headings.append(
            [float(np.abs(np.degrees(rotations.heading(e[end].as_quat()))).mean()) for e in (learned, fixed)]
        )
    learned_deg, fixed_deg = np.mean(headings, axis=0)
    print(f"heading in the last 10 s: scale learned {learned_deg:.2f} deg, not learned {fixed_deg:.2f} deg")
    assert learned_deg < 0.6 * fixed_deg


# Bad data ----------------------------------------------------------------------------------------------------------


def within(of: Case, result: FilterRun, after: int, sigmas: float = 3.0) -> bool:
    """Errors in W from a sample on are within so many of the stated standard deviations."""
    R = Rotation.from_quat(result.quat_VS).as_matrix()
    std = np.sqrt(np.diagonal(R @ cov(result) @ R.transpose(0, 2, 1), axis1=1, axis2=2))
    return bool((np.abs(errors(of, result.quat_VS).as_rotvec()) <= sigmas * std)[after:].all())


@pytest.mark.parametrize("length", [1, 5, 30])
@pytest.mark.parametrize("kind", [Amekf, Smoother])
def test_lost_gyro_samples_grow_the_covariance_and_are_got_over(length: int, kind: Any) -> None:
    of = case(5)
    gyro = of.gyro.copy()
    gyro[2000 : 2000 + length] = np.nan
    clean, lossy = run(of, kind=kind), run(of._replace(gyro=gyro), kind=kind)
    assert all(part is not None and np.isfinite(part).all() for part in lossy)
    assert within(of, lossy, 2000)
    assert np.trace(cov(lossy)[2100]) > np.trace(cov(clean)[2100])
    tilt = tilt_deg(errors(of, lossy.quat_VS))
    assert tilt[-600:].max() < 1.0
    assert tilt[1500:1950].max() < 1.0


def test_a_clipped_gyroscope_is_known_to_be_wrong() -> None:
    of = case(6)
    limit = 0.6 * np.abs(of.gyro).max()
    clipped = of._replace(gyro=np.clip(of.gyro, -limit, limit))
    with_range, without_range = run(clipped, AmekfParams(gyro_range=limit)), run(clipped)
    assert within(of, with_range, 500)
    assert not within(of, without_range, 500)


def test_an_impact_does_not_tip_the_attitude() -> None:
    """150 m/s² for 20 ms, a velocity change of 3 m/s that never was."""
    of = case(7)
    accel = of.accel.copy()
    accel[2500:2502] += [150.0, -100.0, 50.0]
    clean, struck = (tilt_deg(errors(of, run(c).quat_VS)) for c in (of, of._replace(accel=accel)))
    print(f"tilt after the impact: {struck[2500:].max():.2f} deg, without {clean[2500:].max():.2f} deg")
    assert struck[2500:].max() < 1.0


def test_a_bias_that_jumps_is_taken_over_at_the_next_rest() -> None:
    of = case(8)
    jump = np.deg2rad([0.3, -0.2, 0.25])
    gyro = of.gyro.copy()
    gyro[3000:] += jump
    result = run(of._replace(gyro=gyro))
    assert of.static[-100:].all()
    np.testing.assert_allclose(result.gyro_bias[-1] - of.noise.gyro_bias, jump, atol=2e-4)
    assert tilt_deg(errors(of, result.quat_VS))[3000:].max() < 3.0


def test_a_person_who_sways_at_rest_does_not_pass_for_bias() -> None:
    """0.1 deg/s of sway, as a standing person has: at its end the rest knows the bias to a third of that, not less."""
    rng = np.random.default_rng(8)
    time = np.arange(500) / RATE
    bias = np.deg2rad([0.2, -0.1, 0.3])
    sway = np.deg2rad(0.14) * np.sin(2.0 * np.pi * 0.4 * time[:, None] + [0.3, 1.7, 4.0])
    gyro = bias + sway + np.deg2rad(0.05) * rng.normal(size=(500, 3))
    accel = [0.0, 0.0, 9.81] + 0.02 * rng.normal(size=(500, 3))
    noise = estimate_noise(gyro[:400], accel[:400], RATE)
    start = np.array([0.0, 0.0, 0.0, 1.0])
    result = Amekf(noise, RATE, start).run(gyro, accel, np.ones(500, dtype=bool))
    off = np.degrees(np.abs(result.gyro_bias[400:] - bias)).max()
    white = replace(noise, gyro_half_second_cov=None)
    taken_for_bias = Amekf(white, RATE, start).run(gyro, accel, np.ones(500, dtype=bool)).gyro_bias[400:]
    assert off < 0.04 < np.degrees(np.abs(taken_for_bias - bias)).max()


@pytest.mark.parametrize("method", ["amekf", "smoother"])
def test_a_sensor_that_never_rests_converges_and_says_so(method: str) -> None:
    """From within the motion, no static phase, a bias of 0.4 deg/s: starts from its own accelerometer, degrees off."""
    tilts = []
    for seed in range(6):
        of = case(seed)
        gyro, accel = of.gyro[1000:5400] + np.deg2rad([0.4, -0.3, 0.2]), of.accel[1000:5400]
        with pytest.warns(WeposeWarning, match="There is no static phase"):
            orientation = estimate_orientation(gyro, accel, RATE, method=method, static=None)
        assert [each.code for each in orientation.diagnostics] == ["static-phase-missing"]
        error = Rotation.from_quat(orientation.quat_VS) * Rotation.from_quat(of.true[1000:5400]).inv()
        tilts.append(tilt_deg(error))
        assert not orientation.static.any()
    by = np.mean(tilts, axis=0)
    print(f"{method}: tilt at the start {by[0]:.1f}, after 10 s {by[1000]:.2f}, at the end {by[-500:].mean():.2f} deg")
    assert by[0] > 3.0 or method == "smoother"
    assert by[1500:].max() < 1.5
    assert by[-500:].mean() < 0.6


def test_hours_leave_the_covariance_a_covariance() -> None:
    """Half a million samples of trials in a row, motion and rest."""
    of = case(10)
    filter_ = Amekf(of.noise, RATE, of.start)
    for _ in range(85):
        filter_.run(of.gyro, of.accel, of.static)
    P = filter_.state["P"][0, :, :STATES]
    np.testing.assert_array_equal(P, P.T)
    scale = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale))[0] > -1e-9
    assert np.abs(filter_.state["x"][0]).max() < 10.0
    assert abs(np.linalg.norm(filter_.state["quat_VS"][0]) - 1.0) < 1e-14


# Real recordings ---------------------------------------------------------------------------------------------------

# VQF 2.1.2 with its defaults on these trials, scored alike (`vqf.VQF(dt).updateBatch`, `vqf.offlineVQF`).
VQF, OFFLINE_VQF = (0.705, 4.06, 4.17), (0.524, 4.04, 4.11)


def test_broad_against_vqf(data: Path) -> None:
    """Parameters were chosen on simulated trials and on every other trial, the first, third, … by name."""
    paths = sorted((data / "broad").glob("*.mat"))
    if not paths:
        pytest.skip(f"no real recordings at {data / 'broad'}")
    table: dict[str, list[tuple[float, ...]]] = {"amekf": [], "smoother": []}
    for path in paths:
        trial = read_broad(path)
        noise = estimate_noise(trial.gyro_S[trial.static], trial.accel_S[trial.static], trial.rate_hz)
        seen = np.isfinite(trial.quat_true).all(axis=1)
        rest = np.flatnonzero(seen[trial.static]) + trial.static.start
        scored = np.flatnonzero(trial.scored)[::3]
        true = Rotation.from_quat(np.where(seen[:, None], trial.quat_true, [0, 0, 0, 1]))
        for method in table:
            out = run_filter(trial.gyro_S, trial.accel_S, trial.rate_hz, noise, method)
            R_VS = Rotation.from_quat(out.quat_VS)
            psi = float(rotations.heading((true[rest] * R_VS[rest].inv()).mean().as_quat()))
            error = (Rotation.from_rotvec([0, 0, psi]) * R_VS[scored]) * true[scored].inv()
            of = attitude_error(error * true[scored], true[scored], scored / trial.rate_hz)
            table[method].append((of.inclination_rmse, of.heading_rmse, of.total_rmse))
    print(f"\n{len(paths)} trials, RMSE [deg]   inclination heading total | not chosen on")
    print(f"VQF 2.1.2 {VQF}\noffline VQF 2.1.2 {OFFLINE_VQF}")
    for method, rows in table.items():
        everywhere, held = (np.round(np.mean(values, axis=0), 2) for values in (rows, rows[1::2]))
        print(f"{method:9s} {everywhere} | {held}")
    for method, peer in (("amekf", VQF), ("smoother", OFFLINE_VQF)):
        inclination, _, total = np.mean(table[method], axis=0)
        assert inclination <= peer[0]
        assert total <= 0.9 * peer[2]
        assert np.mean(table[method][1::2], axis=0)[2] <= peer[2]
