"""The whole chain on the simulated person, and on the real one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin import OrientationSensor, Recording, Simulation, evaluate, load_session, population_subject, track
from wepose_pin.simulation import Person, simulate


def test_a_perfect_world_is_tracked_to_a_millimetre(person: Person) -> None:
    """500 Hz, no noise, the true lengths: what is left is the filter's and the alignment's own error."""
    simulation = simulate(person.lengths, seed=5, rate_hz=500.0, noise=wp.NOISE_FREE, clasp_s=6.0, circles=1)
    subject = replace(population_subject(), lengths=person.lengths, girdles=simulation.girdles)
    # What observes headings in motion allows for people's errors: it is exact, 0.1 deg, if they stand within 0.6 deg.
    body = wp.load_model()
    exact = {name: each._replace(start_std=(0.01, 0.01, 0.01)) for name, each in body.table.segments.items()}
    body = replace(body, table=replace(body.table, segments=exact))
    for open_loop, most_deg in ((True, 0.05), (False, 0.1)):
        tracked = track(simulation.recording(), subject, model=body, open_loop=open_loop)
        errors = evaluate(tracked, simulation.truth())
        assert max(error.worst for error in errors.position.values()) < 1.0
        assert max(error.total_rmse for error in errors.attitude.values()) < most_deg


@pytest.fixture(scope="module")
def minute(person: Person) -> Simulation:
    """A clasp of twenty seconds and two circles, with the noise of an MTi-3."""
    return simulate(person.lengths, seed=3, clasp_s=20.0, circles=2)


@pytest.mark.parametrize("method", ["amekf", "smoother", "smekf", "smekf_published", "ncf", "gdc"])
def test_a_noisy_world_is_tracked_by_every_filter(minute: Simulation, person: Person, method: str) -> None:
    simulation, subject = minute, replace(population_subject(), lengths=person.lengths, girdles=minute.girdles)
    pose = track(simulation.recording(), subject, method=method)
    errors = evaluate(pose.pose, simulation.truth(), simulation.phases["circles"][0])
    assert errors.position["right_palm"].mean < 20.0
    summary = pose.summary
    assert summary["method"] == method
    assert set(summary["sensors"]) == set(simulation.gyro_S)


def measure_exactly(recording: Recording, simulation: Simulation) -> dict[str, OrientationSensor]:
    n, quat_WS = len(recording), simulation.quat_WS
    return {name: OrientationSensor(quat_WS[name][:n], s.stated_quat_LS) for name, s in recording.sensors.items()}


@pytest.mark.parametrize("causal", [False, True])
def test_the_uncertainty_of_measured_orientations_grows_in_gaps(
    half_minute: Recording, simulation: Simulation, causal: bool
) -> None:
    n, segment = len(half_minute), "left_forearm"
    gap = np.zeros(n, dtype=bool)
    gap[1500:1700] = True
    sensors = measure_exactly(half_minute, simulation)
    held = sensors[segment].quat_VS.copy()
    held[gap] = held[1499]
    with_gap = {**sensors, segment: replace(sensors[segment], quat_VS=held, gap=gap)}
    without, tracked = (track(replace(half_minute, sensors=each), causal=causal) for each in (sensors, with_gap))
    lost = gap[n - len(tracked.time) :]
    true = Rotation.from_quat(simulation.quat_WL[segment][n - len(tracked.time) : n])
    error = np.linalg.norm((Rotation.from_quat(tracked.quat_WL[segment]) * true.inv()).as_rotvec(), axis=1)
    std, std_without = (
        np.sqrt(np.trace(each.pose.segment_cov[segment], axis1=1, axis2=2) / 3.0) for each in (tracked, without)
    )
    assert np.degrees(error[lost].max()) > 20.0
    assert (error[lost] < 3.0 * std[lost]).all()
    assert (np.diff(std[lost][:20]) > 0.0).all()
    assert std[lost].max() > np.pi / 2.0
    np.testing.assert_allclose(std[~lost], std_without[~lost], rtol=0.05)


def test_sensors_that_are_missing_leave_out_what_cannot_be_known(half_minute: Recording) -> None:
    recording = half_minute
    fewer = {name: s for name, s in recording.sensors.items() if name not in ("left_forearm", "right_upper_arm")}
    pose = track(replace(recording, sensors=fewer))
    assert set(pose.quat_WL) == set(fewer)
    assert set(pose.points) == {"left_shoulder", "left_elbow", "right_shoulder"}
    assert pose.summary["points"] == sorted(pose.points)
    only_arm = {"left_upper_arm": recording.sensors["left_upper_arm"]}
    assert track(replace(recording, sensors=only_arm)).points == {}


def test_the_subject_gives_the_lengths(half_minute: Recording, person: Person) -> None:
    subject = replace(population_subject(), lengths=person.lengths)
    pose = track(half_minute, subject)
    upper_arm = np.linalg.norm(pose.points["left_elbow"] - pose.points["left_shoulder"], axis=1)
    np.testing.assert_allclose(upper_arm, person.lengths["left_upper_arm"], atol=1e-12)


def test_the_real_person_hangs_the_arms_again(data: Path) -> None:
    """Second standing phase, 86.6 to 88.0 s, after half a minute of work: the tilt agrees with the accelerometers'."""
    recording = load_session(data / "upper_body" / "session.toml")
    pose = track(recording)
    standing = recording.span((86.6, 88.0))
    for segment in ("torso", "left_forearm", "right_forearm"):
        R_LS = Rotation.from_quat(pose.segments.quat_LS[segment])
        accel_S = recording.sensors[segment].accel_S
        up_said = R_LS.apply(accel_S[standing]).mean(axis=0)
        up_found = Rotation.from_quat(pose.quat_WL[segment][standing]).mean().as_matrix()[2]
        off = np.degrees(np.arccos(up_found @ up_said / np.linalg.norm(up_said)))
        assert off < 4.0
    # In the N-pose all is where it should be: arms down, facing forward.
    start = recording.span((40.2, 44.4))
    for side, y in (("left", 1.0), ("right", -1.0)):
        hand = pose.points[f"{side}_palm"][start].mean(axis=0)
        shoulder = pose.points[f"{side}_shoulder"][start].mean(axis=0)
        np.testing.assert_allclose(hand[:2], shoulder[:2], atol=0.02)
        assert shoulder[1] * y > 0.15
        assert shoulder[2] - hand[2] > 0.55


def test_what_reading_finds_reaches_the_result(half_minute: Recording) -> None:
    recording = replace(half_minute, phases={})
    [guessed] = track(recording).diagnostics
    gaps = wp.Diagnostic("samples-lost", guessed.severity, "torso", 0.2, 0.05, {"samples": 30, "gaps": 2})
    tracked = track(replace(recording, diagnostics=(gaps,)))
    assert {each.code for each in tracked.diagnostics} == {"start-pose-guessed", "samples-lost"}
    assert [each["code"] for each in tracked.summary["diagnostics"]] == [each.code for each in tracked.diagnostics]
