"""Samples in the order of arrival → ticks: what is on its tick is kept to the bit, whatever else happens."""

from itertools import pairwise

import numpy as np
import pytest

from wepose_pin.recording.arrivals import Samples, StreamSynchronizer, order_arrivals

NAMES = ("torso", "left_upper_arm", "left_forearm")
RATE, BEGIN = 100.0, 3.0


def signals(n: int) -> tuple[np.ndarray, np.ndarray]:
    """gyro_S, accel_S (3, n, 3)."""
    rng = np.random.default_rng(0)
    return rng.standard_normal((3, n, 3)), rng.standard_normal((3, n, 3)) + [0.0, 0.0, 9.8]


def synchronize(time: np.ndarray, *numbers: np.ndarray, came: np.ndarray | None = None) -> list[np.ndarray]:
    """Time (m,), gyro and accel (m, k, 3) of all ticks, from (k, n, 3) that come one by one where (k, n) `came`."""
    k, n, _ = numbers[0].shape
    synchronizer, made = StreamSynchronizer(NAMES[:k], RATE, BEGIN), []
    for row in range(n):
        for i, name in enumerate(NAMES[:k]):
            if came is None or came[i, row]:
                one = Samples(name, time[row : row + 1], *(each[i, row : row + 1] for each in numbers))
                made += synchronizer.push(order_arrivals([one], NAMES[:k]))
    assert all(a.first + len(a.time) == b.first for a, b in pairwise(made))
    return [np.concatenate([getattr(ticks, name) for ticks in made]) for name in ("time", "gyro_S", "accel_S")]


def on_ticks(n: int) -> np.ndarray:
    return BEGIN + np.arange(n) / RATE


@pytest.mark.parametrize("digits", [1.0, 20.0])
def test_a_rate_that_is_cut_off_is_not_known(digits: float) -> None:
    """Swings of up to 6 rad/s behind a range of 4: all but the first samples of the first time there."""
    rng, n = np.random.default_rng(5), 1000
    swing = 6.0 * np.sin(2.0 * np.pi * 0.5 * np.arange(n) / RATE) * (np.arange(n) > 300)
    gyro, accel = (0.02 * rng.standard_normal((3, n, 3)) for _ in range(2))
    gyro[1, :, 2] += swing
    gyro[2, :, 0] += 0.6 * swing
    gyro = np.round(np.clip(gyro, -4.0, 4.0) * 1000.0 / digits) / 1000.0 * digits
    beyond = np.abs(gyro).max(axis=2) > 0.98 * 4.0
    assert beyond[1].sum() > 100
    known = np.isfinite(synchronize(on_ticks(n), gyro, accel)[1]).all(axis=2).T
    assert known[[0, 2]].all()
    assert known[1][~beyond[1]].all()
    assert np.count_nonzero(known[1][beyond[1]]) < 10  # and those just below it, before it was known


@pytest.mark.parametrize("digit", [0.5, 1.0])
def test_coarse_digits_that_repeat_are_measured(digit: float) -> None:
    """Noise of half a digit or less, at rest, then now and then in motion: it stays the same for a while by chance."""
    rng, n = np.random.default_rng(3), 6000
    motion = 80.0 * np.clip(np.sin(np.arange(n) / 300.0) - 0.5, 0.0, None)[None, :, None]
    gyro, accel = (np.round((rng.standard_normal((3, n, 3)) + motion) / digit / 4.0) for _ in range(2))
    assert np.array_equal(synchronize(on_ticks(n), gyro, accel)[1], gyro.swapaxes(0, 1))


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_sensor_that_never_changes_is_frozen_where_another_one_is_noisy(noise: float) -> None:
    gyro, accel = (noise * values for values in signals(600))
    gyro[1], accel[1] = 0.01, [0.0, 0.0, 9.81]
    known = np.isfinite(synchronize(on_ticks(600), gyro, accel)[1]).all(axis=2).T
    assert known[[0, 2]].all()
    assert known[1, :190].all()
    assert known[1, 230:].all() == known[1, 230:].any() == (noise == 0.0)


@pytest.mark.parametrize(("lost", "bridged"), [(1, True), (5, True), (6, False), (40, False)])
def test_holes_are_bridged_up_to_50_ms_and_then_nan(lost: int, bridged: bool) -> None:
    gyro, accel = signals(200)
    came = np.ones((3, 200), dtype=bool)
    came[2, 60 : 60 + lost] = False
    _, made, _ = synchronize(on_ticks(200), gyro, accel, came=came)
    hole = made[60 : 60 + lost, 2]
    if bridged:
        share = (np.arange(1, lost + 1) / (lost + 1))[:, None]
        np.testing.assert_allclose(hole, gyro[2, 59] + share * (gyro[2, 60 + lost] - gyro[2, 59]))
    else:
        assert np.isnan(hole).all()
    back = 60 + lost + (lost == 40)  # of a sensor that was given up the first sample comes when its tick is gone
    assert np.array_equal(made[back:, 2], gyro[2, back:])
    assert np.array_equal(made[:, :2], gyro[:2].swapaxes(0, 1))


def test_clocks_that_are_off_the_ticks_lose_no_rotation() -> None:
    """A sensor 30 ppm fast and half a step off: the integral of its rate is kept."""
    time = BEGIN - 0.0047 + np.arange(3000) / (RATE * (1.0 + 3e-5))
    rate = np.sin(2.0 * np.pi * 0.7 * time)[:, None] * [1.0, 0.0, 0.0]
    force = np.cos(2.0 * np.pi * 0.7 * time)[:, None] * [0.0, 0.0, 9.8]
    ticks, gyro, accel = synchronize(time, rate[None], force[None])
    turned = np.cumsum(gyro[:, 0, 0]) / RATE
    expected = np.interp(ticks, time, np.cumsum(rate[:, 0]) / RATE)
    np.testing.assert_allclose(turned - turned[10], expected - expected[10], atol=2e-4)
    np.testing.assert_allclose(accel[:, 0, 2], 9.8 * np.cos(2.0 * np.pi * 0.7 * ticks), atol=6e-3)
