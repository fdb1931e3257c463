"""Headings held together by joined hands, elbows and the accelerations of joints."""

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from bodies import LENGTHS, mount_rows
from bodies import RIGID_SHOULDERS as RIGID
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin import ImuSensor, OrientationSensor, Recording, Simulation, Subject, simulate, simulate_person, track
from wepose_pin.body.subject import Hinge
from wepose_pin.rotations import heading
from wepose_pin.tracking import Tracker

HINGES = {joint: Hinge(np.array([0.0, 1.0, 0.0]), np.deg2rad(2.0)) for joint in ("left_elbow", "right_elbow")}
LIMB = ("torso", "right_upper_arm", "right_forearm")


@pytest.fixture(scope="module")
def made() -> tuple[Simulation, Subject]:
    person = simulate_person(4)
    simulation = simulate(person.lengths, seed=4, noise=wp.NOISE_FREE, clasp_s=20.0, circles=2)
    mounts = dict.fromkeys(simulation.quat_WL, np.array([0.0, 0.0, 0.0, 1.0]))
    return simulation, replace(person.prior, lengths=person.lengths, mounts=mounts, hinges=HINGES, girdles=RIGID)


def drifting(simulation: Simulation, deg_min: dict[str, float]) -> Recording:
    """Exact orientations whose headings drift from the end of the start pose on."""
    recording = simulation.recording()
    since = np.clip(recording.time - recording.phases["start"][0][1], 0.0, None)
    sensors = {}
    for name, quat in simulation.quat_WL.items():
        turn = np.deg2rad(deg_min.get(name, 0.0)) / 60.0 * since[:, None] * [0.0, 0.0, 1.0]
        drifted = (Rotation.from_rotvec(turn) * Rotation.from_quat(quat)).as_quat()
        sensors[name] = OrientationSensor(quat_VS=drifted, stated_quat_LS=np.array([0.0, 0.0, 0.0, 1.0]))
    return replace(recording, sensors=sensors)


def test_a_forearm_that_drifts_is_brought_back(made: tuple[Simulation, Subject]) -> None:
    simulation, subject = made
    recording = drifting(simulation, {"right_forearm": 16.0})
    errors = {}
    for open_loop in (True, False):
        pose = track(recording, subject, open_loop=open_loop)
        errors[open_loop] = (
            wp.evaluate(pose, simulation.truth(), simulation.phases["circles"][0]).position["right_palm"].mean
        )
    assert errors[False] < 0.7 * errors[True]
    assert pose.correction is not None
    largest = pose.summary["heading_correction"]["largest_correction_deg"]
    assert largest["right_forearm"] > 4.0 > largest["left_upper_arm"]


def elbow_rms(pose: wp.TrackResult) -> float:
    """By how much the right forearm leaves the plane of its hinge [rad]."""
    return float(np.sqrt(np.mean(wp.joint_angles(pose)["right_elbow"]["carrying_angle"] ** 2)))


def test_without_a_clasp_the_hinges_of_each_arm_correct_it(made: tuple[Simulation, Subject]) -> None:
    """Axes as the table has them where none is calibrated, and without the torso that the hands would need."""
    simulation, subject = made
    recording = drifting(simulation, {"right_forearm": 24.0})
    recording = replace(recording, phases={"start": recording.phases["start"]})
    fewer = replace(recording, sensors={n: s for n, s in recording.sensors.items() if n != "torso"})
    alone = replace(recording, sensors={n: s for n, s in recording.sensors.items() if "forearm" not in n})
    for of, person in ((recording, replace(subject, hinges={})), (fewer, subject)):
        assert elbow_rms(track(of, person)) < 0.7 * elbow_rms(track(of, person, open_loop=True))
    assert track(alone, subject).correction is None
    assert track(recording, subject, open_loop=True).correction is None


