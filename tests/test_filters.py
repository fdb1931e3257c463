"""Orientation filters: against plain transcriptions of their papers, against physics, against themselves cut in two."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.trials import read_authors_trial
from benchmarks.validation.single import simulate_paper_dynamic
from wepose_pin.errors import WeposeError
from wepose_pin.filters import (
    METHODS,
    OFFLINE,
    AmekfParams,
    Gdc,
    GdcParams,
    Ncf,
    SensorFilters,
    Smekf,
    SmekfParams,
    estimate_orientation,
    run_filter,
)
from wepose_pin.filters.noise import SensorNoise, estimate_noise
from wepose_pin.recording import ImuSensor, Recording
from wepose_pin.rotations import quat_from_gravity

RATE = 100.0
GRAVITY = 9.81


def cross_matrix(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def quat_product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product of xyzw quaternions, by its definition on scalar and vector part."""
    vector = p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])
    return np.append(vector, p[3] * q[3] - p[:3] @ q[:3])


def quat_exp(v: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(v)
    return np.append(np.sinc(angle / 2 / np.pi) * v / 2, np.cos(angle / 2))


def matrix(quat: np.ndarray) -> np.ndarray:
    w = quat[3]
    return np.eye(3) + 2 * w * cross_matrix(quat[:3]) + 2 * cross_matrix(quat[:3]) @ cross_matrix(quat[:3])


def smekf_by_the_book(
    noise: SensorNoise, quat: np.ndarray, gyro: np.ndarray, accel: np.ndarray, static: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Algorithm 1 as the paper writes it, with full matrices."""
    q, b, P = quat.copy(), noise.gyro_bias.copy(), 1e-3 * np.eye(6)
    Q = np.block([[noise.gyro_cov, np.zeros((3, 3))], [np.zeros((3, 3)), noise.bias_step_cov]])
    R = np.block([[noise.accel_cov, np.zeros((3, 3))], [np.zeros((3, 3)), noise.gyro_cov]])
    G = dt * np.diag([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    quats, biases, covs = [], [], []
    for k in range(len(gyro)):
        omega = gyro[k] - b
        q = quat_product(q, quat_exp(omega * dt))
        F = np.eye(6) + dt * np.block([[-cross_matrix(omega), -np.eye(3)], [np.zeros((3, 6))]])
        P = F @ P @ F.T + G @ Q @ G.T
        if static[k]:
            up = matrix(q).T @ [0, 0, 1]
            H = np.block([[cross_matrix(up), np.zeros((3, 3))], [np.zeros((3, 3)), np.eye(3)]])
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            innovation = np.concatenate([accel[k] / noise.gravity - up, gyro[k] - b])
            x = np.concatenate([np.zeros(3), b]) + K @ innovation
            P = (np.eye(6) - K @ H) @ P
            q, b = quat_product(q, quat_exp(x[:3])), x[3:]
        quats.append(q)
        biases.append(b)
        covs.append(P[:3, :3])
    return np.array(quats), np.array(biases), np.array(covs)


def measured(
    rng: np.random.Generator, seconds: float, *, bias: Any = (0.0, 0.0, 0.0), tilt: float = 1.2
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gyro, accel, true quaternions, and where it truly rests: 2 s of rest at the start and in every 10 s.

    The heading swings by 1.5 rad, roll and pitch by `tilt` [rad]; the noise is an MTi-3's.
    """
    n = round(seconds * RATE)
    time = np.arange(n + 1) / RATE
    # The speed of the motion is zero in the rests and rises and falls smoothly in between.
    within = time % 10.0
    speed = np.sin(0.5 * np.pi * np.clip(np.minimum(within - 2.0, 10.0 - within), 0.0, 1.0)) ** 2
    progress = np.cumsum(speed) / RATE
    swing = [np.sin(2 * np.pi * f * progress + p) for f, p in rng.uniform([0.2, 0], [0.5, 6.3], size=(3, 2))]
    rotation = Rotation.from_euler("ZYX", np.column_stack([1.5 * swing[0], tilt * swing[1], tilt * swing[2]]))
    true = rotation[1:]
    linear_W = 2.0 * speed[1:, None] * np.column_stack(swing[::-1])[1:]  # any smooth thing that rests with it
    gyro = (rotation[:-1].inv() * true).as_rotvec() * RATE + np.asarray(bias)
    gyro += rng.normal(scale=np.deg2rad(0.007) * np.sqrt(RATE), size=(n, 3))
    accel = true.inv().apply(linear_W + [0, 0, GRAVITY])
    accel += rng.normal(scale=120e-6 * 9.81 * np.sqrt(RATE), size=(n, 3))
    return gyro, accel, true.as_quat(), speed[1:] == 0.0


def heading_error_deg(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    error = (Rotation.from_quat(estimated) * Rotation.from_quat(true).inv()).as_euler("ZYX", degrees=True)[:, 0]
    return np.unwrap(error, period=360.0)


# sMEKF -------------------------------------------------------------------------------------------------------------


def test_smekf_published_is_algorithm_1_with_the_papers_static_test() -> None:
    """A slow steady turn from 12 s on passes the paper's four conditions; smekf itself takes it for motion."""
    rng = np.random.default_rng(2)
    gyro, accel, _, _ = measured(rng, 12.0, bias=(0.01, -0.02, 0.005))
    turn = np.deg2rad(4.0)
    gyro = np.concatenate([gyro, gyro[:180] + [0.0, 0.0, turn], gyro[:180] + [0.0, 0.0, turn]])
    accel = np.concatenate([accel, accel[:180], accel[:180]])
    out = estimate_orientation(gyro, accel, RATE, method="smekf_published", static=(0.0, 1.79))
    assert out.static[1300:].all()
    assert not estimate_orientation(gyro, accel, RATE, method="smekf", static=(0.0, 1.79)).static[1300:].any()
    noise = estimate_noise(gyro[:180], accel[:180], RATE)
    before = (Rotation.from_quat(out.quat_VS[0]) * Rotation.from_rotvec((gyro[0] - noise.gyro_bias) / -RATE)).as_quat()
    quat, bias, cov = smekf_by_the_book(noise, before, gyro, accel, out.static, 1 / RATE)
    assert (Rotation.from_quat(out.quat_VS).inv() * Rotation.from_quat(quat)).magnitude().max() < 1e-9
    np.testing.assert_allclose(out.gyro_bias, bias, atol=1e-9)
    np.testing.assert_allclose(out.attitude_cov, cov, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("omega", [(0.0, 0.0, 0.0), (1.0, -2.0, 0.5), (0.0, 0.0, 13.9), (8.0, -9.0, 7.6)])
def test_the_prediction_of_the_covariance_is_that_of_the_attitude(omega: tuple[float, float, float]) -> None:
    """Over a second, F by finite differences; without noise P becomes F P Fᵀ, to what a sample adds to it."""
    eps, rate_hz, n = 1e-5, 1000.0, 1000
    quat, bias = Rotation.from_rotvec([0.2, 0.1, -0.7]), np.array([0.01, 0.02, -0.03])

    def predict(error: np.ndarray) -> Rotation:
        """Of [a; b], a on the left."""
        turn = Rotation.from_rotvec((np.array(omega) - error[3:]) / rate_hz)
        return Rotation.from_rotvec(error[:3]) * quat * Rotation.from_rotvec(n * turn.as_rotvec())

    F = np.eye(6)
    F[:3] = np.column_stack([(predict(eps * e) * predict(-eps * e).inv()).as_rotvec() / (2 * eps) for e in np.eye(6)])
    zero = np.zeros((3, 3))
    noise = SensorNoise(bias, np.diag([1e-5, 2e-5, 3e-5]), zero, zero, zero, GRAVITY)
    filter_ = Smekf(noise, rate_hz, quat.as_quat(), SmekfParams(tilt_std=0.03, gyro_scale_std=0.0))
    P0 = np.diag([0.03**2, 0.03**2, 1e-10, 1e-5, 2e-5, 3e-5])
    run = filter_.run(np.tile(np.array(omega) + bias, (n, 1)), np.zeros((n, 3)), np.zeros(n, dtype=bool))
    assert run.attitude_cov is not None
    R = Rotation.from_quat(run.quat_VS[-1]).as_matrix()
    expected = F @ P0 @ F.T
    np.testing.assert_allclose(R @ run.attitude_cov[-1] @ R.T, expected[:3, :3], rtol=1e-3, atol=3e-8)
    np.testing.assert_allclose(filter_.state["P_ab"].reshape(3, 3), expected[:3, 3:], rtol=1e-3, atol=3e-8)


def test_the_exact_covariance_keeps_the_heading_through_wild_motion() -> None:
    """The paper's first order lets rests correct the heading, which nothing measures: jumps of degrees at 100 Hz."""
    worst: dict[str, list[float]] = {"smekf": [], "smekf_published": []}
    for seed in range(8):
        gyro, accel, true, _ = measured(np.random.default_rng(seed), 120.0, tilt=1.2)
        noise = estimate_noise(gyro[:180], accel[:180], RATE)
        for method, errors in worst.items():
            out = run_filter(gyro, accel, RATE, noise, method)
            error = heading_error_deg(out.quat_VS, true)
            errors.append(float(np.abs(error - error[100]).max()))
    mean = {method: float(np.mean(errors)) for method, errors in worst.items()}
    print(f"largest heading error [deg], mean of 8: {mean}")
    assert mean["smekf"] < 0.7
    assert mean["smekf"] < 0.6 * mean["smekf_published"]


def test_the_heading_of_a_sensor_that_turns_round_and_round_is_as_uncertain_as_its_scale() -> None:
    """0.5 % of scale on an office chair: 140 deg/s for 40 s are 28 deg, which no static phase shows."""
    rate, n = np.deg2rad(140.0), 4000
    still = np.random.default_rng(4).normal(scale=1e-3, size=(500, 3))
    gyro = np.concatenate([still, np.tile([0.0, 0.0, 1.005 * rate], (n, 1))])
    accel = np.tile([0.0, 0.0, GRAVITY], (len(gyro), 1)) + np.random.default_rng(5).normal(
        scale=0.01, size=(500 + n, 3)
    )
    out = run_filter(gyro, accel, RATE, estimate_noise(gyro[:500], accel[:500], RATE), "smekf")
    assert out.attitude_cov is not None
    turned = Rotation.from_quat(out.quat_VS[-1]).as_rotvec()[2] - rate * n / RATE
    off = float(np.angle(np.exp(1j * turned)))
    assert abs(np.degrees(off)) == pytest.approx(28.0, abs=1.5)
    assert abs(off) < 3.0 * np.sqrt(out.attitude_cov[-1, 2, 2])


# The other two -----------------------------------------------------------------------------------------------------


def test_ncf_is_mahonys_equations() -> None:
    gyro, accel, _, rest = measured(np.random.default_rng(1), 10.0, bias=(0.02, 0.0, -0.01))
    noise = estimate_noise(gyro[:180], accel[:180], RATE)
    start = Rotation.from_rotvec([0.3, -0.5, 0.1]).as_quat()
    filter_ = Ncf(noise, RATE, start)
    run = filter_.run(gyro, accel, rest)
    q, b = start.copy(), noise.gyro_bias.copy()
    for k in range(len(gyro)):
        e = np.cross(accel[k] / np.linalg.norm(accel[k]), matrix(q).T @ [0, 0, 1])
        q = quat_product(q, quat_exp((gyro[k] - b + filter_.params.proportional * e) / RATE))
        b = b - filter_.params.integral * e / RATE
    np.testing.assert_allclose(run.quat_VS[-1] * np.sign(run.quat_VS[-1] @ q), q, atol=1e-11)
    np.testing.assert_allclose(run.gyro_bias[-1], b, atol=1e-13)


@pytest.mark.parametrize("method", ["amekf", "smekf", "ncf", "gdc"])
def test_how_the_sensors_axes_lie_changes_nothing(method: str) -> None:
    gyro, accel, _, _ = measured(np.random.default_rng(4), 30.0, bias=(0.02, 0.0, -0.01))
    turn = Rotation.from_rotvec([1.0, -2.0, 0.5])
    runs = []
    for R in (Rotation.identity(), turn):
        own_gyro, own_accel = R.apply(gyro), R.apply(accel)
        noise = estimate_noise(own_gyro[:180], own_accel[:180], RATE)
        quat = run_filter(own_gyro, own_accel, RATE, noise, method, start=slice(0, 180)).quat_VS
        R_VS = Rotation.from_quat(quat) * R
        runs.append(R_VS[0].inv() * R_VS)  # each world has a heading of its own
    # amekf doubts each axis of a measurement by itself (three standard deviations), the others none
    bound = 0.5 if method in ("amekf", "smoother") else 1e-4
    assert np.degrees((runs[0].inv() * runs[1]).magnitude()).max() < bound


def tilt_error_deg(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    up = (Rotation.from_quat(estimated) * Rotation.from_quat(true).inv()).apply([0.0, 0.0, 1.0])
    return np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0)))


@pytest.mark.parametrize("method", METHODS)
def test_a_recording_may_begin_in_motion(method: str) -> None:
    """The start phase is the rest after 47 s of free motion by hand; what lies before is filtered backward from it."""
    worst: list[float] = []
    for seed in range(3):
        trial = simulate_paper_dynamic(seed)
        gyro, accel, true = trial.gyro_S[800:], trial.accel_S[800:], trial.quat_WS[800:]
        orientation = estimate_orientation(gyro, accel, RATE, method=method, static=(47.6, 51.6))
        tilt_deg = tilt_error_deg(orientation.quat_VS, true)
        assert tilt_deg[4760:].max() < 0.5
        assert len(orientation.static) == len(gyro)
        assert orientation.static[4900:].mean() > 0.8
        worst.append(float(tilt_deg.max()))
    print(f"{method}: tilt within {np.round(worst, 2)} deg")
    if orientation.attitude_cov is not None:  # what the others keep depends on their gains
        assert max(worst) < 1.0


@pytest.mark.parametrize("method", ["amekf", "smoother", "smekf"])
def test_the_rate_changes_little(method: str) -> None:
    """The same motion and noise density at 100 and 200 Hz: orientations within 2 deg in a minute, ± within a tenth."""
    std, quats = [], []
    for rate in (100.0, 200.0):
        n = round(60.0 * rate)
        time = np.arange(n + 1) / rate
        amount = np.clip((time - 5.0) / 1.5, 0.0, 1.0) * np.clip((55.0 - time) / 1.5, 0.0, 1.0)
        angles = np.column_stack([0.8 * amount * np.sin(2 * np.pi * f * time) for f in (0.31, 0.77, 1.13)])
        R = Rotation.from_euler("ZYX", angles)
        rng = np.random.default_rng(0)
        gyro = (R[:-1].inv() * R[1:]).as_rotvec() * rate + rng.normal(scale=1e-4 * np.sqrt(rate), size=(n, 3))
        accel = R[1:].inv().apply([0.0, 0.0, GRAVITY]) + rng.normal(scale=1e-3 * np.sqrt(rate), size=(n, 3))
        k = round(4.5 * rate)
        noise = estimate_noise(gyro[:k], accel[:k], rate)
        orientation = run_filter(gyro, accel, rate, noise, method, start=slice(0, k))
        assert orientation.attitude_cov is not None
        std.append(np.sqrt(np.trace(orientation.attitude_cov[round(50.0 * rate)])))
        every = round(rate / 100.0)
        quats.append(Rotation.from_quat(orientation.quat_VS[every - 1 :: every]))
    assert np.degrees((quats[0].inv() * quats[1]).magnitude()).max() < 2.0
    assert abs(std[1] / std[0] - 1.0) < 0.1


def test_gdc_is_madgwicks_equations() -> None:
    """f and its Jacobian in the paper's order q1 … q4 = w x y z, eq. (25), (26), (33)."""
    gyro, accel, _, rest = measured(np.random.default_rng(2), 10.0, bias=(0.02, 0.0, -0.01))
    noise = estimate_noise(gyro[:180], accel[:180], RATE)
    start = Rotation.from_rotvec([0.3, -0.5, 0.1]).as_quat()
    run = Gdc(noise, RATE, start, GdcParams(0.1)).run(gyro, accel, rest)
    q = np.roll(start, 1)
    for k in range(len(gyro)):
        q1, q2, q3, q4 = q
        a = accel[k] / np.linalg.norm(accel[k])
        f = np.array([2 * (q2 * q4 - q1 * q3), 2 * (q1 * q2 + q3 * q4), 2 * (0.5 - q2**2 - q3**2)]) - a
        J = np.array([[-2 * q3, 2 * q4, -2 * q1, 2 * q2], [2 * q2, 2 * q1, 2 * q4, 2 * q3], [0, -4 * q2, -4 * q3, 0]])
        step = J.T @ f
        step -= (step @ q) * q  # what is along q turns nothing
        rate = np.roll(quat_product(np.roll(q, -1), np.append(gyro[k] - noise.gyro_bias, 0.0)), 1) / 2
        q = q + (rate - 0.1 * step / np.linalg.norm(step)) / RATE
        q /= np.linalg.norm(q)
    estimate = np.roll(run.quat_VS[-1], 1)
    np.testing.assert_allclose(estimate * np.sign(estimate @ q), q, atol=1e-11)


# All ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [name for name in METHODS if name not in OFFLINE])
def test_any_cut_and_one_by_one_give_the_same_bits_with_bad_samples_too(method: str) -> None:
    gyro, accel, _, rest = measured(np.random.default_rng(3), 10.0, bias=(0.02, 0.0, -0.01))
    noise = estimate_noise(gyro[:180], accel[:180], RATE)
    gyro[[3, 310, 311, 312], 0] = np.nan
    accel[[7, 500], 2] = np.inf
    params = {"amekf": AmekfParams(gyro_range=3.0), "smekf": SmekfParams(gyro_range=3.0)}.get(method)
    start = Rotation.from_rotvec([0.3, -0.5, 0.1]).as_quat()
    whole = METHODS[method](noise, RATE, start, params).run(gyro, accel, rest)
    for edges in ([0, 1, 24, 25, 26, 311, 700, 1000], range(1001)):
        filter_ = METHODS[method](noise, RATE, start, params)
        parts = [filter_.run(gyro[a:b], accel[a:b], rest[a:b]) for a, b in pairwise(edges)]
        for k, name in enumerate(whole._fields):
            if whole[k] is not None:
                assert np.isfinite(whole[k]).all()
                np.testing.assert_array_equal(np.concatenate([part[k] for part in parts]), whole[k], err_msg=name)


def test_wrong_input_is_named() -> None:
    gyro = np.zeros((100, 3))
    with pytest.raises(WeposeError, match="did you mean 'smekf'"):
        estimate_orientation(gyro, gyro, RATE, method="smekv", static=(0, 0.5))
    with pytest.raises(WeposeError, match=r"must both be \(n, 3\)"):
        estimate_orientation(gyro, gyro[:50], RATE, static=(0, 0.5))
    noise = estimate_noise(*measured(np.random.default_rng(0), 2.0)[:2], RATE)
    for params, name in ((SmekfParams, "tilt_std"), (AmekfParams, "gyro_range"), (GdcParams, "gain")):
        with pytest.raises(WeposeError, match=f"{name} = -1.0: a (finite )?number"):
            params(**{name: -1.0})
    with pytest.raises(WeposeError, match="as many"):
        Smekf(noise, RATE, np.array([0.0, 0.0, 0.0, 1.0])).run(np.zeros((5, 3)), np.zeros((5, 3)), True)
    with pytest.raises(WeposeError, match="finite"):
        estimate_orientation(gyro * np.nan, gyro, RATE, static=(0, 0.5))
    with pytest.raises(WeposeError, match=r"which lasts 1\.000 s"):
        estimate_orientation(gyro, gyro, RATE, static=(0, 5))
    with pytest.raises(WeposeError, match="no gravity"):
        estimate_orientation(gyro, gyro, RATE, static=(0, 0.9))


# Live, in threads, and with samples missing ---------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["amekf", "smekf", "ncf"])
def test_steps_of_many_sensors_give_the_bits_of_chunks(method: str) -> None:
    drawn = [measured(np.random.default_rng(seed), 20.0, bias=(0.01, -0.02, 0.005)) for seed in range(5)]
    gyro, accel = (np.stack([sensor[i] for sensor in drawn], axis=1) for i in range(2))
    gap = np.zeros((len(gyro), 5), dtype=bool)
    gap[700:703, 2] = gap[1400, 4] = True  # one sensor's samples do not come
    recording = Recording(
        "many",
        np.arange(len(gyro)) / RATE,
        RATE,
        {f"sensor_{i}": ImuSensor(gyro[:, i], accel[:, i], gap=gap[:, i]) for i in range(5)},
    )
    noises = {name: estimate_noise(s.gyro_S[:180], s.accel_S[:180], RATE) for name, s in recording.imus.items()}
    whole = SensorFilters(noises, method=method, start=slice(0, 180)).push(recording)
    alone = list(whole.values())
    assert 0.1 < np.mean([orientation.static for orientation in alone]) < 0.9
    gyro[gap], accel[gap] = np.nan, np.nan
    filters = SensorFilters(noises, method=method, start=slice(0, 180))
    filters.push(recording.cut(slice(0, 200)))
    for k in range(200, 1000):
        quat = filters.step(gyro[k], accel[k])
        np.testing.assert_array_equal(quat, [orientation.quat_VS[k] for orientation in alone])
        np.testing.assert_array_equal(filters.static, [orientation.static[k] for orientation in alone])
    rest = filters.push(recording.cut(slice(1000, 1800)))  # chunks and samples in turn
    for name, orientation in whole.items():
        np.testing.assert_array_equal(rest[name].quat_VS, orientation.quat_VS[1000:1800])
    for k in range(1800, len(gyro)):
        quat = filters.step(gyro[k], accel[k])
    assert quat is filters.quat_VS
    np.testing.assert_array_equal(quat, [orientation.quat_VS[-1] for orientation in alone])
    np.testing.assert_array_equal(filters.gyro_bias, [orientation.gyro_bias[-1] for orientation in alone])
    if filters.attitude_cov is not None:
        np.testing.assert_array_equal(filters.attitude_cov, [orientation.attitude_cov[-1] for orientation in alone])


@pytest.mark.parametrize("method", ["smekf", "ncf", "gdc"])
@pytest.mark.parametrize("wrong", [np.nan, -1e300])
def test_a_sample_that_is_no_number_does_not_stay(method: str, wrong: float) -> None:
    """One in motion, three at rest, one at the very start."""
    gyro, accel, _, rest = measured(np.random.default_rng(9), 20.0)
    noise = estimate_noise(gyro[:180], accel[:180], RATE)
    start = quat_from_gravity(accel[:50].mean(axis=0))
    clean = METHODS[method](noise, RATE, start).run(gyro, accel, rest)
    gyro[[0, 500, 1050, 1051, 1052], [0, 1, 2, 0, 1]] = wrong
    accel[[0, 500, 1100, 1200, 1201], [0, 1, 2, 0, 1]] = wrong
    run = METHODS[method](noise, RATE, start).run(gyro, accel, rest & np.isfinite(accel).all(axis=1))
    assert all(np.isfinite(part).all() for part in run if part is not None)
    turned = np.degrees((Rotation.from_quat(run.quat_VS).inv() * Rotation.from_quat(clean.quat_VS)).magnitude())
    assert turned[:500].max() < 0.3
    assert turned.max() < 3.0


@pytest.mark.parametrize("gap", [1, 10, 200])
def test_what_is_unseen_is_in_the_covariance(gap: int) -> None:
    """The same motion with a gap in it: the error it makes is within the covariance it adds, and not far within."""
    normalised, growth = [], []
    for seed in range(40):
        gyro, accel, _, rest = measured(np.random.default_rng(100 + seed), 10.0)
        noise = estimate_noise(gyro[:180], accel[:180], RATE)
        params = SmekfParams(tilt_std=1e-4)
        clean = Smekf(noise, RATE, quat_from_gravity(accel[:50].mean(axis=0)), params).run(gyro, accel, rest)
        first = 350 + 5 * seed
        gyro[first : first + gap] = np.nan
        run = Smekf(noise, RATE, quat_from_gravity(accel[:50].mean(axis=0)), params).run(gyro, accel, rest)
        last = first + gap - 1
        error = (Rotation.from_quat(run.quat_VS[last]).inv() * Rotation.from_quat(clean.quat_VS[last])).as_rotvec()
        assert run.attitude_cov is not None
        normalised.append(error @ np.linalg.solve(run.attitude_cov[last], error))
        growth.append(np.sqrt(run.attitude_cov[last, 0, 0]))
    print(f"{gap} missing: normalised error {np.mean(normalised):.2f} (3 is right), std {np.mean(growth):.4f} rad")
    assert 0.03 < np.mean(normalised) < 3.5


# A real recording --------------------------------------------------------------------------------------------------


def test_the_authors_own_trial_against_vicon(data: Any) -> None:
    """1 kHz, aligned on the world side at the first Vicon sample: VQF 2.1.2 gets 1.94 deg mean angle."""
    trial = read_authors_trial(data / "wepose_hr" / "prova_HR.txt")
    true = Rotation.from_quat(trial.quat_true[trial.scored])
    for method, limit in (("smekf", 2.2), ("ncf", 2.5), ("gdc", 2.5)):
        out = estimate_orientation(trial.gyro_S, trial.accel_S, trial.rate_hz, method=method, static=(0.05, 0.9))
        R_VS = Rotation.from_quat(out.quat_VS[trial.scored])
        aligned = (true[0] * R_VS[0].inv()) * R_VS
        angle = np.degrees((true.inv() * aligned).magnitude())
        print(f"{method}: mean angle {angle.mean():.3f} deg, largest {angle.max():.2f} deg")
        assert angle.mean() < limit
