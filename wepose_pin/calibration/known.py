"""What is known before the motion: average lengths and tapes, stated mounts, how people stand and how sensors drift.

All of it is one Gaussian over the unknowns of `problem`, which the least squares weighs against what the looks see.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import START_POSE_STD, heading_to, mount_covariance, nominal_mount
from ..errors import BadSubject
from ..filters.sensors import FilteredRecording
from ..recording import Recording
from ..subject import LENGTHS, Subject
from .losses import FREE_STD, HEADING_STD
from .problem import K, Layout, Looks, placed
from .protocols import Closure
from .start import headings

# Priors, one standard deviation. A stated mount names sensor axes, put on by hand.
STATED_STD = np.deg2rad(10.0)  # [rad] of a stated mount's heading
READY_STD = np.deg2rad(2.0)  # [rad] about each axis, of segments that a device aligned itself
DRIFT_STD = np.deg2rad(1.0) / 60.0  # [rad/s]
POINT_STD = 3.0  # [m] of a point of W that nothing tells
# [rad] by which soft tissue turns a sensor as its segment turns by a radian, each axis against each. It moves as much
# on a trunk, which leans by a fifth of what arms turn.
SAG_STD, TORSO_SAG_STD = np.deg2rad(0.6), np.deg2rad(3.0)
SHOULDERS_STD = np.deg2rad(2.0)  # [rad] of the shoulders' line about the torso's z: some 9 mm of one of them
# Elbow axis (x, 1, z) in the upper arm: palms turn in or out alike on both sides, the torso's facing is common to both.
HINGE_MIRROR_STD, HINGE_COMMON_STD, HINGE_TILT_STD = np.deg2rad([20.0, 5.0, 5.0])


def known_before(
    recording: Recording,
    found: FilteredRecording,
    looks: Looks,
    prior: Subject,
    gauge: Mapping[str, float],
    gauge_std: float,
) -> tuple[np.ndarray, np.ndarray]:
    """All that is known before the closure, as one Gaussian over x: centre and information."""
    layout = looks.layout
    center, information = np.zeros(layout.size), np.zeros((layout.size, layout.size))
    center[:K], information[:K, :K] = known_lengths(prior, gauge, gauge_std)
    for name, row in zip(layout.gauges, range(layout.size)[layout.distances], strict=True):
        stated = next(c for c in looks.conditions if isinstance(c, Closure) and c.gauge == name)
        center[row] = gauge.get(name, stated.metres)
        information[row, row] = (gauge_std if name in gauge else stated.metres_std) ** -2
    information[layout.points, layout.points] = np.eye(3 * layout.fixed) / POINT_STD**2

    guess = headings(looks, center[:K], center[layout.distances], stated_headings(recording, found, layout, prior))
    free = looks.step_std > FREE_STD
    center[layout.step] = np.where(free, guess[len(layout.sensors) :], 0.0)
    information[layout.step, layout.step] = np.diag(np.where(free, HEADING_STD, looks.step_std) ** -2.0)
    for i, name in enumerate(layout.sensors):
        # What is known of this sensor's (ε_x, ε_y, ψ): the person stands nearly so, and of a mount R_LS = exp(m) R_0
        # that m = μ − ε + ψ' e_z is small, with μ the misfit of the start pose at the heading nearest to R_0.
        of = [layout.tilt.start + 2 * i, layout.tilt.start + 2 * i + 1, layout.heading.start + i]
        known = np.diag([START_POSE_STD**-2, START_POSE_STD**-2, HEADING_STD**-2])
        mean = np.zeros(3)
        center[of[2]] = guess[i]
        mount = nominal_mount(recording, name, prior)
        if mount is not None:
            R_mount = Rotation.from_quat(mount)
            center[of[2]] = psi = heading_to(found.at_start[name], R_mount)
            misfit = (Rotation.from_rotvec([0.0, 0.0, psi]) * found.at_start[name] * R_mount.inv()).as_rotvec()
            sure = _mount_information(recording, name, prior)
            signs = np.diag([-1.0, -1.0, 1.0])
            mean = np.linalg.solve(
                known + signs @ sure @ signs + 1e-9 * np.eye(3), -signs @ sure @ np.append(misfit[:2], 0.0)
            )
            known = known + signs @ sure @ signs
        center[of] += mean
        information[np.ix_(of, of)] = known
    information[layout.drift, layout.drift] = np.eye(len(layout.sensors)) / DRIFT_STD**2
    sag = [TORSO_SAG_STD if name == "torso" else SAG_STD for name in layout.sensors]
    information[layout.sag, layout.sag] = np.diag(np.repeat(sag, 9) ** -2.0)
    information[layout.shoulders, layout.shoulders] = SHOULDERS_STD**-2
    x_left, z_left, x_right, z_right = range(layout.hinge.start, layout.hinge.stop)
    for std, rows, share in (
        (HINGE_COMMON_STD, (x_left, x_right), np.array([0.5, 0.5])),
        (HINGE_MIRROR_STD, (x_left, x_right), np.array([0.5, -0.5])),
        (HINGE_TILT_STD, (z_left,), np.ones(1)),
        (HINGE_TILT_STD, (z_right,), np.ones(1)),
    ):
        information[np.ix_(rows, rows)] += np.outer(share, share) / std**2
    return placed(center, looks), information


def known_lengths(prior: Subject, gauge: Mapping[str, float], gauge_std: float) -> tuple[np.ndarray, np.ndarray]:
    """Lengths (8,) [m] of the prior and the tapes, and their information (8, 8).

    Raises
    ------
    BadSubject
        The prior does not know how sure its lengths are.
    """
    if not set(LENGTHS) <= set(prior.order) or np.linalg.eigvalsh(prior.lengths_covariance())[0] <= 0.0:
        raise BadSubject(f"prior '{prior.name}': its lengths need a covariance that is positive definite, all of them")
    information = np.linalg.inv(prior.lengths_covariance())
    target = information @ [prior.lengths[name] for name in LENGTHS]
    for i, name in enumerate(LENGTHS):
        if name in gauge:
            information[i, i] += 1.0 / gauge_std**2
            target[i] += gauge[name] / gauge_std**2
    return np.linalg.solve(information, target), information


def stated_headings(recording: Recording, found: FilteredRecording, layout: Layout, prior: Subject) -> dict[str, float]:
    """Sensor → ψ [rad] to its nominal mount, of those that have one."""
    mounts = {name: nominal_mount(recording, name, prior) for name in layout.sensors}
    return {
        name: heading_to(found.at_start[name], Rotation.from_quat(mount))
        for name, mount in mounts.items()
        if mount is not None
    }


def _mount_information(recording: Recording, segment: str, prior: Subject) -> np.ndarray:
    """Information (3, 3) [1/rad²] of the nominal mount's error in L."""
    covariance = mount_covariance(recording, segment, prior)
    if covariance is not None:
        return np.linalg.inv(covariance + 1e-12 * np.eye(3))
    calibrated = segment in prior.mounts and not recording.remounted
    if calibrated or segment not in recording.imus:
        return np.eye(3) / READY_STD**2
    return np.diag([0.0, 0.0, STATED_STD**-2])
