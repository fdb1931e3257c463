"""Smooth functions of time that joint angles are made of: no samples, so that every rate sees the same motion."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

Function = Callable[[np.ndarray], np.ndarray]


def rise(s: np.ndarray) -> np.ndarray:
    """From 0 to 1 over 0 ≤ s ≤ 1 with least jerk (Flash & Hogan 1985)."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def risen(s: np.ndarray) -> np.ndarray:
    """The integral of `rise` from 0 to s."""
    inside = np.clip(s, 0.0, 1.0)
    return inside**4 * (2.5 - 3.0 * inside + inside**2) + np.maximum(s - 1.0, 0.0)


@dataclass
class Curve:
    """A constant, waves (amplitude, frequency [Hz], phase), and moves (begin [s], duration [s], by how much)."""

    constant: float = 0.0
    waves: list[tuple[float, float, float]] = field(default_factory=list)
    moves: list[tuple[float, float, float]] = field(default_factory=list)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        value = np.full(np.shape(t), self.constant)
        for amplitude, frequency, phase in self.waves:
            value += amplitude * np.sin(2.0 * np.pi * frequency * t + phase)
        for begin, duration, delta in self.moves:
            value += delta * rise((t - begin) / duration)
        return value


@dataclass
class Steady:
    """What grows at `rate` [1/s] from `begin` to `end` [s], the rate rising and falling within `ramp` [s]."""

    begin: float
    end: float
    ramp: float
    rate: float

    def __call__(self, t: np.ndarray) -> np.ndarray:
        up, down = (risen((t - at) / self.ramp) * self.ramp for at in (self.begin, self.end - self.ramp))
        return self.rate * (up - down)


def wander(rng: np.random.Generator, rate_rms: float, slow: float = 0.08, fast: float = 0.5, count: int = 5) -> Curve:
    """A slow irregular wave whose derivative has this root mean square, of frequencies [Hz] between the two."""
    frequencies = np.exp(rng.uniform(np.log(slow), np.log(fast), count))
    share = rng.dirichlet(np.ones(count))
    amplitudes = rate_rms * np.sqrt(2.0 * share) / (2.0 * np.pi * frequencies)
    return Curve(
        0.0,
        [
            (float(a), float(f), float(rng.uniform(0.0, 2.0 * np.pi)))
            for a, f in zip(amplitudes, frequencies, strict=True)
        ],
    )


def wave(rng: np.random.Generator, amplitude: float, frequency: float) -> tuple[float, float, float]:
    """One wave at any phase."""
    return amplitude, frequency, float(rng.uniform(0.0, 2.0 * np.pi))
