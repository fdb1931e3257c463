"""The static detector against a plain two-pass transcription of conditions (1) to (4)."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.validation.single import simulate_paper_dynamic
from wepose_pin.errors import WeposeError
from wepose_pin.filters import run_filter
from wepose_pin.filters.noise import SensorNoise, estimate_noise
from wepose_pin.filters.static import StaticDetector, StaticTest

RATE = 100.0
# The paper's conditions alone, without (5) and (6)
PaperTest = partial(StaticTest, rate_stds=np.inf)


def by_the_book(gyro: np.ndarray, accel: np.ndarray, noise: SensorNoise, test: StaticTest, rate: float) -> np.ndarray:
    """Each window by itself: mean and covariance in two passes, matrix inequalities by eigenvalues."""
    n = test.samples(rate)
    static = np.zeros(len(gyro), dtype=bool)
    scaled = accel / noise.gravity
    norm = np.linalg.norm(scaled, axis=1)
    for k in range(n - 1, len(gyro)):
        window = slice(k - n + 1, k + 1)
        one = np.linalg.eigvalsh(test.alpha * noise.gyro_cov - np.cov(gyro[window].T))[0] >= 0
        two = np.linalg.eigvalsh(test.beta * noise.accel_cov - np.cov(scaled[window].T))[0] >= 0
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
    noise = estimate_noise(gyro[:500], accel[:500], RATE)
    expected = by_the_book(gyro, accel, noise, test, RATE)
    static = StaticDetector(noise, RATE, test).run(gyro, accel)
    assert 0.05 < expected.mean() < 0.95
    np.testing.assert_array_equal(static, expected)


def test_any_cut_and_one_by_one_give_the_same() -> None:
    gyro, accel = stop_and_go(np.random.default_rng(3))
    noise = estimate_noise(gyro[:500], accel[:500], RATE)
    whole = StaticDetector(noise, RATE, PaperTest()).run(gyro, accel)
    for edges in ([0, 1, 38, 87, 137, 188, 1234, 3000], range(3001)):
        detector = StaticDetector(noise, RATE, PaperTest())
        parts = [detector.run(gyro[a:b], accel[a:b]) for a, b in pairwise(edges)]
        np.testing.assert_array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("rest_begins", range(500, 551, 10))
def test_a_window_at_rest_is_exact_right_after_a_blow(rest_begins: int) -> None:
    """Rest of 1e-3 after 1e6, at every place of the block: the variance is right to 1e-12."""
    rng = np.random.default_rng(rest_begins)
    accel = np.zeros((700, 3))
    accel[:, 2] = 9.81 + rng.normal(scale=1e-3, size=700)
    accel[:rest_begins, 2] += rng.normal(scale=1e6, size=rest_begins)
    noise = SensorNoise(np.zeros(3), np.eye(3), np.eye(3), np.eye(3), np.eye(3), 1.0)
    ends = range(rest_begins + 49, 700)
    huge = {"alpha": 1e9, "beta": 1e9, "gamma1": 1e9}
    first = np.array(accel[ends[0] - 49 : ends[0] + 1, 2], dtype=np.longdouble)
    variance = float(np.sum((first - first.mean()) ** 2) / 49)
    for factor, expected in ((1 + 1e-12, True), (1 - 1e-12, False)):
        static = StaticDetector(noise, RATE, PaperTest(gamma2=variance * factor, **huge)).run(np.zeros((700, 3)), accel)
        assert static[ends[0]] == expected
        assert not static[: ends[0]].any()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e300])
@pytest.mark.parametrize("at", [330, 349, 350])
@pytest.mark.parametrize("gyro_is_wrong", [True, False])
def test_a_sample_that_is_no_number_says_no_for_one_window_and_is_forgotten(
    wrong: float, at: int, gyro_is_wrong: bool
) -> None:
    gyro, accel = stop_and_go(np.random.default_rng(8))
    noise = estimate_noise(gyro[:500], accel[:500], RATE)
    without = StaticDetector(noise, RATE, PaperTest()).run(gyro, accel)
    assert without[300:450].any()
    (gyro if gyro_is_wrong else accel)[at, 1] = wrong
    static = StaticDetector(noise, RATE, PaperTest()).run(gyro, accel)
    assert not static[at : at + 50].any()
    np.testing.assert_array_equal(np.delete(static, range(at, at + 50)), np.delete(without, range(at, at + 50)))


# (5), which the paper does not have --------------------------------------------------------------------------------


def chair(rate_deg_s: float, seed: int = 0, sway_deg_s: float = 0.0) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Gyro, accel and orientations of a sensor on a chair: 5 s still, 12 s at a steady rate about the vertical, 3 s
    still; all the while it sways about the vertical at three frequencies."""
    rng = np.random.default_rng(seed)
    n = 2000
    time = np.arange(n) / RATE
    rate = np.where((time >= 5.0) & (time < 17.0), np.deg2rad(rate_deg_s), 0.0)
    omega = 2.0 * np.pi * np.array([0.17, 0.31, 0.47])[:, None]
    sway = (
        np.deg2rad(sway_deg_s)
        * np.sqrt(2.0 / 3.0)
        * (np.sin(omega * time + rng.uniform(0, 6.3, (3, 1))) / omega).sum(0)
    )
    R = Rotation.from_rotvec((np.cumsum(rate) / RATE + sway)[:, None] * [0.0, 0.0, 1.0])
    R = R * Rotation.random(random_state=seed)
    gyro = np.vstack([np.zeros(3), (R[:-1].inv() * R[1:]).as_rotvec() * RATE]) + np.deg2rad(rng.normal(0, 0.5, 3))
    gyro += rng.normal(scale=np.deg2rad(0.07), size=(n, 3))
    accel = R.inv().apply([0.0, 0.0, 9.81]) + rng.normal(scale=0.012, size=(n, 3))
    return gyro, accel, R


