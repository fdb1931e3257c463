"""Which samples are connected with the start pose: a sensor that was lost in between no longer knows its heading.

After lost samples a filter recovers the tilt from gravity, but never the heading.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..recording import OrientationSensor, Recording
from ..recording.gaps import find_runs

LONGEST_LOSS_S = 0.1  # [s] over which the rate of an arm is interpolated to some degrees


class SampleLoss(NamedTuple):
    """Samples `first` to `last` that one sensor lost."""

    sensor: str
    first: int
    last: int
    after: bool  # the start pose; False: before it

    def beyond(self, samples: np.ndarray) -> np.ndarray:
        """(n,) bool: the loss lies between the start pose and these samples (n,)."""
        return samples > self.last if self.after else samples < self.first


def find_sample_losses(recording: Recording, start: tuple[float, float], sensors: Collection[str]) -> list[SampleLoss]:
    """The losses of these sensors above `LONGEST_LOSS_S`, without those of measured orientations.

    Parameters
    ----------
    start : [s] the start pose
    """
    begin, losses = recording.span(start).start, []
    for name in sensors:
        sensor = recording.sensors[name]
        if sensor.gap is None or isinstance(sensor, OrientationSensor):
            continue
        for first, end in find_runs(sensor.gap):
            if end - first > LONGEST_LOSS_S * recording.rate_hz:
                losses.append(SampleLoss(name, first, end - 1, first >= begin))
    return losses


def find_samples(recording: Recording, intervals: Iterable[tuple[float, float]]) -> np.ndarray:
    """Return the numbers (n,) of the samples in intervals [s], which may overlap: each sample counts once."""
    inside = np.zeros(len(recording), dtype=bool)
    for interval in intervals:
        inside[recording.span(interval)] = True
    return np.flatnonzero(inside)


def mask_measured(recording: Recording, sensors: Collection[str], samples: np.ndarray) -> np.ndarray:
    """Return (n,) bool: all of these sensors measured these samples (n,)."""
    gaps = [recording.sensors[name].gap for name in sensors]
    return ~np.any([np.zeros(len(samples), dtype=bool), *(gap[samples] for gap in gaps if gap is not None)], axis=0)


def mask_connected(losses: Sequence[SampleLoss], samples: np.ndarray) -> np.ndarray:
    """(n,) bool: none of the losses lies between the start pose and these samples (n,)."""
    apart = np.zeros(len(samples), dtype=bool)
    for loss in losses:
        apart |= loss.beyond(samples)
    return ~apart
