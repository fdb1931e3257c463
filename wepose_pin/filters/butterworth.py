"""Butterworth filters of second order: forwards and backwards, so that nothing is delayed, or as samples come.

The same as `butter`, `sosfiltfilt` and `sosfilt` of SciPy, whose `scipy.signal` takes half a second to load.
"""

from __future__ import annotations

import numpy as np

from ..compilation import kernel

_PAD = 3  # times the length of the filter, by which the signal is continued beyond its ends


def low_pass(values: np.ndarray, cutoff_hz: float, rate_hz: float, pad: int | None = None) -> np.ndarray:
    """Signals (n, …) without what is faster than `cutoff_hz`.

    Parameters
    ----------
    pad : samples by which the signals are mirrored beyond their ends, fewer than n; None: as SciPy
    """
    return _filter_both_ways(_design_low_pass(cutoff_hz, rate_hz), values, pad)


def band_pass(values: np.ndarray, band_hz: tuple[float, float], rate_hz: float) -> np.ndarray:
    """Signals (n, …) without what is slower or faster than `band_hz`."""
    return _filter_both_ways(_design_band_pass(band_hz, rate_hz), values)


_POLES = np.exp(1j * np.pi * np.array([0.75, 1.25]))  # of the analogue low-pass filter of 1 rad/s
_DOUBLE_RATE = 4.0  # of the bilinear transform at a rate of 2, as the frequencies are warped


def _warp(frequency_hz: float, rate_hz: float) -> float:
    return float(_DOUBLE_RATE * np.tan(np.pi * frequency_hz / rate_hz))


def _design_low_pass(cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Section (1, 6) b0, b1, b2, 1, a1, a2."""
    cutoff = _warp(cutoff_hz, rate_hz)
    poles = cutoff * _POLES
    gain = cutoff**2 / float(np.prod(_DOUBLE_RATE - poles).real)
    pole = (_DOUBLE_RATE + poles[0]) / (_DOUBLE_RATE - poles[0])
    return np.array([[gain, 2.0 * gain, gain, 1.0, -2.0 * pole.real, abs(pole) ** 2]])


def _design_band_pass(band_hz: tuple[float, float], rate_hz: float) -> np.ndarray:
    """Sections (2, 6) b0, b1, b2, 1, a1, a2."""
    low, high = (_warp(frequency_hz, rate_hz) for frequency_hz in band_hz)
    half = 0.5 * (high - low) * _POLES
    root = np.sqrt(half**2 - low * high)
    poles = np.concatenate((half + root, half - root))
    gain = float(((high - low) ** 2 * _DOUBLE_RATE**2 / np.prod(_DOUBLE_RATE - poles)).real)
    digital = (_DOUBLE_RATE + poles) / (_DOUBLE_RATE - poles)
    first, second = sorted(digital[digital.imag > 0.0], key=abs)
    return np.array(
        [
            [gain, 2.0 * gain, gain, 1.0, -2.0 * first.real, abs(first) ** 2],
            [1.0, -2.0, 1.0, 1.0, -2.0 * second.real, abs(second) ** 2],
        ]
    )


def _filter_both_ways(sections: np.ndarray, values: np.ndarray, pad: int | None = None) -> np.ndarray:
    n, columns = len(values), values.reshape(len(values), -1)
    if pad is None:
        pad = _PAD * (2 * len(sections) + 1)
    if n <= pad:
        raise ValueError(f"{n} samples, and more than {pad} are needed")
    first, last = 2.0 * columns[0] - columns[pad:0:-1], 2.0 * columns[-1] - columns[-2 : -pad - 2 : -1]
    signals = np.concatenate((first, columns, last))
    for _ in range(2):
        _filter(sections, _find_settled_state(sections, signals[0]), signals)
        signals = np.ascontiguousarray(signals[::-1])
    return signals[pad : pad + n].reshape(values.shape)


def _find_settled_state(sections: np.ndarray, first: np.ndarray) -> np.ndarray:
    """State (k, c, 2) of each section after a long time of the values `first` (c,)."""
    states, gain = [], 1.0
    for b0, b1, b2, _, a1, a2 in sections:
        state = (b1 + b2 - (a1 + a2) * b0) / (1.0 + a1 + a2)
        states.append((gain * state, gain * ((1.0 + a1) * state - b1 + a1 * b0)))
        gain *= (b0 + b1 + b2) / (1.0 + a1 + a2)
    return np.array(states)[:, None] * first[:, None]


@kernel
def _filter(sections: np.ndarray, state: np.ndarray, signals: np.ndarray) -> None:
    """Filter signals (n, c) in place and keep the state (k, c, 2); direct form II transposed."""
    for k in range(len(sections)):
        b0, b1, b2, _, a1, a2 = sections[k]
        for i in range(signals.shape[0]):
            for c in range(signals.shape[1]):
                x = signals[i, c]
                y = b0 * x + state[k, c, 0]
                state[k, c, 0] = b1 * x - a1 * y + state[k, c, 1]
                state[k, c, 1] = b2 * x - a2 * y
                signals[i, c] = y


class BandPass:
    """A band-pass filter of signals that come in chunks, from the state settled at `first` (c,)."""

    def __init__(self, band_hz: tuple[float, float], rate_hz: float, first: np.ndarray) -> None:
        self._sections = _design_band_pass(band_hz, rate_hz)
        self._state = _find_settled_state(self._sections, first)

    def push(self, values: np.ndarray) -> np.ndarray:
        """Return the filtered chunk (n, c)."""
        signals = np.array(values, dtype=float)
        _filter(self._sections, self._state, signals)
        return signals
