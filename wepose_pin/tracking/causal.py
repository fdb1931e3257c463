"""Segment orientations without a look ahead: from the end of the start pose on, sample by sample or many at once.

Both use the same compiled steps, so that a live session and its recording give bit-identical quaternions. The start
pose is filtered when it has ended; later samples change no result.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..alignment import (
    START_POSE_STD,
    Segments,
    align,
    check_mounts,
    compute_heading,
    compute_heading_variance,
    compute_segment_covariance,
    orient_segments,
)
from ..compilation import kernel
from ..errors import BadOption, BadPhase
from ..filters import BEST, Orientation
from ..filters.bank import LiveBank, OneByOne, create_bank
from ..filters.sensors import SensorFilters, combine_chunk
from ..filters.static import StaticTest
from ..kinematics import axis_std
from ..recording import OrientationSensor, Recording, join_recordings
from ..rotations import product
from ..subject import Subject
from .segments import Oriented
from .start_pose import HOLD_S, StartGuide, cut_start_pose

RESET_S = 0.5  # [s] over which the orientation is averaged when headings are set anew


class CausalEstimator:
    """Segment orientations from the end of the start pose on, chunk by chunk (`push`) or sample by sample (`step`).

    Without `phases.start` the start pose is the first `HOLD_S` in which nothing moves. Headings are set anew before
    each of `Recording.resets`. An estimator that was stepped takes no more chunks.

    Parameters
    ----------
    subject : lengths and mounts; None for the session's stated mounts
    """

    def __init__(
        self, subject: Subject | None = None, *, method: str = BEST, static_test: StaticTest | None = None
    ) -> None:
        self._subject, self._method, self._static_test = subject, method, static_test
        self._so_far: Recording | None = None  # samples until the end of the start pose
        self._guide: StartGuide | None = None
        self._follower: SegmentFollower | None = None
        self._tracked = False

    @property
    def follower(self) -> SegmentFollower:
        """The segment orientations after the start pose, sample by sample.

        Raises
        ------
        BadPhase
            The start pose has not ended.
        """
        if self._follower is None:
            raise BadPhase("the start pose has not ended: push a recording that includes it")
        return self._follower

    def push(self, chunk: Recording) -> list[Oriented]:
        """Take a chunk; gives its part after the start pose, and its segments.

        Raises
        ------
        WeposeError
            A sensor with measured orientations, or without a known mount; as `SensorFilters`.
        """
        if self._follower is None:
            chunk = self._find_start(chunk)
        if self._follower is None or not len(chunk):
            return []
        self._tracked = True
        return [(chunk, self._follower.run(chunk))]

    def finish(self) -> list[Oriented]:
        """Nothing is left when the last chunk has been pushed.

        Raises
        ------
        BadPhase
            There was no start pose, or nothing after it.
        """
        if self._tracked:
            return []
        recording = self._so_far
        if self._follower is None and self._guide is not None and recording is not None:
            raise BadPhase(
                f"{recording.where()}: nobody stands still for {HOLD_S:g} s ({self._guide.held_s:.1f} s at its end); "
                f"state the seconds of the start pose, [phases] start = [[from, to]]"
            )
        where = "" if recording is None else f"{recording.where()}: "
        raise BadPhase(f"{where}phases.start ends with the recording; nothing is left to track")

    def _find_start(self, chunk: Recording) -> Recording:
        """The part of a chunk after the start pose; the whole chunk while the start pose has not ended."""
        for name, sensor in chunk.sensors.items():
            if isinstance(sensor, OrientationSensor):
                raise BadOption(
                    f"{chunk.where()}: sensors.{name} comes with measured orientations: there is no filter to run "
                    f"causally; leave the option out"
                )
        so_far = chunk if self._so_far is None else join_recordings(self._so_far, chunk)
        self._so_far = so_far
        if so_far.phases.get("start"):
            interval = so_far.phases["start"][0]
            if so_far.time[-1] < interval[1] - 1e-9:
                return chunk
            last = so_far.span(interval).stop
        else:
            if self._guide is None:
                self._guide = StartGuide(so_far.rate_hz, len(so_far.sensors))
            rates = [sensor.gyro_S for sensor in chunk.imus.values()]
            for tick in np.stack(rates, axis=1):
                if self._guide.push(tick) == "ready":
                    break
            else:
                return chunk
            interval = float(so_far.time[self._guide.begin]), float(so_far.time[self._guide.end])
            last = self._guide.end + 1
        start_pose = replace(cut_start_pose(so_far, interval), start_is_guessed=not so_far.phases.get("start"))
        self._follower = SegmentFollower(start_pose, self._subject, method=self._method, static_test=self._static_test)
        return so_far.cut(slice(last, len(so_far)))


class SegmentFollower:
    """Segment orientations after a start pose; k sensors in the order of `names`.

    Parameters
    ----------
    until : a recording that ends with its start pose, `phases.start`
    subject : lengths and mounts; None for the session's stated mounts

    Attributes
    ----------
    start : `Segments` of the start pose: mounts, headings, diagnostics
    heading : (k,) ψ [rad] from each sensor's world to W
    quat_WL, static, gyro_bias : (k, 4) xyzw, (k,), (k, 3) [rad/s] after the last step; overwritten by the next
    """

    def __init__(
        self,
        until: Recording,
        subject: Subject | None = None,
        *,
        method: str = BEST,
        static_test: StaticTest | None = None,
    ) -> None:
        check_mounts(until, subject)
        self._filters = SensorFilters(until, method=method, static_test=static_test)
        _, orientation = self._filters.push(until) or self._filters.finish()
        alignment = align(until, subject, combine_chunk(self._filters, until, orientation))
        self.start = orient_segments(until, alignment, orientation, subject)
        self.names = tuple(until.sensors)
        self.rate_hz = until.rate_hz
        started = [orientation[name] for name in self.names]
        self._bank: LiveBank | OneByOne = create_bank(
            [of.filter for of in started if of.filter is not None],
            [of.detector for of in started if of.detector is not None],
        )
        self._so_far, self._subject = until, subject
        self._mount = np.array([self.start.quat_LS[name] for name in self.names])
        self.heading = np.array([self.start.heading[name] for name in self.names])
        self._turn = _about_z(self.heading)
        self._recent = np.stack([of.quat_WS for of in started], axis=1)[-max(1, round(RESET_S * self.rate_hz)) :].copy()
        self._oldest = 0  # its place in `_recent`
        self.quat_WL = np.zeros((len(self.names), 4))
        _place_segments(self._turn, self._recent[-1:], self._mount, self.quat_WL, self.quat_WL[None].copy())
        self._run_var = self.heading_var()  # (k,) [rad²] of each heading by its filter alone, after the last run
        self._var_at_reset: np.ndarray | None = None  # (k,) [rad²] of heading that a reset took away

    @property
    def static(self) -> np.ndarray:
        return self._bank.static

    @property
    def gyro_bias(self) -> np.ndarray:
        return self._bank.gyro_bias

    def step(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """`quat_WL` (k, 4) after one sample, (k, 3) [rad/s], (k, 3) [m/s²], NaN where a sensor is lost."""
        self._recent[self._oldest] = self._bank.update(gyro_S, accel_S)
        newest = self._recent[self._oldest : self._oldest + 1]
        _place_segments(self._turn, newest, self._mount, self.quat_WL, self.quat_WL[None])
        self._oldest = (self._oldest + 1) % len(self._recent)
        return self.quat_WL

    def run(self, chunk: Recording) -> Segments:
        """The segments of many samples, bit-identical with as many steps."""
        resets = {tick for tick in chunk.resets if 0 <= tick < len(chunk)}  # two at once are one
        parts = []
        for begin, end in pairwise(sorted({0, *resets, len(chunk)})):
            if begin in resets:
                self.reset_headings(self._run_var)
            parts.append(self._run(chunk.cut(slice(begin, end))))
        return parts[0] if len(parts) == 1 else _join_segments(chunk, parts)

    def _run(self, chunk: Recording) -> Segments:
        """As `run`, without a reset."""
        _, orientation = self._filters.push(chunk) or self._filters.finish()
        quat_VS = np.stack([orientation[name].quat_WS for name in self.names], axis=1)
        quat_WL = np.empty(quat_VS.shape)
        _place_segments(self._turn, quat_VS, self._mount, self.quat_WL, quat_WL)
        self._recent = np.concatenate([self._order_recent(), quat_VS])[-len(self._recent) :].copy()
        self._oldest = 0
        covariance_W = {}
        covs = {name: of.attitude_cov for name, of in orientation.items() if of.attitude_cov is not None}
        if covs:
            last = np.stack([covs[name][-1] for name in self.names])
            self._run_var = compute_heading_variance(quat_VS[-1], last)
            covariance_W = {name: self._covariance_W(i, quat_VS[:, i], covs[name]) for i, name in enumerate(self.names)}
        return replace(
            self.start,
            time=chunk.time,
            quat_WL={name: quat_WL[:, i] for i, name in enumerate(self.names)},
            heading={name: float(self.heading[i]) for i, name in enumerate(self.names)},
            orientation=orientation,
            covariance_W=covariance_W,
        )

    def reset_headings(self, heading_var: np.ndarray | None = None) -> None:
        """Set headings anew: the person stands in the start pose again, and has for `RESET_S`.

        `heading_var` (k,) [rad²]: the filters' variance of the heading, which the reset ends; None
        for that of the last step.
        """
        recent = self._order_recent()
        same_sign = recent * np.sign(np.einsum("nki,ki->nk", recent, recent[-1]))[:, :, None]
        mean = same_sign.sum(axis=0)
        mean /= np.linalg.norm(mean, axis=1)[:, None]
        for i in range(len(self.names)):
            self.heading[i] = compute_heading(Rotation.from_quat(mean[i]), Rotation.from_quat(self._mount[i]))
        self._turn = _about_z(self.heading)
        self._var_at_reset = heading_var if heading_var is not None else self.heading_var()

    def heading_var(self) -> np.ndarray | None:
        """(k,) [rad²] variance of each heading by its filter alone, after a step; None where the filter has none."""
        cov = self._bank.attitude_cov
        return None if cov is None else compute_heading_variance(self._recent[self._oldest - 1], cov)

    def heading_std(self) -> np.ndarray:
        """(k,) [rad] one standard deviation of each segment's heading, as `track` states it: the mounts' part too.

        NaN where the filter has none.
        """
        return np.sqrt([cov[2, 2] for cov in self._covariances_W()])

    def std(self) -> np.ndarray:
        """(k,) [rad] one standard deviation of an axis of each segment; NaN where the filter has none."""
        return axis_std(self._covariances_W())

    def _covariances_W(self) -> np.ndarray:
        """(k, 3, 3) [rad²] of each segment in W after the last step; NaN where the filter has none."""
        cov = self._bank.attitude_cov
        if cov is None:
            return np.full((len(self.names), 3, 3), np.nan)
        now = self._recent[self._oldest - 1]
        return np.concatenate([self._covariance_W(i, now[i : i + 1], cov[i : i + 1]) for i in range(len(cov))])

    def _covariance_W(self, i: int, quat_VS: np.ndarray, attitude_cov: np.ndarray) -> np.ndarray:
        """(n, 3, 3) [rad²] of sensor i's segment in W, error on the left of `quat_WL`, since the last reset.

        As `alignment.compute_segment_covariance`; after a reset the heading's error is that of the pose, plus drift.
        """
        R_WS = Rotation.from_rotvec([0.0, 0.0, self.heading[i]]) * Rotation.from_quat(quat_VS)
        mount = Rotation.from_quat(self._mount[i])
        cov = compute_segment_covariance(self._so_far, self.names[i], self._subject, R_WS, mount, attitude_cov)
        if self._var_at_reset is not None:
            var = compute_heading_variance(quat_VS, attitude_cov)
            grown = np.maximum(0.0, var - self._var_at_reset[i])
            # The mount's part of the heading stays: the reset has set that of the start pose alone.
            share = np.sqrt((np.maximum(cov[:, 2, 2] - var, 0.0) + grown + START_POSE_STD**2) / cov[:, 2, 2])
            cov[:, 2, :] *= share[:, None]
            cov[:, :, 2] *= share[:, None]
        return cov

    def _order_recent(self) -> np.ndarray:
        return np.concatenate([self._recent[self._oldest :], self._recent[: self._oldest]])


def _join_segments(chunk: Recording, parts: list[Segments]) -> Segments:
    """Segments of a chunk from those of its parts; headings are the last one's."""

    def orientation(name: str) -> Orientation:
        rows = [part.orientation[name] for part in parts]
        covs = [of.attitude_cov for of in rows if of.attitude_cov is not None]
        quat_WS, gyro_bias, static = (
            np.concatenate([getattr(of, field) for of in rows]) for field in ("quat_WS", "gyro_bias", "static")
        )
        return rows[-1]._replace(
            quat_WS=quat_WS, gyro_bias=gyro_bias, static=static, attitude_cov=np.concatenate(covs) if covs else None
        )

    last = parts[-1]
    return replace(
        last,
        time=chunk.time,
        quat_WL={name: np.concatenate([part.quat_WL[name] for part in parts]) for name in last.quat_WL},
        orientation={name: orientation(name) for name in last.orientation},
        covariance_W={name: np.concatenate([part.covariance_W[name] for part in parts]) for name in last.covariance_W},
    )


