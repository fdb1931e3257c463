"""How large a person's own errors are: of soft tissue, whose means are corrected, and of the start pose."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from ..compilation import kernel
from ..rotations import product, rotate_by_vector
from .body import BodyModel
from .table import ZERO, BodyTable, SoftTissue

# Least squared cosine of half the angle between long axes at which the twist between them counts in full.
LEAST_TWIST_COSINE = 0.1
# Of simulated people: the angle [rad] by which a forearm leaves the plane of its elbow, geometric mean, and how far its
# logarithm scatters. The logarithm of a person's size of soft tissue has a standard deviation among people, assumption.
USUAL_HINGE_STD, HINGE_LOG_STD = np.deg2rad(3.5), 0.15
SCATTER_LOG_STD = 0.5
# Tilts of simulated people's arms in the start pose, as a share of what the table states, geometric mean. The logarithm
# of a segment's share scatters about that of its person, which scatters as that of soft tissue; assumptions.
USUAL_POSE_SHARE, POSE_LOG_STD = 0.78, 0.35
SHOWN = 0.5  # times its standard deviation among people: a tilt that is known better counts
LEAST_REPEAT_SHARE = 0.01
LEAST_SHARE = 0.25  # nobody stands more exactly, or wears firmer straps


def estimate_scatter(hinge_stds: Collection[float]) -> float:
    """Estimate the size of what varies beyond a person's means, as a share of that among all people.

    It follows from the angles [rad] by which segments leave their hinges, by empirical Bayes.
    """
    if not hinge_stds:
        return 1.0
    weight = SCATTER_LOG_STD**2 / (SCATTER_LOG_STD**2 + HINGE_LOG_STD**2)
    ratios = np.maximum(np.array([*hinge_stds]) / USUAL_HINGE_STD, 1e-3)
    return max(float(np.exp(weight * np.mean(np.log(ratios)))), LEAST_SHARE)


def estimate_pose_share(offsets: Mapping[str, np.ndarray], table: BodyTable) -> float:
    """Estimate how far a person is off the start pose, as a share of what the table states of people.

    It follows by empirical Bayes from the tilts of segments at a hinge, such as arms, which the motion shows. Of others
    a standard deviation may be small because the prior's is. `offsets` is `Subject.start_pose_offset`.
    """
    squares, limbs = [], {name for hinge in table.hinges.values() for name in (hinge.on, hinge.moves)}
    for name, (x, y, std) in offsets.items():
        var = np.square(table.segments[name].start_std[:2])
        if name in limbs and std < SHOWN * np.sqrt(np.mean(var)):
            squares.append((x**2 + y**2) / (np.square(table.segments[name].start_mean[:2]) + var).sum())
    if not squares or table.is_mechanism:
        return 1.0
    weight = SCATTER_LOG_STD**2 / (SCATTER_LOG_STD**2 + POSE_LOG_STD**2)
    share = USUAL_POSE_SHARE * float(np.sqrt(np.mean(squares)) / USUAL_POSE_SHARE) ** weight
    return max(share, LEAST_SHARE)


def estimate_repeat_share(tilts: Collection[float]) -> float:
    """Estimate how much a start pose differs from that of the calibration, as a share of what the table states.

    It is an empirical Bayes estimate from the `tilts` between both, each over its standard deviation. The headings
    cannot be observed: they are assumed to repeat as exactly as the tilts do, as in the calibration's own recording.
    """
    if not tilts:
        return 1.0
    weight = SCATTER_LOG_STD**2 / (SCATTER_LOG_STD**2 + POSE_LOG_STD**2 + 0.5 / len(tilts))
    return float(np.clip(np.sqrt(np.mean(np.square([*tilts]))) ** weight, LEAST_REPEAT_SHARE, 1.0))


def make_personal(tissue: SoftTissue, share: float, lag: float, scatter: float) -> SoftTissue:
    """Return the soft tissue of one person: its own means, and the standard deviations that remain beyond them.

    Parameters
    ----------
    share : of the population's means for tilt and raised arms that the person has
    lag : [rad/rad] `mean_per_twist` of the person
    scatter : as of `estimate_scatter`
    """

    def remain(std: Any, mean: Any) -> Any:
        return tuple(scatter * np.sqrt(np.maximum(np.square(std) - np.square(mean), 0.0)))

    mean_per_tilt, mean_per_raised = (
        (share * x, share * y, share * z) for x, y, z in (tissue.mean_per_tilt, tissue.mean_per_raised)
    )
    return tissue._replace(
        std=remain(tissue.std, ZERO),
        per_tilt=remain(tissue.per_tilt, tissue.mean_per_tilt),
        per_twist=scatter * np.sqrt(max(tissue.per_twist**2 - tissue.mean_per_twist**2, 0.0)),
        per_raised=remain(tissue.per_raised, tissue.mean_per_raised),
        mean_per_tilt=mean_per_tilt,
        mean_per_twist=lag,
        mean_per_raised=mean_per_raised,
    )


def make_correction(body: BodyModel, segments: Sequence[str]) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that corrects orientations (..., k, 4) xyzw of k segments by a person's soft tissue.

    Only segments whose means the person's calibration shows are corrected (`BodyModel.personal`).

    Parameters
    ----------
    segments : those with a sensor, in the order of the columns of orientations
    """
    table, columns = body.table, {name: k for k, name in enumerate(segments)}
    names = [name for name in table.segments if name in columns and name in body.personal]
    tissues = [body.personal[name].soft_tissue for name in names]
    raised = np.reshape([[segment in each.raised for segment in segments] for each in tissues], (-1, len(segments)))
    terms = (
        np.array([columns[name] for name in names], dtype=np.int64),
        np.array([columns.get(table.segments[name].soft_tissue.relative_to, -1) for name in segments], np.int64),
        np.array([table.segments[name].along for name in segments]),
        np.array([tissue.mean_per_tilt for tissue in tissues]).reshape(-1, 3),
        raised / np.maximum(1, raised.sum(axis=1, keepdims=True)),
        np.array([tissue.mean_per_raised for tissue in tissues]).reshape(-1, 3),
        np.array([tissue.mean_per_twist for tissue in tissues]),
        np.array([body.personal[name].start_mean[2] for name in names]),
    )

    def correct(quat_WL: np.ndarray) -> np.ndarray:
        corrected = quat_WL.copy()
        _correct(corrected.reshape(-1, *quat_WL.shape[-2:]), *terms)
        return corrected

    return correct


