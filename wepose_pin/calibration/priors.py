"""What is known before the motion: lengths, stated mounts, how people stand and how sensors drift.

All of it is one Gaussian over the unknowns of `least_squares`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import BodyTable
from ..body.girdle import PARAMETERS
from ..body.mounts import MEASURED_ORIENTATION_STD, find_mount_covariance
from ..body.subject import Subject
from ..body.table import NEUTRAL_POSE
from ..errors import BadSubject
from .conditions import Loop
from .equations import Layout
from .least_squares import Gaussian, Observations
from .problem import CalibrationProblem

# Priors, one standard deviation. A stated mount names sensor axes, estimated by eye.
STATED_STD = np.deg2rad(10.0)  # [rad] of a stated mount's heading
HEADING_STD = np.pi / np.sqrt(3.0)  # [rad] of an unknown heading: the whole circle
DRIFT_STD = np.deg2rad(1.0) / 60.0  # [rad/s]
LEAST_FOAM_STD = 1e-4  # [rad/rad] about an axis about which a table states that no foam gives
LEAST_GIRDLE_STD = 1e-5  # [m] of a parameter that a table states as exact
POINT_STD = 3.0  # [m] of an unknown point of W


def build_prior(problem: CalibrationProblem, observations: Observations) -> Gaussian:
    """Return all that is known before the motion, as one Gaussian over x; unknown headings are 0.

    Raises
    ------
    BadSubject
        The prior has no positive definite covariance of its lengths.
    """
    layout = observations.layout
    mean, information = np.zeros(layout.size), np.zeros((layout.size, layout.size))
    _add_shape(mean, information, problem, layout)
    _add_places(mean, information, observations)
    stated_headings = problem.stated_headings(layout.sensors)
    for i, name in enumerate(layout.sensors):
        rows = [*layout.tilt[i], layout.heading[i]]
        mean[rows[2]] = stated_headings.get(name, 0.0)
        offset, information[np.ix_(rows, rows)] = _mount_prior(problem, name, stated_headings.get(name))
        mean[rows] += offset
    information[layout.drift, layout.drift] = DRIFT_STD**-2
    for name, rows in zip(layout.soft, layout.foam, strict=True):
        std = np.maximum(np.tile(problem.model.table.segments[name].foam_std, 3), LEAST_FOAM_STD)
        information[rows, rows] = std**-2.0
    _add_hinges(information, layout, problem.model.table)
    return Gaussian(mean, information)


def _add_shape(mean: np.ndarray, information: np.ndarray, problem: CalibrationProblem, layout: Layout) -> None:
    """Lengths and girdles, jointly: of the prior, else of the table, with measured lengths.

    Raises
    ------
    BadSubject
        The prior has no positive definite covariance of its lengths.
    """
    prior, table, size = problem.prior, problem.model.table, len(PARAMETERS)
    of_lengths, _ = combine_lengths(prior, {}, layout.lengths)
    own = [prior.girdles.get(term.name, np.zeros(size)) for term in layout.girdles]
    first, names = len(table.lengths), list(table.girdles)
    chosen = [list(table.lengths).index(name) for name in layout.lengths]
    chosen += [first + size * names.index(term.name) + k for term in layout.girdles for k in range(size)]
    covariance = prior.shape_covariance(table)[np.ix_(chosen, chosen)]
    covariance[len(layout.lengths) :, len(layout.lengths) :] += LEAST_GIRDLE_STD**2 * np.eye(size * len(own))
    rows = np.concatenate((layout.length, layout.girdle.ravel()))
    K, before = np.linalg.inv(covariance), np.concatenate((of_lengths, *own))
    target = K @ before
    for i, name in enumerate(layout.lengths):
        if name in problem.measured:
            metres, std = problem.measured[name]
            K[i, i] += std**-2
            target[i] += metres * std**-2
    mean[rows], information[np.ix_(rows, rows)] = np.linalg.solve(K, target), K


def _add_places(mean: np.ndarray, information: np.ndarray, observations: Observations) -> None:
    """Unknown points and heights of planes, and known points."""
    layout = observations.layout
    information[layout.height, layout.height] = POINT_STD**-2
    fixed = [c.closure for c in observations.conditions if isinstance(c, Loop) and c.kind == "fixed_point"]
    for closure, rows in zip(fixed, layout.point, strict=True):
        std = POINT_STD if closure.at is None else closure.at_std
        information[rows, rows] = std**-2
        mean[rows] = 0.0 if closure.at is None else closure.at


def _add_hinges(information: np.ndarray, layout: Layout, table: BodyTable) -> None:
    """The axes of hinges, those of a left and a right one partly alike, and how far sensors lag behind twists."""
    information[layout.twist, layout.twist] = np.array([twist.std for twist in layout.twists]) ** -2.0
    rows = {hinge.name: places for hinge, places in zip(layout.hinges, layout.hinge, strict=True)}
    for name, (across, tilted) in rows.items():
        hinge, other = table.hinges[name], table.counterpart(name)
        information[tilted, tilted] += hinge.tilt_std**-2
        if other not in rows:
            information[across, across] += (hinge.common_std**2 + hinge.mirror_std**2) ** -1.0
        elif table.side(name) == "left":
            columns = (across, rows[other][0])
            for std, share in ((hinge.common_std, np.array([0.5, 0.5])), (hinge.mirror_std, np.array([0.5, -0.5]))):
                information[np.ix_(columns, columns)] += np.outer(share, share) / std**2


def place_points(x: np.ndarray, observations: Observations) -> np.ndarray:
    """Return x with each unknown fixed point and height at the mean of the body's points that lie on it."""
    layout = observations.layout
    if not layout.fixed and not layout.planes:
        return x
    x, gaps = x.copy(), observations.gaps(x)
    for condition, span in observations.spans():
        if isinstance(condition, Loop) and condition.kind == "fixed_point" and condition.closure.at is None:
            x[layout.point[condition.unknown]] += gaps[span].mean(axis=0)
        elif isinstance(condition, Loop) and condition.kind == "plane":
            x[layout.height[condition.unknown]] += gaps[span, : condition.rows].mean()
    return x


