"""The rate of each sensor, as its samples come."""

import numpy as np
import pytest

from wepose_pin.live.sources import Source
from wepose_pin.live.ticks import SensorMonitor
from wepose_pin.recording.arrivals import Samples

RATE_HZ = 100.0


class LateSource(Source):
    now = 0.0

    def read(self, timeout_s: float) -> list[Samples] | None:
        raise NotImplementedError

    def clock(self) -> float:
        return self.now


@pytest.mark.parametrize(
    ("samples", "late_s", "offset_s"),
    [(50, 0.0, 0.0), (1, 0.3, 0.0), (1, 0.0, 1e9), (1, 0.0, -100.0)],
    ids=["in batches", "late", "a later clock", "an earlier clock"],
)
def test_the_rate_is_that_of_the_sensor_until_it_is_silent(samples: int, late_s: float, offset_s: float) -> None:
    source = LateSource()
    monitor, rows = SensorMonitor(source), np.zeros((samples, 3))
    monitor.push([Samples("torso", np.zeros(0), rows[:0], rows[:0])])  # of a plug-in that has read nothing
    for k in range(0, 500, samples):
        time_s = np.arange(k, k + samples) / RATE_HZ
        source.now = time_s[-1] + late_s
        monitor.push([Samples("torso", time_s + offset_s, rows, rows)])
        if k >= 200:
            for now in (source.now, source.now + samples / RATE_HZ):
                assert monitor.update(now)["torso"] == pytest.approx(RATE_HZ, abs=1.0)
    assert monitor.update(source.now + 1.1)["torso"] == 0.0


def test_a_single_wild_time_or_value_changes_nothing_for_long() -> None:
    monitor = SensorMonitor(LateSource())
    for k in [*range(300), 10**6, *range(301, 420)]:
        gyro_S = np.full((1, 3), np.inf if k == 310 else 0.0)
        monitor.push([Samples("torso", np.array([k / RATE_HZ]), gyro_S, np.ones((1, 3)))])
    assert monitor.update(0.0)["torso"] == pytest.approx(RATE_HZ, abs=1.0)
