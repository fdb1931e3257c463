"""Sensor-to-segment alignment: mounts R_LS and heading offsets ψ from the start pose.

A filter observes the vertical and not the heading: its world V differs from W by a rotation about the vertical,
R_WV = Rz(ψ). Alignment works with the frame L' of each segment that equals W in the start pose: the mount in it is
R_L'S = R_WS(start) = Rz(ψ) R_VS(start). Gravity gives its tilt; ψ is the angle that makes it nearest to the stated or
calibrated mount. A calibrated mount is fused with the start pose, whose standard deviation is `StartPose.std`. A
person's segment frames L equal W in the N-pose; in another start pose R_LS = R_WL(start)ᵀ R_L'S.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from .. import rotations
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadSession, one_of
from ..recording import CONFIGURATION, OrientationSensor, Recording, format_span
from .body import BodyModel
from .soft_tissue import estimate_repeat_share
from .subject import Subject
from .table import NEUTRAL_POSE, BodyTable, Vector, load_table
from .tree import check_joint_values, parse_tree

# Angles [deg] between a stated mount and gravity or motion. Above them the mount is an error or gets a warning.
MAX_MOUNT_ERROR_DEG = 60.0
MOUNT_WARNING_DEG = 35.0
# A calibrated mount has moved where gravity contradicts it by more standard deviations than this.
MOUNT_MOVED_STDS = 3.5

# Standard deviations per axis; assumptions. Those of start poses and soft tissue stand in the table of the body.
# [rad] of a device's own orientation about each axis: segments differ from optical motion capture, in walking and
# turning, by 1.1 to 5.5 deg rms in all (Lebel et al. 2017, BioMed Eng OnLine 16:56), soft tissue included.
MEASURED_ORIENTATION_STD = np.deg2rad(2.0)
SEGMENT_ATTITUDE_STD = np.deg2rad(1.5)  # [rad] of a segment's orientation in motion, mostly by soft tissue
PALM_SLIP_STD = 0.005  # [m] by which joined palms slip


@dataclass(frozen=True)
class StartPose:
    """The links of a body in the start pose, where the frame L' of each equals W."""

    R_WK: Mapping[str, np.ndarray] = field(default_factory=dict)  # link → (3, 3); without: the frame of W
    table: BodyTable = field(default_factory=load_table)
    q: np.ndarray | None = None  # (nq,) the body's configuration; None: not known
    repeat_share: float = 1.0  # of how much people repeat it (`estimate_repeat_share`)

    def std(self, segment: str, *, again: bool = False) -> np.ndarray:
        """Return one std (3,) [rad] of a segment's rotation off the start pose, or, `again`, between two of them."""
        own = self.table.segments[segment]
        return self.repeat_share * np.array(own.repeat_std) if again else np.array(own.start_std)

    def rotation(self, link: str) -> np.ndarray:
        """Return the orientation (3, 3) of a link."""
        return self.R_WK.get(link, np.eye(3))

    def turn(self, link: str, vector: Collection[float]) -> Vector:
        """Return a vector (3,) of a link's frame, in L'."""
        x, y, z = self.rotation(link) @ np.array(vector)
        return float(x), float(y), float(z)

    def to_world(self, segment: str, R_LS: Rotation) -> Rotation:
        """Return R_L'S of a mount R_LS: the sensor's orientation in W in the start pose."""
        return Rotation.from_matrix(self.R_WK[segment]) * R_LS if segment in self.R_WK else R_LS

    def to_segment(self, segment: str, R_WS: Rotation) -> Rotation:
        """Return the mount R_LS of a sensor whose orientation in the start pose is R_WS."""
        return Rotation.from_matrix(self.R_WK[segment]).inv() * R_WS if segment in self.R_WK else R_WS


N_POSE = StartPose()


def find_start_pose(body: BodyModel, recording: Recording) -> StartPose:
    """Find the links of a body in the start pose of its recording."""
    q = compute_start_configuration(body, recording.start_pose, recording.joints, recording.where())
    # A person's segment frames equal W in the N-pose, whatever the pose of a body whose joints are at zero.
    is_neutral = recording.start_pose == NEUTRAL_POSE and not body.table.is_mechanism
    return StartPose({} if is_neutral else body.orient_links(q), body.table, q)


