"""The Butterworth filters are those of SciPy."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from wepose_pin.filters.butterworth import band_pass, low_pass

SIGNAL = np.random.default_rng(0).normal(size=(4000, 2, 3)).cumsum(axis=0)


@pytest.mark.parametrize("rate_hz", [20.0, 59.94, 100.0, 2000.0])
@pytest.mark.parametrize("cutoff_hz", [0.05, 1.5, 6.0, 8.0])
def test_low_pass(cutoff_hz: float, rate_hz: float) -> None:
    sos = butter(2, cutoff_hz, fs=rate_hz, output="sos")
    for pad in (None, 10, 3999):
        expected = sosfiltfilt(sos, SIGNAL, axis=0, padlen=pad)
        np.testing.assert_allclose(low_pass(SIGNAL, cutoff_hz, rate_hz, pad), expected, atol=1e-9 * np.ptp(SIGNAL))


@pytest.mark.parametrize("rate_hz", [20.0, 59.94, 100.0, 2000.0])
def test_band_pass(rate_hz: float) -> None:
    sos = butter(2, (0.1, 1.5), "band", fs=rate_hz, output="sos")
    expected = sosfiltfilt(sos, SIGNAL, axis=0)
    np.testing.assert_allclose(band_pass(SIGNAL, (0.1, 1.5), rate_hz), expected, atol=1e-9 * np.ptp(SIGNAL))


def test_too_short_a_signal_is_refused() -> None:
    with pytest.raises(ValueError, match="9 samples, and more than 9 are needed"):
        low_pass(SIGNAL[:9], 6.0, 100.0)
    low_pass(SIGNAL[:10], 6.0, 100.0)


def test_neither_tracking_nor_calibration_loads_the_statistics_of_scipy() -> None:
    """They take half a second."""
    code = (
        "import sys, wepose_pin.tracking, wepose_pin.calibration, wepose_pin.report.track, wepose_pin.writers\n"
        "print(sorted({'scipy.signal', 'scipy.stats', 'scipy.optimize'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
