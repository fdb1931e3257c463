"""Orientation filters: against plain transcriptions of their papers, against physics, on a real sensor."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.trials import read_authors_trial
from benchmarks.validation.single import simulate_paper_dynamic
from wepose_pin import WeposeError, estimate_orientation

METHODS = ("amekf", "smoother", "smekf", "smekf_published", "ncf", "gdc")
START = (0.0, 1.79)  # [s] of rest, as in `measured`
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
    noise: Any, quat: np.ndarray, gyro: np.ndarray, accel: np.ndarray, static: np.ndarray, dt: float
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


# sMEKF -------------------------------------------------------------------------------------------------------------


def test_smekf_published_is_algorithm_1_with_the_papers_static_test() -> None:
    """A slow steady turn from 12 s on passes the paper's four conditions; smekf itself takes it for motion."""
    rng = np.random.default_rng(2)
    gyro, accel, _, _ = measured(rng, 12.0, bias=(0.01, -0.02, 0.005))
    turn = np.deg2rad(4.0)
    gyro = np.concatenate([gyro, gyro[:180] + [0.0, 0.0, turn], gyro[:180] + [0.0, 0.0, turn]])
    accel = np.concatenate([accel, accel[:180], accel[:180]])
    out = estimate_orientation(gyro, accel, RATE, method="smekf_published", static=START)
    assert out.static[1300:].all()
    assert not estimate_orientation(gyro, accel, RATE, method="smekf", static=START).static[1300:].any()
    rest = gyro[:180], accel[:180] / out.noise.gravity
    np.testing.assert_allclose(out.noise.gyro_bias, rest[0].mean(axis=0))
    for cov, samples in ((out.noise.gyro_cov, rest[0]), (out.noise.accel_cov, rest[1])):
        np.testing.assert_allclose(cov, np.cov(samples.T), atol=1e-9)
    np.testing.assert_allclose(out.noise.bias_step_cov, np.cov(np.diff(rest[0], axis=0).T), atol=1e-9)
    turned = Rotation.from_rotvec((gyro[0] - out.noise.gyro_bias) / -RATE)
    before = (Rotation.from_quat(out.quat_VS[0]) * turned).as_quat()
    quat, bias, cov = smekf_by_the_book(out.noise, before, gyro, accel, out.static, 1 / RATE)
    assert (Rotation.from_quat(out.quat_VS).inv() * Rotation.from_quat(quat)).magnitude().max() < 1e-9
    np.testing.assert_allclose(out.gyro_bias, bias, atol=1e-9)
    np.testing.assert_allclose(out.attitude_cov, cov, rtol=1e-6, atol=1e-12)


def test_the_exact_covariance_keeps_the_heading_through_wild_motion() -> None:
    """The paper's first order lets rests correct the heading, which nothing measures: jumps of degrees at 100 Hz."""
    worst: dict[str, list[float]] = {"smekf": [], "smekf_published": []}
    for seed in range(8):
        gyro, accel, true, _ = measured(np.random.default_rng(seed), 120.0, tilt=1.2)
        for method, errors in worst.items():
            out = estimate_orientation(gyro, accel, RATE, method=method, static=START)
            off = Rotation.from_quat(out.quat_VS) * Rotation.from_quat(true).inv()
            error = np.unwrap(off.as_euler("ZYX", degrees=True)[:, 0], period=360.0)
            errors.append(float(np.abs(error - error[100]).max()))
    mean = {method: float(np.mean(errors)) for method, errors in worst.items()}
    assert mean["smekf"] < 0.7
    assert mean["smekf"] < 0.6 * mean["smekf_published"]


def test_the_heading_of_a_sensor_that_turns_round_and_round_is_as_uncertain_as_its_scale() -> None:
    """0.5 % of scale on an office chair: 140 deg/s for 40 s are 28 deg, which no static phase shows."""
    rate, n = np.deg2rad(140.0), 4000
    turning = np.arange(500 + n) >= 500
    gyro, accel = (np.random.default_rng(4).normal(scale=s, size=(500 + n, 3)) for s in (1e-3, 0.01))
    gyro += 1.005 * rate * turning[:, None] * [0.0, 0.0, 1.0]
    accel += [0.0, 0.0, GRAVITY]
    out = estimate_orientation(gyro, accel, RATE, method="smekf", static=(0.0, 4.99))
    assert out.attitude_cov is not None
    turned = Rotation.from_quat(out.quat_VS[-1]).as_rotvec()[2] - rate * n / RATE
    off = float(np.angle(np.exp(1j * turned)))
    assert abs(np.degrees(off)) == pytest.approx(28.0, abs=1.5)
    assert abs(off) < 3.0 * np.sqrt(out.attitude_cov[-1, 2, 2])


# The other two -----------------------------------------------------------------------------------------------------


