"""A pose → the angles of its joints, after Wu et al. 2005 and 2002 and, of the knee, Grood and Suntay 1983."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..arguments import check_arguments
from ..body.kinematics import Pose
from ..diagnostics import INFO, Diagnostic
from ..errors import BadData, BadOption, Named, one_of
from ..recording import AXES
from ..rotations import conjugate, multiply
from ..tracking import TrackResult
from . import euler

# Where the ISB's axes X, Y, Z of a segment point in our frame of it. X is forward (of a forearm and a hand: to the side
# of the palm), Y up or proximal, Z to the right (of a forearm and a hand: from the ulna to the radius, the side of the
# thumb). In the N-pose, palms to the thighs, a forearm is turned by 90° of pronation from the anatomical position, in
# which all of the ISB's axes are parallel; so are the axes here.
ISB_AXES = dict.fromkeys(("world", "torso", "upper_arm", "pelvis", "thigh", "shank", "foot"), ("+x", "+z", "-y"))
ISB_AXES |= dict.fromkeys(("forearm", "hand"), ("+y", "+z", "+x"))
# The axes of both segments of a right knee, by which Grood and Suntay's three angles have their signs: forward, distal,
# medial.
KNEE_AXES = ("+x", "-z", "+y")
# Signs that mirror on the sagittal plane: quaternions xyzw, and rotation vectors.
_MIRRORED_QUAT = np.array([-1.0, 1.0, -1.0, 1.0])
_MIRRORED_TURN = np.array([-1.0, 1.0, -1.0])

# Nearer than this to the lock [rad] an angle is flagged: there an error of the orientation is 5.8 times that in the
# first and third angle, or more.
NEAR_LOCK = float(np.radians(10.0))
MAX_NEAR_LOCK = 0.01  # of the samples: of an angle that is read as a whole

# Sequence of a shoulder's angles → their names; docs/angles.md says where each is positive.
SHOULDER_SEQUENCES = {
    "YXY": ("plane_of_elevation", "elevation", "internal_rotation"),  # Wu 2005, 2.4.7
    "XZY": ("adduction", "flexion", "internal_rotation"),
    "ZXY": ("flexion", "adduction", "internal_rotation"),
}
AUTO = "auto"  # the sequence of `choose_shoulder_sequence`


class Joint(NamedTuple):
    """A joint's two segments and the names of its angles; empty for the shoulder's choice."""

    proximal: str
    distal: str
    names: tuple[str, ...]
    sequence: str = "ZXY"
    axes: tuple[str, str, str] | None = None  # X, Y, Z of both segments in our frame of them; None: `ISB_AXES`


_THORAX = ("extension", "lateral_flexion_right", "axial_rotation_left")  # Wu 2005, 2.4.1
_ELBOW = ("flexion", "carrying_angle", "pronation")  # Wu 2005, 3.4.1
_WRIST = ("flexion", "ulnar_deviation", "pronation")  # Wu 2005, 4.4.1
_PELVIS = ("posterior_tilt", "obliquity_right_down", "axial_rotation_left")
_HIP = ("flexion", "adduction", "internal_rotation")  # Wu 2002
_KNEE = ("flexion", "adduction", "external_rotation")  # Grood and Suntay 1983
_ANKLE = ("dorsiflexion", "inversion", "internal_rotation")  # Wu 2002

SIDES = ("left", "right")
JOINTS = {"thorax": Joint("world", "torso", _THORAX)}
for _side in SIDES:
    JOINTS |= {
        f"{_side}_shoulder": Joint("torso", f"{_side}_upper_arm", (), ""),
        f"{_side}_elbow": Joint(f"{_side}_upper_arm", f"{_side}_forearm", _ELBOW),
        f"{_side}_wrist": Joint(f"{_side}_forearm", f"{_side}_hand", _WRIST),
    }
# In the axes of Wu 2002, who give no sequence in W: the thorax's. A table has the segment's columns as "pelvis".
JOINTS["pelvis_in_world"] = Joint("world", "pelvis", _PELVIS)
for _side in SIDES:
    JOINTS |= {
        f"{_side}_hip": Joint("pelvis", f"{_side}_thigh", _HIP),
        f"{_side}_knee": Joint(f"{_side}_thigh", f"{_side}_shank", _KNEE, axes=KNEE_AXES),
        f"{_side}_ankle": Joint(f"{_side}_shank", f"{_side}_foot", _ANKLE),
    }


@dataclass(frozen=True)
class JointAngles:
    """The angles of one joint over time.

    `std` is at most that of an angle even over the circle (104°). `quat` is the rotation that the angles are of: the
    distal segment in the proximal one, both in the ISB's axes (a knee: in `KNEE_AXES`), a left joint mirrored on the
    sagittal plane as its angles are.
    """

    sequence: str  # intrinsic axes, such as "ZXY"
    names: tuple[str, ...]  # of the three angles
    values: np.ndarray  # (n, 3) [rad], continuous but for what is near the lock; NaN where the pose has none
    gimbal: np.ndarray  # (n,) [rad], how far from gimbal lock, at most π/2
    near_lock: np.ndarray  # (n,) bool, within 10° of the lock, where first and third angle say little and jump
    gap: np.ndarray  # (n,) bool, one of the segments was bridged over a gap of its sensor, or is not known
    std: np.ndarray | None  # (n, 3) [rad], one standard deviation; None where the pose has no covariances
    quat: np.ndarray  # (n, 4) xyzw

    def __getitem__(self, angle: str) -> np.ndarray:
        """(n,) [rad], the values of the angle of this name."""
        return Named("angle", dict(zip(self.names, self.values.T, strict=True)))[angle]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __repr__(self) -> str:
        return f"JointAngles({', '.join(self.names)}: {len(self.values)} samples [rad], {self.sequence})"

    def hidden(self, k: int) -> np.ndarray:
        """(n,) bool, where the k-th angle is not to be read: in gaps, and but for the second near gimbal lock."""
        return self.gap if k == 1 else self.gap | self.near_lock


@dataclass(frozen=True)
class Angles:
    """The angles of all joints whose segments are known: ``angles[joint][angle]`` is (n,) [rad]."""

    time: np.ndarray  # (n,) [s]
    joints: Mapping[str, JointAngles]  # name → its three angles and their standard deviations

    def __getitem__(self, joint: str) -> JointAngles:
        """The angles of the joint of this name."""
        return Named("joint", self.joints)[joint]

    def __iter__(self) -> Iterator[str]:
        return iter(self.joints)

    def __repr__(self) -> str:
        return f"Angles({', '.join(self.joints)}: {len(self.time)} samples)"


def diagnose_lock(angles: Angles) -> list[Diagnostic]:
    """Diagnose joints that are near gimbal lock for more than `MAX_NEAR_LOCK` of the samples."""
    diagnostics = []
    for name, joint in angles.joints.items():
        share = float(np.mean(joint.near_lock))
        if share > MAX_NEAR_LOCK:
            facts = {"first": joint.names[0], "third": joint.names[2]}
            facts |= {"variant": "hanging"} if joint.sequence == "YXY" else {}
            diagnostics.append(Diagnostic("angles-near-lock", INFO, name, share, MAX_NEAR_LOCK, facts))
    return diagnostics


def group_sides(joints: Iterable[str]) -> dict[str, dict[str, str]]:
    """Joint without its side → side ("left", "right", or its name where it has none) → joint."""
    groups: dict[str, dict[str, str]] = {}
    for joint in joints:
        group = joint.removeprefix("left_").removeprefix("right_")
        groups.setdefault(group, {})[joint.removesuffix(f"_{group}")] = joint
    return groups


def joint_angles(pose: Pose | TrackResult, sequence: str = "YXY") -> Angles:
    """Joint angles after the ISB: thorax and pelvis in W, shoulders, elbows, wrists, hips, knees, ankles, as measured.

    Left joints are mirrored on the sagittal plane first, so that an angle has the same sign and meaning on both sides.
    Angles are continuous over time; samples within 10° of gimbal lock are flagged, and full turns are not added up
    there. Standard deviations are to first order; errors of two segments are independent except those of headings.

    Parameters
    ----------
    pose : Pose or TrackResult
        What `track` or `load_result` gives, or its `pose`; n samples.
    sequence : str
        Intrinsic axes of the shoulder's angles: "YXY", "XZY" or "ZXY"; all other joints have ZXY. "auto": the first,
        or where it is near gimbal lock for more than 1 % of the time, the one that is so for the least time;
        ``angles["right_shoulder"].sequence`` names it.

    Returns
    -------
    Angles
        ``angles[joint][angle]`` is (n,) [rad]; ``list(angles)`` are its joints, ``list(angles[joint])`` their angles;
        ``angles[joint].std`` (n, 3) [rad] is their standard deviation.

    Raises
    ------
    BadOption
        An unknown sequence.
    BadData
        No joint has both of its segments in the pose, or all of their orientations are NaN.

    Examples
    --------
    >>> angles = wp.joint_angles(result)
    >>> list(angles)
    ['thorax', 'left_shoulder', 'left_elbow', 'right_shoulder', 'right_elbow']
    >>> list(angles["right_elbow"])
    ['flexion', 'carrying_angle', 'pronation']
    >>> angles["right_elbow"]["flexion"].shape == result.time.shape
    True
    """
    check_arguments(joint_angles, locals())
    if isinstance(pose, TrackResult):
        pose = pose.pose
    if sequence == AUTO:
        sequence = choose_shoulder_sequence(pose)
    if sequence not in SHOULDER_SEQUENCES:
        raise BadOption(f"shoulder sequence '{sequence}' is not known; {one_of((*SHOULDER_SEQUENCES, AUTO), sequence)}")
    joints = {}
    for name, joint in JOINTS.items():
        if _is_known(pose, joint):
            if not joint.sequence:
                joint = joint._replace(sequence=sequence, names=SHOULDER_SEQUENCES[sequence])
            joints[name] = _angles(pose, joint, name.startswith("left_"))
    if not joints:
        raise BadData(
            f"no joint has its segments in the pose: torso, or two segments that one joint connects, are needed; "
            f"{one_of(pose.quat_WL)}"
        )
    if not any(np.isfinite(joint.quat).all(axis=1).any() for joint in joints.values()):
        raise BadData("the pose holds no numbers for a joint: the orientations of its segments are NaN in all samples")
    return Angles(pose.time, joints)


def choose_shoulder_sequence(pose: Pose) -> str:
    """Choose the sequence by which the angles of both shoulders are near gimbal lock for the least time.

    It is YXY, which the ISB recommends, where that is near the lock for no more than `MAX_NEAR_LOCK` of the samples. An
    arm that hangs is in its lock.
    """
    counts = {}
    for sequence, names in SHOULDER_SEQUENCES.items():
        shoulders = {side: JOINTS[f"{side}_shoulder"]._replace(sequence=sequence, names=names) for side in SIDES}
        parts = [_decompose(pose, joint, side == "left") for side, joint in shoulders.items() if _is_known(pose, joint)]
        counts[sequence] = max((np.count_nonzero(gimbal < NEAR_LOCK) for *_, gimbal in parts), default=0)
    return "YXY" if counts["YXY"] <= MAX_NEAR_LOCK * len(pose.time) else min(counts, key=counts.__getitem__)


def _is_known(pose: Pose, joint: Joint) -> bool:
    return {joint.proximal, joint.distal} <= {"world", *pose.quat_WL}


def _decompose(pose: Pose, joint: Joint, left: bool) -> tuple[np.ndarray, ...]:
    """The m known samples as a mask (n,), the proximal frame (m, 4) in W, the rotation (m, 4), `euler.decompose`."""
    members = {joint.proximal, joint.distal} - {"world"}
    known = np.all([np.isfinite(pose.quat_WL[segment]).all(axis=1) for segment in members], axis=0)
    quat_WP, quat_WD = (_joint_frame(pose, joint, segment, left, known) for segment in (joint.proximal, joint.distal))
    quat = multiply(conjugate(quat_WP), quat_WD)
    return known, quat_WP, quat, *euler.decompose(quat, joint.sequence)


def _angles(pose: Pose, joint: Joint, left: bool) -> JointAngles:
    members = [segment for segment in (joint.proximal, joint.distal) if segment != "world"]
    known, quat_WP, quat, principal, gimbal = _decompose(pose, joint, left)
    values = euler.follow((principal, gimbal), joint.sequence, NEAR_LOCK)
    std = None
    if all(segment in pose.segment_cov for segment in members):
        cov_W = np.sum([pose.segment_cov[segment][known] for segment in members], axis=0)
        # A common heading error does not rotate the joint.
        cov_W[:, 2, 2] -= 2.0 * pose.find_heading_cov(*members)[known]
        rows = _gradients(values, joint.sequence, quat_WP, left)
        variance = np.einsum("nai,nij,naj->na", rows, cov_W, rows, optimize=True)
        std = _expand(known, np.minimum(np.sqrt(np.maximum(variance, 0.0)), euler.UNKNOWN))
    gap = np.any([~known, *(pose.gap[segment] for segment in members if segment in pose.gap)], axis=0)
    gimbal, values, quat = (_expand(known, each) for each in (gimbal, values, rotations.unwrap_signs(quat)))
    return JointAngles(joint.sequence, joint.names, values, gimbal, gimbal < NEAR_LOCK, gap, std, quat)


def compute_gradients(pose: Pose, name: str, joint: JointAngles, samples: np.ndarray) -> np.ndarray:
    """Compute derivatives (m, 3, 3) of a joint's angles at samples (m,) by a small rotation in W of its distal segment.

    Those by the proximal segment are of opposite sign. The samples are known ones.
    """
    quat_WP = _joint_frame(pose, JOINTS[name], JOINTS[name].proximal, name.startswith("left_"), samples)
    return _gradients(joint.values[samples], joint.sequence, quat_WP, name.startswith("left_"))


def _gradients(values: np.ndarray, sequence: str, quat_WP: np.ndarray, left: bool) -> np.ndarray:
    """Derivatives (n, 3, 3) of angles by the turn between the segments, in W; of a left joint not mirrored.

    With ``exp(e_W) R_WL`` for each segment the rotation between two is turned on its left by ``R_WPᵀ (e_D − e_P)``.
    """
    rows = euler.gradients(values, sequence) @ np.swapaxes(Rotation.from_quat(quat_WP).as_matrix(), -1, -2)
    return rows * _MIRRORED_TURN if left else rows


def _joint_frame(pose: Pose, joint: Joint, segment: str, left: bool, samples: np.ndarray) -> np.ndarray:
    """Axes (m, 4) in W in which a joint's angles are taken, of one segment at m samples; of a left joint mirrored."""
    axes = joint.axes or ISB_AXES[segment.removeprefix("left_").removeprefix("right_")]
    quat_LI = Rotation.from_matrix(np.column_stack([AXES[axis] for axis in axes])).as_quat()
    if segment == "world":
        return np.tile(quat_LI, (len(pose.time[samples]), 1))
    quat_WL = pose.quat_WL[segment][samples]
    return multiply(quat_WL * _MIRRORED_QUAT if left else quat_WL, quat_LI)


def _expand(known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """`values` of the known samples among all of them, NaN elsewhere."""
    out = np.full((len(known), *values.shape[1:]), np.nan)
    out[known] = values
    return out
