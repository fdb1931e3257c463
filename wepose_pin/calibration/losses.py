"""What a sensor lost between the start pose and the motion: its heading there is not that of the start pose.

A filter finds its tilt again from gravity, sooner or later, its heading never. So each loss between the start pose and
a look is an unknown of its own, a step of the heading, and a closure tells it. What is seen of a sensor only beyond a
long loss says where it points then, and nothing of how it sits on its segment.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from ..alignment import vertical_var
from ..errors import BadPhase
from ..filters import Orientation
from ..filters.smekf import HOLD_S, UNSEEN_RATE_STD
from ..recording import OrientationSensor, Recording, span_text
from ..recording.gaps import runs

HEADING_STD = np.pi / np.sqrt(3.0)  # [rad] of a heading that nothing tells: the whole circle
FREE_STD = np.deg2rad(15.0)  # [rad] of a step from which on the heading after it may be any
TILT_STD = np.deg2rad(5.0)  # [rad] of a tilt that the filter has not found again


class Loss(NamedTuple):
    """Samples `first` to `last` that one sensor lost, after the start pose or before it."""

    sensor: str
    first: int
    last: int
    after: bool
    std: float  # [rad] by which the heading may have stepped

    @property
    def free(self) -> bool:
        """The heading beyond it may be any."""
        return self.std > FREE_STD

    def beyond(self, samples: np.ndarray) -> np.ndarray:
        """(n,) bool: the loss lies between the start pose and these samples (n,)."""
        return samples > self.last if self.after else samples < self.first


def losses_of(recording: Recording, start: tuple[float, float], sensors: Collection[str]) -> list[Loss]:
    """What these sensors lost, those aside that fuse by themselves; `start` [s] is the start pose."""
    begin, losses = recording.span(start).start, []
    for name in sensors:
        sensor = recording.sensors[name]
        if sensor.gap is None or isinstance(sensor, OrientationSensor):
            continue
        for first, end in runs(sensor.gap):
            seconds = (end - first + 1) / recording.rate_hz
            std = min(HEADING_STD, UNSEEN_RATE_STD * seconds**2 / (seconds + HOLD_S))
            losses.append(Loss(name, first, end - 1, first >= begin, std))
    return losses


def tilted(orientation: Orientation, samples: np.ndarray) -> np.ndarray:
    """(n,) bool: at which samples (n,) the filter does not know the tilt; it says so where it has a covariance."""
    if orientation.attitude_cov is None:
        return np.zeros(len(samples), dtype=bool)
    cov = orientation.attitude_cov[samples]
    heading_var = vertical_var(orientation.quat_WS[samples], cov)
    return np.trace(cov, axis1=1, axis2=2) - heading_var > 2.0 * TILT_STD**2


def connected(losses: Sequence[Loss], samples: np.ndarray) -> np.ndarray:
    """(n,) bool: none of the losses lies between the start pose and these samples (n,)."""
    apart = np.zeros(len(samples), dtype=bool)
    for loss in losses:
        apart |= loss.beyond(samples)
    return ~apart


def steps_of(losses: Sequence[Loss], samples: np.ndarray) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Steps of headings that samples (n,) see: the sensor of each, its standard deviation (m,) [rad], beyond (m, n).

    Losses of a sensor between which there is no sample are one step.
    """
    variances: dict[tuple[str, bytes], float] = {}
    for loss in losses:
        beyond = loss.beyond(samples)
        if beyond.any():
            step = loss.sensor, beyond.tobytes()
            variances[step] = variances.get(step, 0.0) + loss.std**2
    std = np.minimum(np.sqrt(list(variances.values())), HEADING_STD)
    beyond = np.array([np.frombuffer(step[1], dtype=bool) for step in variances]).reshape(-1, len(samples))
    return tuple(name for name, _ in variances), std, beyond


def need_start_pose(
    recording: Recording, losses: Sequence[Loss], samples: np.ndarray, unknown: Collection[str], least: int
) -> None:
    """Raises `BadPhase` where the motion does not tell how a sensor sits: it, or the torso's, lost samples before.

    Parameters
    ----------
    samples : (n,) of the looks
    unknown : sensors of the chain whose mount is not known
    least : looks that are needed
    """
    for name in unknown:
        between = [loss for loss in losses if loss.sensor in (name, "torso") and loss.free]
        if name == "torso" or np.count_nonzero(connected(between, samples)) >= least:
            continue
        worst = max(between, key=lambda loss: np.count_nonzero(loss.beyond(samples)))
        span = span_text(recording.time[[worst.first, worst.last]])
        raise BadPhase(
            f"{recording.where()}: sensors.{worst.sensor} is lost from {span}, between the start pose and the motion, "
            f"and its heading with it: how sensors.{name} sits is not to be found; state its mount, name a start pose "
            f"and a motion with nothing lost between them, or record again"
        )
