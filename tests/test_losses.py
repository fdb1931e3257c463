"""Samples that never came are counted by the times of those that did."""

from __future__ import annotations

import numpy as np
import pytest

from wepose_pin.live.sources.base import Source
from wepose_pin.live.ticks import SensorMonitor
from wepose_pin.recording.arrivals import Samples

RATE_HZ = 100.0


class LateSource(Source):
    now = 0.0

    def read(self, timeout_s: float) -> list[Samples] | None:
        raise NotImplementedError

    def clock(self) -> float:
        return self.now


def count(time_s: np.ndarray) -> int:
    """Missing samples of a sensor whose status is updated every seven samples."""
    monitor = SensorMonitor(LateSource())
    empty = np.zeros((0, 3))
    monitor.push([Samples("torso", np.zeros(0), empty, empty)])  # of a plug-in that has read nothing
    for k in range(0, len(time_s), 7):
        rows = np.zeros((len(time_s[k : k + 7]), 3))
        monitor.push([Samples("torso", time_s[k : k + 7], rows, rows)], ["torso"])
        missing = monitor.update(time_s[k])["torso"].missing
    return missing


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.3])
@pytest.mark.parametrize("jitter", [0.0, 0.15])
@pytest.mark.parametrize("drift", [0.0, 3e-4])
def test_lost_samples_of_a_minute(share: float, jitter: float, drift: float) -> None:
    rng = np.random.default_rng(1)
    time_s = (1.0 + drift) * np.arange(6000) / RATE_HZ
    came = rng.random(6000) >= share
    came[:100] = came[-100:] = True
    time_s = time_s + jitter / RATE_HZ * rng.uniform(-1.0, 1.0, 6000)
    lost = count(time_s[came])
    assert abs(lost - np.count_nonzero(~came)) <= 0.02 * np.count_nonzero(~came)


def test_a_sensor_that_is_silent_loses_samples_until_it_comes_again() -> None:
    time_s = np.arange(1000) / RATE_HZ
    assert count(np.concatenate([time_s, time_s + 12.0])) == pytest.approx(200, abs=1)


def test_a_clock_that_is_set_loses_no_sample() -> None:
    time_s = np.arange(1000) / RATE_HZ
    assert count(np.concatenate([time_s + 1e3, time_s, time_s + 1e6])) == 0


def test_a_sample_that_was_overtaken_is_not_lost() -> None:
    time_s = np.arange(1000) / RATE_HZ
    time_s[[500, 502]] = time_s[[502, 500]]
    assert count(time_s) == 0


@pytest.mark.parametrize(
    ("samples", "late_s", "offset_s"),
    [(50, 0.0, 0.0), (1, 0.3, 0.0), (1, 0.0, 1e9), (1, 0.0, -100.0)],
    ids=["in batches", "late", "a later clock", "an earlier clock"],
)
def test_the_rate_is_that_of_the_sensor_until_it_is_silent(samples: int, late_s: float, offset_s: float) -> None:
    source = LateSource()
    monitor, rows = SensorMonitor(source), np.zeros((samples, 3))
    for k in range(0, 500, samples):
        time_s = np.arange(k, k + samples) / RATE_HZ
        source.now = time_s[-1] + late_s
        monitor.push([Samples("torso", time_s + offset_s, rows, rows)], ["torso"])
        if k >= 200:
            for now in (source.now, source.now + samples / RATE_HZ):
                assert monitor.update(now)["torso"].rate_hz == pytest.approx(RATE_HZ, abs=1.0)
    assert monitor.update(source.now + 1.1)["torso"].rate_hz == 0.0
