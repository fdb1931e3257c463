"""Several sensors live: one compiled call a sample for all of them, static detector and filter together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import BadData, BadOption
from .covariance import symmetric
from .static import StaticDetector, StaticState


class LiveBank:
    """k sensors that are sampled together, each with its own filter and detector, which may have run before.

    The bank continues from their states, on a copy, with bit-identical results. `update` allocates nothing: the next
    one overwrites its result and the arrays named here.

    Parameters
    ----------
    filters : one a sensor, all of one kind with a `bank_kernel` (`Smekf`)
    detectors : one a sensor, their windows equally long

    Attributes
    ----------
    quat_WS : (k, 4) xyzw
    gyro_bias : (k, 3) [rad/s]
    static : (k,) bool, of the last sample

    Raises
    ------
    BadOption
        Filters of several kinds, or of one that cannot run live; windows of several lengths; numbers that differ.
    """

    def __init__(self, filters: Sequence[Any], detectors: Sequence[StaticDetector]) -> None:
        kinds = {type(filter_).__name__ for filter_ in filters}
        windows = {detector.state.block.shape[1] for detector in detectors}
        if len(kinds) != 1 or not hasattr(filters[0], "bank_kernel"):
            raise BadOption(f"filters of kind {', '.join(sorted(kinds)) or 'none'}: one kind that has a `bank_kernel`")
        if len(windows) != 1 or len(filters) != len(detectors):
            raise BadOption(
                f"{len(filters)} filters and {len(detectors)} detectors with windows of {sorted(windows)} samples: "
                "one of each a sensor and one length are needed"
            )
        self._step = filters[0].bank_kernel
        self._states = np.concatenate([filter_.state.record for filter_ in filters])
        self._models = np.concatenate([filter_.model for filter_ in filters])
        detector_states = zip(*(detector.state for detector in detectors), strict=True)
        self._detectors = StaticState(*map(np.concatenate, detector_states))
        self._shape = (len(filters), 3)
        self.static = np.zeros(len(filters), dtype=np.bool_)
        self.quat_WS = self._states["quat_WS"]
        self.gyro_bias = self._states["gyro_bias"]

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Take a sample of each sensor, `gyro_S` (k, 3) [rad/s], `accel_S` (k, 3) [m/s²]; returns `quat_WS` (k, 4).

        A sensor whose sample did not come has NaN in its row: its rate is held and fades, its covariance grows.
        """
        gyro, accel = np.ascontiguousarray(gyro_S, dtype=float), np.ascontiguousarray(accel_S, dtype=float)
        if gyro.shape != self._shape or accel.shape != self._shape:  # the compiled step would read beyond their ends
            raise BadData(f"gyro_S {gyro.shape} and accel_S {accel.shape}: a row for each of {self._shape[0]} sensors")
        self._step(self._states, self._models, *self._detectors, gyro, accel, self.static)
        return self.quat_WS

    @property
    def attitude_cov(self) -> np.ndarray:
        """Covariance (k, 3, 3) [rad²] of the error on the right, in S; a copy."""
        return symmetric(self._states["attitude_cov"])

    @property
    def about_vertical(self) -> np.ndarray:
        """(k, 6) as `AboutVertical`; a view."""
        return np.asarray(self._states["about_vertical"])


class OneByOne:
    """As `LiveBank`, for filters without a kernel for many: each filter itself is updated, one after the other."""

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

    @property
    def about_vertical(self) -> np.ndarray | None:
        return None


def create_bank(filters: Sequence[Any], detectors: Sequence[StaticDetector]) -> LiveBank | OneByOne:
    """Create a `LiveBank` if the filters have a kernel for it, else `OneByOne`."""
    kind = LiveBank if all(hasattr(filter_, "bank_kernel") for filter_ in filters) else OneByOne
    return kind(filters, detectors)