def compute_start_configuration(
    model: BodyModel, start_pose: str, joints: Mapping[str, float], where: str
) -> np.ndarray:
    """Compute `q` (nq,) in the start pose, of the body's table or a "configuration" of joints [rad or m], else at zero.

    `where` begins the text of a `BadSession`: an unknown start pose or joint, or one outside its limits.
    """
    poses = {**model.table.poses, CONFIGURATION: joints}
    if start_pose not in poses:
        raise BadSession(f"{where}: start_pose = '{start_pose}' is not known; {one_of(poses, start_pose)}")
    values, m = poses[start_pose], model.pin
    check_joint_values(model.robot, values, f"{where}: joints", BadSession)
    q, tree = pin.neutral(m), parse_tree(model.robot, where)
    for joint in range(1, m.njoints):
        if m.nqs[joint] == 1:
            q[m.idx_qs[joint]] = values.get(m.names[joint], 0.0)
    for link, axes in model.axes.items():  # three joints that are one spherical joint
        angles = np.array([[values.get(joint.name, 0.0)] for joint in tree.path(link)[-3:]])
        first, second, third = Rotation.from_rotvec(angles * axes)
        at = m.idx_qs[m.getJointId(link)]
        q[at : at + 4] = (first * second * third).as_quat()
    return q


def collect_nominal_mounts(
    recording: Recording, subject: Subject | None, start_pose: StartPose
) -> dict[str, np.ndarray]:
    """Return segment → nominal mount `quat_LS` (4,) xyzw of every sensor; raise `BadSession` where one is not known."""
    nominal = {segment: find_nominal_mount(recording, segment, subject, start_pose) for segment in recording.sensors}
    missing = [segment for segment, mount in nominal.items() if mount is None]
    if missing:
        others = f", nor that of {', '.join(missing[1:])}" if len(missing) > 1 else ""
        if subject is not None and recording.remounted and set(missing) & set(subject.mounts):
            others += " (remounted = true: the subject's are of another mounting)"
        # Calibrations close chains of lengths: they find no mount of a segment on which no length lies.
        can_calibrate = {length.segment for length in start_pose.table.lengths.values()} & set(missing)
        remedy = "; or find it by `wepose calibrate` (without a clasp `protocol` free), then track with its `subject`"
        raise BadSession(
            f"{recording.where()}: sensors.{missing[0]}.mount is not known{others}: state it, as in "
            f'mount = {{ up = "+x", forward = "-z" }}{remedy if can_calibrate else ""}'
        )
    return {segment: mount for segment, mount in nominal.items() if mount is not None}


def find_nominal_mount(
    recording: Recording, segment: str, subject: Subject | None, start_pose: StartPose = N_POSE
) -> np.ndarray | None:
    """Find the mount `quat_LS` (4,) xyzw: the calibrated one, else the stated one; None: unknown.

    A stated mount names the sensor's axes that point up and forward in the start pose. Where a device measures the
    orientation of the segment itself, and no mount is stated, it is the identity.
    """
    if subject is not None and segment in subject.mounts and not recording.remounted:
        return subject.mounts[segment]
    sensor = recording.sensors[segment]
    if sensor.stated_quat_LS is None:
        is_own = isinstance(sensor, OrientationSensor) and (sensor.aligned or not recording.remounted)
        return np.array([0.0, 0.0, 0.0, 1.0]) if is_own else None
    return start_pose.to_segment(segment, Rotation.from_quat(sensor.stated_quat_LS)).as_quat()


def find_mount_covariance(
    recording: Recording, segment: str, subject: Subject | None, start_pose: StartPose = N_POSE
) -> np.ndarray | None:
    """Find the covariance (3, 3) [rad²] of a calibrated mount's error in L', in the N-pose L; None: not known."""
    cov = None if subject is None or recording.remounted else subject.mount_covariance(segment)
    R = start_pose.rotation(segment)
    return None if cov is None else R @ cov @ R.T


def compute_start_heading_var(
    recording: Recording, segment: str, subject: Subject | None, start_pose: StartPose
) -> float:
    """Compute the variance [rad²] that an inexact start pose gives a segment's heading offset; 0: it defines x."""
    # A calibrated mount contains the heading error of its start pose; what differs between two of them is left.
    is_calibrated = subject is not None and segment in subject.start_pose_offset and not recording.remounted
    is_reference = segment == start_pose.table.reference
    return 0.0 if is_reference else float(start_pose.std(segment, again=is_calibrated)[2] ** 2)


def compute_heading_offset(R_VS: Rotation, R_WS: Rotation) -> float:
    """Return ψ [rad] such that Rz(ψ) R_VS is nearest to R_WS: the twist about the vertical of R_WS R_VSᵀ."""
    return float(rotations.heading((R_WS * R_VS.inv()).as_quat()))