def _mount_prior(problem: CalibrationProblem, segment: str, heading: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Mean (3,) and information (3, 3) of a sensor's (ε_x, ε_y, ψ), with ψ relative to its `heading`.

    The person stands nearly in the start pose. A mount R_LS = exp(m) R_0 has a small error m = μ − ε + ψ e_z, with μ
    the misfit of the start pose at the heading nearest to R_0.
    """
    R_start = problem.start_pose.rotation(segment)
    start_cov = R_start @ np.diag(np.square(problem.model.table.segments[segment].start_std)) @ R_start.T
    information = np.zeros((3, 3))
    information[:2, :2] = np.linalg.inv(start_cov[:2, :2])
    information[2, 2] = HEADING_STD**-2
    mean = np.zeros(3)
    if problem.recording.start_pose == NEUTRAL_POSE:
        mean[:2] = problem.model.table.segments[segment].start_mean[:2]
    mount = problem.mount(segment)
    if mount is None or heading is None:
        return mean, information
    R_mount = Rotation.from_quat(mount)
    turn = Rotation.from_rotvec([0.0, 0.0, heading])
    misfit = (turn * problem.filtered.R_VS_start[segment] * R_mount.inv()).as_rotvec()
    of_mount, signs = _mount_information(problem, segment), np.diag([-1.0, -1.0, 1.0])
    offset = np.linalg.solve(
        information + signs @ of_mount @ signs + 1e-9 * np.eye(3),
        information @ mean - signs @ of_mount @ np.append(misfit[:2], 0.0),
    )
    return offset, information + signs @ of_mount @ signs


def _mount_information(problem: CalibrationProblem, segment: str) -> np.ndarray:
    """Information (3, 3) [1/rad²] of the nominal mount's error in L."""
    recording, prior = problem.recording, problem.prior
    covariance = find_mount_covariance(recording, segment, prior)
    if covariance is not None:
        R_start = problem.start_pose.rotation(segment)
        return np.linalg.inv(R_start @ covariance @ R_start.T + 1e-12 * np.eye(3))
    calibrated = segment in prior.mounts and not recording.remounted
    if calibrated or segment not in recording.imus:
        return np.eye(3) / MEASURED_ORIENTATION_STD**2
    return np.diag([0.0, 0.0, STATED_STD**-2])


def combine_lengths(
    prior: Subject, measured: Mapping[str, tuple[float, float]], names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """The named lengths (k,) [m] of the prior and the measured lengths, and their information (k, k).

    Raises
    ------
    BadSubject
        The prior has no positive definite covariance of its lengths.
    """
    if not names:
        return np.empty(0), np.empty((0, 0))
    if not set(names) <= set(prior.order) or np.linalg.eigvalsh(prior.lengths_covariance(names))[0] <= 0.0:
        raise BadSubject(f"prior '{prior.name}': its lengths need a covariance that is positive definite, all of them")
    information = np.linalg.inv(prior.lengths_covariance(names))
    target = information @ [prior.lengths[name] for name in names]
    for i, name in enumerate(names):
        if name in measured:
            metres, std = measured[name]
            information[i, i] += 1.0 / std**2
            target[i] += metres / std**2
    return np.linalg.solve(information, target), information
