"""Heading steps where a sensor lost samples between the start pose and the motion.

After lost samples a filter recovers the tilt from gravity, but never the heading. So each loss between the start pose
and a sample is an unknown heading step, which a closure observes. A sensor that is measured only beyond a long loss
observes nothing of its mount.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from ..alignment import compute_heading_variance
from ..errors import BadPhase
from ..filters import Orientation
from ..filters.smekf import HOLD_S, LOST_RATE_STD
from ..recording import OrientationSensor, Recording, format_span
from ..recording.gaps import find_runs

HEADING_STD = np.pi / np.sqrt(3.0)  # [rad] of an unknown heading: the whole circle
FREE_STD = np.deg2rad(15.0)  # [rad] of a step, above which the heading after it is unknown
TILT_STD = np.deg2rad(5.0)  # [rad] above which the filter has not recovered the tilt


class SampleLoss(NamedTuple):
    """Samples `first` to `last` that one sensor lost."""

    sensor: str
    first: int
    last: int
    after: bool  # the start pose; False: before it
    std: float  # [rad] of the heading step

    @property
    def free(self) -> bool:
        """Whether the heading beyond it is unknown."""
        return self.std > FREE_STD

    def beyond(self, samples: np.ndarray) -> np.ndarray:
        """(n,) bool: the loss lies between the start pose and these samples (n,)."""
        return samples > self.last if self.after else samples < self.first


def find_sample_losses(recording: Recording, start: tuple[float, float], sensors: Collection[str]) -> list[SampleLoss]:
    """The losses of these sensors, without those of measured orientations; `start` [s] is the start pose."""
    begin, losses = recording.span(start).start, []
    for name in sensors:
        sensor = recording.sensors[name]
        if sensor.gap is None or isinstance(sensor, OrientationSensor):
            continue
        for first, end in find_runs(sensor.gap):
            seconds = (end - first + 1) / recording.rate_hz
            std = min(HEADING_STD, LOST_RATE_STD * seconds**2 / (seconds + HOLD_S))
            losses.append(SampleLoss(name, first, end - 1, first >= begin, std))
    return losses


def find_unknown_tilt(orientation: Orientation, samples: np.ndarray) -> np.ndarray:
    """(n,) bool: the filter's covariance of the tilt is large at these samples (n,); False without a covariance."""
    if orientation.attitude_cov is None:
        return np.zeros(len(samples), dtype=bool)
    cov = orientation.attitude_cov[samples]
    heading_var = compute_heading_variance(orientation.quat_WS[samples], cov)
    return np.trace(cov, axis1=1, axis2=2) - heading_var > 2.0 * TILT_STD**2


def mask_connected(losses: Sequence[SampleLoss], samples: np.ndarray) -> np.ndarray:
    """(n,) bool: none of the losses lies between the start pose and these samples (n,)."""
    apart = np.zeros(len(samples), dtype=bool)
    for loss in losses:
        apart |= loss.beyond(samples)
    return ~apart


def group_steps(losses: Sequence[SampleLoss], samples: np.ndarray) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Heading steps before samples (n,): the sensor of each, its standard deviation (m,) [rad], beyond (m, n).

    Losses of a sensor without a sample between them are one step.
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


def check_start_pose(
    recording: Recording,
    losses: Sequence[SampleLoss],
    samples: np.ndarray,
    unknown: Collection[str],
    reference: str,
    min_samples: int,
) -> None:
    """Raise `BadPhase` where lost samples of its sensor or the reference keep the motion from determining a mount.

    Parameters
    ----------
    samples : (n,) of the motion
    unknown : sensors of the chain whose mount is not known
    reference : the sensor that faces x of W in the start pose
    min_samples : least number of samples before which neither the sensor nor the reference lost its heading
    """
    for name in unknown:
        between = [loss for loss in losses if loss.sensor in (name, reference) and loss.free]
        if name == reference or np.count_nonzero(mask_connected(between, samples)) >= min_samples:
            continue
        worst = max(between, key=lambda loss: np.count_nonzero(loss.beyond(samples)))
        span = format_span(recording.time[[worst.first, worst.last]])
        raise BadPhase(
            f"{recording.where()}: sensors.{worst.sensor} is lost from {span}, between the start pose and the motion, "
            f"and its heading with it: the mount of sensors.{name} cannot be estimated; state its mount, name a start "
            f"pose and a motion with nothing lost between them, or record again"
        )
