"""Tracking without a look ahead: steps and runs give the same bits, and nothing later changes what was said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import LENGTHS
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from wepose_pin.body.subject import Subject, mount_rows, population_subject
from wepose_pin.errors import WeposeError
from wepose_pin.recording import OrientationSensor, Recording
from wepose_pin.simulation import Simulation
from wepose_pin.tracking import Tracker, TrackOptions, TrackResult, track
from wepose_pin.tracking.segments import SegmentEstimator
from wepose_pin.tracking.start_pose import START_POSE_HOLD_S, StartPoseDetector, stack_ticks


@pytest.fixture(scope="module")
def recording(simulation: Simulation) -> Recording:
    """The first forty seconds."""
    return first(simulation.recording("causal"), 4000)


def first(recording: Recording, n: int, begin: int = 0) -> Recording:
    """Some samples of it, with the start pose alone for a phase."""
    return replace(recording.cut(slice(begin, n)), phases={"start": recording.phases["start"]})


@pytest.fixture(scope="module")
def whole(recording: Recording) -> TrackResult:
    return track(recording, causal=True)


def started(
    recording: Recording, subject: Subject | None = None, method: str = "amekf"
) -> tuple[SegmentEstimator, int]:
    """A causal tracker whose start pose has just ended, and the sample that comes next."""
    begin = recording.span(recording.phases["start"][0]).stop
    tracker = Tracker(subject, options=TrackOptions(method, causal=True))
    assert tracker.push(recording.cut(slice(0, begin))) is None
    assert tracker.segment_estimator is not None
    return tracker.segment_estimator, begin


def covariance_of(tracker: SegmentEstimator) -> np.ndarray:
    return [each for each in tracker.covariance_gradually() if each is not None][-1]


def columns(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    sensors = recording.imus.values()
    return np.stack([s.gyro_S for s in sensors], axis=1), np.stack([s.accel_S for s in sensors], axis=1)


@pytest.mark.parametrize("method", ["amekf", "ncf"])
def test_sample_by_sample_gives_the_bits_of_a_run_through_resets_and_gaps(recording: Recording, method: str) -> None:
    gap = np.zeros(len(recording), dtype=bool)
    gap[2100:2300] = True
    sensors = dict(recording.sensors)
    sensors["left_forearm"] = replace(sensors["left_forearm"], gap=gap)
    phases = {"start": recording.phases["start"], "clasp": ((12.0, 14.0), (24.005, 26.0))}
    recording = replace(recording, sensors=sensors, resets=(1500, 1520, 2900), phases=phases)
    pose = track(recording, method=method, causal=True)
    tracker, begin = started(recording, method=method)
    gyro, accel = columns(recording)
    column = tracker.names.index("left_forearm")
    gyro[gap, column] = np.nan
    accel[gap, column] = np.nan
    for k in range(begin, len(recording)):
        if k in recording.resets:
            tracker.reset_headings()
        if k in (1200, 1401, 2401, 2601):
            tracker.mark_phase("clasp", begins=k in (1200, 2401))
        stepped = tracker.step(gyro[k], accel[k])
        covariance = covariance_of(tracker) if k % 7 == 0 and pose.segments.covariance_W else None
        for i, name in enumerate(tracker.names):
            assert np.array_equal(stepped[i], pose.quat_WL[name][k - begin]), (name, k)
            if covariance is not None:
                stated = pose.segments.covariance_W[name][k - begin]
                np.testing.assert_allclose(covariance[i], stated, rtol=1e-9, atol=1e-12, err_msg=f"{name}, {k}")
    assert pose.time[0] == recording.time[begin]
    assert recording.phases["start"][0][1] < pose.time[0]


def test_measured_orientations_beside_raw_data_step_and_run_alike(recording: Recording, simulation: Simulation) -> None:
    """In a gap the last one stands, and not what the reader put there."""
    n = 2200
    gap = np.zeros(n, dtype=bool)
    gap[1500:1600] = True
    sensors = dict(first(recording, n).sensors)
    for name, lost in (("torso", None), ("left_forearm", gap)):
        quat_VS, stated = simulation.quat_WS[name][:n], sensors[name].stated_quat_LS
        sensors[name] = OrientationSensor(quat_VS, stated, lost)
    mixed = replace(first(recording, n), sensors=sensors, resets=(1550,))
    mixed = replace(mixed, phases={**mixed.phases, "clasp": ((12.0, 14.0),)})
    pose = track(mixed, causal=True)
    tracker, begin = started(mixed)
    gyro, accel = stack_ticks(mixed)
    column = tracker.names.index("left_forearm")
    gyro[gap, column] = accel[gap, column] = np.nan
    for k in range(begin, n):
        if k == 1550:
            tracker.reset_headings()
        if k in (1200, 1401):
            tracker.mark_phase("clasp", begins=k == 1200)
        stepped = tracker.step(gyro[k], accel[k])
        assert all(np.array_equal(stepped[i], pose.quat_WL[name][k - begin]) for i, name in enumerate(tracker.names)), k
        if k % 7 == 0:
            stated = np.stack([pose.segments.covariance_W[name][k - begin] for name in tracker.names])
            np.testing.assert_allclose(covariance_of(tracker), stated, rtol=1e-9, atol=1e-12, err_msg=f"{k}")
    held = pose.quat_WL["left_forearm"][1501 - begin : 1540 - begin]
    swing = Rotation.from_quat(held[0]).inv() * Rotation.from_quat(held)
    assert np.degrees(swing.magnitude().max()) < 1.0
    off = Rotation.from_quat(simulation.quat_WL["torso"][begin:n]).inv() * Rotation.from_quat(pose.quat_WL["torso"])
    assert np.degrees(off.magnitude()[: 1500 - begin].max()) < 5.0
    assert np.isfinite(covariance_of(tracker)).all()
    assert np.isnan(tracker.gyro_bias[column]).all()
    quiet = {name: replace(sensor, gap=None) for name, sensor in sensors.items()}
    tracked = track(replace(mixed, sensors=quiet, phases={}, resets=()), causal=True)
    assert tracked.time[0] == pytest.approx(recording.time[0] + START_POSE_HOLD_S, abs=0.5)


def test_resets_at_once_and_before_the_first_pose(recording: Recording) -> None:
    """Who presses twice between two ticks asks for one reset, and may do so as soon as the start pose is over."""
    tracker, begin = started(recording)
    pose = track(replace(recording, resets=(begin, 2000, 2000)), causal=True)
    gyro, accel = columns(recording)
    for k in range(begin, 2500):
        for _ in range({begin: 1, 2000: 2}.get(k, 0)):
            tracker.reset_headings()
        stepped = tracker.step(gyro[k], accel[k])
        assert all(np.array_equal(stepped[i], pose.quat_WL[name][k - begin]) for i, name in enumerate(tracker.names))


def test_chunks_and_samples_in_turn_give_the_bits_of_the_whole(recording: Recording, whole: TrackResult) -> None:
    estimator, begin = started(recording)
    gyro, accel = columns(recording)
    stepped = np.array([estimator.step(gyro[k], accel[k]).copy() for k in range(begin, begin + 777)])
    chunk = estimator.push(recording.cut(slice(begin + 777, 3000)))
    last = [estimator.step(gyro[k], accel[k]).copy() for k in range(3000, len(recording))]
    for i, name in enumerate(estimator.names):
        parts = [stepped[:, i], chunk.quat_WL[name], np.array(last)[:, i]]
        assert np.array_equal(np.concatenate(parts), whole.quat_WL[name]), name


def test_what_lay_before_the_start_pose_changes_nothing(recording: Recording, whole: TrackResult) -> None:
    begin = recording.span(recording.phases["start"][0]).start
    assert begin > 0
    part = track(first(recording, len(recording), begin), causal=True)
    assert all(np.array_equal(part.quat_WL[name], quat) for name, quat in whole.quat_WL.items())


def test_a_reset_turns_headings_to_where_the_person_stands(recording: Recording) -> None:
    """A forearm's gyroscope turns its heading by 30 degrees while the person stands in the start pose."""
    tracker, begin = started(recording)
    gyro, accel = (np.array(values[begin - 1]) for values in columns(recording))
    column = tracker.names.index("left_forearm")
    turning = gyro.copy()
    turning[column] += np.deg2rad(30.0) * accel[column] / np.linalg.norm(accel[column])
    for k in range(160):
        tracker.step(turning if k < 100 else gyro, accel)
    assert np.degrees(Rotation.from_quat(tracker.quat_WL[column]).magnitude()) > 20.0
    tracker.reset_headings()
    assert np.degrees(Rotation.from_quat(tracker.step(gyro, accel)).magnitude().max()) < 1.5  # as the person sways


