"""Correction of headings by what neighbouring segments share: joint accelerations, hinges, joined hands.

The filters' tilt is good and their headings drift. Time is cut into intervals of equal length, the knots, and
`heading_filter` estimates one error of each heading a knot; an error common to all segments is unobservable. Offline a
Rauch-Tung-Striebel pass backward follows. Causally what a knot shows is corrected over the next one.
"""

import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from tempfile import SpooledTemporaryFile
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..filters.butterworth import filter_chunk, settle_band_pass
from ..observations import BAND_HZ, compute_sides
from .heading_filter import HeadingFilter, symmetric

E_Z = np.array([0.0, 0.0, 1.0])
MOST_IN_MEMORY = 2**27  # [bytes] of the states of knots; more are in a temporary file


@dataclass(frozen=True)
class HeadingCorrection:
    """The correction of the headings of k segments at m knots, and what was observed."""

    filter: HeadingFilter  # which estimated them
    time: np.ndarray  # (m,) [s] of the knots
    errors: np.ndarray  # (m, k) [rad] that are corrected, on the left in W
    covariance: np.ndarray  # (m, k, k) [rad²] of the errors of the sensors' heading offsets
    segment_covariance: np.ndarray  # (m, k, k) [rad²] of the segments' headings
    filtered: np.ndarray  # (m, k) [rad] by which the orientation filters had corrected their headings by then

    @property
    def max_correction_deg(self) -> dict[str, float]:
        """Segment → largest rotation about the vertical."""
        largest = np.degrees(np.max(np.abs(self.errors), axis=0, initial=0.0))
        return dict(zip(self.filter.names, largest.tolist(), strict=True))

    def interpolate(self, time: np.ndarray, filtered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the corrections (n, k) [rad] and the variances (n, k) [rad²] of segments' headings at times [s].

        `filtered` (n, k) [rad] is that of the orientation filters at these times: what is interpolated has none of it.
        """
        variances = np.diagonal(self.segment_covariance, axis1=1, axis2=2)
        knots = np.hstack([self.errors + self.filtered, variances])
        at_times = np.column_stack([np.interp(time, self.time, values) for values in knots.T])
        return at_times[:, : variances.shape[1]] - filtered, at_times[:, variances.shape[1] :]

    def correlate_segments(
        self, time: np.ndarray, segment_cov: Mapping[str, np.ndarray]
    ) -> dict[tuple[str, str], np.ndarray]:
        """Return two segments → the covariance (n,) [rad²] of their headings at these times [s].

        Neighbours share what one tells of the other. Where `segment_cov` (n, 3, 3) [rad²] in W, given for each segment,
        states less than the heading filter knew, the correlation stays and the covariance shrinks.
        """
        rows, scale = {name: i for i, name in enumerate(self.filter.names) if name in segment_cov}, {}
        for name, i in rows.items():
            # As much as the heading is uncertain where the tilt is known may be shared with other segments.
            own = np.linalg.det(segment_cov[name]) / np.linalg.det(segment_cov[name][:, :2, :2])
            with np.errstate(divide="ignore"):
                scale[name] = np.sqrt(np.clip(own / self._read(self.segment_covariance[:, i, i], time), 0.0, 1.0))
        return {
            (a, b): scale[a] * scale[b] * self._read(self.segment_covariance[:, rows[a], rows[b]], time)
            for a, b in combinations(rows, 2)
        }

    def _read(self, values: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Return what is known (n,) at these times [s] of `values` (m,) at the knots.

        Causally a knot is used after the next one, and before the first nothing is known.
        """
        if not self.filter.causal:
            return np.asarray(np.interp(time, self.time, values))
        knots = np.searchsorted(self.time, time - self.filter.knot_s, side="right")
        return np.concatenate(([0.0], values))[knots]


class HeadingCorrector:
    """Corrects headings as samples come, or by `smooth` after the last one.

    Causally the correction by a complete knot fades in over the next one. Offline nothing is corrected yet.

    Parameters
    ----------
    offset : (k,) ψ [rad] to which corrections are added

    Attributes
    ----------
    variance : (3, k) [rad²] after the last knot: variances of each segment's heading and of its filter's alone, and
        the squared correction of the headings since the start or the last reset, with what that is less certain by
    """

    def __init__(self, heading_filter: HeadingFilter, offset: np.ndarray) -> None:
        self.filter, self.offset, k = heading_filter, offset, len(offset)
        self._quat_WV = rotations.rotation_about(E_Z, offset)
        # Of the joint accelerations: their band-pass, and the last two samples of the last knot.
        self._band: tuple[np.ndarray, np.ndarray] | None = None
        self._last_R_WS, self._last_accel_S = np.zeros((2, k, 3, 3)), np.zeros((2, k, 3))
        self._size, self._count = self.filter.stride * self.filter.samples_per_knot, 0  # samples of the open knot
        self._quat_VS, self._accel_S = np.zeros((self._size, k, 4)), np.zeros((self._size, k, 3))
        self._clasped = np.zeros(self._size, dtype=bool)
        self._from, self._to, self._at_reset = np.zeros((3, k))
        self._start_cov = self.filter.start_cov
        self._var_at_knot = np.zeros(k)  # [rad²] of the filters, at the last knot
        self._times: list[float] = []  # [s] of the knots: their ends, offline their middles
        self._filtered: list[np.ndarray] = []  # as of `HeadingCorrection`
        # Of each knot causally: what was corrected, as `HeadingFilter.estimate`.
        self._history = list[tuple[np.ndarray, np.ndarray, np.ndarray]]()
        # Offline: x, P, and what led to them; of a day 2 GB.
        self._states = SpooledTemporaryFile(MOST_IN_MEMORY)  # noqa: SIM115 - it lives as long as this
        weakref.finalize(self, self._states.close)
        self._set_variance(self._estimate()[2])

    @property
    def fade(self) -> tuple[np.ndarray, np.ndarray, int, int]:
        """How the correction fades in: from and to (k,) [rad], number of the next sample, number of samples."""
        return self._from, self._to, self._count, self._size

    @property
    def remaining(self) -> int:
        """Number of samples until the knot is complete."""
        return self._size - self._count

    def push(self, quat_VS: np.ndarray, accel_S: np.ndarray, clasped: np.ndarray | bool) -> bool:
        """Add up to `remaining` samples; return whether the knot is complete.

        `quat_VS` is (n, k, 4) xyzw, `accel_S` (n, k, 3) [m/s²], NaN where lost, `clasped` (n,) bool: joined palms.
        """
        rows = slice(self._count, self._count + len(quat_VS))
        self._quat_VS[rows], self._accel_S[rows], self._clasped[rows] = quat_VS, accel_S, clasped
        self._count += len(quat_VS)
        return self._count == self._size

    def close(self, filters: np.ndarray, end: float | None = None) -> None:
        """Close the open knot; `filters` (5, k) is after its last sample at `end` [s]; None: not collected."""
        n, rows = slice(self._count), slice(None, self._count, self.filter.stride)
        quat_WS, accel_S = rotations.multiply(self._quat_WV, self._quat_VS[n]), self._accel_S[n]
        sides = np.zeros((0, *accel_S.shape[1:], 8))
        if self.filter.pairs:
            R_WS = Rotation.from_quat(quat_WS.reshape(-1, 4)).as_matrix().reshape(*quat_WS.shape[:2], 3, 3)
            sides = self._filter_sides(R_WS, accel_S)[rows]
        lost = np.asarray(np.isnan(accel_S).any(axis=(0, 2)))
        quat_WL = rotations.multiply(quat_WS[rows], self.filter.quat_SL)
        self.filter.step(quat_WL, sides, self._clasped[rows], lost, filters)
        last, self._count = self._count - 1, 0
        if end is not None:
            self._filtered.append(np.nan_to_num(filters[1]))
        if not self.filter.causal:
            if end is not None:
                knot = self.filter.x, self.filter.P, *self.filter.process
                self._states.write(np.concatenate([values.ravel() for values in knot]).tobytes())
                self._times.append(end - 0.5 * last / self.filter.sensor_rate_hz)
            return
        errors, covariance, segment_covariance = self._estimate()
        self._from, self._to = self._to, errors
        if end is not None:
            self._history.append((self._to, covariance, segment_covariance))
            self._times.append(end)
        self._var_at_knot = np.nan_to_num(filters[0])
        self._set_variance(segment_covariance)

    def _filter_sides(self, R_WS: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Return the side B (n, k, 3, 8) of each sensor at its joints, band-passed, one sample late.

        `R_WS` is (n, k, 3, 3), `accel_S` (n, k, 3) [m/s²], NaN where lost; where samples are lost B is of no use.
        """
        rate_hz, accel_S = self.filter.sensor_rate_hz, np.concatenate([self._last_accel_S, accel_S])
        lost = ~np.isfinite(accel_S).all(axis=2)
        for i in np.flatnonzero(lost.any(axis=0)):
            accel_S[:, i] = accel_S[np.maximum.accumulate(np.where(lost[:, i], 0, np.arange(len(accel_S)))), i]
        if self._band is None:
            self._last_R_WS, accel_S[:2] = np.repeat(R_WS[:1], 2, axis=0), accel_S[2]
            steady = compute_sides(np.repeat(R_WS[:1], 3, axis=0), np.repeat(accel_S[2:3], 3, axis=0), rate_hz)
            self._band = settle_band_pass(BAND_HZ, rate_hz, steady.ravel())
        R_WS = np.concatenate([self._last_R_WS, R_WS])
        self._last_R_WS, self._last_accel_S = R_WS[-2:], accel_S[-2:]
        B = compute_sides(R_WS, accel_S, rate_hz)
        return filter_chunk(*self._band, B.reshape(len(B), -1)).reshape(B.shape)

    def reset(self, heading_offset: np.ndarray) -> None:
        """Correct the headings to ψ (k,) [rad] at once, as the person shows them by standing in the start pose."""
        error = heading_offset - self.offset
        error = error + 2.0 * np.pi * np.round((self._to - error) / (2.0 * np.pi))
        self.filter.reset(error, again=True)
        self._from = self._to = self._at_reset = error
        self._set_variance(self._estimate()[2])

    def _estimate(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.filter.estimate(self.filter.x, self.filter.P)

    def _set_variance(self, segment_covariance: np.ndarray) -> None:
        left, correction = self._to - self._from, self._to - self._at_reset  # until it has faded in
        other = correction**2 + np.diag(self.filter.start_cov - self._start_cov)
        self.variance = np.array([np.diag(segment_covariance) + left**2, self._var_at_knot, other])

    def collect(self, knots: Sequence[tuple[Any, ...]] | None = None) -> HeadingCorrection:
        """Return what was observed and corrected causally so far; or `knots`, as `HeadingFilter.estimate` each."""
        knots, k = self._history if knots is None else knots, len(self.offset)
        columns = zip(((k,), (k, k), (k, k)), zip(*knots, strict=True) if knots else ((), (), ()), strict=True)
        errors, cov, segment_cov = (np.array(values).reshape(-1, *shape) for shape, values in columns)
        filtered = np.reshape(self._filtered, errors.shape)
        return HeadingCorrection(self.filter, np.array(self._times), errors, cov, segment_cov, filtered)

    def smooth(self, filters: np.ndarray, end: float) -> HeadingCorrection | None:
        """Smooth all knots (Rauch, Tung, Striebel 1965), `filters` (5, k) after the last sample at `end` [s].

        None: there is no knot.
        """
        forward = self.filter
        if self._count:
            self.close(filters, end)
        if not self._times:
            return None
        x, P, process = self._read_state(len(self._times) - 1)
        estimates = [forward.estimate(x, P)]
        for knot in range(len(self._times) - 2, -1, -1):
            before_x, before_P, process_before = self._read_state(knot)
            forward.x, forward.P = before_x, before_P
            forward.predict(process)
            gain = np.linalg.solve(forward.P, forward.advance(before_P, process[2])).T
            x = before_x + gain @ (x - forward.x)
            P = symmetric(before_P + gain @ (P - forward.P) @ gain.T)
            estimates.append(forward.estimate(x, P))
            process = process_before
        return self.collect(estimates[::-1])

    def _read_state(self, knot: int) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return x, P and `HeadingFilter.process` of a knot."""
        n, k = len(self.filter.x), len(self.offset)
        ends = np.cumsum([n, n * n, n, n, k])
        self._states.seek(8 * ends[-1] * knot)
        x, P, change, variance, turn = np.split(np.frombuffer(self._states.read(8 * ends[-1])), ends[:-1])
        return x, P.reshape(n, n), (change, variance, turn)
