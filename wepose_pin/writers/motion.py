"""What is exported: a pose with its body, or a URDF with its joints over time, of a person or of a robot."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from ..angles import NEAR_LOCK, euler
from ..body import BodyModel
from ..body.configuration import compute_pose, solve_configuration
from ..body.kinematics import compute_joint_values, find_usual_rate
from ..body.tree import joint_axis, parse_tree
from ..body.urdf import read_urdf
from ..data_tables import read_columns, read_table
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, MissingFile, WrongOption
from ..libraries import library_errors
from ..recording import Intervals, select_interval
from ..recording.clocks import interpolate
from ..rotations import multiply
from ..tracking import TrackResult
from .result import TRAJECTORY, read_phases

ROBOT_URDF = "robot.urdf"
# Times count as even while none is off the even grid by more than this share of a step.
EVEN = 0.1
SLACK_S = 1e-6  # [s] by which times that are written with digits differ
_ONE_AXIS = ("revolute", "continuous", "prismatic")


def make_times(time: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return even times (m,) [s] at this rate, from the first of the times (n,) to the last."""
    return np.asarray(time[0] + np.arange(int((time[-1] - time[0]) * rate_hz + SLACK_S) + 1) / rate_hz)


def is_even(time: np.ndarray) -> bool:
    """Return whether times (n,) are those of a constant rate."""
    grid = np.linspace(time[0], time[-1], len(time))
    return bool(np.abs(time - grid).max() * find_usual_rate(time) <= EVEN)


def check_rate(rate_hz: float) -> None:
    """Raise `WrongOption` where no recording has that rate."""
    if not 1.0 <= rate_hz <= 10000.0:
        raise WrongOption("rate_hz", f"{rate_hz:g}", "between 1 and 10000 samples a second")


def resample_evenly(motion: TrackResult) -> TrackResult:
    """Return the motion on even times."""
    return motion if is_even(motion.pose.time) else resample(motion, motion.rate_hz)


def resample(motion: TrackResult, rate_hz: float) -> TrackResult:
    """Return the motion at another rate: orientations by the shortest way between two samples, points from the body.

    No filter comes before: what is faster than half the new rate is folded. `BadData` is raised where an orientation
    is not known.
    """
    check_complete(motion, "resampling")
    pose, old = motion.pose, motion.pose.time
    time = np.minimum(make_times(old, rate_hz), old[-1])
    after = np.clip(np.searchsorted(old, time, side="left"), 1, len(old) - 1)
    share = (time - old[after - 1]) / (old[after] - old[after - 1])
    first, last = share < 1.0 - 1e-6, share > 1e-6  # samples to which the old ones contribute
    quat_WL = {name: interpolate(old, quat, time) for name, quat in pose.quat_WL.items()}
    parts: dict[str, Any] = {
        name: {each: ((1.0 - share) * cov[after - 1].T + share * cov[after].T).T for each, cov in covs.items()}
        for name, covs in ((name, getattr(pose, name)) for name in ("segment_cov", "point_cov", "heading_cov"))
    }
    parts["gap"] = {name: (gap[after - 1] & first) | (gap[after] & last) for name, gap in pose.gap.items()}
    return replace(motion, pose=replace(compute_pose(motion.model, time, quat_WL), **parts))


def check_complete(motion: TrackResult, format_name: str) -> None:
    """Raise `BadData` where a sample of a segment has no orientation, which the format cannot leave out."""
    for segment, quat in motion.pose.quat_WL.items():
        lost = ~np.isfinite(quat).all(axis=1)
        if lost.any():
            place = f"{motion.where}: {segment} has no orientation in row {int(np.argmax(lost)) + 1} of pose.parquet"
            raise BadData(f"{place}; {format_name} needs one in every row, csv and parquet do not")


def diagnose_gaps(motion: TrackResult) -> list[Diagnostic]:
    """List the segments with gaps, where a format has no way to mark them."""
    return [
        Diagnostic("samples-lost", WARNING, segment, int(np.count_nonzero(gap)), facts={"variant": "unmarked"})
        for segment, gap in motion.pose.gap.items()
        if gap.any()
    ]


def find_measured_points(motion: TrackResult) -> dict[str, np.ndarray]:
    """Point → (n, 3) [m] in W, NaN where a segment on its way from the root was bridged; `BadData`: none is known."""
    pose = motion.pose
    if not pose.points:
        reference = motion.model.table.reference
        raise BadData(f"{motion.where}: no points in pose.parquet, for lack of a sensor on the {reference}")
    points = {}
    for point, p_W in pose.points.items():
        lost = [pose.gap[link] for link in motion.model.reaches[point] if link in pose.gap]
        points[point] = np.where(np.any(lost, axis=0)[:, None], np.nan, p_W) if lost else p_W
    return points