def align_sensors(
    recording: Recording,
    subject: Subject | None,
    R_VS_start: Mapping[str, Rotation],
    start: tuple[float, float],
    start_pose: StartPose = N_POSE,
) -> tuple[dict[str, Rotation], dict[str, float], list[Diagnostic], float]:
    """Compute mounts R_LS and heading offsets ψ [rad] of all sensors, with the diagnostics of the mounts.

    The last number is `StartPose.repeat_share`.

    Parameters
    ----------
    recording : the one that was filtered, or its chunk that contains the start pose
    subject : its mounts are used in place of those that the session states; None: the stated ones are used
    R_VS_start, start : mean orientations of the sensors in the start pose, and its interval [s]
    start_pose : `find_start_pose` of the body; left out: the N-pose

    Raise `BadSession` where no mount is known for a sensor, or gravity contradicts it.
    """
    diagnostics: list[Diagnostic] = []
    nominal_mounts = collect_nominal_mounts(recording, subject, start_pose)
    mounts: dict[str, Rotation] = {}
    heading_offsets: dict[str, float] = {}
    repeats = list[float]()
    # The segment that faces x is the first of the table; without a sensor there the first one that has a sensor.
    aligned = [segment for segment, sensor in recording.sensors.items() if sensor.aligned]
    for segment, R_VS in R_VS_start.items():
        if segment in aligned:
            R_WL_start = start_pose.to_world(aligned[0], Rotation.identity())
            mounts[segment] = Rotation.identity()
            heading_offsets[segment] = compute_heading_offset(R_VS_start[aligned[0]], R_WL_start)
            continue
        R_WS_nominal = start_pose.to_world(segment, Rotation.from_quat(nominal_mounts[segment]))
        psi = compute_heading_offset(R_VS, R_WS_nominal)
        R_WS_start = Rotation.from_rotvec([0.0, 0.0, psi]) * R_VS
        error = R_WS_start * R_WS_nominal.inv()
        tilt_error = float(error.magnitude())
        if tilt_error > np.deg2rad(MAX_MOUNT_ERROR_DEG):
            name, remedy = ".mount", "state which sensor axis points up and which forward"
            if subject is not None and segment in subject.mounts and not recording.remounted:
                name = ": its calibrated mount"
                remedy = "if the sensor was mounted again, state remounted = true and its mount"
            raise BadSession(
                f"{recording.where()}: sensors.{segment}{name} is {np.degrees(tilt_error):.0f} deg off gravity in the "
                f"start pose ({format_span(start)}); {remedy}, or the seconds of the start pose in [phases]"
            )
        mount_cov = find_mount_covariance(recording, segment, subject, start_pose)
        value, limit, facts = tilt_error, float(np.deg2rad(MOUNT_WARNING_DEG)), dict[str, float | str]()
        if mount_cov is not None and subject is not None:
            # Kalman update of the mount by the two observed components of tilt. The start pose observes no heading;
            # the mount's heading changes by correlation alone.
            misfit = error.as_rotvec()[:2]
            misfit_cov = mount_cov[:2, :2] + np.diag(start_pose.std(segment)[:2] ** 2)
            R_WS_start = Rotation.from_rotvec(mount_cov[:, :2] @ np.linalg.solve(misfit_cov, misfit)) * R_WS_nominal
            psi = compute_heading_offset(R_VS, R_WS_start)
            if segment in subject.start_pose_offset:
                # The calibrated mount has the same error as the tilt of its start pose; only repeatability is left.
                misfit = misfit - subject.start_pose_offset[segment][:2]
                repeat_std = np.array(start_pose.table.segments[segment].repeat_std[:2])
                misfit_cov = np.diag(repeat_std**2)
                repeats += (misfit / repeat_std).tolist()
            stds, facts = float(misfit @ np.linalg.solve(misfit_cov, misfit)) ** 0.5, {"variant": "as-calibrated"}
            if stds > MOUNT_MOVED_STDS:
                value = float(np.linalg.norm(misfit))
                limit = value * MOUNT_MOVED_STDS / stds  # [rad] in the direction of the misfit
                facts = {"variant": "calibrated", "stds": MOUNT_MOVED_STDS}
        if value > limit:
            diagnostics.append(Diagnostic("mount-contradicted", WARNING, segment, value, limit, facts))
        mounts[segment], heading_offsets[segment] = start_pose.to_segment(segment, R_WS_start), psi
    return mounts, heading_offsets, diagnostics, estimate_repeat_share(repeats)
