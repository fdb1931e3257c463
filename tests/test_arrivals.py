"""Samples in the order of arrival → ticks: what is on its tick is kept to the bit, whatever else happens."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest

from wepose_pin.recording.arrivals import (
    CUT_OFF,
    FROZEN,
    LATE,
    LONGEST_GAP_S,
    Arrivals,
    Samples,
    StreamSynchronizer,
    Ticks,
    order_arrivals,
)

NAMES = ("torso", "left_upper_arm", "left_forearm")
RATE = 100.0
BEGIN = 3.0


def signals(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """gyro_S, accel_S (k, n, 3)."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((3, n, 3)), rng.standard_normal((3, n, 3)) + [0.0, 0.0, 9.8]


def fed(synchronizer: StreamSynchronizer, came: Iterable[tuple[int, float, np.ndarray, np.ndarray]]) -> Ticks:
    """All ticks of single samples (sensor, time, gyro, accel) that come one by one."""
    made = [
        ticks
        for i, t, g, a in came
        for ticks in synchronizer.push(
            order_arrivals([Samples(synchronizer.sensors[i], np.array([t]), g[None], a[None])], synchronizer.sensors),
        )
    ]
    assert all(a.first + len(a.time) == b.first for a, b in pairwise(made))
    return Ticks(made[0].first, *(np.concatenate([getattr(t, part) for t in made]) for part in Ticks._fields[1:]))


def tick_time(k: int) -> float:
    return BEGIN + k / RATE


def in_order(gyro: np.ndarray, accel: np.ndarray) -> list[tuple[int, float, np.ndarray, np.ndarray]]:
    return [(i, tick_time(k), gyro[i, k], accel[i, k]) for k in range(gyro.shape[1]) for i in range(3)]


def test_the_same_arrivals_in_blocks_give_the_same_ticks() -> None:
    gyro, accel = signals(500)
    rng = np.random.default_rng(1)
    came = sorted(
        ((t + rng.exponential(0.02), i, t, g, a) for i, t, g, a in in_order(gyro, accel) if rng.random() > 0.05),
        key=lambda each: each[0],
    )
    one_by_one = StreamSynchronizer(NAMES, RATE, BEGIN)
    first = fed(one_by_one, [each[1:] for each in came])
    which = np.array([each[1] for each in came], dtype=np.uint8)
    parts = [np.array([each[k] for each in came]) for k in (2, 3, 4)]
    blocks = StreamSynchronizer(NAMES, RATE, BEGIN)
    cuts = [0, 1, 2, 50, 700, len(came)]
    made = [
        ticks for a, b in pairwise(cuts) for ticks in blocks.push(Arrivals(which[a:b], *(part[a:b] for part in parts)))
    ]
    for part in ("gyro_S", "accel_S", "lost"):
        whole = np.concatenate([getattr(ticks, part) for ticks in made])
        np.testing.assert_array_equal(whole, getattr(first, part))
    assert np.array_equal(one_by_one.counts, blocks.counts)
    assert first.lost.any() or np.isnan(first.gyro_S).any() or one_by_one.counts[:, LATE].any()  # something did happen


@pytest.mark.parametrize("digits", [1.0, 20.0])
def test_a_rate_that_is_cut_off_is_not_known(digits: float) -> None:
    """Swings of up to 6 rad/s behind a range of 4: all but the first samples of the first time there."""
    rng, n = np.random.default_rng(5), 1000
    swing = 6.0 * np.sin(2.0 * np.pi * 0.5 * np.arange(n) / RATE) * (np.arange(n) > 300)
    gyro, accel = (0.02 * rng.standard_normal((3, n, 3)) for _ in range(2))
    gyro[1, :, 2] += swing
    gyro[2, :, 0] += 0.6 * swing
    gyro = np.round(np.clip(gyro, -4.0, 4.0) * 1000.0 / digits) / 1000.0 * digits
    synchronizer = StreamSynchronizer(NAMES, RATE, BEGIN)
    ticks = fed(synchronizer, in_order(gyro, accel))
    beyond = np.abs(gyro).max(axis=2) > 0.98 * 4.0
    assert beyond[1].sum() > 100
    known = np.isfinite(ticks.gyro_S).all(axis=2).T
    assert known[[0, 2]].all()
    assert known[1][~beyond[1]].all()
    assert np.count_nonzero(known[1][beyond[1]]) < 10  # and those just below it, before it was known
    assert synchronizer.counts[:, CUT_OFF].tolist() == [0, np.count_nonzero(~known[1]), 0]
    assert not ticks.lost.any()


