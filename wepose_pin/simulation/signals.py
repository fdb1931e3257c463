"""Smooth signals of continuous time: steps and pulses with their integrals, and random processes.

All are closed forms, exact between the samples, with four continuous derivatives at least.
"""

from collections.abc import Mapping

import numpy as np

Streams = Mapping[str, np.random.Generator]  # of random numbers, by their names
_TOP_RATE = 2.0 * np.pi * 1.0  # [rad/s] the fastest wave of a `Process`: limbs' tissue follows slower motion than that
_WAVES = 12


def make_step(t: np.ndarray, start: float, duration: float) -> np.ndarray:
    """Make a step (n,): 0 before `start`, 1 after `start + duration`, with four continuous derivatives."""
    x = np.clip((t - start) / duration, 0.0, 1.0)
    return x**5 * (126.0 + x * (-420.0 + x * (540.0 + x * (-315.0 + x * 70.0))))


def make_pulse(t: np.ndarray, start: float, stop: float, ramp: float) -> np.ndarray:
    """Make a pulse (n,): 1 between `start + ramp` and `stop - ramp`, exactly 0 outside `start` and `stop`."""
    return make_step(t, start, ramp) * (1.0 - make_step(t, stop - ramp, ramp))


def integrate_step(t: np.ndarray, start: float, duration: float) -> np.ndarray:
    """Integrate `make_step` up to the times `t` (n,); in seconds."""
    x = np.clip((t - start) / duration, 0.0, 1.0)
    inner = x**6 * (21.0 + x * (-60.0 + x * (67.5 + x * (-35.0 + x * 7.0))))
    return duration * inner + np.maximum(t - start - duration, 0.0)


class Process:
    """A random process (k components) of rms 1 with nearly the spectrum of a first-order (Ornstein-Uhlenbeck) one.

    Each component is a sum of sinusoids of equal size, one from each of as many equal parts of the variance of the
    first-order process below 1 Hz, so that its correlation time is that of the process and its derivatives exist.
    """

    def __init__(self, rng: np.random.Generator, correlation_s: float, components: int) -> None:
        shape = (components, _WAVES)
        share = (np.arange(_WAVES) + rng.uniform(0.0, 1.0, shape)) / _WAVES
        share *= 2.0 / np.pi * np.arctan(_TOP_RATE * correlation_s)
        self.omega = np.tan(0.5 * np.pi * share) / correlation_s  # [rad/s]
        self.phase = rng.uniform(0.0, 2.0 * np.pi, shape)

    def __call__(self, t: np.ndarray, components: slice = slice(None)) -> np.ndarray:
        """Return the values (n, k) of some components at the times `t` (n,) [s]."""
        waves = np.sin(t[:, None, None] * self.omega[components] + self.phase[components])
        return np.sqrt(2.0 / _WAVES) * waves.sum(axis=2)


class RandomWalk:
    """A smooth random walk (k components) from 0, of variance t/duration: the first terms of its Karhunen-Loève sum."""

    def __init__(self, rng: np.random.Generator, duration: float, components: int) -> None:
        self.rate = (np.arange(20) + 0.5) * np.pi / duration  # [rad/s]
        self.size = np.sqrt(2.0) * rng.standard_normal((components, 20)) / (self.rate * duration)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Return the values (n, k) at the times `t` (n,) [s]."""
        return np.sin(t[:, None] * self.rate) @ self.size.T


class Wander:
    """A smooth random signal between -1 and 1: four sinusoids of 0.1 to 0.6 Hz, limited by tanh."""

    def __init__(self, rng: np.random.Generator) -> None:
        # One frequency from each part of the band: every seed gives slow and fast parts.
        self.frequency_hz = np.array((0.1, 0.2, 0.33, 0.46)) + rng.uniform(0.0, 0.13, 4)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, 4)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        waves = np.sin(t[:, None] * (2.0 * np.pi * self.frequency_hz) + self.phase)
        return np.tanh(0.9 * (waves / np.sqrt(10.0 * self.frequency_hz)).sum(axis=1))


class Sway:
    """A slow sway about x and y: three sinusoids of 0.3 to 0.5 Hz each, with a total rms rate of 1 rad/s."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.omega = 2.0 * np.pi * (np.array((0.3, 0.37, 0.44)) + rng.uniform(0.0, 0.06, (2, 3)))  # [rad/s]
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Angles (n, 2) [rad]."""
        waves = np.sin(self.omega * t[:, None, None] + self.phase) / self.omega
        return waves.sum(axis=2) / np.sqrt(3.0)  # each wave has the mean square 1/2, there are six