def _about_z(angle: np.ndarray) -> np.ndarray:
    return rotations.exp(angle[:, None] * [0.0, 0.0, 1.0])


@kernel
def _place_segments(turn, quat_VS, mount, last, out):  # type: ignore[no-untyped-def]
    """``turn ⊗ quat_VS ⊗ mount⁻¹`` for each of n ticks and k sensors, of the sign that is nearer to `last` (k, 4)."""
    for n in range(len(quat_VS)):
        for k in range(len(turn)):
            ax, ay, az, aw = turn[k, 0], turn[k, 1], turn[k, 2], turn[k, 3]
            bx, by, bz, bw = quat_VS[n, k, 0], quat_VS[n, k, 1], quat_VS[n, k, 2], quat_VS[n, k, 3]
            x, y, z, w = product(ax, ay, az, aw, bx, by, bz, bw)
            rx, ry, rz, rw = product(x, y, z, w, -mount[k, 0], -mount[k, 1], -mount[k, 2], mount[k, 3])
            sign = 1.0
            if rx * last[k, 0] + ry * last[k, 1] + rz * last[k, 2] + rw * last[k, 3] < 0.0:
                sign = -1.0
            last[k, 0], last[k, 1], last[k, 2], last[k, 3] = sign * rx, sign * ry, sign * rz, sign * rw
            out[n, k, 0], out[n, k, 1], out[n, k, 2], out[n, k, 3] = last[k, 0], last[k, 1], last[k, 2], last[k, 3]