# Joints ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class JointMotion:
    """A motion by the joints of a URDF."""

    name: str  # of the recording of a person, of the robot
    where: str  # the result's folder, for error texts
    robot: Any  # the URDF as yourdfpy has it
    urdf: str  # its text
    joints: tuple[str, ...]  # names of those that move
    time: np.ndarray  # (n,) [s]
    position: np.ndarray  # (n, joints) [rad or m]
    velocity: np.ndarray  # (n, joints) [rad/s or m/s]
    recorded_time: np.ndarray  # (n,) [s] of the recording at each sample
    posture: Mapping[str, float] = field(default_factory=dict)  # joint that stays → its value; zero where not named
    p_WB: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [m] of the root link in W
    quat_WB: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))  # xyzw of the root link in W
    phases: Mapping[str, Intervals] = field(default_factory=dict)  # [s] of the recording
    begin: int = 0  # the first sample after the robot's approach
    source: str = ""  # name of the recording that a robot follows

    @property
    def rate_hz(self) -> float:
        """The rate of its usual time step."""
        return find_usual_rate(self.time)

    @cached_property
    def root(self) -> str:
        """The link without a parent."""
        return str(parse_tree(self.robot, self.where).root)

    @cached_property
    def ordered(self) -> list[Any]:
        """The URDF's joints depth first, in the order of the file, as MuJoCo numbers them."""
        ordered, below = [], parse_tree(self.robot, self.where).below
        waiting = [*reversed(below[self.root])]
        while waiting:
            ordered.append(joint := waiting.pop())
            waiting += reversed(below[joint.child])
        return ordered

    @property
    def moving(self) -> tuple[str, ...]:
        """All joints of one axis that copy no other, also those that stay, in the order of `ordered`."""
        return tuple(joint.name for joint in self.ordered if joint.type in _ONE_AXIS and joint.mimic is None)

    def values(self, joint: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions (n,) of a joint [rad or m], and its velocities."""
        if joint not in self.joints:
            return np.full(len(self.time), self.posture.get(joint, 0.0)), np.zeros(len(self.time))
        k = self.joints.index(joint)
        return self.position[:, k], self.velocity[:, k]

    def samples(self, interval: tuple[float, float]) -> slice:
        """Return the samples after the approach that follow an interval [s] of the recording."""
        recorded = self.recorded_time[self.begin :]
        first, last = np.searchsorted(recorded, [interval[0] - SLACK_S, interval[1] + SLACK_S])
        # At the end the robot settles while the recording stands still.
        return slice(self.begin + int(first), self.begin + int(last))

    def cut(self, samples: slice) -> JointMotion:
        """Return the motion at some samples only."""
        of_samples = {name: getattr(self, name)[samples] for name in ("time", "position", "velocity", "recorded_time")}
        return replace(self, **of_samples, begin=0)

    def select(self, interval: tuple[float, float] | None, phase: str | None) -> JointMotion:
        """Return the part that follows an interval [s] or a phase of the recording; both None: all of it."""
        selected = select_interval(self.recorded_time, self.phases, interval, phase)
        part = self if selected is None else self.cut(self.samples(selected))
        if selected is not None and len(part.time) < 2:
            raise BadData(f"{self.where}: follows no {selected[0]:g} to {selected[1]:g} s of the recording")
        return part

    def resample(self, rate_hz: float) -> JointMotion:
        """Return the motion at another rate, on the cubics through positions and velocities."""
        time = make_times(self.time, rate_hz)
        curve, inside = CubicHermiteSpline(self.time, self.position, self.velocity), np.minimum(time, self.time[-1])
        return replace(
            self,
            time=time,
            position=curve(inside),
            velocity=curve.derivative()(inside),
            recorded_time=np.interp(inside, self.time, self.recorded_time),
            begin=int(np.searchsorted(time, self.time[min(self.begin, len(self.time) - 1)] - SLACK_S)),
        )


@runtime_checkable
class HasJointMotion(Protocol):
    """What moves a robot, such as a trajectory of `retarget`."""

    def joint_motion(self) -> JointMotion:
        """Return the motion."""


class LinkTransform(NamedTuple):
    """A link in its parent link: xyzw (n, 4) and [m] (n, 3), or of one row where it is fixed to it."""

    parent: str
    quat: np.ndarray
    p: np.ndarray


def compute_link_transforms(motion: JointMotion) -> dict[str, LinkTransform]:
    """Compute the transform of every link but the root, parents before children."""
    transforms = {}
    for joint in motion.ordered:
        origin = joint.origin
        quat, p = Rotation.from_matrix(origin[:3, :3]).as_quat()[None], origin[None, :3, 3]
        if joint.type in _ONE_AXIS:
            source, factor, offset = joint.name, 1.0, 0.0
            if joint.mimic is not None:
                source, factor, offset = joint.mimic.joint, joint.mimic.multiplier or 1.0, joint.mimic.offset or 0.0
            along = (factor * motion.values(source)[0] + offset)[:, None] * joint_axis(joint)
            quat, p = np.repeat(quat, len(along), axis=0), np.repeat(p, len(along), axis=0)
            if joint.type == "prismatic":
                p = p + along @ origin[:3, :3].T
            else:
                quat = multiply(quat, Rotation.from_rotvec(along).as_quat())
        transforms[joint.child] = LinkTransform(joint.parent, quat, p)
    return transforms


# Of a robot ----------------------------------------------------------------------------------------------------------


def read_joint_motion(folder: Path) -> JointMotion:
    """Read the trajectory that `wepose retarget` wrote; `MissingFile` or `BadData`: it is none, or is damaged."""
    file, summary_file, urdf = folder / TRAJECTORY, folder / "summary.json", folder / ROBOT_URDF
    if lost := [path.name for path in (file, summary_file, urdf) if not path.is_file()]:
        raise MissingFile(f"{folder}: no {lost[0]} in it; a folder that `wepose retarget` wrote is needed here")
    with library_errors(summary_file, "the summary of a trajectory"):
        summary = json.loads(summary_file.read_text(encoding="utf-8"))
        joints, approach_s = tuple(map(str, summary["joints"])), float(summary["approach_s"])
        place = np.array([float(summary["root"][key]) for key in ("x", "y", "z", "qx", "qy", "qz", "qw")])
        posture = {str(joint): float(value) for joint, value in summary["posture"].items()}
        named = {"name": str(summary["robot"]), "source": str(summary["recording"])}
    columns = ["time", "recorded_time", *joints, *(f"{joint}_velocity" for joint in joints)]
    values = read_columns(read_table(file), columns, str(file), str(file))
    time = values[:, 0]
    if not np.isfinite(values).all() or len(time) < 2 or np.any(np.diff(time) <= 0.0):
        raise BadData(f"{file}: needs two rows at least, a number in each cell, and times that grow")
    return JointMotion(
        where=str(folder),
        robot=read_urdf(urdf),
        urdf=urdf.read_text(encoding="utf-8", errors="replace"),
        joints=joints,
        time=time,
        recorded_time=values[:, 1],
        position=values[:, 2 : 2 + len(joints)],
        velocity=values[:, 2 + len(joints) :],
        posture=posture,
        p_WB=place[:3],
        quat_WB=place[3:] / np.linalg.norm(place[3:]),
        phases=read_phases(summary),
        begin=int(np.searchsorted(time, approach_s - SLACK_S)),
        **named,
    )


# Of a person ---------------------------------------------------------------------------------------------------------


def convert_person(motion: TrackResult) -> JointMotion:
    """Return a person's motion by the joints of the subject's URDF: a spherical joint is three of one axis."""
    check_complete(motion, "a file of joints")
    motion = resample_evenly(motion)
    model, pose = motion.model, motion.pose
    spherical = [name for name, size in zip(model.pin.names, model.pin.nvs, strict=True) if size == 3]
    if free := [child for child in spherical if child not in model.axes]:
        raise BadData(f"{motion.where}: link '{free[0]}' hangs on a joint of type floating, which has no axes to state")
    q = solve_configuration(model, pose.quat_WL) if pose.q is None else pose.q
    values = compute_joint_values(model.pin, q)
    for child in model.axes:
        values |= _split_triple(model, child, q)
    position = np.stack(list(values.values()), axis=1)
    return JointMotion(
        name=motion.name,
        where=motion.where,
        robot=model.robot,
        urdf=model.urdf(),
        joints=tuple(values),
        time=pose.time,
        recorded_time=pose.time,
        position=position,
        velocity=np.gradient(position, pose.time, axis=0),
    )


def _split_triple(model: BodyModel, child: str, q: np.ndarray) -> dict[str, np.ndarray]:
    """Compute the angles (n,) [rad] of the three revolute joints that are one spherical joint of the model."""
    first, axes = model.pin.idx_qs[model.pin.getJointId(child)], model.axes[child]
    last = -1.0 if np.linalg.det(axes) < 0.0 else 1.0  # mirrored axes
    basis = axes * [[1.0], [1.0], [last]]
    # R = exp(a1 q1) exp(a2 q2) exp(a3 q3), in coordinates along the axes Rx Ry Rz.
    quat = np.column_stack([q[:, first : first + 3] @ basis.T, q[:, first + 3]])
    angles = euler.follow(euler.decompose(quat, "XYZ"), "XYZ", NEAR_LOCK) * [1.0, 1.0, last]
    triple = parse_tree(model.robot, child).path(child)[-3:]
    return {joint.name: angles[:, k] for k, joint in enumerate(triple)}
