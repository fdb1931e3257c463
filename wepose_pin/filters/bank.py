"""Several sensors live: one compiled call a sample for all of them, static detector and filter together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import BadData, BadOption
from .smekf import P_AA, P_AB, symmetric
from .static import StaticDetector, StaticState


class LiveBank:
    """k sensors that are sampled together, each with a filter and a detector made (and perhaps run) on its own.

    The bank goes on from where those are, on a copy of their states, and gives the same bits as they would. Nothing is
    allocated by `update`: what it gives and the arrays named here are overwritten by the next.

    Parameters
    ----------
    filters : one a sensor, all of one kind with a `live` kernel (`Smekf`)
    detectors : one a sensor, their windows equally long

    Attributes
    ----------
    quat_WS : (k, 4) xyzw
    gyro_bias : (k, 3) [rad/s]
    static : (k,) bool, of the last sample

    Raises
    ------
    BadOption
        Filters of several kinds, or of one that cannot run live; windows of several lengths; not as many each.
    """

    def __init__(self, filters: Sequence[Any], detectors: Sequence[StaticDetector]) -> None:
        kinds = {type(filter_).__name__ for filter_ in filters}
        windows = {detector.state.block.shape[1] for detector in detectors}
        if len(kinds) != 1 or not hasattr(filters[0], "live"):
            raise BadOption(f"filters of kind {', '.join(sorted(kinds)) or 'none'}: one kind that has a `live` kernel")
        if len(windows) != 1 or len(filters) != len(detectors):
            raise BadOption(
                f"{len(filters)} filters and {len(detectors)} detectors with windows of {sorted(windows)} samples: "
                "one of each a sensor and one length are needed"
            )
        self._step = filters[0].live
        self._rows = np.stack([filter_.state.row for filter_ in filters])
        self._models = np.stack([filter_.model for filter_ in filters])
        self._still = StaticState(*map(np.concatenate, zip(*(detector.state for detector in detectors), strict=True)))
        self._shape = (len(filters), 3)
        self.static = np.zeros(len(filters), dtype=np.bool_)
        self.quat_WS = self._rows[:, :4]
        self.gyro_bias = self._rows[:, 4:7]

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """`quat_WS` (k, 4) after one sample of each sensor, `gyro_S` (k, 3) [rad/s], `accel_S` (k, 3) [m/s²].

        A sensor whose sample did not come has NaN in its row: its rate is held and fades, its covariance grows.
        """
        gyro, accel = np.ascontiguousarray(gyro_S, dtype=float), np.ascontiguousarray(accel_S, dtype=float)
        if gyro.shape != self._shape or accel.shape != self._shape:  # the compiled step would read beyond their ends
            raise BadData(f"gyro_S {gyro.shape} and accel_S {accel.shape}: a row for each of {self._shape[0]} sensors")
        self._step(self._rows, self._models, *self._still, gyro, accel, self.static)
        return self.quat_WS

    @property
    def attitude_cov(self) -> np.ndarray:
        """(k, 3, 3) [rad²] of the error on the right, in S; a copy."""
        return symmetric(self._rows[:, P_AA:P_AB])


class OneByOne:
    """As `LiveBank`, for filters without a kernel for many: each is updated on its own, and goes on itself."""

    def __init__(self, filters: Sequence[Any], detectors: Sequence[StaticDetector]) -> None:
        self._filters, self._detectors = filters, detectors
        self.static = np.zeros(len(filters), dtype=np.bool_)
        self.quat_WS = np.stack([filter_.state.quat_WS for filter_ in filters])
        self.gyro_bias = np.stack([filter_.state.gyro_bias for filter_ in filters])

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """As `LiveBank.update`."""
        for i, (filter_, detector) in enumerate(zip(self._filters, self._detectors, strict=True)):
            self.static[i] = detector.update(gyro_S[i], accel_S[i])
            self.quat_WS[i] = filter_.update(gyro_S[i], accel_S[i], bool(self.static[i]))
            self.gyro_bias[i] = filter_.state.gyro_bias
        return self.quat_WS

    @property
    def attitude_cov(self) -> np.ndarray | None:
        return None


def bank_of(filters: Sequence[Any], detectors: Sequence[StaticDetector]) -> LiveBank | OneByOne:
    """The fastest of the two that these filters allow."""
    kind = LiveBank if all(hasattr(filter_, "live") for filter_ in filters) else OneByOne
    return kind(filters, detectors)
