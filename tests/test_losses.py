"""Samples that never came are counted by the times of those that did."""

from __future__ import annotations

import numpy as np
import pytest

from wepose_pin.live.ticks import SampleCounter, measure_step

RATE_HZ = 100.0


def count(time_s: np.ndarray) -> int:
    counter = SampleCounter()
    for k in range(0, len(time_s), 7):
        counter.push(time_s[k : k + 7])
    return counter.missing


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.3])
@pytest.mark.parametrize("jitter", [0.0, 0.15])
@pytest.mark.parametrize("drift", [0.0, 3e-4])
def test_lost_samples_of_a_minute(share: float, jitter: float, drift: float) -> None:
    rng = np.random.default_rng(1)
    time_s = (1.0 + drift) * np.arange(6000) / RATE_HZ
    came = rng.random(6000) >= share
    came[[0, -1]] = True
    time_s = time_s + jitter / RATE_HZ * rng.uniform(-1.0, 1.0, 6000)
    lost = count(time_s[came])
    assert abs(lost - np.count_nonzero(~came)) <= 0.02 * np.count_nonzero(~came)
    assert 1.0 / measure_step(time_s[came][:200]) == pytest.approx(RATE_HZ, rel=1.0 / 200.0)  # a step of them


def test_a_sensor_that_is_silent_loses_samples_until_it_comes_again() -> None:
    time_s = np.arange(1000) / RATE_HZ
    assert count(np.concatenate([time_s, time_s + 12.0])) == pytest.approx(200, abs=1)


def test_a_sample_that_was_overtaken_is_not_lost() -> None:
    time_s = np.arange(1000) / RATE_HZ
    time_s[[500, 502]] = time_s[[502, 500]]
    assert count(time_s) == 0
