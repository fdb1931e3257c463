"""Tracking without a look ahead: steps and runs give the same bits, and nothing later changes what was said."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin import ImuSensor, Recording, Simulation, TrackResult, WeposeError, track
from wepose_pin.tracking import Tracker


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


def started(recording: Recording, method: str) -> tuple[Tracker, int]:
    """A causal tracker as a live session has it, whose start pose has just ended, and the sample that comes next."""
    begin = recording.span(recording.phases["start"][0]).stop
    tracker = Tracker(method=method, causal=True)
    assert tracker.push(recording.cut(slice(0, begin))) is None
    return tracker, begin


def columns(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    sensors = recording.imus.values()
    return np.stack([s.gyro_S for s in sensors], axis=1), np.stack([s.accel_S for s in sensors], axis=1)


@pytest.mark.parametrize("method", ["amekf", "ncf"])
def test_sample_by_sample_gives_the_bits_of_a_run_through_resets_and_gaps(recording: Recording, method: str) -> None:
    """Two resets between two ticks are one."""
    gap = np.zeros(len(recording), dtype=bool)
    gap[2100:2300] = True
    sensors = dict(recording.sensors)
    sensors["left_forearm"] = replace(sensors["left_forearm"], gap=gap)
    phases = {"start": recording.phases["start"], "clasp": ((12.0, 14.0), (24.005, 26.0))}
    recording = replace(recording, sensors=sensors, resets=(1500, 1520, 1520, 2900), phases=phases)
    pose = track(recording, method=method, causal=True)
    tracker, begin = started(recording, method)
    gyro, accel = columns(recording)
    column = tracker.names.index("left_forearm")
    gyro[gap, column] = np.nan
    accel[gap, column] = np.nan
    for k in range(begin, len(recording)):
        for _ in range(recording.resets.count(k)):
            tracker.reset_headings()
        if k in (1200, 1401, 2401, 2601):
            tracker.mark_phase("clasp", begins=k in (1200, 2401))
        stepped = tracker.step(gyro[k], accel[k])
        for i, name in enumerate(tracker.names):
            assert np.array_equal(stepped[i], pose.quat_WL[name][k - begin]), (name, k)
        if k % 7 == 0 and pose.pose.segment_cov:
            covariance = [tracker.compute_covariance(i) for i in range(len(tracker.names))]
            stated = [pose.pose.segment_cov[name][k - begin] for name in tracker.names]
            np.testing.assert_allclose(covariance, stated, rtol=1e-9, atol=1e-12, err_msg=f"{k}")
    assert pose.time[0] == recording.time[begin]
    assert recording.phases["start"][0][1] < pose.time[0]


def test_what_lay_before_the_start_pose_changes_nothing(recording: Recording, whole: TrackResult) -> None:
    begin = recording.span(recording.phases["start"][0]).start
    assert begin > 0
    part = track(first(recording, len(recording), begin), causal=True)
    assert all(np.array_equal(part.quat_WL[name], quat) for name, quat in whole.quat_WL.items())


def test_a_reset_turns_headings_to_where_the_person_stands() -> None:
    """A forearm's gyroscope turns its heading by 30 degrees while the person stands in the start pose."""
    rng, n = np.random.default_rng(0), 900
    time, sensors = np.arange(n) / 100.0, {}
    for name in ("torso", "left_upper_arm", "left_forearm"):
        gyro, accel = rng.normal(0.0, [[0.001], [0.01]], (n, 2, 3)).transpose(1, 0, 2)
        sensors[name] = ImuSensor(gyro, accel + [0.0, 0.0, 9.81], np.array([0.0, 0.0, 0.0, 1.0]))
    sensors["left_forearm"].gyro_S[500:600, 2] += np.deg2rad(30.0)
    recording = Recording("standing", time, 100.0, sensors, {"start": ((0.5, 4.0),)}, resets=(700,))
    tracked = track(recording, causal=True)
    turned = np.degrees(Rotation.from_quat(tracked.quat_WL["left_forearm"]).magnitude())
    reset = np.searchsorted(tracked.time, 7.0 - 1e-9)
    assert turned[reset - 1] > 20.0
    assert turned[reset:].max() < 1.5


def test_without_a_named_start_pose_it_is_found(recording: Recording, whole: TrackResult) -> None:
    tracked = track(replace(recording, phases={}), causal=True)
    named = whole
    assert tracked.time[0] == pytest.approx(recording.time[0] + 3.0, abs=0.5)
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