def test_a_heading_is_stated_as_track_states_it(recording: Recording, simulation: Simulation) -> None:
    """With what the mounts' uncertainty turns a segment by as it moves, not the filter's part alone."""
    order = tuple(row for name in recording.sensors for row in mount_rows(name))
    covariance = np.diag(np.tile(np.deg2rad([2.0, 2.0, 4.0]) ** 2, len(recording.sensors)))
    average = population_subject()
    subject = replace(average, mounts=simulation.quat_LS, order=(*LENGTHS, *order),
                      covariance=block_diag(average.covariance, covariance))  # fmt: skip
    tracker, begin = started(recording, subject)
    gyro, accel = columns(recording)
    for k in range(begin, begin + 3000):
        tracker.step(gyro[k], accel[k])
    tracked = track(recording, subject, causal=True)
    stated = [np.sqrt(tracked.pose.segment_cov[name][2999, 2, 2]) for name in tracker.names]
    np.testing.assert_allclose(np.sqrt(covariance_of(tracker)[:, 2, 2]), stated, rtol=1e-9)
    moved = np.array([name != "torso" for name in tracker.names])
    assert (np.degrees(np.sqrt(covariance_of(tracker)[:, 2, 2]))[moved] > 1.0).all()
    tracker.reset_headings()  # sets the heading of the start pose, and says nothing of how the mount turns a raised arm
    assert (np.degrees(np.sqrt(covariance_of(tracker)[:, 2, 2]))[moved] > 1.0).all()