@pytest.mark.parametrize("rate", [0.5, 5.0, 60.0])
@pytest.mark.parametrize("method", ["amekf", "smoother", "smekf"])
def test_an_office_chair_is_no_bias(method: str, rate: float) -> None:
    gyro, accel, R = chair(rate)
    noise = estimate_noise(gyro[:500], accel[:500], RATE)
    paper = StaticDetector(noise, RATE, PaperTest()).run(gyro, accel)
    assert paper[600:1600].mean() > 0.8  # the paper's conditions see nothing in it
    orientation = run_filter(gyro, accel, RATE, noise, method, start=slice(0, 500))
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
        noise = estimate_noise(gyro[:500], accel[:500], RATE, worn=True)
        orientation = run_filter(gyro, accel, RATE, noise, method, start=slice(0, 500))
        assert orientation.attitude_cov is not None
        error = Rotation.from_quat(orientation.quat_VS) * R.inv()
        up = R[-1].inv().apply([0.0, 0.0, 1.0])
        std = np.sqrt(up @ orientation.attitude_cov[-1] @ up)
        worst = max(worst, abs((error[-1] * error[:500].mean().inv()).as_rotvec()[2]) / std)
    print(f"{method}, sway {sway} deg/s: heading off by up to {worst:.1f} standard deviations")
    assert worst < 6.0


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_the_start_of_a_smooth_motion_is_not_static(rate_hz: float) -> None:
    """Condition (6): sampled ten times as often the noise of a sample is √10 times as large, and hides no more."""
    ends: dict[StaticTest | PaperTest, list[float]] = {StaticTest(): [], PaperTest(): []}
    for seed in range(4):
        sensor = simulate_paper_dynamic(seed, rate_hz)
        start = slice(round(0.5 * rate_hz), round(4.5 * rate_hz))
        noise = estimate_noise(sensor.gyro_S[start], sensor.accel_S[start], rate_hz)
        for test, late in ends.items():
            static = StaticDetector(noise, rate_hz, test).run(sensor.gyro_S, sensor.accel_S)
            assert static[start].mean() > 0.98
            late.append(sensor.time[np.flatnonzero(static & (sensor.time < 10.0))[-1]] - sensor.moving[0])
    assert np.mean(ends[StaticTest()]) < 0.1  # [s]
    assert np.mean(ends[PaperTest()]) > (0.12 if rate_hz > 500.0 else 0.0)


def test_wrong_numbers_of_a_test_are_named() -> None:
    for wrong in ({"window_s": 0.0}, {"alpha": -1.0}, {"rate_stds": np.nan}, {"averaging_s": 0.0}):
        with pytest.raises(WeposeError, match=next(iter(wrong))):
            StaticTest(**wrong)