def test_hands_that_are_apart_in_the_clasp_phase_turn_nothing(made: tuple[Simulation, Subject]) -> None:
    """A phase that goes on into the circles, in which the palms are half a metre apart, is one without them."""
    simulation, subject = made
    recording = drifting(simulation, {"right_forearm": 16.0})
    start, clasp, circles = recording.phases["start"], recording.phases["clasp"], simulation.phases["circles"]
    only, longer, alone = (
        track(replace(recording, phases={"start": start, "clasp": spans}), replace(subject, hinges={}))
        for spans in (clasp, (*clasp, *circles), tuple(circles))
    )
    assert only.correction is not None
    assert only.correction.max_correction_deg["right_forearm"] > 0.5
    assert longer.correction is not None
    for name, quat in only.quat_WL.items():
        np.testing.assert_allclose(longer.quat_WL[name], quat, atol=1e-12)
    never = track(replace(recording, phases={"start": start}), replace(subject, hinges={}))
    for name, quat in never.quat_WL.items():
        np.testing.assert_allclose(alone.quat_WL[name], quat, atol=1e-12)


def test_a_marked_clasp_of_two_seconds_brings_a_turned_arm_back_within_one(made: tuple[Simulation, Subject]) -> None:
    """Sensors without accelerations: nothing else tells that a whole arm has turned against the torso."""
    simulation, subject = made
    recording = drifting(simulation, dict.fromkeys(("right_upper_arm", "right_forearm"), 24.0)).cut(slice(0, 3000))
    subject = replace(subject, covariance=0.04 * subject.covariance)
    off = {}
    for marked in (False, True):
        phases = {"start": recording.phases["start"]} | ({"clasp": ((25.0, 27.0),)} if marked else {})
        pose = track(replace(recording, phases=phases), subject, causal=True)
        at = np.searchsorted(simulation.time, pose.time - 1e-9)
        off_W = {
            n: Rotation.from_quat(simulation.quat_WL[n][at]) * Rotation.from_quat(q).inv()
            for n, q in pose.quat_WL.items()
        }
        turn = {name: R.as_rotvec()[:, 2] for name, R in off_W.items()}
        relative = np.degrees(turn["right_upper_arm"] - turn["torso"])
        off[marked] = [float(np.interp(time, pose.time, relative)) for time in (24.9, 26.0)]
    assert off[True][0] == off[False][0]
    assert abs(off[False][1]) > abs(off[False][0]) > 7.0
    assert abs(off[True][1]) < 0.5 * abs(off[False][1])


def test_only_the_filters_part_of_the_headings_variance_is_held() -> None:
    """Joined hands bound the drift; of a mount's heading that is off they say nothing."""
    noise = wp.ImuNoise(gyro_density=40.0 * wp.ImuNoise().gyro_density)
    simulation = simulate(simulate_person(4).lengths, seed=4, noise=noise, clasp_s=20.0, circles=1)
    recording = simulation.recording()
    average = simulate_person(4).prior
    order = (*LENGTHS, *mount_rows("torso", "right_forearm"))
    covariance = np.zeros((len(order), len(order)))
    covariance[:8, :8] = average.covariance
    sure = replace(average, mounts=simulation.quat_LS, hinges=HINGES, order=order, covariance=covariance)
    sure = replace(sure, girdles=simulation.girdles)
    loose = covariance.copy()
    loose[-1, -1] = np.deg2rad(5.0) ** 2
    held, free = (
        [track(recording, replace(sure, covariance=C), open_loop=open_loop) for C in (covariance, loose)]
        for open_loop in (False, True)
    )
    name = "right_forearm"
    brought = [of[1].pose.segment_cov[name] - of[0].pose.segment_cov[name] for of in (held, free)]
    assert brought[1][:, 2, 2].max() > np.deg2rad(3.0) ** 2
    assert brought[0][:, 2, 2].max() > 0.5 * brought[1][:, 2, 2].max()
    assert np.all(np.linalg.eigvalsh(held[1].pose.segment_cov[name]) > 0.0)
    end = [np.degrees(np.sqrt(of[0].pose.segment_cov[name][-1, 2, 2])) for of in (held, free)]
    assert end[0] < 0.9 * end[1]


