"""What is known before the motion: lengths, stated mounts, how people stand and how sensors drift.

All of it is one Gaussian over the unknowns of `least_squares`.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..body.girdle import PARAMETERS
from ..body.mounts import MEASURED_ORIENTATION_STD, find_mount_covariance
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

    It raises `BadSubject` where the prior has no positive definite covariance of its lengths.
    """
    layout, table = observations.layout, problem.model.table
    mean, information = np.zeros(layout.size), np.zeros((layout.size, layout.size))
    _add_shape(mean, information, problem, layout)
    stated_headings = problem.stated_headings(layout.sensors)
    for i, name in enumerate(layout.sensors):
        rows = [*layout.tilt[i], layout.heading[i]]
        offset, information[np.ix_(rows, rows)] = _mount_prior(problem, name, stated_headings.get(name))
        mean[rows] = offset + [0.0, 0.0, stated_headings.get(name, 0.0)]
    information[layout.drift, layout.drift] = DRIFT_STD**-2
    for name, foam in zip(layout.soft, layout.foam, strict=True):
        information[foam, foam] = np.maximum(np.tile(table.segments[name].foam_std, 3), LEAST_FOAM_STD) ** -2.0
    information[layout.twist, layout.twist] = np.array([std for *_, std in layout.twists]) ** -2.0
    # Axes of hinges; those of a left and a right one are partly alike.
    hinges = {hinge.name: rows for hinge, rows in zip(layout.hinges, layout.hinge, strict=True)}
    for name, (across, tilted) in hinges.items():
        hinge, other = table.hinges[name], table.counterpart(name)
        information[tilted, tilted] = hinge.tilt_std**-2
        if other not in hinges:
            information[across, across] = 1.0 / (hinge.common_std**2 + hinge.mirror_std**2)
        elif table.side(name) == "left":
            pair = np.ix_((across, hinges[other][0]), (across, hinges[other][0]))
            information[pair] = 0.25 * hinge.common_std**-2 + 0.25 * hinge.mirror_std**-2 * np.array([[1, -1], [-1, 1]])
    # Heights of planes, and points of W.
    information[layout.height, layout.height] = POINT_STD**-2
    fixed = [c.closure for c in observations.conditions if isinstance(c, Loop) and c.kind == "fixed_point"]
    for closure, point in zip(fixed, layout.point, strict=True):
        information[point, point] = (POINT_STD if closure.at is None else closure.at_std) ** -2
        mean[point] = closure.at or 0.0
    return mean, information


def _add_shape(mean: np.ndarray, information: np.ndarray, problem: CalibrationProblem, layout: Layout) -> None:
    """Lengths and girdles, jointly: of the prior, else of the table, with measured lengths."""
    prior, table, size = problem.prior, problem.model.table, len(PARAMETERS)
    own = [prior.girdles.get(term.name, np.zeros(size)) for term in layout.girdles]
    count, names = len(layout.lengths), list(table.girdles)
    rows = np.arange(size)
    chosen = [np.arange(count), *(count + size * names.index(term.name) + rows for term in layout.girdles)]
    covariance = prior.shape_covariance(table)[np.ix_(np.concatenate(chosen), np.concatenate(chosen))]
    covariance[count:, count:] += LEAST_GIRDLE_STD**2 * np.eye(len(covariance) - count)
    if not set(layout.lengths) <= set(prior.order) or np.any(np.linalg.eigvalsh(covariance) <= 0.0):
        raise BadSubject(f"prior '{prior.name}': its lengths need a covariance that is positive definite, all of them")
    K = np.linalg.inv(covariance)
    target = K @ np.concatenate(([prior.lengths[name] for name in layout.lengths], *own))
    for name, (metres, std) in problem.measured.items():
        i = layout.lengths.index(name)
        K[i, i] += std**-2
        target[i] += metres * std**-2
    places = np.concatenate((layout.length, layout.girdle.ravel()))
    mean[places], information[np.ix_(places, places)] = np.linalg.solve(K, target), K


def _mount_prior(problem: CalibrationProblem, segment: str, heading: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Mean (3,) and information (3, 3) of a sensor's (ε_x, ε_y, ψ), with ψ relative to its `heading`.

    The person stands nearly in the start pose. A mount R_LS = exp(m) R_0 has a small error m = μ − ε + ψ e_z, with μ
    the misfit of the start pose at the heading nearest to R_0.
    """
    recording, prior, own = problem.recording, problem.prior, problem.model.table.segments[segment]
    R_start = problem.start_pose.rotation(segment)
    start_cov = R_start @ np.diag(np.square(own.start_std)) @ R_start.T
    mean, information = np.zeros(3), np.zeros((3, 3))
    information[:2, :2], information[2, 2] = np.linalg.inv(start_cov[:2, :2]), HEADING_STD**-2
    if recording.start_pose == NEUTRAL_POSE:
        mean[:2] = own.start_mean[:2]
    mount = problem.mount(segment)
    if mount is None or heading is None:
        return mean, information
    covariance = find_mount_covariance(recording, segment, prior)
    if covariance is not None:
        of_mount = np.linalg.inv(R_start @ covariance @ R_start.T + 1e-12 * np.eye(3))
    elif segment in recording.imus and (recording.remounted or segment not in prior.mounts):
        of_mount = np.diag([0.0, 0.0, STATED_STD**-2])
    else:
        of_mount = np.eye(3) / MEASURED_ORIENTATION_STD**2
    turn = Rotation.from_rotvec([0.0, 0.0, heading])
    misfit = (turn * problem.filtered.R_VS_start[segment] * mount.inv()).as_rotvec()
    signs = np.diag([-1.0, -1.0, 1.0])
    both = information + signs @ of_mount @ signs
    target = information @ mean - signs @ of_mount @ np.append(misfit[:2], 0.0)
    return np.linalg.solve(both + 1e-9 * np.eye(3), target), both


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
            x[layout.height[condition.unknown]] += gaps[span, : condition.closure.rows].mean()
    return x
