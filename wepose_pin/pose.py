"""`Pose`: segment orientations → configuration of the Pinocchio model → forward kinematics → points; and its table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.spatial.transform import Rotation

from . import so3
from .errors import BadData, BadModel, one_of
from .model import POINTS, BodyModel
from .recording import SEGMENTS


@dataclass(frozen=True)
class Pose:
    """The pose of the upper body over time, in W.

    Parameters
    ----------
    time : (n,) [s]
    quat_WL : segment → (n, 4) xyzw; only segments that are known
    points : point → (n, 3) [m] in W; only points that are known
    q : (n, nq) configuration of the Pinocchio model; unmeasured segments are rigid with the one above; None where the
        pose came from a table
    """

    time: np.ndarray
    quat_WL: Mapping[str, np.ndarray]
    points: Mapping[str, np.ndarray]
    q: np.ndarray | None = None


def pose_of(model: BodyModel, time: np.ndarray, quat_WL: Mapping[str, np.ndarray]) -> Pose:
    """The pose of `model` with measured segment orientations `quat_WL`, segment → (n, 4) xyzw."""
    q = configuration(model, quat_WL)
    known = known_points(quat_WL)
    frames = [link for point, link in POINTS.items() if point in known]
    _, p_W = forward_kinematics(model, q, frames, rotations=False)
    points = {point: p_W[:, k] for k, point in enumerate(known)}
    return Pose(time, {name: so3.continuous(quat) for name, quat in quat_WL.items()}, points, q)


def known_points(segments: Iterable[str]) -> list[str]:
    """Points that follow from the measured segments; a hand without a sensor is rigid with its forearm."""
    have = set(segments)
    known = []
    for point in POINTS:
        side, part = point.split("_", 1)
        needs = {
            "shoulder": ["torso"],
            "elbow": ["torso", f"{side}_upper_arm"],
            "wrist": ["torso", f"{side}_upper_arm", f"{side}_forearm"],
            "hand": ["torso", f"{side}_upper_arm", f"{side}_forearm"],
        }[part]
        if have.issuperset(needs):
            known.append(point)
    return known


def known_links(model: BodyModel, segments: Iterable[str]) -> list[str]:
    """Links whose place follows from the measured segments: those, and what is rigid with them.

    Without its sensor a hand is rigid with the forearm, head and pelvis with the torso; an upper arm or forearm
    without one is not known, and what hangs on it neither.
    """
    have = set(segments)
    spherical = {joint: link for link, joint in model.joints.items()}
    known_joint = {0: True}
    for joint in range(1, model.pin.njoints):
        link = spherical.get(joint, "")
        guessed = link in SEGMENTS and not link.endswith(("hand", "head", "pelvis"))
        known_joint[joint] = known_joint[model.pin.parents[joint]] and (link in have or not guessed)
    return [frame.name for frame in model.pin.frames[1:] if known_joint[frame.parentJoint]]


def configuration(model: BodyModel, quat_WL: Mapping[str, np.ndarray]) -> np.ndarray:
    """Configuration `q` (n, nq): at each spherical joint the quaternion of its link relative to the link above.

    Segments without an orientation are rigid with the segment above; other joints are at zero.

    Raises
    ------
    BadModel
        A measured segment is no link of the model, or does not hang on a spherical joint.
    """
    n = len(next(iter(quat_WL.values())))
    for segment in quat_WL:
        if segment not in model.joints:
            raise BadModel(
                f"{model.pin.name}: segment '{segment}' hangs on no spherical joint of this model; "
                f"{one_of(model.joints, segment)}"
            )
    link_of = {joint: link for link, joint in model.joints.items()}
    q = np.tile(pin.neutral(model.pin), (n, 1))
    world: list[Rotation] = [Rotation.identity(n)]  # orientation in W of each joint's moving frame
    for joint in range(1, model.pin.njoints):
        above = world[model.pin.parents[joint]] * Rotation.from_matrix(model.pin.jointPlacements[joint].rotation)
        link = link_of.get(joint, "")
        if link not in quat_WL:
            world.append(above)
            continue
        # The moving frame of a spherical joint is its link's frame.
        world.append(Rotation.from_quat(quat_WL[link]))
        first = model.pin.idx_qs[joint]
        q[:, first : first + 4] = so3.continuous((above.inv() * world[-1]).as_quat())
    return q


def forward_kinematics(
    model: BodyModel, q: np.ndarray, links: list[str], *, rotations: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (n, m, 3, 3) and positions (n, m, 3) [m] of links in W, by Pinocchio; rotations empty if not wanted."""
    data = model.pin.createData()
    frames = [model.pin.getFrameId(link) for link in links]
    # Views into Pinocchio's memory: reading data.oMf[f] anew costs more than the kinematics.
    p_view = [data.oMf[frame].translation for frame in frames]
    R_view = [data.oMf[frame].rotation for frame in frames] if rotations else []
    R = np.empty((len(q), len(R_view), 3, 3))
    p = np.empty((len(q), len(frames), 3))
    for k, row in enumerate(np.ascontiguousarray(q)):
        pin.framesForwardKinematics(model.pin, data, row)
        for i, view in enumerate(p_view):
            p[k, i] = view
        for i, view in enumerate(R_view):
            R[k, i] = view
    return R, p