def test_a_chunk_may_end_with_the_last_sample_of_the_start_pose(made: tuple[Simulation, Subject]) -> None:
    """What the filters have corrected up to there is that of the next chunk's first sample, as in the whole."""
    recording = made[0].recording()
    begin, end = recording.phases["start"][0]
    phases = {"start": ((begin, end + 0.4 / recording.rate_hz),)}
    recording = replace(recording.cut(slice(0, 1500)), phases=phases)
    tracker, last = Tracker(), recording.span(phases["start"][0]).stop
    assert recording.time[last - 1] < phases["start"][0][1] < recording.time[last]
    for span in ((0, last), (last, 1500)):
        assert tracker.push(recording.cut(slice(*span))) is None
    chunks = list(tracker.smooth())
    for name, quat_WL in track(recording).quat_WL.items():
        assert np.array_equal(np.concatenate([chunk.quat_WL[name] for chunk in chunks]), quat_WL)


def test_hands_with_sensors_of_their_own_bend_at_the_wrist(made: tuple[Simulation, Subject]) -> None:
    """Forearms as long as forearm and hand were, so that the wrists meet; both hands point up from there."""
    simulation, subject = made
    recording = drifting(simulation, {})
    bent = np.clip((recording.time - recording.phases["start"][0][1]) / 2.0, 0.0, 1.0)[:, None] * [0.0, -2.8, 0.0]
    lengths, sensors, mounts = dict(subject.lengths), dict(recording.sensors), dict(subject.mounts)
    for side in ("left", "right"):
        lengths[f"{side}_forearm"] += lengths[f"{side}_hand"]
        sensors[f"{side}_hand"] = OrientationSensor(quat_VS=Rotation.from_rotvec(bent).as_quat())
        mounts[f"{side}_hand"] = np.array([0.0, 0.0, 0.0, 1.0])
    pose = track(replace(recording, sensors=sensors), replace(subject, lengths=lengths, mounts=mounts, hinges={}))
    assert pose.correction is not None
    assert max(pose.correction.max_correction_deg.values()) < 0.1  # 1.3 mm over two arms, of people who stand ± 13 deg
    assert set(pose.correction.max_correction_deg) == set(sensors)


def test_hinges_hold_for_the_strapping_in_which_they_were_found(made: tuple[Simulation, Subject]) -> None:
    simulation, subject = made
    recording = drifting(simulation, {"right_forearm": 16.0}).cut(slice(0, 3000))
    recording = replace(recording, phases={"start": recording.phases["start"]})
    skew = Hinge(np.array([np.sin(0.2), np.cos(0.2), 0.0]), np.deg2rad(2.0))
    subject = replace(subject, hinges=dict.fromkeys(HINGES, skew))
    calibrated, remounted = (track(replace(recording, remounted=again), subject) for again in (False, True))
    usual = track(recording, replace(subject, hinges={}))
    assert calibrated.correction is not None
    assert usual.correction is not None
    assert not np.array_equal(calibrated.quat_WL["right_forearm"], usual.quat_WL["right_forearm"])
    assert all(np.array_equal(remounted.quat_WL[name], quat) for name, quat in usual.quat_WL.items())


def test_a_turn_is_uncertain_by_the_scale_of_its_gyroscope(made: tuple[Simulation, Subject]) -> None:
    correction = track(drifting(made[0], {}), made[1]).correction
    assert correction is not None
    forward, turn = correction.filter, np.array([0.0, 1.0, -2.0, 30.0, 0.5])
    covariance = forward.advance(forward.advance(np.eye(len(forward.x)), turn).T, turn)
    np.testing.assert_allclose(np.diag(covariance)[:5], 1.0 + forward.knot_s**2 + turn**2)


