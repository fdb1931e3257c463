"""Headings held together: what drifts apart between sensors is seen at joined hands and at the elbows' hinges.

The filters' tilt is good and their headings drift. δ_i(t) is the heading error of segment i, R_WL,true = Rz(δ) R_WL, a
random walk whose steps are what the filter's own covariance grows by. Two things measure it, both linear in δ:

- the palm gap in a later `clasp` phase: g + Σ δ_i e_z × v_i = 0, with v_i the link of segment i;
- the elbow of a calibrated subject: the forearm stays in the plane of its hinge, n · R_Uᵀ R_F (−e_z) = 0.

A forward pass and a Rauch-Tung-Striebel pass over knots of a few seconds give δ and its covariance. What is common to
all segments, nothing here sees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import ATTITUDE_STD, SLIP_STD, Segments
from ..recording import SEGMENTS, Recording
from ..subject import Subject

CHAIN = SEGMENTS[:5]
HANDS = ("left_hand", "right_hand")  # each in the chain where it has a sensor, else rigid with its forearm
KNOT_S = 2.0
LOOK_RATE_HZ = 8.0
# How long errors of the residuals last that have nothing to do with headings: soft tissue and what is left of the
# mounts' errors come back in every pose, so that a minute of joined hands is worth three looks. Found on simulated
# people, where less takes a good filter's headings for worse than they are.
CORRELATION_S = 20.0
START_STD = np.deg2rad(0.5)  # [rad] of each heading when the start pose ends
UNKNOWN_DRIFT = np.deg2rad(3.0) ** 2 / 60.0  # [rad²/s] where a filter has no covariance
APART = 5.0  # standard deviations from which on palms are not joined, or an elbow is no hinge


class Reset(NamedTuple):
    """What held the headings together, before and after."""

    clasp_mm: tuple[float, float] | None  # rms palm gap in the clasp phases
    hinge_deg: Mapping[str, tuple[float, float]]  # side → rms of the forearm against the elbow's plane
    largest_deg: Mapping[str, float]  # segment → largest turn


def held_together(recording: Recording, segments: Segments, subject: Subject) -> tuple[Segments, Reset | None]:
    """Segments with their headings corrected; as they were where neither a clasp nor a hinge is known."""
    quat_WL = segments.quat_WL
    if not set(CHAIN) <= set(quat_WL):
        return segments, None
    chain = (*CHAIN, *(hand for hand in HANDS if hand in quat_WL))
    # A hinge was seen through the mounts of its calibration and holds as long as they do.
    hinges = subject.hinges if recording.strapping != "new" else {}
    stride = max(1, round(recording.rate_hz / LOOK_RATE_HZ))
    at = np.arange(0, len(recording), stride)
    at = at[recording.time[at] >= segments.start[1]]
    R = {name: Rotation.from_quat(quat_WL[name][at]) for name in chain}
    time = recording.time[at]
    joined = np.zeros(len(at), dtype=bool)
    for begin, end in recording.phases.get("clasp", ()):
        joined |= (time >= begin) & (time <= end)
    rows = [_gaps(R, subject, joined), *(_hinge(R, subject, side) for side in hinges)]
    rows = [row for row in rows if len(row.look)]
    if not rows:
        return segments, None

    begin = float(time[0])
    knot = np.floor((time - begin) / KNOT_S).astype(int)
    count = knot[-1] + 1
    information, pull = np.zeros((count, len(chain), len(chain))), np.zeros((count, len(chain)))
    share = 1.0 / max(1.0, CORRELATION_S * recording.rate_hz / stride)
    for row in rows:
        weight = share * row.weight[:, None]
        np.add.at(information, knot[row.look], np.einsum("na,nb->nab", weight * row.H, row.H))
        np.add.at(pull, knot[row.look], -weight * row.H * row.r[:, None])
    middle = begin + KNOT_S * (np.arange(count) + 0.5)
    delta, cov = _smoothed(information, pull, _walk(recording, segments, chain, middle))
    # Constant before the first middle and after the last, and in the start pose exactly zero.
    knots = np.concatenate([[segments.start[1]], middle])
    turn = {
        name: np.interp(recording.time, knots, np.concatenate([[0.0], delta[:, i]])) for i, name in enumerate(chain)
    }
    corrected = dict(quat_WL)
    for name in chain:
        about_z = Rotation.from_rotvec(turn[name][:, None] * [0.0, 0.0, 1.0])
        corrected[name] = (about_z * Rotation.from_quat(quat_WL[name])).as_quat()
    covariance = dict(segments.covariance_W)
    for i, name in enumerate(chain):
        if name in covariance:
            variance = np.interp(recording.time, middle, cov[:, i, i])
            covariance[name] = _narrowed(covariance[name], *_of_filter(segments, name), variance)
    after = {name: Rotation.from_quat(corrected[name][at]) for name in chain}
    reset = Reset(
        clasp_mm=(_rms_mm(_palms(R, subject)[joined]), _rms_mm(_palms(after, subject)[joined]))
        if joined.any()
        else None,
        hinge_deg={
            side: (_rms_deg(_elbow(R, subject, side)), _rms_deg(_elbow(after, subject, side))) for side in hinges
        },
        largest_deg={name: float(np.degrees(np.abs(turn[name]).max())) for name in chain},
    )
    return replace(segments, quat_WL=corrected, covariance_W=covariance), reset


class _Rows(NamedTuple):
    """Scalar measurements 0 = r + H δ + e."""

    look: np.ndarray  # (m,) index of the look
    r: np.ndarray  # (m,)
    H: np.ndarray  # (m, k), δ of the chain in its order
    weight: np.ndarray  # (m,) 1 / variance of e


def _links(R: Mapping[str, Rotation], subject: Subject) -> np.ndarray:
    """(k, n, 3) [m] in W: each segment's part of the way from the right palm to the left one."""
    length = subject.lengths
    found = [R["torso"].apply([0.0, length["shoulder_width"], 0.0])]
    for name in [name for name in R if name != "torso"]:
        side = name.split("_", 1)[0]
        along = sum(length[part] for part in _carried(name, R))
        found.append(R[name].apply([0.0, 0.0, -along if side == "left" else along]))
    return np.array(found)


