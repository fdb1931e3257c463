"""When a sensor is static: the paper's conditions (1) to (4), what they miss, and the phase that is found."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.validation.single import simulate_paper_dynamic
from wepose_pin import ImuSensor, OrientationSensor, Recording, StaticTest, estimate_orientation, track
from wepose_pin.filters.phases import estimate_noise

RATE = 100.0
# The paper's conditions alone, without (5) and (6)
PaperTest = partial(StaticTest, rate_stds=np.inf)
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def find_static(gyro: np.ndarray, accel: np.ndarray, test: StaticTest | None = None, until: float = 4.99) -> np.ndarray:
    return estimate_orientation(gyro, accel, RATE, method="smekf", static=(0.0, until), static_test=test).static


def by_the_book(gyro: np.ndarray, accel: np.ndarray, test: StaticTest) -> np.ndarray:
    """Each window by itself: mean and covariance in two passes, matrix inequalities by eigenvalues."""
    n = round(test.window_s * RATE)
    static = np.zeros(len(gyro), dtype=bool)
    scaled = accel / np.linalg.norm(accel[:500], axis=1).mean()
    gyro_cov, accel_cov = np.cov(gyro[:500].T), np.cov(scaled[:500].T)
    norm = np.linalg.norm(scaled, axis=1)
    for k in range(n - 1, len(gyro)):
        window = slice(k - n + 1, k + 1)
        one = np.linalg.eigvalsh(test.alpha * gyro_cov - np.cov(gyro[window].T))[0] >= 0
        two = np.linalg.eigvalsh(test.beta * accel_cov - np.cov(scaled[window].T))[0] >= 0
        three = abs(norm[window].mean() - 1) <= test.gamma1
        four = norm[window].var(ddof=1) <= test.gamma2
        static[k] = one and two and three and four
    return static


def stop_and_go(rng: np.random.Generator, n: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Noise of a real sensor with bursts of motion of all strengths in between."""
    gyro = rng.normal(scale=2e-3, size=(n, 3)) @ np.array([[1, 0.3, 0], [0, 1, -0.2], [0, 0, 0.6]]) + [0.01, -0.02, 0.0]
    accel = rng.normal(scale=0.02, size=(n, 3)) + np.array([0.3, -0.2, 9.78])
    for start in range(600, n - 200, 300):
        strength = 10.0 ** rng.uniform(-4, 0)
        gyro[start : start + 150] += strength * np.sin(np.linspace(0, 12, 150))[:, None] * rng.normal(size=3)
        accel[start : start + 150] += 3 * strength * np.sin(np.linspace(0, 9, 150))[:, None] * rng.normal(size=3)
    return gyro, accel


@pytest.mark.parametrize(
    "test", [PaperTest(), PaperTest(window_s=0.2), PaperTest(alpha=1.2, beta=5.0), PaperTest(window_s=5.0)]
)
def test_it_is_what_the_four_conditions_say(test: StaticTest) -> None:
    gyro, accel = stop_and_go(np.random.default_rng(0))
    expected = by_the_book(gyro, accel, test)
    after = round(test.window_s * RATE)  # what lies before the first window is tested backward
    assert 0.05 < expected.mean() < 0.95
    np.testing.assert_array_equal(find_static(gyro, accel, test)[after:], expected[after:])


def test_a_blow_says_no_for_one_window_and_is_forgotten() -> None:
    """Of 1e3 times gravity: rest is found as without it right after."""
    gyro, accel = stop_and_go(np.random.default_rng(8))
    without = find_static(gyro, accel, PaperTest())
    accel[349, 1] = 9.81e2
    static = find_static(gyro, accel, PaperTest(), 2.99)
    assert not static[349:399].any()
    assert static[399:590].mean() > 0.9
    assert without[300:590].mean() > 0.9