@pytest.mark.parametrize("digit", [0.5, 1.0])
def test_coarse_digits_that_repeat_are_measured(digit: float) -> None:
    """Noise of half a digit or less, at rest, then now and then in motion: it stays the same for a while by chance."""
    rng, n = np.random.default_rng(3), 6000
    motion = 80.0 * np.clip(np.sin(np.arange(n) / 300.0) - 0.5, 0.0, None)[None, :, None]
    gyro, accel = (np.round((rng.standard_normal((3, n, 3)) + motion) / digit / 4.0) for _ in range(2))
    synchronizer = StreamSynchronizer(NAMES, RATE, BEGIN)
    ticks = fed(synchronizer, in_order(gyro, accel))
    assert np.array_equal(ticks.gyro_S, gyro.swapaxes(0, 1))
    assert synchronizer.counts[:, FROZEN].sum() == 0


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_sensor_that_never_changes_is_frozen_where_another_one_is_noisy(noise: float) -> None:
    gyro, accel = (noise * values for values in signals(600))
    gyro[1], accel[1] = 0.01, [0.0, 0.0, 9.81]
    known = np.isfinite(fed(StreamSynchronizer(NAMES, RATE, BEGIN), in_order(gyro, accel)).gyro_S).all(axis=2).T
    assert known[[0, 2]].all()
    assert known[1, :190].all()
    assert known[1, 230:].all() == (noise == 0.0)
    assert known[1, 230:].any() == (noise == 0.0)


@pytest.mark.parametrize(("lost", "bridged"), [(1, True), (5, True), (6, False), (40, False)])
def test_holes_are_bridged_up_to_a_limit_and_then_nan(lost: int, bridged: bool) -> None:
    assert round(LONGEST_GAP_S * RATE) == 5
    gyro, accel = signals(200)
    came = [c for c in in_order(gyro, accel) if not (c[0] == 2 and 60 <= round((c[1] - BEGIN) * RATE) < 60 + lost)]
    ticks = fed(StreamSynchronizer(NAMES, RATE, BEGIN), came)
    hole = ticks.gyro_S[60 : 60 + lost, 2]
    if bridged:
        share = (np.arange(1, lost + 1) / (lost + 1))[:, None]
        np.testing.assert_allclose(hole, gyro[2, 59] + share * (gyro[2, 60 + lost] - gyro[2, 59]))
    else:
        assert np.isnan(hole).all()
    back = 60 + lost + (lost == 40)  # of a sensor that was given up the first sample comes when its tick is gone
    assert np.array_equal(ticks.gyro_S[back:, 2], gyro[2, back:])
    assert np.array_equal(ticks.gyro_S[:, :2], gyro[:2].swapaxes(0, 1))


def test_clocks_that_are_off_the_ticks_lose_no_rotation() -> None:
    """A sensor 30 ppm fast and half a step off: the integral of its rate is kept."""
    n = 3000
    times = BEGIN - 0.0047 + np.arange(n) / (RATE * (1.0 + 3e-5))
    rate = np.sin(2.0 * np.pi * 0.7 * times)[:, None] * [1.0, 0.0, 0.0]
    force = np.cos(2.0 * np.pi * 0.7 * times)[:, None] * [0.0, 0.0, 9.8]
    rows = [(0, float(t), r, f) for t, r, f in zip(times, rate, force, strict=True)]
    ticks = fed(StreamSynchronizer(NAMES[:1], RATE, BEGIN), rows)
    turned = np.cumsum(ticks.gyro_S[:, 0, 0]) / RATE
    expected = np.interp(ticks.time, times, np.cumsum(rate[:, 0]) / RATE)
    np.testing.assert_allclose(turned - turned[10], expected - expected[10], atol=2e-4)
    np.testing.assert_allclose(ticks.accel_S[:, 0, 2], 9.8 * np.cos(2.0 * np.pi * 0.7 * ticks.time), atol=6e-3)


def test_a_stream_that_resumes_after_hours_makes_its_ticks_block_by_block() -> None:
    synchronizer = StreamSynchronizer(NAMES[:1], RATE, BEGIN)
    fed(synchronizer, [(0, tick_time(k), np.ones(3), np.ones(3)) for k in range(100)])
    time = BEGIN + 8.0 * 3600.0 + np.arange(10) / RATE
    resumed = synchronizer.push(Arrivals(np.zeros(10, np.uint8), time, np.ones((10, 3)), np.ones((10, 3))))
    sizes = [len(ticks.time) for ticks in resumed]
    assert sum(sizes) > 2_800_000
    assert max(sizes) < 10_000


def test_a_faster_sensor_is_averaged_over_the_step() -> None:
    n = 1000
    times = BEGIN + np.arange(n) / (4.0 * RATE)
    rate = np.random.default_rng(2).standard_normal((n, 3))
    rows = [(0, float(t), r, r) for t, r in zip(times, rate, strict=True)]
    ticks = fed(StreamSynchronizer(NAMES[:1], RATE, BEGIN), rows)
    means = rate[1 : 4 * ((n - 1) // 4) + 1].reshape(-1, 4, 3).mean(axis=1)
    np.testing.assert_allclose(ticks.gyro_S[1:, 0], means[: len(ticks.time) - 1], atol=1e-9)