def _carried(name: str, R: Mapping[str, Rotation]) -> tuple[str, ...]:
    """The lengths that turn with a segment of the chain."""
    hand = name.replace("forearm", "hand")
    if name == "torso":
        return ("shoulder_width",)
    return (name,) if hand in R else (name, hand)


def _palms(R: Mapping[str, Rotation], subject: Subject) -> np.ndarray:
    """(n, 3) [m] left palm minus right palm in W."""
    return _links(R, subject).sum(axis=0)


def _gaps(R: Mapping[str, Rotation], subject: Subject, joined: np.ndarray) -> _Rows:
    """Of each look with joined palms three whitened rows; those that lie far out are left out."""
    v = _links(R, subject)[:, joined]
    n = v.shape[1]
    eye = np.eye(3)
    covariance = np.tile(SLIP_STD**2 * eye, (n, 1, 1))
    for link in v:
        covariance += ATTITUDE_STD**2 * (
            np.sum(link**2, axis=1)[:, None, None] * eye - np.einsum("na,nb->nab", link, link)
        )
    covariance += _of_lengths(v, R, subject)
    H = np.stack([np.cross([0.0, 0.0, 1.0], link) for link in v], axis=2)  # (n, 3, k)
    r = v.sum(axis=0)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if n else covariance
    r, H = np.einsum("nab,nb->na", whiten, r), whiten @ H
    near = np.sum(r**2, axis=1) < APART**2 * 3.0
    look = np.repeat(np.flatnonzero(joined)[near], 3)
    return _Rows(look, r[near].ravel(), H[near].reshape(-1, len(v)), np.ones(len(look)))


def _of_lengths(v: np.ndarray, R: Mapping[str, Rotation], subject: Subject) -> np.ndarray:
    """(n, 3, 3) [m²]: what the lengths' own covariance makes of the gap."""
    names, J = [], []
    for link, name in zip(v, R, strict=True):
        direction = link / np.linalg.norm(link, axis=1)[:, None]
        for length in _carried(name, R):
            names.append(length)
            J.append(direction)
    jacobian = np.stack(J, axis=2)  # (n, 3, k)
    return jacobian @ subject.lengths_covariance(names) @ jacobian.swapaxes(1, 2)