def placements(model: BodyModel, q: np.ndarray, links: Iterable[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Link → (`quat_WL` (n, 4) xyzw, `p_WL` (n, 3) [m]), for whoever draws the body."""
    links = list(links)
    R, p = forward_kinematics(model, q, links)
    quat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat().reshape(len(q), len(links), 4)
    return {link: (so3.continuous(quat[:, k]), p[:, k]) for k, link in enumerate(links)}


# The table of pose.parquet and truth.parquet -----------------------------------------------------------------------


def pose_table(pose: Pose) -> pl.DataFrame:
    """Columns ``time``, ``<segment>_qx,_qy,_qz,_qw`` (`quat_WL`), ``<point>_x,_y,_z`` [m] in W."""
    table = {"time": pose.time}
    for segment, quat in pose.quat_WL.items():
        table |= {f"{segment}_{c}": quat[:, k] for k, c in enumerate(("qx", "qy", "qz", "qw"))}
    for point, p in pose.points.items():
        table |= {f"{point}_{c}": p[:, k] for k, c in enumerate("xyz")}
    return pl.DataFrame(table)


def pose_from_table(table: pl.DataFrame, file: str) -> Pose:
    """A `Pose` from such a table; segments and points that are not in it are not in the pose.

    Raises
    ------
    BadData
        No time, or nothing known beside it, or numbers that are no rotation.
    """
    if "time" not in table.columns:
        raise BadData(f"{file}: no column 'time'; a table as in pose.parquet is needed; {one_of(table.columns)}")
    try:
        numbers = {name: table[name].cast(pl.Float64).to_numpy() for name in table.columns}
    except pl.exceptions.PolarsError as error:
        raise BadData(f"{file}: a column holds text: {str(error).splitlines()[0]}") from error
    quat_WL, points = {}, {}
    for segment in SEGMENTS:
        names = [f"{segment}_{c}" for c in ("qx", "qy", "qz", "qw")]
        if all(name in numbers for name in names):
            quat = np.column_stack([numbers[name] for name in names])
            norm = np.linalg.norm(quat, axis=1)
            if np.any(np.abs(norm - 1.0) > 1e-2):
                raise BadData(f"{file}: {segment}_qx … _qw is no unit quaternion in row {np.argmax(abs(norm - 1)) + 1}")
            quat_WL[segment] = quat / norm[:, None]
    for point in POINTS:
        names = [f"{point}_{c}" for c in "xyz"]
        if all(name in numbers for name in names):
            points[point] = np.column_stack([numbers[name] for name in names])
    if not quat_WL and not points:
        raise BadData(f"{file}: neither orientations nor points; columns as torso_qx … or left_hand_x … are needed")
    return Pose(numbers["time"], quat_WL, points)
