"""Joint angles against closed forms through gimbal lock, SciPy on frames from bony landmarks, and drawn errors."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin import Pose, WeposeError, joint_angles
from wepose_pin.angles import JointAngles

ARM = ("upper_arm", "forearm", "hand")
LEG = ("thigh", "shank", "foot")
SEGMENTS = ["torso", "pelvis", *(f"{side}_{part}" for side in ("left", "right") for part in (*ARM, *LEG))]
SEQUENCES = ("YXY", "XZY", "ZXY")  # of a shoulder
NEAR_LOCK = np.radians(10.0)
GLOBAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # columns: X, Y, Z of the ISB in x, y, z of W
MIRROR = np.diag([1.0, -1.0, 1.0])


def pose_with(quat_WL: dict[str, np.ndarray], rate_hz: float = 100.0, **more: dict[str, np.ndarray]) -> Pose:
    """A pose of all segments; those not given stand as in the N-pose."""
    n = max(len(np.atleast_2d(quat)) for quat in quat_WL.values())
    still = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    return Pose(np.arange(n) / rate_hz, {s: np.atleast_2d(quat_WL.get(s, still)) for s in SEGMENTS}, {}, **more)


def turned(**degrees: float) -> np.ndarray:
    """Turns about axes x, y, z of W, one after the other, as a quaternion (4,)."""
    total = Rotation.identity()
    for axis, angle in degrees.items():
        total = Rotation.from_euler(axis, angle, degrees=True) * total
    return total.as_quat()


def arm_of(side: str, matrix_I: np.ndarray) -> dict[str, np.ndarray]:
    """A pose in which the upper arm stands so, (n, 3, 3) in the ISB's axes of a right side, to the upright thorax."""
    matrix = GLOBAL @ matrix_I @ GLOBAL.T
    if side == "left":
        matrix = MIRROR @ matrix @ MIRROR
    return {f"{side}_upper_arm": Rotation.from_matrix(matrix).as_quat()}


def check_values(joint: JointAngles) -> None:
    """They are those of the joint's rotation, and jump near the lock at most."""
    back = Rotation.from_euler(joint.sequence, joint.values).inv() * Rotation.from_quat(joint.quat)
    assert back.magnitude().max() < 1e-12
    jumps = np.abs(np.diff(joint.values, axis=0)).max(axis=1) > np.radians(60.0)
    assert not np.any(jumps & ~(joint.near_lock[1:] & joint.near_lock[:-1]))


