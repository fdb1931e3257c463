"""Heading correction: what drifts apart between sensors is observed at joined hands and at the elbows' hinges.

The filters' tilt is good and their headings drift. δ_i(t) is the heading error of segment i, R_WL,true = Rz(δ) R_WL, a
random walk whose steps are what the filter's own covariance grows by. Two things measure it, both linear in δ:

- the palm gap in a later `clasp` phase: g + Σ δ_i e_z × v_i = 0, with v_i the link of segment i;
- the elbow of a calibrated subject: the forearm stays in the plane of its hinge, n · R_Uᵀ R_F (−e_z) = 0.

A forward pass and a Rauch-Tung-Striebel pass over knots of a few seconds give δ and its covariance. What is common to
all segments, nothing here sees.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import ATTITUDE_STD, SLIP_STD, START_POSE_STD, Segments, compute_start_heading_var
from ..recording import SEGMENTS, Recording
from ..subject import Subject

CHAIN = SEGMENTS[:5]
HANDS = ("left_hand", "right_hand")  # each in the chain where it has a sensor, else rigid with its forearm
KNOT_S = 2.0
SAMPLE_RATE_HZ = 8.0
# Correlation time of residual errors other than those of headings: soft tissue and remaining errors of the mounts
# recur in every pose, so that a minute of joined hands gives three effective samples. Chosen on simulated people: with
# less, the headings of a good filter get worse.
CORRELATION_S = 20.0
TORSO_START_STD = np.deg2rad(0.5)  # [rad] of the torso's heading at the end of the start pose, which defines x
UNKNOWN_DRIFT = np.deg2rad(3.0) ** 2 / 60.0  # [rad²/s] where a filter has no covariance
OUTLIER_STDS = 5.0  # standard deviations above which palms are not joined, or an elbow is no hinge


class HeadingCorrection(NamedTuple):
    """The correction of headings: residuals before and after, and the largest correction."""

    clasp_mm: tuple[float, float] | None  # rms palm gap in the clasp phases
    hinge_deg: Mapping[str, tuple[float, float]]  # joint → rms of the forearm against the elbow's plane
    largest_deg: Mapping[str, float]  # segment → largest rotation about the vertical


class HeadingCorrector:
    """Corrects the headings of a recording whose chunks come twice: `observe` all, `solve`, then `correct` each.

    The result does not depend on the chunks: sums are taken knot by knot.

    Parameters
    ----------
    chunk : the first
    segments : names of those that are measured
    begin : [s] end of the start pose, after which headings drift

    Attributes
    ----------
    has_chain : whether all segments from hand to hand are measured; without them there is no correction
    has_observations : whether there is a hinge, or a clasp that ends after the start pose
    """

    def __init__(self, chunk: Recording, segments: Collection[str], begin: float, subject: Subject) -> None:
        self.has_chain = set(CHAIN) <= set(segments)
        self._chain = (*CHAIN, *(hand for hand in HANDS if hand in segments))
        self._subject, self._start, self._clasp = subject, begin, chunk.phases.get("clasp", ())
        # A hinge axis is relative to the calibrated mounts and holds as long as they do.
        self._hinges = subject.hinges if not chunk.remounted else {}
        self.has_observations = bool(self._hinges) or any(end >= begin for _, end in self._clasp)
        self._stride = max(1, round(chunk.rate_hz / SAMPLE_RATE_HZ))
        self._share = 1.0 / max(1.0, CORRELATION_S * chunk.rate_hz / self._stride)
        self._first: float | None = None  # [s] of the first sample that is used
        self._counts = [0, 0]  # samples so far, of either pass
        self._incomplete: tuple[np.ndarray, dict[str, np.ndarray]] | None = None  # samples of the last knot
        self._sums: list[tuple[np.ndarray, np.ndarray]] = []  # information and pull of complete knots
        self._observed = False
        self._var: dict[str, list[np.ndarray]] = {}  # name → the filter's heading variance [rad²] at `_recorded` times
        self._recorded = 0
        self._last: dict[str, tuple[float, float]] = {}  # name → time and variance of the last sample
        self._gaps = {when: _Rms() for when in ("before", "after")}
        self._hinge_rms = {when: {joint: _Rms() for joint in self._hinges} for when in ("before", "after")}
        self._largest = dict.fromkeys(self._chain, 0.0)

    def observe(self, chunk: Recording, segments: Segments) -> None:
        """Add a chunk in the first pass."""
        time, quats = self._decimate(chunk, segments, 0)
        if len(time) and self._first is None:
            self._first = float(time[0])
        self._record_variances(chunk, segments)
        if self._incomplete is not None:
            time = np.concatenate([self._incomplete[0], time])
            quats = {name: np.concatenate([self._incomplete[1][name], quat]) for name, quat in quats.items()}
        if not len(time):
            return
        knot = self._knot_of(time)
        complete = int(np.searchsorted(knot, knot[-1]))
        self._incomplete = time[complete:], {name: quat[complete:] for name, quat in quats.items()}
        if complete:
            self._sum_knots(time[:complete], {name: quat[:complete] for name, quat in quats.items()})

    def solve(self) -> bool:
        """Estimate the heading errors; False where nothing observed them."""
        if self._incomplete is None or self._first is None:
            return False
        self._sum_knots(*self._incomplete)
        if not self._observed:
            return False
        information, pull = (np.concatenate(parts) for parts in zip(*self._sums, strict=True))
        middle = self._first + KNOT_S * (np.arange(len(pull)) + 0.5)
        steps = np.full((len(middle), len(self._chain)), UNKNOWN_DRIFT * KNOT_S)
        for i, name in enumerate(self._chain):
            if name in self._var:
                at = np.concatenate(self._var[name])
                at = np.concatenate([at, np.full(len(middle) + 1 - len(at), self._last[name][1])])
                steps[:, i] = np.maximum(np.diff(at), 1e-10)
        delta, self._cov = _smooth_walk(information, pull, steps)
        self._middle, self._delta = middle, delta  # constant before the first middle and after the last
        return True

    def correct(self, chunk: Recording, segments: Segments) -> Segments:
        """The chunk's segments with corrected headings, in the second pass."""
        corrected, covariance = dict(segments.quat_WL), dict(segments.covariance_W)
        for i, name in enumerate(self._chain):
            psi = np.interp(chunk.time, self._middle, self._delta[:, i])
            about_z = Rotation.from_rotvec(psi[:, None] * [0.0, 0.0, 1.0])
            corrected[name] = (about_z * Rotation.from_quat(corrected[name])).as_quat()
            self._largest[name] = max(self._largest[name], float(np.degrees(np.abs(psi).max())))
            filter_cov = _heading_covariance(segments, name)
            if filter_cov is not None:
                variance = np.interp(chunk.time, self._middle, self._cov[:, i, i])
                with_heading, filter_var = filter_cov
                start = compute_start_heading_var(chunk, name, self._subject)
                covariance[name] = _narrow_covariance(covariance[name], with_heading, filter_var + start, variance)
        result = replace(segments, quat_WL=corrected, covariance_W=covariance)
        time, quats = self._decimate(chunk, result, 1)
        self._add_residuals("after", time, {name: Rotation.from_quat(quat) for name, quat in quats.items()})
        return result

    def correction(self) -> HeadingCorrection:
        """The residuals of the chunks so far."""
        gaps, hinge_rms = self._gaps, self._hinge_rms
        return HeadingCorrection(
            clasp_mm=(1e3 * gaps["before"].value, 1e3 * gaps["after"].value) if gaps["before"].count else None,
            hinge_deg={
                joint: (
                    float(np.degrees(hinge_rms["before"][joint].value)),
                    float(np.degrees(hinge_rms["after"][joint].value)),
                )
                for joint in self._hinges
            },
            largest_deg=dict(self._largest),
        )

    def _decimate(self, chunk: Recording, segments: Segments, nth: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Times (m,) [s] and orientations (m, 4) at `SAMPLE_RATE_HZ`, in pass `nth`."""
        at = np.arange(-self._counts[nth] % self._stride, len(chunk), self._stride)
        self._counts[nth] += len(chunk)
        at = at[chunk.time[at] >= self._start]
        return chunk.time[at], {name: segments.quat_WL[name][at] for name in self._chain}

    def _knot_of(self, time: np.ndarray) -> np.ndarray:
        return np.floor((time - self._first) / KNOT_S).astype(int)

    def _sum_knots(self, time: np.ndarray, quats: Mapping[str, np.ndarray]) -> None:
        """Add information and pull of complete knots from their samples."""
        R = {name: Rotation.from_quat(quat) for name, quat in quats.items()}
        joined = self._add_residuals("before", time, R)
        done = sum(len(pull) for _, pull in self._sums)
        knot = self._knot_of(time) - done
        count, size = int(knot[-1]) + 1, len(self._chain)
        information, pull = np.zeros((count, size, size)), np.zeros((count, size))
        for row in (
            _gap_rows(R, self._subject, joined),
            *(_hinge_rows(R, self._subject, joint) for joint in self._hinges),
        ):
            weight = self._share * row.weight[:, None]
            np.add.at(information, knot[row.sample], np.einsum("na,nb->nab", weight * row.H, row.H))
            np.add.at(pull, knot[row.sample], -weight * row.H * row.r[:, None])
            self._observed |= len(row.sample) > 0
        self._sums.append((information, pull))

    def _add_residuals(self, when: str, time: np.ndarray, R: Mapping[str, Rotation]) -> np.ndarray:
        """Add the residuals of palms and elbows; gives where the palms are joined (m,)."""
        joined = np.zeros(len(time), dtype=bool)
        for begin, end in self._clasp:
            joined |= (time >= begin) & (time <= end)
        if joined.any():
            self._gaps[when].add(np.sum(_palm_gap(R, self._subject)[joined] ** 2, axis=1))
        if len(time):
            for joint in self._hinges:
                self._hinge_rms[when][joint].add(_hinge_residual(R, self._subject, joint) ** 2)
        return joined

    def _record_variances(self, chunk: Recording, segments: Segments) -> None:
        """Record the filters' heading variances at the end of the start pose and in the middles of the knots."""
        # The start pose may end in a chunk whose first used sample is in the next one.
        times = np.array([self._start] if self._recorded == 0 else [])
        if self._first is not None:
            last = int(np.floor((chunk.time[-1] - self._first) / KNOT_S - 0.5))
            times = np.append(times, self._first + KNOT_S * (np.arange(max(0, self._recorded - 1), last + 1) + 0.5))
        times = times[times <= chunk.time[-1]]
        self._recorded += len(times)
        for name in self._chain:
            filter_cov = _heading_covariance(segments, name)
            if filter_cov is None:
                continue
            variance = filter_cov[1]
            known = chunk.time
            if name in self._last:  # the interval between two chunks
                known = np.concatenate([[self._last[name][0]], known])
                variance = np.concatenate([[self._last[name][1]], variance])
            self._var.setdefault(name, []).append(np.interp(times, known, variance))
            self._last[name] = float(known[-1]), float(variance[-1])


class _Rms:
    """Root mean square of added squares."""

    def __init__(self) -> None:
        self.count, self._sum = 0, 0.0

    def add(self, squares: np.ndarray) -> None:
        self.count, self._sum = self.count + len(squares), self._sum + float(squares.sum())

    @property
    def value(self) -> float:
        return float(np.sqrt(self._sum / self.count)) if self.count else float("nan")


class _Rows(NamedTuple):
    """Scalar measurements 0 = r + H δ + e."""

    sample: np.ndarray  # (m,) its index
    r: np.ndarray  # (m,)
    H: np.ndarray  # (m, k), δ of the chain in its order
    weight: np.ndarray  # (m,) 1 / variance of e


def _chain_links(R: Mapping[str, Rotation], subject: Subject) -> np.ndarray:
    """(k, n, 3) [m] in W: each segment's part of the chain from the right palm to the left one."""
    length = subject.lengths
    parts = [R["torso"].apply([0.0, length["shoulder_width"], 0.0])]
    for name in [name for name in R if name != "torso"]:
        side = name.split("_", 1)[0]
        along = sum(length[part] for part in _rotating_lengths(name, R))
        parts.append(R[name].apply([0.0, 0.0, -along if side == "left" else along]))
    return np.array(parts)


def _rotating_lengths(name: str, R: Mapping[str, Rotation]) -> tuple[str, ...]:
    """The lengths that rotate with a segment of the chain."""
    hand = name.replace("forearm", "hand")
    if name == "torso":
        return ("shoulder_width",)
    return (name,) if hand in R else (name, hand)


def _palm_gap(R: Mapping[str, Rotation], subject: Subject) -> np.ndarray:
    """(n, 3) [m] left palm minus right palm in W."""
    return _chain_links(R, subject).sum(axis=0)


def _gap_rows(R: Mapping[str, Rotation], subject: Subject, joined: np.ndarray) -> _Rows:
    """Three whitened rows for each sample with joined palms, without outliers."""
    v = _chain_links(R, subject)[:, joined]
    n = v.shape[1]
    eye = np.eye(3)
    covariance = np.tile(SLIP_STD**2 * eye, (n, 1, 1))
    for link in v:
        covariance += ATTITUDE_STD**2 * (
            np.sum(link**2, axis=1)[:, None, None] * eye - np.einsum("na,nb->nab", link, link)
        )
    covariance += _length_covariance(v, R, subject)
    H = np.stack([np.cross([0.0, 0.0, 1.0], link) for link in v], axis=2)  # (n, 3, k)
    r = v.sum(axis=0)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if n else covariance
    r, H = np.einsum("nab,nb->na", whiten, r), whiten @ H
    near = np.sum(r**2, axis=1) < OUTLIER_STDS**2 * 3.0
    sample = np.repeat(np.flatnonzero(joined)[near], 3)
    return _Rows(sample, r[near].ravel(), H[near].reshape(-1, len(v)), np.ones(len(sample)))


def _length_covariance(v: np.ndarray, R: Mapping[str, Rotation], subject: Subject) -> np.ndarray:
    """Covariance (n, 3, 3) [m²] of the gap from that of the lengths."""
    names, J = [], []
    for link, name in zip(v, R, strict=True):
        direction = link / np.linalg.norm(link, axis=1)[:, None]
        for length in _rotating_lengths(name, R):
            names.append(length)
            J.append(direction)
    jacobian = np.stack(J, axis=2)  # (n, 3, k)
    return jacobian @ subject.lengths_covariance(names) @ jacobian.swapaxes(1, 2)


def _hinge_residual(R: Mapping[str, Rotation], subject: Subject, joint: str) -> np.ndarray:
    """(n,) [rad] by which the forearm leaves the plane of the elbow's hinge."""
    side = joint.removesuffix("_elbow")
    forearm_U = R[f"{side}_upper_arm"].inv().apply(R[f"{side}_forearm"].apply([0.0, 0.0, -1.0]))
    return forearm_U @ subject.hinges[joint].axis


def _hinge_rows(R: Mapping[str, Rotation], subject: Subject, joint: str) -> _Rows:
    side = joint.removesuffix("_elbow")
    upper, fore = R[f"{side}_upper_arm"], R[f"{side}_forearm"]
    r = _hinge_residual(R, subject, joint)
    turned = np.cross([0.0, 0.0, 1.0], fore.apply([0.0, 0.0, -1.0]))
    slope = upper.inv().apply(turned) @ subject.hinges[joint].axis
    H, names = np.zeros((len(r), len(R))), list(R)
    H[:, names.index(f"{side}_forearm")], H[:, names.index(f"{side}_upper_arm")] = slope, -slope
    std = subject.hinges[joint].std
    near = np.abs(r) < OUTLIER_STDS * std + np.deg2rad(
        10.0
    )  # a drifted heading does not make the elbow less of a hinge
    sample = np.flatnonzero(near)
    return _Rows(sample, r[near], H[near], np.full(len(sample), std**-2))


def _heading_covariance(segments: Segments, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """The filter's covariance of the heading with each axis of W (n, 3), and its variance (n,) [rad²], if any."""
    orientation = segments.orientation.get(name)
    if orientation is None or orientation.attitude_cov is None:
        return None
    R_VS = Rotation.from_quat(orientation.quat_WS)
    with_heading_V = R_VS.apply(np.einsum("nab,nb->na", orientation.attitude_cov, R_VS.inv().apply([0.0, 0.0, 1.0])))
    to_W = Rotation.from_rotvec([0.0, 0.0, segments.heading[name]])
    return to_W.apply(with_heading_V), with_heading_V[:, 2]


def _smooth_walk(information: np.ndarray, pull: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed random walks (knots, k) and their covariances (knots, k, k) from information matrices."""
    n, size = pull.shape
    # The start pose sets each segment's heading up to its own error; the torso's is right by definition.
    x, P = np.zeros(size), np.diag([TORSO_START_STD**2] + [START_POSE_STD**2] * (size - 1))
    before, filtered = [], []
    for k in range(n):
        P = P + np.diag(steps[k])
        before.append((x, P))
        P = np.linalg.inv(np.linalg.inv(P) + information[k])
        x = x + P @ (pull[k] - information[k] @ x)
        filtered.append((x, P))
    means, covs = [x], [P]
    for k in range(n - 2, -1, -1):
        gain = filtered[k][1] @ np.linalg.inv(before[k + 1][1])
        x = filtered[k][0] + gain @ (x - before[k + 1][0])
        P = filtered[k][1] + gain @ (P - before[k + 1][1]) @ gain.T
        means.append(x)
        covs.append(P)
    return np.array(means[::-1]), np.array(covs[::-1])


def _narrow_covariance(
    cov_W: np.ndarray, filter_W: np.ndarray, filter_var: np.ndarray, heading_var: np.ndarray
) -> np.ndarray:
    """Covariances (n, 3, 3) in which the heading's part of filter and start pose is no larger than `heading_var` (n,).

    Variance from elsewhere, such as a mount's heading, is not observed by joined hands and elbows: it stays.
    """
    share = np.sqrt(np.minimum(1.0, heading_var / filter_var))
    less = (1.0 - share)[:, None] * filter_W
    narrowed = cov_W.copy()
    narrowed[:, 2, :2] -= less[:, :2]
    narrowed[:, :2, 2] -= less[:, :2]
    narrowed[:, 2, 2] -= (1.0 - share**2) * filter_var
    return narrowed
