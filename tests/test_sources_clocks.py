"""Senders' clocks on ours: offset, drift, jitter, and clocks that jump."""

import numpy as np
import pytest

from wepose_pin.live.sources import HostClock


def mapped(time: np.ndarray, arrival: np.ndarray) -> np.ndarray:
    clock = HostClock()
    return np.concatenate([clock.to_host(time[k : k + 1], arrival[k]) for k in range(len(time))])


@pytest.mark.parametrize("drift", [-100e-6, 0.0, 100e-6])
def test_the_fastest_samples_set_the_clock(drift: float) -> None:
    """Delays of 2 ms and an exponential 8 ms more; a sensor whose crystal is off by `drift`."""
    rng = np.random.default_rng(1)
    true = 500.0 + np.arange(60_00) / 100.0
    device = (true - 500.0) * (1.0 + drift) + 7.0
    host = mapped(device, true + 0.002 + rng.exponential(0.008, len(true)))
    late = (host - true)[1000:]
    assert late.min() > 0.0005
    assert late.max() < 0.004
    steps = np.diff(host[1000:])
    assert np.abs(steps / 0.01 - 1.0).max() < 1e-3


def test_steps_of_a_batch_stay_even() -> None:
    """Forty samples a datagram, each as late as Wi-Fi is: the steps within and between change by a percent at most."""
    rng = np.random.default_rng(2)
    time = np.arange(4000) / 1000.0
    clock = HostClock()
    host = [clock.to_host(batch, 100.0 + batch[-1] + 0.001 + rng.exponential(0.01)) for batch in time.reshape(-1, 40)]
    assert np.abs(np.diff(np.concatenate(host)) / 0.001 - 1.0).max() < 0.0101


def test_what_waited_before_the_first_read_is_no_offset() -> None:
    time = np.arange(500) / 100.0
    arrival = np.maximum(time, 3.0)  # three seconds nobody read
    host = mapped(time, arrival)
    assert np.abs(host - arrival)[320:].max() < 1e-9


@pytest.mark.parametrize("jump", [-1000.0, 1000.0])
def test_a_sender_that_starts_anew_is_mapped_anew(jump: float) -> None:
    true = np.arange(1000) / 100.0
    device = true + np.where(true < 5.0, 2000.0, 2000.0 + jump)
    host = mapped(device, true)
    assert np.abs(host - true).max() < 1e-9


def test_a_datagram_that_was_overtaken_keeps_its_own_time() -> None:
    true = np.arange(100) / 100.0
    order = np.arange(100)
    order[[50, 53]] = order[[53, 50]]
    arrival = np.maximum.accumulate(true[order])
    host = mapped(true[order], arrival)
    assert np.abs(host - true[order]).max() < 1e-9