# Closed forms over time -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("samples", [201, 2000])
def test_a_motion_straight_through_the_lock_keeps_its_angles(name: str, side: str, samples: int) -> None:
    t = np.linspace(0.0, 1.0, samples)
    reach = (-80.0, 60.0) if name == "YXY" else (-20.0, 150.0)
    angles = np.radians(
        np.column_stack([35.0 + 10.0 * np.sin(4.0 * t), reach[0] + (reach[1] - reach[0]) * t, -50.0 + 20.0 * t**2])
    )
    pose = pose_with(arm_of(side, Rotation.from_euler(name, angles).as_matrix()))
    shoulder = joint_angles(pose, name)[f"{side}_shoulder"]
    np.testing.assert_allclose(shoulder.values, angles, atol=1e-9)
    lock = np.abs(angles[:, 1]) if name == "YXY" else np.abs(angles[:, 1] - np.pi / 2.0)
    expected = np.minimum(lock, np.pi / 2.0 - np.abs(lock - np.pi / 2.0) if name == "YXY" else np.pi - lock)
    np.testing.assert_allclose(shoulder.gimbal, expected, atol=1e-9)
    clear = np.abs(expected - NEAR_LOCK) > 1e-6
    assert np.array_equal(shoulder.near_lock[clear], expected[clear] < NEAR_LOCK)
    assert shoulder.near_lock.any()


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("seed", range(3))
def test_what_a_hanging_arm_does_decides_nothing_about_the_motions_after_it(side: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    raised = -np.radians(110.0) * np.sin(np.linspace(0.0, np.pi, 200)) ** 2
    wander = np.cumsum(rng.normal(size=(3, 300, 3)), axis=1)  # it circles about the lock, and shakes
    wander *= np.radians(6.0) * np.sin(np.linspace(0.0, np.pi, 300))[:, None] / np.abs(wander).max()
    hang = [Rotation.from_rotvec(way + 0.003 * rng.normal(size=(300, 3))) for way in wander]
    abducted, flexed = (
        Rotation.from_euler("YXY", np.column_stack([np.full(200, plane), raised, np.full(200, -plane)]))
        for plane in (0.0, np.pi / 2.0)
    )
    R = Rotation.concatenate([hang[0], abducted, hang[1], flexed, hang[2]])
    shoulder = joint_angles(pose_with(arm_of(side, R.as_matrix())))[f"{side}_shoulder"]
    for middle, plane in ((400, 0.0), (900, 90.0)):
        np.testing.assert_allclose(np.degrees(shoulder.values[middle]), [plane, -110.0, -plane], atol=0.1)
    check_values(shoulder)


@pytest.mark.parametrize("name", ["XZY", "auto"])
def test_an_arm_hangs_at_zero_whatever_way_it_takes(name: str) -> None:
    """Straight forward and up to 150°, through the lock of X-Z-Y; down sideways; and the same way back."""
    degrees = np.array([[90.0, 0.0], [90.0, 0.0], [90.0, 150.0], [90.0, 150.0], [0.0, 150.0], [0.0, 0.0], [0.0, 0.0]])
    plane, raised = (np.interp(np.linspace(0.0, 6.0, 6001), range(7), column) for column in degrees.T)
    way = Rotation.from_euler("YXY", np.column_stack([plane, -raised, -plane]), degrees=True).as_matrix()
    shoulder = joint_angles(pose_with(arm_of("right", np.concatenate([way, way[::-1]]))), name)["right_shoulder"]
    np.testing.assert_allclose(shoulder.values[np.tile(raised == 0.0, 2)], 0.0, atol=1e-9)
    check_values(shoulder)


@pytest.mark.parametrize("raised", [False, True])
def test_full_turns_do_not_add_up_while_an_arm_hangs(raised: bool) -> None:
    """A minute in which the arm swings in circles of 2° about the vertical, 30 of them, and turns about its length."""
    n = 6000
    around, about_length = np.linspace(0.0, 60.0 * np.pi, n), 0.5 * np.sin(np.linspace(0.0, np.pi, n))
    way = np.radians(2.0) * np.column_stack([np.cos(around), np.zeros(n), np.sin(around)])
    hang = Rotation.from_rotvec(way) * Rotation.from_rotvec(np.outer(about_length, [0.0, 1.0, 0.0]))
    lift = -np.radians(90.0) * np.sin(np.linspace(0.0, np.pi, 400)) ** 2 - np.radians(2.0)
    lifted = Rotation.from_euler("YXY", np.column_stack([np.full(400, 0.5), lift, np.full(400, -0.5)]))
    R = Rotation.concatenate([lifted, hang, lifted] if raised else [hang])
    shoulder = joint_angles(pose_with(arm_of("right", R.as_matrix())))["right_shoulder"]
    plane, _, internal = np.degrees(shoulder.values).T
    assert np.abs(plane - np.degrees(0.5 * raised)).max() <= 180.0 + 1e-9
    assert np.abs(np.diff(plane + internal)).max() < 5.0  # how far the arm is turned about its length
    check_values(shoulder)


# Against SciPy, on frames from bony landmarks as Wu et al. define them ----------------------------------------------


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def frame(up: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Axes X, Y, Z as columns: Y along `up`, X across the plane of both and forward, Z the common perpendicular."""
    Y = unit(up)
    X = unit(np.cross(Y, right))
    return np.stack([X, Y, np.cross(X, Y)], axis=-1)


def landmark_frames(R: dict[str, np.ndarray], side: str) -> dict[str, np.ndarray]:
    """ISB frames from landmarks of a person who stands in W; a left side's positions are mirrored, z → −z."""
    out = -1.0 if side == "right" else 1.0  # +y is to the left

    def place(segment: str, at: list[float]) -> np.ndarray:
        p_W = R[segment] @ np.array([at[0], out * at[1], at[2]])
        p = np.stack([p_W[:, 0], p_W[:, 2], -p_W[:, 1]], axis=-1)  # the ISB's world: x forward, y up, z to the right
        return p * [1.0, 1.0, -1.0 if side == "left" else 1.0]

    # Thorax: incisura jugularis, C7, processus xiphoideus, T8. The right of the mirrored body is where its left was.
    IJ, C7, PX, T8 = (place("torso", at) for at in ([0.1, 0, 0.5], [-0.06, 0, 0.5], [0.1, 0, 0.3], [-0.06, 0, 0.3]))
    thorax_up = (IJ + C7) / 2.0 - (PX + T8) / 2.0
    thorax = frame(thorax_up, np.cross(IJ - C7, thorax_up))
    arm, forearm, hand = (f"{side}_{part}" for part in ARM)
    GH = place("torso", [0.0, 0.2, 0.45])
    EL, EM = (GH + place(arm, at) for at in ([0.0, 0.04, -0.3], [0.0, -0.04, -0.3]))
    E = (EL + EM) / 2.0
    US, RS = (E + place(forearm, at) for at in ([0.0, 0.0, -0.25], [0.05, 0.0, -0.25]))  # thumbs forward in the N-pose
    base, head = (RS + place(hand, at) for at in ([0.0, 0.0, -0.02], [0.0, 0.0, -0.09]))  # third metacarpal
    MC2, MC5 = (RS + place(hand, at) for at in ([0.02, 0.0, -0.09], [-0.05, 0.0, -0.08]))
    # Wu 2002. Pelvis: spines of the ilium in front and behind; the left of the mirrored body is where its right was.
    thigh, shank, foot = (f"{side}_{part}" for part in LEG)
    ASIS, far_ASIS, PSIS, far_PSIS = (
        place("pelvis", at)
        for at in ([0.09, 0.12, 0.07], [0.09, -0.12, 0.07], [-0.08, 0.05, 0.07], [-0.08, -0.05, 0.07])
    )
    right = ASIS - far_ASIS
    HJC = place("pelvis", [0.0, 0.08, 0.0])
    FE, far_FE = (HJC + place(thigh, at) for at in ([0.0, 0.045, -0.42], [0.0, -0.045, -0.42]))
    knee = (FE + far_FE) / 2.0
    LC, MC, LM, MM = (
        knee + place(shank, at) for at in ([0, 0.04, -0.03], [0, -0.04, -0.03], [0, 0.035, -0.44], [0, -0.035, -0.44])
    )
    IC, IM = (LC + MC) / 2.0, (LM + MM) / 2.0
    heel, ball, sole = (IM + place(foot, at) for at in ([-0.05, 0, -0.07], [0.15, 0, -0.07], [-0.05, 0, -0.08]))
    return {
        "pelvis": frame(np.cross(right, (ASIS + far_ASIS) / 2.0 - (PSIS + far_PSIS) / 2.0), right),
        "hip": frame(HJC - knee, FE - far_FE),
        "knee": frame(IC - IM, LM - MM),
        "ankle": frame(heel - sole, np.cross(ball - heel, heel - sole)),
        "thorax": thorax,
        "shoulder": frame(GH - E, EL - EM),
        "elbow": frame(E - US, RS - US),
        "wrist": frame(base - head, MC2 - MC5),
    }


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("name", SEQUENCES)
def test_angles_are_scipys_on_frames_from_landmarks(side: str, name: str) -> None:
    quat_WL = {s: Rotation.random(300, random_state=k).as_quat() for k, s in enumerate(SEGMENTS)}
    frames = landmark_frames({s: Rotation.from_quat(quat).as_matrix() for s, quat in quat_WL.items()}, side)
    angles = joint_angles(pose_with(quat_WL), name)
    chain = ["thorax", "shoulder", "elbow", "wrist"]
    for proximal, distal in pairwise(chain):
        joint = angles[f"{side}_{distal}"]
        R = Rotation.from_matrix(frames[proximal].transpose(0, 2, 1) @ frames[distal])
        np.testing.assert_allclose((R.inv() * Rotation.from_quat(joint.quat)).magnitude(), 0.0, atol=1e-9)
        sequence = name if distal == "shoulder" else "ZXY"
        assert joint.sequence == sequence
        one = R.as_euler(sequence)
        offset = 0.0 if sequence == "YXY" else np.pi
        two = np.column_stack([one[:, 0] + np.pi, offset - one[:, 1], one[:, 2] + np.pi])
        error = [np.abs(np.angle(np.exp(1j * (joint.values - solution)))).max(axis=1) for solution in (one, two)]
        assert np.minimum(*error).max() < 1e-8
    if side == "right":
        R = Rotation.from_matrix(frames["thorax"])
        np.testing.assert_allclose(
            (R.inv() * Rotation.from_quat(angles["thorax"].quat)).magnitude(), 0.0, atol=1e-9
        )  # the ISB's world is the identity there


@pytest.mark.parametrize("side", ["left", "right"])
def test_hip_and_ankle_are_scipys_on_frames_from_landmarks_and_the_knee_is_grood_and_suntays(side: str) -> None:
    rng = np.random.default_rng(8)
    quat_WL = {s: Rotation.from_rotvec(rng.normal(scale=0.2, size=(300, 3))).as_quat() for s in SEGMENTS}
    frames = landmark_frames({s: Rotation.from_quat(quat).as_matrix() for s, quat in quat_WL.items()}, side)
    angles = joint_angles(pose_with(quat_WL))
    for proximal, distal in (("pelvis", "hip"), ("knee", "ankle")):
        R = Rotation.from_matrix(frames[proximal].transpose(0, 2, 1) @ frames[distal])
        np.testing.assert_allclose(angles[f"{side}_{distal}"].values, R.as_euler("ZXY"), atol=1e-9)
    if side == "right":
        R = Rotation.from_matrix(frames["pelvis"])
        np.testing.assert_allclose(angles["pelvis_in_world"].values, R.as_euler("ZXY"), atol=1e-9)
    # Grood and Suntay 1983, of a right knee: X (I_, i) to the right, Y (J, j) forward, Z (K, k) proximal; capitals are
    # those of the femur. The left one is mirrored already.
    (J, K, I_), (_, k, i) = (np.moveaxis(frames[part], -1, 0) for part in ("hip", "knee"))
    e2 = unit(np.cross(k, I_))
    flexion = np.arctan2(-np.sum(e2 * K, axis=1), np.sum(e2 * J, axis=1))
    adduction = np.pi / 2.0 - np.arccos(np.sum(I_ * k, axis=1))
    external_rotation = np.arcsin(-np.sum(e2 * i, axis=1))
    expected = np.column_stack([flexion, adduction, external_rotation])
    np.testing.assert_allclose(angles[f"{side}_knee"].values, expected, atol=1e-9)


# Signs and names --------------------------------------------------------------------------------------------------

LEG_ANGLES = {
    "hip": ("flexion", "adduction", "internal_rotation"),
    "knee": ("flexion", "adduction", "external_rotation"),
    "ankle": ("dorsiflexion", "inversion", "internal_rotation"),
}
# A segment of the right arm, turns about x, y, z of W, and what of the angles is to be seen [deg].
PLAIN = {
    "n_pose": ({}, {"elbow": {"flexion": 0.0, "carrying_angle": 0.0, "pronation": 90.0}}),
    "abducted": ({"upper_arm": {"x": -90.0}}, {"shoulder": {"plane_of_elevation": 0.0, "elevation": -90.0}}),
    "raised_forward": ({"upper_arm": {"y": -60.0}}, {"shoulder": {"plane_of_elevation": 90.0, "elevation": -60.0}}),
    "raised_backward": ({"upper_arm": {"y": 40.0}}, {"shoulder": {"plane_of_elevation": -90.0, "elevation": -40.0}}),
    "bent": ({"forearm": {"y": -80.0}}, {"elbow": {"flexion": 80.0, "carrying_angle": 0.0, "pronation": 90.0}}),
    "palm_forward": ({"forearm": {"z": -90.0}}, {"elbow": {"flexion": 0.0, "pronation": 0.0}}),
    "palm_back": ({"forearm": {"z": 60.0}}, {"elbow": {"flexion": 0.0, "pronation": 150.0}}),
    "forearm_outward": ({"forearm": {"x": -10.0}}, {"elbow": {"carrying_angle": -10.0}}),
    "hand_to_its_palm": ({"hand": {"x": 30.0}}, {"wrist": {"flexion": 30.0, "ulnar_deviation": 0.0, "pronation": 0.0}}),
    "hand_to_the_thumb": ({"hand": {"y": -20.0}}, {"wrist": {"flexion": 0.0, "ulnar_deviation": -20.0}}),
    "hand_to_the_little_finger": ({"hand": {"y": 20.0}}, {"wrist": {"flexion": 0.0, "ulnar_deviation": 20.0}}),
    "upright": ({}, {joint: dict.fromkeys(LEG_ANGLES[joint], 0.0) for joint in ("hip", "knee", "ankle")}),
    "thigh_forward": ({"thigh": {"y": -90.0}}, {"hip": {"flexion": 90.0, "adduction": 0.0, "internal_rotation": 0.0}}),
    "thigh_outward": ({"thigh": {"x": -20.0}}, {"hip": {"flexion": 0.0, "adduction": -20.0}}),
    "thigh_turned_inward": ({"thigh": {"z": 15.0}}, {"hip": {"adduction": 0.0, "internal_rotation": 15.0}}),
    "heel_to_the_seat": ({"shank": {"y": 110.0}}, {"knee": {"flexion": 110.0, "adduction": 0.0}}),
    "bow_legs": ({"shank": {"x": 8.0}}, {"knee": {"flexion": 0.0, "adduction": 8.0, "external_rotation": 0.0}}),
    "shank_turned_outward": ({"shank": {"z": -12.0}}, {"knee": {"adduction": 0.0, "external_rotation": 12.0}}),
    "toes_up": ({"foot": {"y": -20.0}}, {"ankle": {"dorsiflexion": 20.0, "inversion": 0.0}}),
    "sole_inward": ({"foot": {"x": 10.0}}, {"ankle": {"dorsiflexion": 0.0, "inversion": 10.0}}),
    "toes_inward": ({"foot": {"z": 10.0}}, {"ankle": {"inversion": 0.0, "internal_rotation": 10.0}}),
}


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("pose", PLAIN)
def test_plain_poses_have_the_angles_of_the_isb_on_both_sides(pose: str, side: str) -> None:
    turns, expected = PLAIN[pose]
    quat_WL = {}
    sign = {"x": 1.0, "y": 1.0, "z": 1.0} if side == "right" else {"x": -1.0, "y": 1.0, "z": -1.0}
    for limb in (ARM, LEG):  # the hand goes with the forearm, that with the upper arm
        last: dict[str, float] = {}
        for part in limb:
            last = turns.get(part, last)
            quat_WL[f"{side}_{part}"] = turned(**{axis: sign[axis] * angle for axis, angle in last.items()})
    angles = joint_angles(pose_with(quat_WL))
    for joint, named in expected.items():
        joint_angle = angles[f"{side}_{joint}"]
        for name, value in named.items():
            assert np.degrees(joint_angle.values[0, joint_angle.names.index(name)]) == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize(
    ("segment", "joint", "names"),
    [
        ("torso", "thorax", ("extension", "lateral_flexion_right", "axial_rotation_left")),
        ("pelvis", "pelvis_in_world", ("posterior_tilt", "obliquity_right_down", "axial_rotation_left")),
    ],
)
def test_a_trunk_leans_back_and_right_and_turns_left_in_the_positive(
    segment: str, joint: str, names: tuple[str, ...]
) -> None:
    for k, turn in enumerate((turned(y=-20.0), turned(x=20.0), turned(z=20.0))):
        angles = joint_angles(pose_with({segment: turn}))[joint]
        np.testing.assert_allclose(np.degrees(angles.values[0]), 20.0 * np.eye(3)[k], atol=1e-9)
        assert angles.names == names


# Uncertainty ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SEQUENCES)
def test_standard_deviations_are_those_of_drawn_errors(name: str) -> None:
    n = 20_000
    rng = np.random.default_rng(5)
    middle = {s: Rotation.from_rotvec(rng.normal(scale=0.6, size=3)) for s in SEGMENTS}
    roots = {s: np.radians(0.4) * rng.normal(size=(3, 3)) for s in SEGMENTS}  # errors lean to some direction in W
    drawn = {s: (Rotation.from_rotvec(rng.normal(size=(n, 3)) @ roots[s].T) * middle[s]).as_quat() for s in SEGMENTS}
    spread = joint_angles(pose_with(drawn), name)
    cov = {s: (a @ a.T)[None] for s, a in roots.items()}
    stated = joint_angles(pose_with({s: R.as_quat() for s, R in middle.items()}, segment_cov=cov), name)
    assert len(stated.joints) == 14
    for joint, joint_angle in stated.joints.items():
        assert joint_angle.gimbal[0] > NEAR_LOCK
        assert joint_angle.std is not None
        np.testing.assert_allclose(spread[joint].values.std(axis=0), joint_angle.std[0], rtol=0.03)


def test_a_heading_that_two_segments_share_makes_no_angle_uncertain() -> None:
    sizes = {"right_upper_arm": 3.0, "right_forearm": 3.0, "torso": 0.0}  # [deg]
    quats = {name: Rotation.from_rotvec([0.3, 0.2, 0.1]).as_quat()[None] for name in sizes}
    cov = {name: np.diag([1e-6, 1e-6, np.radians(size) ** 2])[None] for name, size in sizes.items()}
    shared = {("right_forearm", "right_upper_arm"): np.full(1, np.radians(3.0) ** 2)}
    alone, common = (joint_angles(pose_with(quats, segment_cov=cov, heading_cov=each)) for each in ({}, shared))
    assert np.degrees(np.linalg.norm(alone["right_elbow"].std)) == pytest.approx(3.0 * np.sqrt(2.0), rel=0.1)
    assert np.degrees(np.linalg.norm(common["right_elbow"].std)) < 0.2
    np.testing.assert_array_equal(alone["right_shoulder"].std, common["right_shoulder"].std)


def test_towards_the_lock_the_deviation_grows_to_that_of_any_angle() -> None:
    away = np.radians([90.0, 45.0, 20.0, 5.0, 1.0, 1e-3, 0.0])
    angles = np.column_stack([np.full(7, 0.5), -away, np.full(7, 0.2)])
    cov = {s: np.tile(np.radians(1.0) ** 2 * np.eye(3), (7, 1, 1)) for s in SEGMENTS}
    pose = pose_with(arm_of("right", Rotation.from_euler("YXY", angles).as_matrix()), segment_cov=cov)
    shoulder = joint_angles(pose)["right_shoulder"]
    assert shoulder.std is not None
    each = np.radians(1.0) * np.sqrt(2.0)
    np.testing.assert_allclose(shoulder.std[:, 1], each, rtol=1e-9)
    np.testing.assert_allclose(shoulder.std[:5, 2], each / np.sin(away[:5]), rtol=1e-9)
    np.testing.assert_allclose(shoulder.std[-2:, [0, 2]], np.pi / np.sqrt(3.0), rtol=1e-6)
    assert np.array_equal(shoulder.near_lock, away < np.radians(10.0))


# Gaps, missing segments, bad options ------------------------------------------------------------------------------


def test_gaps_and_what_is_not_known_are_flagged_and_hide_nothing_else() -> None:
    n = 100
    given = np.column_stack([np.full(n, 1.0), np.linspace(-0.5, -1.5, n), np.zeros(n)])
    quat_WL = arm_of("right", Rotation.from_euler("YXY", given).as_matrix())
    quat_WL["right_upper_arm"][40:45] = np.nan
    bridged = np.zeros(n, dtype=bool)
    bridged[70:80] = True
    cov = {s: np.tile(1e-4 * np.eye(3), (n, 1, 1)) for s in SEGMENTS}
    angles = joint_angles(pose_with(quat_WL, gap={"right_upper_arm": bridged}, segment_cov=cov))
    shoulder = angles["right_shoulder"]
    unknown = np.isnan(shoulder.values).any(axis=1)
    assert np.array_equal(np.flatnonzero(unknown), np.arange(40, 45))
    assert np.array_equal(shoulder.gap, unknown | bridged)
    assert np.array_equal(angles["right_elbow"].gap, shoulder.gap)
    assert not angles["left_shoulder"].gap.any()
    assert np.isnan(shoulder.quat[42]).all()
    np.testing.assert_allclose(shoulder.values[~unknown], given[~unknown], atol=1e-12)


def test_only_joints_with_both_segments_are_there() -> None:
    whole = pose_with({"torso": turned(x=5.0)})
    some = Pose(
        whole.time, {s: whole.quat_WL[s] for s in ("torso", "left_forearm", "right_upper_arm", "right_forearm")}, {}
    )
    assert list(joint_angles(some).joints) == ["thorax", "right_shoulder", "right_elbow"]
    with pytest.raises(
        WeposeError, match=r"torso, or two segments that one joint connects, are needed; .*: left_forearm$"
    ):
        joint_angles(Pose(whole.time, {"left_forearm": whole.quat_WL["left_forearm"]}, {}))


@pytest.mark.parametrize(("abducted_deg", "sequence"), [(10.0, "XZY"), (90.0, "YXY")])
def test_the_sequence_that_is_chosen_is_determined_while_arms_hang(abducted_deg: float, sequence: str) -> None:
    """Arms that hang, or are raised to the side, and swing by 5°."""
    n = 200
    swing = 5.0 * np.sin(np.linspace(0.0, 20.0, n))
    arms = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        angles_deg = np.column_stack([np.full(n, sign * (abducted_deg if abducted_deg > 45.0 else 1.0)), swing])
        arms[f"{side}_upper_arm"] = Rotation.from_euler("XY", angles_deg, degrees=True).as_quat()
    angles = joint_angles(pose_with({"torso": np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)), **arms}), "auto")
    assert {angles[name].sequence for name in ("left_shoulder", "right_shoulder")} == {sequence}
    assert not angles["left_shoulder"].near_lock.any()
