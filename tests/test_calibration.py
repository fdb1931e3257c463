"""Closed-chain calibration: the physics of the scale, honest deviations."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import GIRDLE_ROWS, LENGTHS, RIGID_SHOULDERS, mount_rows
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin import OrientationSensor, Recording, Simulation, Subject, calibrate, population_subject, simulate
from wepose_pin.body.soft_tissue import LEAST_SHARE
from wepose_pin.simulation import Person, simulate_person


def codes(calibration: wp.Calibration) -> set[str]:
    return {diagnostic.code for diagnostic in calibration.diagnostics}


def ready(simulation: Simulation) -> Recording:
    """The simulated person with exact orientations in place of sensors: what is left is the calibration alone."""
    sensors = {segment: OrientationSensor(quat_VS=quat) for segment, quat in simulation.quat_WL.items()}
    return replace(simulation.recording("exact"), sensors=sensors)


def with_rigid_shoulders(subject: Subject) -> Subject:
    """The same of a person whose shoulders are known not to move on the torso."""
    return replace(
        subject,
        girdles=RIGID_SHOULDERS,
        order=(*subject.order, *GIRDLE_ROWS),
        covariance=block_diag(subject.covariance, np.zeros((len(GIRDLE_ROWS), len(GIRDLE_ROWS)))),
    )


def test_forearms_that_go_inwards_as_they_pronate_do_not_turn_their_mounts() -> None:
    """By 0.11 of their twist, as elbows of the simulation; 14 deg off where the forearm is taken to stay in a plane."""
    person, sizes = simulate_person(12), replace(wp.IDEAL_PRESET, elbow=1.0, mount="any")
    made = simulate(person.lengths, seed=12, imperfections=sizes, noise=wp.NOISE_FREE, clasp_s=30.0, rate_hz=50.0)
    subject = calibrate(made.recording(), measured=person.measured, prior=person.prior).subject
    for side in ("left", "right"):
        true, mount = (Rotation.from_quat(each[f"{side}_forearm"]) for each in (made.quat_LS, subject.mounts))
        assert (mount * true.inv()).magnitude() < np.deg2rad(5.0)
        _, std, _, per_twist = subject.hinges[f"{side}_elbow"]
        assert per_twist == pytest.approx(-0.12, abs=0.04)
        assert std < np.deg2rad(1.5)


@pytest.fixture(scope="module")
def exact() -> tuple[Person, Recording]:
    person = simulate_person(11)
    return person, ready(simulate(person.lengths, seed=11, noise=wp.NOISE_FREE, clasp_s=20.0, circles=0))


def test_a_known_mount_is_known_better_after_and_a_new_strapping_not(exact: tuple[Person, Recording]) -> None:
    _, recording = exact
    rows = mount_rows("torso")
    prior = population_subject()
    before = np.diag([1e-4, 2e-4, 3e-4])
    prior = replace(
        prior,
        mounts={"torso": np.array([0.0, 0.0, 0.0, 1.0])},
        order=(*prior.order, *rows),
        covariance=block_diag(prior.covariance, before),
    )
    after = calibrate(recording, prior=prior).subject.mount_covariance("torso")
    assert after is not None
    assert np.linalg.eigvalsh(before - after)[0] > -1e-12
    again = calibrate(replace(recording, remounted=True), prior=prior).subject.mount_covariance("torso")
    assert again is not None
    assert again[1, 1] > before[1, 1]


def test_known_mounts_are_not_taken_for_those_of_a_start_pose_in_which_the_arms_are_turned() -> None:
    person, sizes = simulate_person(13), replace(wp.IDEAL_PRESET, start_pose=1.0)
    made = simulate(person.lengths, seed=13, imperfections=sizes, noise=wp.NOISE_FREE, clasp_s=30.0, circles=0)
    rows = [row for name in made.quat_LS for row in mount_rows(name)]
    covariance = block_diag(person.prior.covariance, np.deg2rad(0.5) ** 2 * np.eye(len(rows)))
    prior = replace(person.prior, mounts=made.quat_LS, order=(*person.prior.order, *rows), covariance=covariance)
    calibration = calibrate(made.recording(), measured=person.measured, prior=prior)
    assert calibration.quality.quality == "pass"
    assert max(abs(found - person.lengths[name]) for name, found in calibration.subject.lengths.items()) < 0.015


def test_all_mounts_share_the_heading_of_a_start_pose_in_which_the_arms_are_raised() -> None:
    """The torso faces forwards to within its soft tissue: about the vertical, which is across an arm in the T-pose."""
    person = simulate_person(11)
    recording = ready(
        simulate(person.lengths, seed=11, noise=wp.NOISE_FREE, clasp_s=15.0, circles=0, protocol="clasp+t_pose")
    )
    phases = {**recording.phases, "start": recording.phases["t_pose"]}
    calibration = calibrate(replace(recording, phases=phases, start_pose="t_pose"))
    subject, start_pose = calibration.subject, calibration.problem.layout.start_pose
    up = {name: start_pose.rotation(name)[2] for name in subject.mounts}
    assert abs(up["left_upper_arm"][2]) < 0.1
    for name in subject.mounts:
        rows = [[subject.order.index(row) for row in mount_rows(each)] for each in ("torso", name)]
        shared = up["torso"] @ subject.covariance[np.ix_(*rows)] @ up[name]
        assert shared > (0.98 * LEAST_SHARE * np.deg2rad(1.5)) ** 2, name  # `std_deg` of the torso


def test_mounts_at_any_rotation_come_from_the_closure_alone() -> None:
    """Exact motion, no noise: headings drawn from the full circle come back without a guess."""
    person = simulate_person(3)
    simulation = simulate(
        person.lengths, seed=3, noise=wp.NOISE_FREE, imperfections=replace(wp.IDEAL_PRESET, mount="any"), circles=0
    )
    recording = simulation.recording()
    assert all(sensor.stated_quat_LS is None for sensor in recording.sensors.values())
    subject = calibrate(recording, measured=person.measured, prior=person.prior).subject
    for segment, quat_LS in simulation.quat_LS.items():
        off = Rotation.from_quat(subject.mounts[segment]) * Rotation.from_quat(quat_LS).inv()
        assert np.degrees(off.magnitude()) < 0.3, segment


def test_exact_orientations_and_a_gauge_give_the_lengths_back(exact: tuple[Person, Recording]) -> None:
    person, recording = exact
    measured = {"shoulder_width": person.lengths["shoulder_width"]}
    prior = with_rigid_shoulders(population_subject())
    calibration = calibrate(recording, measured=measured, prior=prior, measured_std=1e-5)
    for name in ("shoulder_width", "left_upper_arm", "right_upper_arm"):
        assert calibration.subject.lengths[name] == pytest.approx(person.lengths[name], abs=2e-4)
    for side in ("left", "right"):
        # Without a sensor on the hand only the sum is seen.
        names = f"{side}_forearm", f"{side}_hand"
        assert sum(calibration.subject.lengths[n] for n in names) == pytest.approx(
            sum(person.lengths[n] for n in names), abs=2e-4
        )
    assert calibration.rms_gap < 2e-4


def test_without_a_gauge_the_proportions_are_right_and_the_scale_is_the_priors(exact: tuple[Person, Recording]) -> None:
    person, recording = exact
    calibration = calibrate(recording)
    seen = ("shoulder_width", "left_upper_arm", "right_upper_arm")
    ratio = [calibration.subject.lengths[name] / person.lengths[name] for name in seen]
    assert np.ptp(ratio) < 2e-3
    assert abs(np.mean(ratio) - 1) < 4 * calibration.scale_std
    assert 0.02 < calibration.scale_std < 0.1
    assert calibration.problem.measured == {}
    assert "scale-uncertain" in codes(calibration)
    # Nothing drifts to zero: another prior, ten per cent larger, gives everything ten per cent larger.
    average = population_subject()
    larger = replace(
        average, lengths={k: 1.1 * v for k, v in average.lengths.items()}, covariance=1.21 * average.covariance
    )
    again = calibrate(recording, prior=larger)
    for name in LENGTHS:
        assert again.subject.lengths[name] == pytest.approx(1.1 * calibration.subject.lengths[name], rel=1e-3)


@pytest.mark.monte_carlo
def test_the_standard_deviations_are_honest() -> None:
    """MTi-3 noise, real filtering, a measured shoulder width: errors over their standard deviations, 12 people."""
    z, chi2 = [], []
    for seed in range(12):
        person = simulate_person(100 + seed)
        simulation = simulate(person.lengths, seed=seed, circles=0)
        subject = calibrate(
            simulation.recording(), measured=person.measured, prior=person.prior, measured_std=person.measured_std
        ).subject
        names = [name for name in LENGTHS if name != "trunk"]
        error = np.array([subject.lengths[name] - person.lengths[name] for name in names])
        z.append(error / [subject.std(name) for name in names])
        chi2.append(error @ np.linalg.solve(subject.lengths_covariance(names), error))
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.5
    # Jointly, narrow combinations such as left minus right included; 7 is right, 24 is passed by one in a thousand.
    assert 2.0 < np.mean(chi2) < 10.0
    assert np.max(chi2) < 24.0


def test_the_trunk_is_not_seen(exact: tuple[Person, Recording]) -> None:
    person, recording = exact
    subject = calibrate(recording, prior=person.prior).subject
    assert subject.lengths["trunk"] == pytest.approx(person.prior.lengths["trunk"], rel=1e-6)
    assert subject.std("trunk") == pytest.approx(person.prior.std("trunk"), rel=1e-3)
    # A measured trunk is kept, and does not scale the arms.
    alone = calibrate(recording, prior=person.prior, measured={"trunk": 0.5})
    assert alone.subject.lengths["trunk"] == pytest.approx(0.5, abs=2e-3)
    assert not alone.problem.scale_lengths
    assert alone.subject.note.endswith("of the population prior")


def test_nothing_is_printed(exact: tuple[Person, Recording], capfd: pytest.CaptureFixture[str]) -> None:
    calibrate(exact[1])
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_soft_tissue_of_the_torso_is_no_heading() -> None:
    """The closure alone is off by 6 deg on this person, whose tissue turns the sensor as he leans."""
    person, imperfections = simulate_person(6), replace(wp.PEOPLE_PRESET, mount="any")
    simulation = simulate(person.lengths, seed=6, imperfections=imperfections, circles=0, rate_hz=50.0)
    measured = {"shoulder_width": person.measured["shoulder_width"]}
    subject = calibrate(simulation.recording(), measured=measured, prior=person.prior).subject
    error = Rotation.from_quat(subject.mounts["torso"]) * Rotation.from_quat(simulation.quat_LS["torso"]).inv()
    off = abs(error.as_rotvec()[2])
    assert np.degrees(off) < 3.0
    assert off < 2.0 * subject.std("mounts.torso.z")