@kernel
def _relate(quat, k, below):  # type: ignore[no-untyped-def]
    """Return the orientation of segment k against the one below it, four floats."""
    if below < 0:
        return quat[k, 0], quat[k, 1], quat[k, 2], quat[k, 3]
    b = quat[below]
    return product(-b[0], -b[1], -b[2], b[3], quat[k, 0], quat[k, 1], quat[k, 2], quat[k, 3])


@kernel
def _correct(quats, columns, below, along, per_tilt, raised, per_raised, lag, start):  # type: ignore[no-untyped-def]
    for n in range(len(quats)):
        quat = quats[n]
        for i in range(len(columns)):
            k = columns[i]
            elevation = 0.0
            for j in range(len(along)):
                if raised[i, j] > 0.0:
                    x, y, z, w = _relate(quat, j, below[j])
                    t = x * along[j, 0] + y * along[j, 1] + z * along[j, 2]
                    elevation += raised[i, j] * 2.0 * np.arccos(np.sqrt(min(1.0, t * t + w * w)))
            x, y, z, w = _relate(quat, k, below[k])
            ax, ay, az = along[k, 0], along[k, 1], along[k, 2]
            t = x * ax + y * ay + z * az
            twist = 2.0 * t * w / max(t * t + w * w, LEAST_TWIST_COSINE)
            # The long axis before the tilt, in the segment, less its part along the axis.
            ux, uy, uz = (
                2.0 * (t * x - w * (y * az - z * ay)),
                2.0 * (t * y - w * (z * ax - x * az)),
                2.0 * (t * z - w * (x * ay - y * ax)),
            )
            angle = lag[i] * twist
            rotate_by_vector(
                quat[k],
                per_tilt[i, 0] * (uy * az - uz * ay) + per_raised[i, 0] * elevation + angle * ax,
                per_tilt[i, 1] * (uz * ax - ux * az) + per_raised[i, 1] * elevation + angle * ay,
                per_tilt[i, 2] * (ux * ay - uy * ax) + per_raised[i, 2] * elevation + angle * az + start[i],
            )
