"""What is known before the motion: lengths, stated mounts, how people stand and how sensors drift.

All of it is one Gaussian over the unknowns of `least_squares`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import START_POSE_STD, find_mount_covariance
from ..errors import BadSubject
from ..subject import Subject
from .chain import LENGTHS
from .initial_headings import estimate_headings
from .least_squares import Gaussian, K, Observations, place_points
from .losses import FREE_STD, HEADING_STD
from .problem import CalibrationProblem
from .protocols import Closure

# Priors, one standard deviation. A stated mount names sensor axes, estimated by eye.
STATED_STD = np.deg2rad(10.0)  # [rad] of a stated mount's heading
MEASURED_ORIENTATION_STD = np.deg2rad(2.0)  # [rad] about each axis, of segments that a device aligned itself
DRIFT_STD = np.deg2rad(1.0) / 60.0  # [rad/s]
POINT_STD = 3.0  # [m] of an unknown point of W
# [rad] by which soft tissue rotates a sensor as its segment rotates by a radian, each axis against each. It moves as
# much on a trunk, which leans by a fifth of the angle that arms rotate.
SOFT_TISSUE_STD, TORSO_SOFT_TISSUE_STD = np.deg2rad(0.6), np.deg2rad(3.0)
SHOULDERS_STD = np.deg2rad(2.0)  # [rad] of the shoulders' line about the torso's z: some 9 mm of one of them
# Elbow axis (x, 1, z) in the upper arm: palms turn in or out alike on both sides, the torso's facing is common to both.
HINGE_MIRROR_STD, HINGE_COMMON_STD, HINGE_TILT_STD = np.deg2rad([20.0, 5.0, 5.0])


def build_prior(problem: CalibrationProblem, observations: Observations) -> Gaussian:
    """All that is known before the closure, as one Gaussian over x; unknown headings start at those of the closure.

    Raises
    ------
    BadSubject
        The prior has no positive definite covariance of its lengths.
    """
    layout, prior = observations.layout, problem.prior
    mean, information = np.zeros(layout.size), np.zeros((layout.size, layout.size))
    mean[:K], information[:K, :K] = combine_lengths(prior, problem.measured)
    for name, row in zip(layout.distance_names, range(layout.size)[layout.distances], strict=True):
        stated = next(c for c in observations.conditions if isinstance(c, Closure) and c.distance == name)
        mean[row], std = problem.measured.get(name, (stated.metres, stated.metres_std))
        information[row, row] = std**-2
    information[layout.points, layout.points] = np.eye(3 * layout.fixed) / POINT_STD**2

    stated_headings = problem.stated_headings(layout.sensors)
    headings = estimate_headings(observations, mean[:K], mean[layout.distances], stated_headings)
    free = observations.step_std > FREE_STD
    mean[layout.step] = np.where(free, headings[len(layout.sensors) :], 0.0)
    information[layout.step, layout.step] = np.diag(np.where(free, HEADING_STD, observations.step_std) ** -2.0)
    for i, name in enumerate(layout.sensors):
        rows = [layout.tilt.start + 2 * i, layout.tilt.start + 2 * i + 1, layout.heading.start + i]
        mean[rows[2]] = stated_headings.get(name, headings[i])
        offset, information[np.ix_(rows, rows)] = _mount_prior(problem, name, stated_headings.get(name))
        mean[rows] += offset
    information[layout.drift, layout.drift] = np.eye(len(layout.sensors)) / DRIFT_STD**2
    soft_tissue = [TORSO_SOFT_TISSUE_STD if name == "torso" else SOFT_TISSUE_STD for name in layout.sensors]
    information[layout.soft_tissue, layout.soft_tissue] = np.diag(np.repeat(soft_tissue, 9) ** -2.0)
    information[layout.shoulders, layout.shoulders] = SHOULDERS_STD**-2
    x_left, z_left, x_right, z_right = range(layout.hinge.start, layout.hinge.stop)
    for std, columns, share in (
        (HINGE_COMMON_STD, (x_left, x_right), np.array([0.5, 0.5])),
        (HINGE_MIRROR_STD, (x_left, x_right), np.array([0.5, -0.5])),
        (HINGE_TILT_STD, (z_left,), np.ones(1)),
        (HINGE_TILT_STD, (z_right,), np.ones(1)),
    ):
        information[np.ix_(columns, columns)] += np.outer(share, share) / std**2
    return Gaussian(place_points(mean, observations), information)


def _mount_prior(problem: CalibrationProblem, segment: str, heading: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Mean (3,) and information (3, 3) of a sensor's (ε_x, ε_y, ψ), with ψ relative to its `heading`.

    The person stands nearly in the start pose. A mount R_LS = exp(m) R_0 has a small error m = μ − ε + ψ e_z, with μ
    the misfit of the start pose at the heading nearest to R_0.
    """
    information = np.diag([START_POSE_STD**-2, START_POSE_STD**-2, HEADING_STD**-2])
    mount = problem.mount(segment)
    if mount is None or heading is None:
        return np.zeros(3), information
    R_mount = Rotation.from_quat(mount)
    turn = Rotation.from_rotvec([0.0, 0.0, heading])
    misfit = (turn * problem.filtered.R_VS_start[segment] * R_mount.inv()).as_rotvec()
    of_mount, signs = _mount_information(problem, segment), np.diag([-1.0, -1.0, 1.0])
    offset = np.linalg.solve(
        information + signs @ of_mount @ signs + 1e-9 * np.eye(3), -signs @ of_mount @ np.append(misfit[:2], 0.0)
    )
    return offset, information + signs @ of_mount @ signs


def _mount_information(problem: CalibrationProblem, segment: str) -> np.ndarray:
    """Information (3, 3) [1/rad²] of the nominal mount's error in L."""
    recording, prior = problem.recording, problem.prior
    covariance = find_mount_covariance(recording, segment, prior)
    if covariance is not None:
        return np.linalg.inv(covariance + 1e-12 * np.eye(3))
    calibrated = segment in prior.mounts and not recording.remounted
    if calibrated or segment not in recording.imus:
        return np.eye(3) / MEASURED_ORIENTATION_STD**2
    return np.diag([0.0, 0.0, STATED_STD**-2])


def combine_lengths(prior: Subject, measured: Mapping[str, tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Lengths (8,) [m] of the prior and the measured lengths, and their information (8, 8).

    Raises
    ------
    BadSubject
        The prior has no positive definite covariance of its lengths.
    """
    if not set(LENGTHS) <= set(prior.order) or np.linalg.eigvalsh(prior.lengths_covariance())[0] <= 0.0:
        raise BadSubject(f"prior '{prior.name}': its lengths need a covariance that is positive definite, all of them")
    information = np.linalg.inv(prior.lengths_covariance())
    target = information @ [prior.lengths[name] for name in LENGTHS]
    for i, name in enumerate(LENGTHS):
        if name in measured:
            metres, std = measured[name]
            information[i, i] += 1.0 / std**2
            target[i] += metres / std**2
    return np.linalg.solve(information, target), information