def test_ncf_is_mahonys_equations() -> None:
    """With the gains of the Mahony baseline of Laidig and Seel 2023."""
    gyro, accel, _, _ = measured(np.random.default_rng(1), 10.0, bias=(0.02, 0.0, -0.01))
    out = estimate_orientation(gyro, accel, RATE, method="ncf", static=START)
    q, b = out.quat_VS[0], out.gyro_bias[0]
    for k in range(1, len(gyro)):
        e = np.cross(accel[k] / np.linalg.norm(accel[k]), matrix(q).T @ [0, 0, 1])
        q = quat_product(q, quat_exp((gyro[k] - b + 0.74 * e) / RATE))
        b = b - 0.0012 * e / RATE
    np.testing.assert_allclose(out.quat_VS[-1] * np.sign(out.quat_VS[-1] @ q), q, atol=1e-9)
    np.testing.assert_allclose(out.gyro_bias[-1], b, atol=1e-9)


@pytest.mark.parametrize("method", ["amekf", "smekf", "ncf", "gdc"])
def test_how_the_sensors_axes_lie_changes_nothing(method: str) -> None:
    gyro, accel, _, _ = measured(np.random.default_rng(4), 30.0, bias=(0.02, 0.0, -0.01))
    turn = Rotation.from_rotvec([1.0, -2.0, 0.5])
    runs = []
    for R in (Rotation.identity(), turn):
        own_gyro, own_accel = R.apply(gyro), R.apply(accel)
        quat = estimate_orientation(own_gyro, own_accel, RATE, method=method, static=START).quat_VS
        R_VS = Rotation.from_quat(quat) * R
        runs.append(R_VS[0].inv() * R_VS)  # each world has a heading of its own
    # amekf doubts each axis of a measurement by itself (three standard deviations), the others none
    bound = 0.5 if method in ("amekf", "smoother") else 1e-4
    assert np.degrees((runs[0].inv() * runs[1]).magnitude()).max() < bound


@pytest.mark.parametrize("method", METHODS)
def test_a_recording_may_begin_in_motion(method: str) -> None:
    """The start phase is the rest after 47 s of free motion by hand; what lies before is filtered backward from it."""
    worst: list[float] = []
    for seed in range(3):
        trial = simulate_paper_dynamic(seed)
        gyro, accel, true = trial.gyro_S[800:], trial.accel_S[800:], trial.quat_WS[800:]
        orientation = estimate_orientation(gyro, accel, RATE, method=method, static=(47.6, 51.6))
        off = Rotation.from_quat(orientation.quat_VS) * Rotation.from_quat(true).inv()
        tilt_deg = np.degrees(np.arccos(np.clip(off.apply([0.0, 0.0, 1.0])[:, 2], -1.0, 1.0)))
        assert tilt_deg[4760:].max() < 0.5
        assert len(orientation.static) == len(gyro)
        assert orientation.static[4900:].mean() > 0.8
        worst.append(float(tilt_deg.max()))
    if orientation.attitude_cov is not None:  # what the others keep depends on their gains
        assert max(worst) < 1.0


def test_gdc_is_madgwicks_equations() -> None:
    """f and its Jacobian in the paper's order q1 … q4 = w x y z, eq. (25), (26), (33), with its gain for an IMU."""
    gyro, accel, _, _ = measured(np.random.default_rng(2), 10.0, bias=(0.02, 0.0, -0.01))
    out = estimate_orientation(gyro, accel, RATE, method="gdc", static=START)
    q = np.roll(out.quat_VS[0], 1)
    for k in range(1, len(gyro)):
        q1, q2, q3, q4 = q
        a = accel[k] / np.linalg.norm(accel[k])
        f = np.array([2 * (q2 * q4 - q1 * q3), 2 * (q1 * q2 + q3 * q4), 2 * (0.5 - q2**2 - q3**2)]) - a
        J = np.array([[-2 * q3, 2 * q4, -2 * q1, 2 * q2], [2 * q2, 2 * q1, 2 * q4, 2 * q3], [0, -4 * q2, -4 * q3, 0]])
        step = J.T @ f
        step -= (step @ q) * q  # what is along q turns nothing
        rate = np.roll(quat_product(np.roll(q, -1), np.append(gyro[k] - out.noise.gyro_bias, 0.0)), 1) / 2
        q = q + (rate - 0.033 * step / np.linalg.norm(step)) / RATE
        q /= np.linalg.norm(q)
    estimate = np.roll(out.quat_VS[-1], 1)
    np.testing.assert_allclose(estimate * np.sign(estimate @ q), q, atol=1e-9)


# All ---------------------------------------------------------------------------------------------------------------


def test_wrong_input_is_named() -> None:
    gyro = np.zeros((100, 3))
    for changed, said in (
        ({"method": "smekv"}, "did you mean 'smekf'"),
        ({"accel_S": gyro[:50]}, r"must both be \(n, 3\)"),
        ({"gyro_S": gyro * np.nan}, "finite"),
        ({"static": (0, 5)}, r"which lasts 1\.000 s"),
        ({"static": (0, 0.9)}, "no gravity"),
        ({"static": (0, 0.05)}, "holds 6 samples"),
    ):
        with pytest.raises(WeposeError, match=said):
            estimate_orientation(**{"gyro_S": gyro, "accel_S": gyro, "rate_hz": RATE, "static": (0, 0.5), **changed})


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
        assert angle.mean() < limit