def _elbow(R: Mapping[str, Rotation], subject: Subject, side: str) -> np.ndarray:
    """(n,) [rad] by which the forearm is out of the plane of the elbow's hinge."""
    forearm_U = R[f"{side}_upper_arm"].inv().apply(R[f"{side}_forearm"].apply([0.0, 0.0, -1.0]))
    return forearm_U @ subject.hinges[side].axis


def _hinge(R: Mapping[str, Rotation], subject: Subject, side: str) -> _Rows:
    upper, fore = R[f"{side}_upper_arm"], R[f"{side}_forearm"]
    r = _elbow(R, subject, side)
    turned = np.cross([0.0, 0.0, 1.0], fore.apply([0.0, 0.0, -1.0]))
    slope = upper.inv().apply(turned) @ subject.hinges[side].axis
    H, names = np.zeros((len(r), len(R))), list(R)
    H[:, names.index(f"{side}_forearm")], H[:, names.index(f"{side}_upper_arm")] = slope, -slope
    std = subject.hinges[side].std
    near = np.abs(r) < APART * std + np.deg2rad(10.0)  # a heading that has drifted is no reason to doubt the hinge
    look = np.flatnonzero(near)
    return _Rows(look, r[near], H[near], np.full(len(look), std**-2))


def _walk(recording: Recording, segments: Segments, chain: tuple[str, ...], middle: np.ndarray) -> np.ndarray:
    """(knots, k) [rad²]: variance of each heading's step to each knot, by what its filter's covariance grew."""
    steps = np.full((len(middle), len(chain)), UNKNOWN_DRIFT * KNOT_S)
    for i, name in enumerate(chain):
        if name in segments.covariance_W:
            _, variance = _of_filter(segments, name)
            at = np.interp(np.concatenate([[segments.start[1]], middle]), recording.time, variance)
            steps[:, i] = np.maximum(np.diff(at), 1e-10)
    return steps


def _of_filter(segments: Segments, name: str) -> tuple[np.ndarray, np.ndarray]:
    """What the filter's own covariance says of the heading: with each axis of W (n, 3), and of itself (n,) [rad²]."""
    of = segments.orientation[name]
    R_VS = Rotation.from_quat(of.quat_WS)
    assert of.attitude_cov is not None
    with_heading_V = R_VS.apply(np.einsum("nab,nb->na", of.attitude_cov, R_VS.inv().apply([0.0, 0.0, 1.0])))
    to_W = Rotation.from_rotvec([0.0, 0.0, segments.heading[name]])
    return to_W.apply(with_heading_V), with_heading_V[:, 2]


def _smoothed(information: np.ndarray, pull: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Random walks (knots, k) and their covariances (knots, k, k), seen through information matrices."""
    n, size = pull.shape
    x, P = np.zeros(size), START_STD**2 * np.eye(size)
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


def _narrowed(cov_W: np.ndarray, filter_W: np.ndarray, filter_var: np.ndarray, heading_var: np.ndarray) -> np.ndarray:
    """Covariances (n, 3, 3) in which the filter's part of the heading is no larger than `heading_var` (n,).

    What comes from elsewhere, as from a mount's heading, joined hands and elbows do not take away: it stays.
    """
    share = np.sqrt(np.minimum(1.0, heading_var / filter_var))
    less = (1.0 - share)[:, None] * filter_W
    narrowed = cov_W.copy()
    narrowed[:, 2, :2] -= less[:, :2]
    narrowed[:, :2, 2] -= less[:, :2]
    narrowed[:, 2, 2] -= (1.0 - share**2) * filter_var
    return narrowed


def _rms_mm(gaps: np.ndarray) -> float:
    return float(1e3 * np.sqrt(np.mean(np.sum(gaps**2, axis=1))))


def _rms_deg(angles: np.ndarray) -> float:
    return float(np.degrees(np.sqrt(np.mean(angles**2))))
