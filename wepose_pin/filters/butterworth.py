"""Butterworth filters of second order as `butter`, `sosfiltfilt` and `sosfilt` of SciPy, which takes 0.5 s to load."""

import numpy as np

from ..compilation import kernel


def low_pass(values: np.ndarray, cutoff_hz: float, rate_hz: float, pad: int | None = None) -> np.ndarray:
    """Signals (n, …) without what is faster than `cutoff_hz`; their ends are mirrored by `pad` samples.

    `pad` None: as SciPy; no more than there are.
    """
    return _filter_both_ways(_design((None, cutoff_hz), rate_hz), values, pad)


def band_pass(values: np.ndarray, band_hz: tuple[float, float], rate_hz: float) -> np.ndarray:
    """Signals (n, …) without what is slower or faster than `band_hz`."""
    return _filter_both_ways(_design(band_hz, rate_hz), values)


def settle_band_pass(band_hz: tuple[float, float], rate_hz: float, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a band-pass for `filter_chunk`, in the state after a long time of the signals `first` (c,)."""
    sections = _design(band_hz, rate_hz)
    return sections, _find_settled_state(sections, first)


def filter_chunk(sections: np.ndarray, state: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return a filtered chunk (n, c) of signals; `state` is then that after it."""
    signals = np.array(values, dtype=float)
    _filter(sections, state, signals)
    return signals


def _design(band_hz: tuple[float | None, float], rate_hz: float) -> np.ndarray:
    """Sections (k, 6) b0, b1, b2, 1, a1, a2, by the bilinear transform at a rate of 2 of warped frequencies."""
    low, high = (0.0 if f is None else 4.0 * float(np.tan(np.pi * f / rate_hz)) for f in band_hz)
    half = 0.5 * (high - low) * np.exp(0.75j * np.pi)  # pole of the analogue filter; its conjugate is one, too
    root = np.sqrt(half**2 - low * high)
    poles = np.array([2.0 * half] if band_hz[0] is None else [half + root, half - root])
    gain = (high - low) ** 2 * 16.0 ** (len(poles) - 1) / np.prod(np.abs(4.0 - poles) ** 2)
    digital = sorted((4.0 + poles) / (4.0 - poles), key=abs)
    zeros = zip((2.0, -2.0), digital, strict=False)
    sections = np.array([[1.0, b1, 1.0, 1.0, -2.0 * pole.real, abs(pole) ** 2] for b1, pole in zeros])
    sections[0, :3] *= gain
    return sections


def _filter_both_ways(sections: np.ndarray, values: np.ndarray, pad: int | None = None) -> np.ndarray:
    n, columns = len(values), values.reshape(len(values), -1)
    pad = min(n - 1, 3 * (2 * len(sections) + 1) if pad is None else pad)
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
