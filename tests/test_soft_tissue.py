"""The size of a person's errors: what hinges show of soft tissue and its means, and arms of the start pose."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin import IDEAL_PRESET, PEOPLE_PRESET, calibrate, load_model, population_subject, simulate, track
from wepose_pin.body.soft_tissue import LEAST_SHARE, USUAL_POSE_SHARE, estimate_pose_share
from wepose_pin.body.subject import Hinge, mount_rows
from wepose_pin.simulation import simulate_person


@pytest.mark.parametrize(("shown", "used"), [(7.0, 0.675), (0.4, 0.4), (-2.0, 0.0)])
def test_a_lag_beyond_all_people_is_no_skin(shown: float, used: float) -> None:
    hinge = Hinge(np.array((0.0, 1.0, 0.0)), 0.05, shown)
    order = tuple(mount_rows("right_upper_arm"))
    subject = replace(population_subject(), hinges={"right_elbow": hinge}, order=order, covariance=1e-2 * np.eye(3))
    personal = subject.shape(load_model()).personal
    assert personal["right_upper_arm"].soft_tissue.mean_per_twist == pytest.approx(used)
    # Soft tissue in any pose is part of what is known of the mount, and of the twist that the hinge shows.
    assert not any(personal["right_upper_arm"].soft_tissue.std)
    assert all(personal["right_forearm"].soft_tissue.std)


@pytest.mark.parametrize("offset", [0.0, 0.13])
def test_segments_that_hang_on_each_other_share_how_exactly_a_person_stood(offset: float) -> None:
    """A segment is not scaled for itself and once more for the one that carries it."""
    tilts, body = {"left_upper_arm": np.array((offset, 0.0, 0.01))}, load_model()
    hinges = {"right_elbow": Hinge(np.array((0.0, 1.0, 0.0)), 0.05, 0.4)}
    own = replace(population_subject(), hinges=hinges, start_pose_offset=tilts).shape(body).personal
    for name in ("torso", "pelvis", "head"):
        share = own[name].start_std[2] / body.table.segments[name].start_std[2]
        assert share == pytest.approx(estimate_pose_share(tilts, body.table) / USUAL_POSE_SHARE)


def test_who_repeats_the_tilts_of_the_start_pose_repeats_its_headings() -> None:
    """As in the recording of the calibration; another start pose is as uncertain as that of people, also of a reset."""
    simulation = simulate(simulate_person(3).lengths, seed=3, clasp_s=10.0, circles=0)
    recording, order = simulation.recording(), tuple(row for name in simulation.quat_LS for row in mount_rows(name))
    subject = replace(
        population_subject(), mounts=simulation.quat_LS, order=order, covariance=1e-6 * np.eye(len(order))
    )
    stds = []
    for offset in (0.0, 0.06):
        offsets = {name: np.array([offset, -offset, 0.01]) for name in simulation.quat_LS}
        tracked = track(recording, replace(subject, start_pose_offset=offsets), open_loop=True)
        cov = tracked.pose.segment_cov["right_upper_arm"][:, 2, 2]
        stds.append(np.degrees(np.sqrt(cov[recording.span(recording.phases["start"][0])].mean())))
    assert np.sqrt(stds[1] ** 2 - stds[0] ** 2) == pytest.approx(7.0, rel=0.05)  # `repeat_std_deg`
    same = replace(subject, start_pose_offset={name: np.array([0.0, 0.0, 0.01]) for name in simulation.quat_LS})
    tracked = track(replace(recording, resets=(600,)), same, causal=True)
    reset = np.searchsorted(tracked.time, recording.time[600])
    before, after = tracked.pose.segment_cov["right_upper_arm"][reset - 1 : reset + 1, 2, 2]
    assert np.degrees(np.sqrt(after - before)) > 5.0


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_a_hinge_shows_how_far_skin_lags_behind_a_twist(size: float) -> None:
    person = simulate_person(3)
    sizes = replace(IDEAL_PRESET, tissue_gain=size, sensor_place=1.0)
    made = simulate(person.lengths, seed=3, imperfections=sizes, clasp_s=40.0, circles=2)
    recording = made.recording()
    subject = calibrate(recording, measured=person.measured, prior=person.prior).subject
    tracked = track(recording, subject)
    uncorrected = track(recording, replace(subject, hinges={}))
    table, personal = tracked.model.table, tracked.model.personal_table
    usual, own = (each.segments["torso"].soft_tissue.mean_per_tilt[1] for each in (table, personal))
    assert own / usual == pytest.approx(size, abs=0.5)
    errors = []
    for pose in (tracked, uncorrected):
        relative, true = (
            Rotation.from_quat(quats["torso"]).inv() * Rotation.from_quat(quats["right_upper_arm"])
            for quats in (pose.quat_WL, made.quat_WL)
        )
        errors.append(np.degrees(np.sqrt(np.mean((relative * true.inv()).as_rotvec() ** 2))))
    assert errors[0] < (0.7 * errors[1] if size else errors[1] + 0.1)


def test_elbows_that_fit_hinges_well_do_not_overrule_the_clasp() -> None:
    """Of a person with firm straps; elbows are no exact hinges however firm the straps are."""
    person = simulate_person(24000, 0.012)
    firm = replace(PEOPLE_PRESET, mount="any", tissue_gain=0.3, tissue_random=0.3, sway=0.3, clock_offset=0.0)
    recording = simulate(person.lengths, seed=24000, imperfections=firm, circles=0, rate_hz=50.0).recording()
    assert calibrate(recording, measured=person.measured, prior=person.prior).rms_gap < 0.045


def test_arms_show_how_exactly_a_person_stood() -> None:
    """Nothing shows the lean of the torso."""
    person, stds = simulate_person(24000, 0.012), []
    for size in (0.3, 1.0):
        sizes = replace(PEOPLE_PRESET, mount="any", start_pose=size)
        options = {"imperfections": sizes, "clasp_s": 25.0, "circles": 0, "rate_hz": 50.0}
        recording = simulate(person.lengths, seed=24000, **options).recording()
        stds.append(calibrate(recording, measured=person.measured).subject.start_pose_offset["torso"][2])
    assert stds[0] < 0.75 * stds[1]


@pytest.mark.parametrize(
    ("offset", "share"),
    [
        ((0.0, 0.0, 0.01), LEAST_SHARE),
        ((0.3, 0.3, 0.3), 1.0),  # not shown
        ((0.3, 0.3, np.nan), 1.0),
        ((0.15, 0.0, 0.01), 0.68),
        ((1.5, 0.0, 0.01), 3.3),
    ],
)
def test_the_share_of_a_start_pose_is_a_positive_number(offset: tuple[float, float, float], share: float) -> None:
    offsets = {"left_upper_arm": np.array(offset), "torso": np.array((0.0, 0.0, 0.01))}
    assert estimate_pose_share(offsets, load_model().table) == pytest.approx(share, rel=0.05)
    assert estimate_pose_share({}, load_model().table) == 1.0