@pytest.mark.parametrize("causal", [False, True])
def test_headings_known_from_each_other_are_uncertain_together(made: tuple[Simulation, Subject], causal: bool) -> None:
    """A limb is turned as a whole: what two segments share, and the covariance of all is one."""
    simulation, subject = made
    tracked = track(drifting(simulation, {}), subject, causal=causal)
    assert tracked.correction is not None
    shared = tracked.correction.correlate_segments(tracked.time, tracked.pose.segment_cov)
    names = list(tracked.pose.segment_cov)
    assert {frozenset(pair) for pair in shared} == {frozenset(pair) for pair in combinations(names, 2)}
    rows = np.arange(0, len(tracked.time), 500)
    together = np.zeros((len(rows), 3 * len(names), 3 * len(names)))
    for i, name in enumerate(names):
        together[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = tracked.pose.segment_cov[name][rows]
    for (near, far), cov in shared.items():
        i, j = 3 * names.index(near) + 2, 3 * names.index(far) + 2
        together[:, i, j] = together[:, j, i] = cov[rows]
    assert np.linalg.eigvalsh(together).min() > -1e-12
    heading = together[-1, 2::3, 2::3]
    correlation = heading / np.sqrt(np.outer(np.diag(heading), np.diag(heading)))
    assert correlation[names.index("right_upper_arm"), names.index("right_forearm")] > 0.05


# Accelerations of joints -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def moving() -> Simulation:
    return simulate(simulate_person(3).lengths, seed=3, imperfections=wp.MILD_PRESET, clasp_s=40.0, circles=1)


def heading_errors(simulation: Simulation, tracked: wp.TrackResult, from_s: float) -> dict[tuple[str, str], np.ndarray]:
    """Heading [deg] of each sensor's world of the right arm against its neighbour's."""
    rows = np.flatnonzero(tracked.time > from_s)[::20]
    at = np.searchsorted(simulation.time, tracked.time[rows] - 1e-9)
    off = {}
    for name in LIMB:
        R_WS = Rotation.from_quat(tracked.quat_WL[name][rows]) * Rotation.from_quat(tracked.segments.quat_LS[name])
        off[name] = (Rotation.from_quat(simulation.quat_WS[name][at]) * R_WS.inv()).as_rotvec()[:, 2]
    return {(a, b): np.degrees(np.angle(np.exp(1j * (off[a] - off[b])))) for a, b in pairwise(LIMB)}


@pytest.mark.parametrize("causal", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_forearm_that_drifts_is_corrected_without_calibration_and_clasp(moving: Simulation, causal: bool) -> None:
    """The gyroscope of the right forearm turns about the vertical by 0.25 deg/s from the end of the start pose on."""
    recording = moving.recording()
    recording = replace(recording, phases={"start": recording.phases["start"]})
    after = recording.time > recording.phases["start"][0][1]
    up_S = Rotation.from_quat(moving.quat_WS["right_forearm"]).inv().apply([0.0, 0.0, 1.0])
    recording.sensors["right_forearm"].gyro_S[:] += np.deg2rad(0.25) * after[:, None] * up_S
    rms = {}
    for open_loop in (True, False):
        tracked = track(recording, open_loop=open_loop, causal=causal)
        errors = heading_errors(moving, tracked, 30.0)
        rms[open_loop] = {pair: float(np.sqrt(np.mean(error**2))) for pair, error in errors.items()}
    assert rms[True][LIMB[1:]] > 5.0
    assert rms[False][LIMB[1:]] < 2.0
    correction = tracked.correction
    assert correction is not None
    assert set(tracked.summary["heading_correction"]["joint_accelerations"]) == {
        f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm")
    }
    rows = tracked.time[tracked.time > 30.0][::20]
    for pair in pairwise(LIMB):
        signs = [(name == pair[0]) - float(name == pair[1]) for name in correction.filter.names]
        std = np.sqrt(np.interp(rows, correction.time, correction.covariance @ signs @ signs))
        by_std = errors[pair] / np.degrees(std)
        assert np.sqrt(np.mean(by_std**2)) < 1.6


@pytest.mark.parametrize("name", ["", "torso", "left_upper_arm", "right_forearm"])
def test_a_sensor_that_is_stated_backwards_is_named(moving: Simulation, name: str) -> None:
    """Turned about the vertical of the start pose, where gravity does not show it."""
    recording, half_turn = moving.recording(), Rotation.from_rotvec([0.0, 0.0, np.pi])
    backwards = {name: half_turn * Rotation.from_quat(recording.sensors[name].stated_quat_LS)} if name else {}
    stated = {each: replace(recording.sensors[each], stated_quat_LS=quat.as_quat()) for each, quat in backwards.items()}
    diagnostics = track(replace(recording, sensors={**recording.sensors, **stated})).diagnostics
    found = {each.place: each.value for each in diagnostics if each.code == "mount-contradicted"}
    assert found == {each: pytest.approx(np.pi, abs=0.3) for each in stated}


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("lost", ["left_forearm", "right_upper_arm"])
def test_a_sensor_that_is_lost_while_the_person_turns_is_found_again(
    moving: Simulation, lost: str, causal: bool
) -> None:
    """Until then its stated uncertainty covers the turn, and a warning names its joints."""
    begin, turn = 30.0, np.pi
    end = begin + turn / np.deg2rad(90.0)
    recording, up = moving.recording(), [0.0, 0.0, 1.0]
    gap, sensors = (recording.time > begin) & (recording.time <= end), dict[str, ImuSensor]()
    for name, sensor in recording.imus.items():
        turning_S = np.deg2rad(90.0) * Rotation.from_quat(moving.quat_WS[name]).inv().apply(up)
        gyro_S = np.where(gap[:, None], sensor.gyro_S + turning_S, sensor.gyro_S)
        sensors[name] = replace(sensor, gyro_S=gyro_S, gap=gap if name == lost else None)
    phases = {"start": recording.phases["start"]}
    tracked = track(replace(recording, sensors=sensors, phases=phases), causal=causal)
    truth = Rotation.from_quat(moving.quat_WL[lost][np.searchsorted(moving.time, tracked.time - 1e-9)])
    turned = np.clip(tracked.time - begin, 0.0, end - begin)[:, None] * np.deg2rad(90.0) * up
    error = (Rotation.from_rotvec(turned) * truth * Rotation.from_quat(tracked.quat_WL[lost]).inv()).as_quat()
    after = tracked.time > end
    error_deg, std = np.degrees(np.abs(heading(error)))[after], np.sqrt(tracked.pose.segment_cov[lost][after, 2, 2])
    assert np.all(error_deg < 3.0 * np.degrees(std))
    assert np.all(error_deg[-1500:] < 15.0)
    if causal:
        assert error_deg.max() > 120.0
        uncertain = [each.place for each in tracked.diagnostics if each.code == "heading-uncertain"]
        assert tracked.model.table.joint_name(lost) in uncertain
    else:
        assert error_deg.max() < 20.0


@pytest.mark.parametrize("causal", [False, True])
def test_after_a_loss_of_all_sensors_that_follows_one_of_a_single_one_there_are_poses(
    moving: Simulation, causal: bool
) -> None:
    recording, sensors = moving.recording(), dict[str, ImuSensor]()
    time = recording.time
    for name, sensor in recording.imus.items():
        own = (time > 30.0) & (time < 33.0) & (name == "right_forearm")
        sensors[name] = replace(sensor, gap=own | ((time > 36.0) & (time < 38.0)))
    phases = {"start": recording.phases["start"]}
    tracked = track(replace(recording, sensors=sensors, phases=phases), causal=causal)
    truth = np.searchsorted(moving.time, tracked.time - 1e-9)
    for name, quat in tracked.quat_WL.items():
        error = Rotation.from_quat(moving.quat_WL[name][truth]) * Rotation.from_quat(quat).inv()
        assert np.all(np.abs(heading(error.as_quat())) < 3.0 * np.sqrt(tracked.pose.segment_cov[name][:, 2, 2]))


@pytest.mark.parametrize("causal", [False, True])
def test_arms_that_hang_still_stay_as_the_filter_has_them(moving: Simulation, causal: bool) -> None:
    rng = np.random.default_rng(1)
    n = 4000
    sensors = {
        name: ImuSensor(
            rng.normal(0.0, 2e-3, (n, 3)), sensor.accel_S[200] + rng.normal(0.0, 0.02, (n, 3)), sensor.stated_quat_LS
        )
        for name, sensor in moving.recording().imus.items()
    }
    recording = Recording("still", np.arange(n) / 100.0, 100.0, sensors, {"start": ((0.5, 4.5),)})
    corrected, alone = (track(recording, causal=causal, open_loop=open_loop) for open_loop in (False, True))
    for name, quat in alone.quat_WL.items():
        turned = Rotation.from_quat(corrected.quat_WL[name]) * Rotation.from_quat(quat).inv()
        assert np.degrees(turned.magnitude().max()) < 3.0  # by the hinges, of arms whose start pose is known to 13 deg
