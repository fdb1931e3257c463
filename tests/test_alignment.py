"""Sensors to segments: mounts and headings from the start pose."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bodies import TABLE
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin import OrientationSensor, Recording, Simulation, Subject, WeposeError, population_subject
from wepose_pin.recording import compute_mount, find_mount_axes


def estimate_segments(recording: Recording, subject: Subject | None = None) -> Any:
    """What follows from the start pose alone, with its own diagnostics."""
    return wp.track(recording, subject, open_loop=True).segments


@pytest.mark.parametrize(("up", "forward"), [("+x", "-z"), ("-y", "+x"), ("+z", "+x"), ("-z", "-y")])
def test_stated_axes_are_what_they_say(up: str, forward: str) -> None:
    R_LS = Rotation.from_quat(compute_mount(up, forward)).as_matrix()
    axis = {"x": 0, "y": 1, "z": 2}
    for name, segment_axis in ((up, [0, 0, 1]), (forward, [1, 0, 0])):
        in_sensor = np.eye(3)[axis[name[1]]] * (1 if name[0] == "+" else -1)
        np.testing.assert_allclose(R_LS @ in_sensor, segment_axis, atol=1e-15)
    assert np.linalg.det(R_LS) == pytest.approx(1.0)
    assert find_mount_axes(compute_mount(up, forward)) == (up, forward)


def test_a_mount_tilted_from_its_stated_axes_is_found_by_gravity(
    simulation: Simulation, half_minute: Recording
) -> None:
    segments = estimate_segments(half_minute)
    for name, true in simulation.quat_LS.items():
        off = Rotation.from_quat(true).inv() * Rotation.from_quat(segments.quat_LS[name])
        # What is left is the accelerometer's bias: 3 mg on each axis.
        assert np.degrees(off.magnitude()) < 0.8
        stated = Rotation.from_quat(true).inv() * Rotation.from_quat(compute_mount(*simulation.stated_mount))
        assert np.degrees(stated.magnitude()) > 1.5
        true_WL = Rotation.from_quat(simulation.quat_WL[name][: len(half_minute)])
        error = Rotation.from_quat(segments.quat_WL[name]) * true_WL.inv()
        assert np.degrees(error.magnitude()).max() < 1.5


MOUNT = Rotation.from_quat(compute_mount("+x", "-z"))


ARMS = ("torso", "left_upper_arm", "right_upper_arm")


def mounted(segment: str, covariance: np.ndarray) -> Subject:
    """A subject with one calibrated mount, and the covariance (3, 3) [rad²] of its error."""
    order = tuple(f"mounts.{segment}.{axis}" for axis in "xyz")
    return replace(population_subject(), mounts={segment: MOUNT.as_quat()}, order=order, covariance=covariance)


def ready_recording(headings: dict[str, float], mounts: dict[str, Rotation]) -> tuple[Recording, dict[str, Rotation]]:
    """Ready orientations in worlds that each have a heading of their own; the true segment orientations beside."""
    time = np.arange(500) / 100.0
    moving = np.clip(time - 2.0, 0.0, None)[:, None]
    true = {name: Rotation.from_rotvec(moving * np.array([0.3, -0.8, 0.2 * k])) for k, name in enumerate(headings)}
    sensors = {
        name: OrientationSensor(quat_VS=(Rotation.from_rotvec([0, 0, -psi]) * true[name] * mounts[name]).as_quat())
        for name, psi in headings.items()
    }
    return Recording("ready", time, 100.0, sensors, {"start": ((0.0, 1.9),)}), true


def test_calibrated_mounts_give_headings_of_any_size() -> None:
    rng = np.random.default_rng(0)
    headings = {"torso": 2.9, "left_upper_arm": -1.7, "left_forearm": 0.4}
    mounts = {name: Rotation.random(random_state=rng) for name in headings}
    recording, true = ready_recording(headings, mounts)
    subject = replace(population_subject(), mounts={name: mount.as_quat() for name, mount in mounts.items()})
    segments = estimate_segments(recording, subject)
    for name, psi in headings.items():
        assert segments.heading_offset[name] == pytest.approx(psi, abs=1e-9)
        assert (Rotation.from_quat(segments.quat_WL[name]) * true[name].inv()).magnitude().max() < 1e-9


def test_a_calibrated_mount_is_weighed_against_the_start_pose() -> None:
    """A person stands with the arm 5 deg bent: a sure mount sees it, a vague one takes it for its own error."""
    bent = Rotation.from_rotvec([0.0, -np.deg2rad(5.0), 0.0])
    recording, true = ready_recording({"left_forearm": 0.7}, {"left_forearm": bent.inv() * MOUNT})
    # Sensor orientation = bent pose times true mount: `true` of the helper is the segment, straight at the start.
    truth = true["left_forearm"] * bent.inv()
    as_sure_as_the_pose = np.degrees(TABLE.segments["left_forearm"].start_std[1])
    for std_deg, share in ((0.0, 0.0), (as_sure_as_the_pose, 0.5), (100.0 * as_sure_as_the_pose, 1.0)):
        subject = mounted("left_forearm", np.deg2rad(std_deg) ** 2 * np.eye(3))
        segments = estimate_segments(recording, subject)
        off = (truth.inv() * Rotation.from_quat(segments.quat_WL["left_forearm"])).magnitude()
        assert np.degrees(off.max()) == pytest.approx(5.0 * share, abs=0.05)
        assert not segments.diagnostics


@pytest.mark.parametrize(("off", "sure", "text"), [(20.0, 1.0, "mounted again"), (36.0, 20.0, "calibrate again")])
def test_a_calibrated_mount_that_has_moved_is_said(off: float, sure: float, text: str) -> None:
    moved = Rotation.from_rotvec([0.0, np.deg2rad(off), 0.0])
    recording, _ = ready_recording({"torso": 0.0}, {"torso": moved * MOUNT})
    subject = mounted("torso", np.deg2rad(sure) ** 2 * np.eye(3))
    (diagnostic,) = estimate_segments(recording, subject).diagnostics
    assert (diagnostic.code, diagnostic.place) == ("mount-contradicted", "torso")
    assert diagnostic.value == pytest.approx(np.deg2rad(off), abs=0.01)
    assert text in str(diagnostic)


def test_a_person_stands_as_in_the_calibration() -> None:
    """Leaning by 20 deg in both start poses is no mount that moved; by 20 deg in one of them is."""
    lean = np.array([0.0, np.deg2rad(20.0)])
    start = np.deg2rad([0.0, 20.0, 1.0])
    subject = replace(mounted("torso", np.deg2rad(1.0) ** 2 * np.eye(3)), start_pose_offset={"torso": start})
    for tilt, off in ((lean, []), (lean - [0.0, np.deg2rad(9.0)], [9.0]), (0.0 * lean, [20.0])):
        recording, _ = ready_recording({"torso": 0.0}, {"torso": Rotation.from_rotvec([*tilt, 0.0]) * MOUNT})
        diagnostics = estimate_segments(recording, subject).diagnostics
        assert [each.code for each in diagnostics] == ["mount-contradicted"] * len(off)
        assert [each.value for each in diagnostics] == pytest.approx(np.deg2rad(off), abs=0.01)


def test_a_calibrated_mount_that_cannot_be_names_the_strapping() -> None:
    over = Rotation.from_rotvec([0.0, np.pi, 0.0])
    recording, _ = ready_recording({"torso": 0.0}, {"torso": over * MOUNT})
    subject = replace(population_subject(), mounts={"torso": MOUNT.as_quat()})
    with pytest.raises(WeposeError, match=r"sensors\.torso: its calibrated mount is 180 deg off .* remounted = true"):
        estimate_segments(recording, subject)


def test_a_mount_that_contradicts_gravity_and_one_that_is_missing(simulation: Simulation) -> None:
    recording = simulation.recording()
    wrong = replace(recording.sensors["torso"], stated_quat_LS=compute_mount("-x", "+z"))
    with pytest.raises(WeposeError, match=r"sensors\.torso\.mount is \d+ deg off gravity"):
        estimate_segments(replace(recording, sensors={**recording.sensors, "torso": wrong}))
    without = replace(recording.sensors["torso"], stated_quat_LS=None)
    with pytest.raises(WeposeError, match=r"sensors\.torso\.mount is not known: state it"):
        estimate_segments(replace(recording, sensors={**recording.sensors, "torso": without}))


def test_without_phases_the_quietest_window_is_taken_and_said(simulation: Simulation) -> None:
    segments = estimate_segments(replace(simulation.recording(), phases={}))
    assert 0.0 <= segments.start[0] < segments.start[1] <= 5.1
    (guess,) = segments.diagnostics
    assert (guess.code, guess.facts) == ("start-pose-guessed", dict(zip(("start", "end"), segments.start, strict=True)))
    with pytest.raises(WeposeError, match="holds 2 samples"):
        estimate_segments(replace(simulation.recording(), phases={"start": ((1.0, 1.01),)}))


@pytest.mark.parametrize("segment", ["head", "pelvis", "left_forearm"])
def test_an_unknown_mount_beside_a_subject_that_has_none_for_it(half_minute: Recording, segment: str) -> None:
    bare = replace(half_minute.sensors["torso"], stated_quat_LS=None)
    recording = replace(half_minute, sensors={**half_minute.sensors, segment: bare})
    known = {name: s.stated_quat_LS for name, s in half_minute.sensors.items() if name != segment}
    with pytest.raises(WeposeError, match=rf"sensors\.{segment}\.mount is not known: state it") as raised:
        estimate_segments(recording, replace(population_subject(), name="anna", mounts=known))
    assert ("wepose calibrate" in str(raised.value)) == (segment == "left_forearm")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("rate_deg_s", [2.0, 10.0])
def test_a_person_who_turns_in_the_start_pose_is_named(half_minute: Recording, rate_deg_s: float) -> None:
    """The same rate about the vertical in all sensors: little of it makes the biases uncertain, much is refused."""
    turning = {}
    for segment, sensor in half_minute.sensors.items():
        up = sensor.accel_S[half_minute.span(half_minute.phases["start"][0])].mean(axis=0)
        turning[segment] = replace(sensor, gyro_S=sensor.gyro_S + np.deg2rad(rate_deg_s) * up / np.linalg.norm(up))
    turned = replace(half_minute, sensors=turning)
    if rate_deg_s > 5.0:
        with pytest.raises(WeposeError, match=r"phases.start \(.* all sensors turn about the vertical"):
            estimate_segments(turned)
        return
    still, segments = estimate_segments(half_minute), estimate_segments(turned)
    (rotates,) = (each for each in segments.diagnostics if each.code == "start-pose-motion")
    assert rotates.value == pytest.approx(np.deg2rad(rate_deg_s), rel=0.3)
    assert "start-pose-motion" not in {each.code for each in still.diagnostics}
    for segment, orientation in segments.orientation.items():
        less = still.orientation[segment].noise.gyro_bias_cov
        assert np.trace(orientation.noise.gyro_bias_cov - less) > 0.9 * np.deg2rad(rate_deg_s) ** 2


def test_a_raised_arm_and_the_chest_are_less_certain_by_soft_tissue() -> None:
    """Of exact orientations; the further a segment is from the N-pose, the more a sensor turns on it."""
    time = np.arange(0.0, 12.0, 0.02)
    raised = np.clip(time - 5.0, 0.0, 1.0)[:, None] * [np.pi / 2.0, 0.0, 0.0]
    sensors = {name: OrientationSensor(np.tile(np.eye(4)[3], (len(time), 1)), np.eye(4)[3]) for name in ARMS}
    sensors["left_upper_arm"] = replace(sensors["left_upper_arm"], quat_VS=Rotation.from_rotvec(raised).as_quat())
    pose = wp.track(Recording("raised", time, 50.0, sensors, {"start": ((0.5, 4.5),)}), open_loop=True).pose
    grown = {}
    for name in ARMS:
        variance = np.degrees(np.sqrt(np.diagonal(pose.segment_cov[name], axis1=1, axis2=2))) ** 2
        grown[name] = np.sqrt(np.clip(variance[-1] - variance[200], 0.0, None))
    # 0.05 of the angle across the arm; the chest extends with the mean of both arms, by 0.04 of it about y.
    assert grown["left_upper_arm"].max() > 4.0
    assert grown["torso"][1] == pytest.approx(0.04 * 45.0, abs=0.3)
    assert grown["right_upper_arm"].max() < 0.1


def with_start(recording: Recording, begin: float, end: float) -> Recording:
    return replace(recording, phases={**recording.phases, "start": ((begin, end),)})


def test_a_start_interval_that_reaches_into_the_motion_is_trimmed_for_tracking(half_minute: Recording) -> None:
    segments = estimate_segments(with_start(half_minute, 3.3, 5.75))
    [trimmed] = segments.diagnostics
    assert trimmed.code == "static-phase-trimmed"
    assert segments.start[0] == pytest.approx(3.3)
    assert 4.9 < segments.start[1] < 5.4
    assert "[phases] start = [[3.3, " in str(trimmed)
    assert not estimate_segments(with_start(half_minute, *segments.start)).diagnostics


def test_a_start_interval_with_too_little_static_time_is_refused(half_minute: Recording) -> None:
    with pytest.raises(
        WeposeError, match=r"phases\.start: sensors\.\w+ turns at up to .* less than 1 s of it is static"
    ):
        estimate_segments(with_start(half_minute, 4.6, 5.9))