def chair(rate_deg_s: float, seed: int = 0, sway_deg_s: float = 0.0) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Gyro, accel and orientations of a sensor on a chair: 5 s still, 12 s at a steady rate about the vertical, 3 s
    still; all the while it sways about the vertical at three frequencies."""
    rng = np.random.default_rng(seed)
    n = 2000
    time = np.arange(n) / RATE
    rate = np.where((time >= 5.0) & (time < 17.0), np.deg2rad(rate_deg_s), 0.0)
    omega = 2.0 * np.pi * np.array([0.17, 0.31, 0.47])[:, None]
    swing = np.sqrt(2.0 / 3.0) * (np.sin(omega * time + rng.uniform(0, 6.3, (3, 1))) / omega).sum(0)
    yaw = np.cumsum(rate) / RATE + np.deg2rad(sway_deg_s) * swing
    R = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
    gyro = np.vstack([np.zeros(3), (R[:-1].inv() * R[1:]).as_rotvec() * RATE]) + np.deg2rad(rng.normal(0, 0.5, 3))
    gyro += rng.normal(scale=np.deg2rad(0.07), size=(n, 3))
    accel = R.inv().apply([0.0, 0.0, 9.81]) + rng.normal(scale=0.012, size=(n, 3))
    return gyro, accel, R


@pytest.mark.parametrize("rate", [0.5, 5.0, 60.0])
@pytest.mark.parametrize("method", ["amekf", "smoother", "smekf"])
def test_an_office_chair_is_no_bias(method: str, rate: float) -> None:
    gyro, accel, R = chair(rate)
    assert find_static(gyro, accel, PaperTest())[600:1600].mean() > 0.8  # the paper's conditions see nothing in it
    orientation = estimate_orientation(gyro, accel, RATE, method=method, static=(0.0, 4.99))
    assert not orientation.static[650:1690].any()
    assert orientation.static[1900:].mean() > 0.8
    error = Rotation.from_quat(orientation.quat_VS) * R.inv()
    heading = np.degrees((error[1699] * error[499].inv()).as_rotvec()[2])
    assert abs(heading) < 1.0


@pytest.mark.parametrize("method", ["amekf", "smoother", "smekf"])
@pytest.mark.parametrize("sway", [0.0, 0.3])
def test_a_rotation_too_slow_to_tell_from_the_bias_is_in_the_standard_deviation(method: str, sway: float) -> None:
    worst = 0.0
    for rate in (0.0, 0.02, 0.05, 0.1, 0.2, 0.3):
        gyro, accel, R = chair(rate, 1, sway)
        sensors = {"torso": ImuSensor(gyro, accel, UPRIGHT)}
        recording = Recording("chair", np.arange(len(gyro)) / RATE, RATE, sensors, {"start": ((0.0, 4.99),)})
        tracked = track(recording, method=method, open_loop=True)
        error = Rotation.from_quat(tracked.quat_WL["torso"]) * R.inv()
        std = np.sqrt(tracked.pose.segment_cov["torso"][-1, 2, 2])
        worst = max(worst, abs((error[-1] * error[:500].mean().inv()).as_rotvec()[2]) / std)
    assert worst < 6.0


@pytest.mark.parametrize("rate_hz", [25.0, 100.0, 400.0, 2000.0])
def test_one_sensor_is_as_static_at_any_rate(rate_hz: float) -> None:
    """White noise of one density, of z half: rest is static, and an oscillation of 0.5 deg/s about z is not."""
    rng, n = np.random.default_rng(0), round(15.0 * rate_hz)
    scale = np.sqrt(rate_hz) * np.outer([np.deg2rad(0.01), 1.5e-3], [1.0, 1.0, 0.5])
    gyro, accel = rng.normal(scale=scale, size=(n, 2, 3)).swapaxes(0, 1)
    time = np.arange(n) / rate_hz
    gyro[:, 2] += np.deg2rad(0.5) * np.sin(4.0 * np.pi * time) * (time > 10.0)
    static = estimate_orientation(gyro, accel + [0.0, 0.0, 9.81], rate_hz, method="smekf", static=(0.0, 5.0)).static
    assert static[(time > 5.0) & (time < 10.0)].mean() > 0.95
    assert static[time > 10.5].mean() < 0.02


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_the_start_of_a_smooth_motion_is_not_static(rate_hz: float) -> None:
    """Condition (6): sampled ten times as often the noise of a sample is √10 times as large, and hides no more."""
    ends: dict[StaticTest, list[float]] = {StaticTest(): [], PaperTest(): []}
    for seed in range(4):
        sensor = simulate_paper_dynamic(seed, rate_hz)
        first = slice(0, round(10.0 * rate_hz))
        for test, late in ends.items():
            static = estimate_orientation(
                sensor.gyro_S[first],
                sensor.accel_S[first],
                rate_hz,
                method="smekf",
                static=(0.5, 4.5),
                static_test=test,
            ).static
            late.append(sensor.time[np.flatnonzero(static)[-1]] - sensor.moving[0])
    assert np.mean(ends[StaticTest()]) < 0.1  # [s]
    assert np.mean(ends[PaperTest()]) > (0.12 if rate_hz > 500.0 else 0.0)


@pytest.mark.parametrize("seconds", [0.6, 1.0, 1.9, 2.5, 4.0, 10.0])
def test_a_worn_sensor_s_bias_is_as_uncertain_as_sway_makes_it(seconds: float) -> None:
    """People who sway at 0.3 to 1 deg/s below 0.5 Hz: the mean rate of a phase is within its standard deviation."""
    z = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        time = np.arange(round(seconds * RATE)) / RATE
        omega, phase = 2.0 * np.pi * rng.uniform(0.1, 0.5, (3, 3, 1)), rng.uniform(0.0, 6.3, (3, 3, 1))
        sway = np.deg2rad(rng.uniform(0.3, 1.0)) * np.sqrt(2.0 / 3.0) * np.cos(omega * time + phase).sum(axis=1).T
        gyro = sway + rng.normal(scale=np.deg2rad(0.07), size=(len(time), 3))
        noise = estimate_noise(gyro, np.tile([0.0, 0.0, 9.8], (len(time), 1)), RATE, worn=True)
        z += list(noise.gyro_bias / np.sqrt(np.diag(noise.gyro_bias_cov)))
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.abs(z).max() < 5.0


def find_start(recording: Recording) -> tuple[float, float]:
    """The start pose [s] that is taken where none is named."""
    [guess] = [each for each in track(recording).diagnostics if each.code == "start-pose-guessed"]
    return guess.facts["start"], guess.facts["end"]


def test_a_steady_turn_is_not_the_quietest_window() -> None:
    rng = np.random.default_rng(5)
    n = 2000
    time = np.arange(n) / RATE
    sensors = {}
    for k, segment in enumerate(("torso", "left_forearm", "right_forearm")):
        gyro = rng.normal(scale=2e-3, size=(n, 3)) + np.deg2rad([0.3, -0.2, 0.4]) * (k + 1)
        gyro[:1000, 2] += np.deg2rad(20.0)  # a chair, very evenly
        gyro[1000:] += np.deg2rad(0.5) * np.sin(2.0 * time[1000:, None] + [0.0, 1.0, 2.0])  # standing, with sway
        sensors[segment] = ImuSensor(gyro, rng.normal(scale=0.02, size=(n, 3)) + [0.0, 0.0, 9.8], UPRIGHT)
    assert find_start(Recording("chair", time, RATE, sensors))[0] >= 9.9


@pytest.mark.parametrize("measured", [False, True])
def test_the_quietest_window_is_found(measured: bool) -> None:
    rng = np.random.default_rng(2)
    time = 100.0 + np.arange(3000) / RATE
    gyro = rng.normal(scale=0.3, size=(3000, 3))
    gyro[700:950] *= 0.01
    imu = ImuSensor(gyro, [0.0, 0.0, 9.8] + rng.normal(scale=0.02, size=(3000, 3)), UPRIGHT)
    recording = Recording("r", time, RATE, {"torso": imu})
    if measured:
        quat_VS = estimate_orientation(gyro, imu.accel_S, RATE, method="smekf", static=(7.0, 9.4)).quat_VS
        recording = replace(recording, sensors={"torso": OrientationSensor(quat_VS, UPRIGHT)})
    first, last = find_start(recording)
    assert 106.95 <= first < last <= 109.55