def test_the_detector_finds_the_first_stillness_and_says_who_moves() -> None:
    rng = np.random.default_rng(0)
    rate, n = 100.0, 1500
    gyro = 0.002 * rng.standard_normal((n, 3, 3))
    gyro[:400, 1] += 2.0 * np.sin(np.arange(400) / 10.0)[:, None]
    gyro[600, 2] = np.nan
    detector = StartPoseDetector(rate, np.zeros(3, dtype=bool))
    states = [detector.push(tick, np.zeros((3, 3))) for tick in gyro]
    assert states[50] == "moved"
    assert detector.moving == (1,)
    assert "start_pose" in states[520:600]
    assert states[600] == "waiting"
    assert states[601] == "start_pose"
    assert states[-1] == "ready"
    assert (detector.begin, detector.end) == (601, 600 + round(START_POSE_HOLD_S * rate))
    turns = StartPoseDetector(rate, np.zeros(1, dtype=bool))  # slowly and evenly
    assert all(turns.push(np.full((1, 3), np.deg2rad(6.0)), np.zeros((1, 3))) != "ready" for _ in range(1000))


def test_without_a_named_start_pose_it_is_found(recording: Recording, whole: TrackResult) -> None:
    tracked = track(replace(recording, phases={}), causal=True)
    named = whole
    assert tracked.time[0] == pytest.approx(recording.time[0] + START_POSE_HOLD_S, abs=0.5)
    for name, quat in named.quat_WL.items():
        both = tracked.quat_WL[name][-len(quat) :]
        assert np.degrees((Rotation.from_quat(both).inv() * Rotation.from_quat(quat)).magnitude().max()) < 3.0


def test_what_cannot_be_causal_is_said(recording: Recording) -> None:
    with pytest.raises(WeposeError, match=r"'smoother' needs the whole recording"):
        track(recording, method="smoother", causal=True)
    until = recording.span(recording.phases["start"][0]).stop
    with pytest.raises(WeposeError, match="ends with the recording"):
        track(recording.cut(slice(0, until)), causal=True)
    moving = {name: replace(of, gyro_S=of.gyro_S + 1.0) for name, of in recording.imus.items()}
    with pytest.raises(WeposeError, match="no start pose of 3 s without motion"):
        track(replace(recording, sensors=moving, phases={}), causal=True)
