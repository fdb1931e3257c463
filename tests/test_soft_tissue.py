"""Means of soft tissue: what a hinge shows of them, and their correction in the pose."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.body import load_model
from wepose_pin.body.soft_tissue import SoftTissueCorrection, TissueMean, correct_table
from wepose_pin.body.subject import Hinge, population_subject
from wepose_pin.body.table import load_table
from wepose_pin.calibration import calibrate
from wepose_pin.simulation import IDEAL_PRESET, PEOPLE_MEASURED_STD, PEOPLE_PRESET, simulate, simulate_person
from wepose_pin.tracking import track

TABLE = load_table()
SEGMENTS = ("right_upper_arm", "torso", "right_forearm")


def correct(means: dict[str, TissueMean], **turns_deg: tuple[float, float, float]) -> dict[str, np.ndarray]:
    """Return segment → rotation vector [deg] of its correction, of segments that are turned in W by these vectors."""
    turns = {name: Rotation.from_rotvec(turns_deg.get(name, (0.0, 0.0, 0.0)), degrees=True) for name in SEGMENTS}
    quats = np.array([[turns[name].as_quat() for name in SEGMENTS]])
    corrected = SoftTissueCorrection(TABLE, means, SEGMENTS).correct(quats)[0]
    pairs = zip(SEGMENTS, corrected, strict=True)
    return {name: (turns[name].inv() * Rotation.from_quat(quat)).as_rotvec(degrees=True) for name, quat in pairs}


def test_a_segment_is_turned_by_its_own_twist_tilt_and_start() -> None:
    means = {
        "torso": TissueMean(1.0, 0.0),
        "right_upper_arm": TissueMean(1.0, 0.5),
        "right_forearm": TissueMean(1.0, 0.2, 0.1),
    }
    still = correct(means)
    np.testing.assert_allclose(still["right_upper_arm"], 0.0, atol=1e-9)
    np.testing.assert_allclose(still["right_forearm"], [0.0, 0.0, np.degrees(0.1)], atol=1e-9)
    twisted = correct(means, right_upper_arm=(0.0, 0.0, 30.0), right_forearm=(0.0, 0.0, 30.0))
    lag = np.degrees(0.5 * np.sin(np.pi / 6.0))
    np.testing.assert_allclose(twisted["right_upper_arm"], [0.0, 0.0, lag], atol=1e-9)
    # A forearm is twisted against the arm as it is corrected.
    np.testing.assert_allclose(twisted["right_forearm"][2], np.degrees(0.1 - 0.2 * np.sin(np.radians(lag))), atol=1e-9)
    bow = correct(means, torso=(0.0, 30.0, 0.0), right_upper_arm=(0.0, 30.0, 0.0))["torso"]
    np.testing.assert_allclose(bow, [0.0, np.degrees(-0.107 * 0.5), 0.0], atol=1e-9)
    np.testing.assert_allclose(
        correct(means, right_upper_arm=(0.0, -90.0, 0.0))["torso"], [0.0, 0.036 * 90.0, 0.0], atol=1e-9
    )


@pytest.mark.parametrize(("shown", "used"), [(7.0, 0.675), (0.4, 0.4), (-2.0, 0.0)])
def test_a_lag_beyond_all_people_is_no_skin(shown: float, used: float) -> None:
    hinge = Hinge(np.array((0.0, 1.0, 0.0)), 0.05, shown)
    subject = replace(population_subject(), hinges={"right_elbow": hinge})
    assert subject.shape(load_model()).tissue_means["right_upper_arm"].lag == pytest.approx(used)


@pytest.mark.parametrize(("hinge_deg", "size"), [(5.3, 1.0), (2.0, 0.46), (8.0, 1.39)])
def test_elbows_that_hold_show_that_soft_tissue_is_firm(hinge_deg: float, size: float) -> None:
    hinge = Hinge(np.array((0.0, 1.0, 0.0)), np.radians(hinge_deg), 0.45)
    subject = replace(population_subject(), hinges={"left_elbow": hinge, "right_elbow": hinge})
    table = correct_table(TABLE, subject.shape(load_model()).tissue_means)
    torso, arm, forearm = (table.segments[name] for name in ("torso", "right_upper_arm", "right_forearm"))
    np.testing.assert_allclose(np.degrees(torso.soft_tissue.std), 1.5 * size, rtol=0.01)
    assert torso.soft_tissue.per_tilt[1] == pytest.approx(size * np.sqrt(0.12**2 - 0.107**2), rel=0.01)
    assert arm.soft_tissue.per_twist == pytest.approx(size * np.sqrt(0.48**2 - 0.45**2), rel=0.01)
    # The twist in the start pose: 13 deg among people, of which the axis of the hinge leaves 10 deg times the size.
    twist = 1.0 / np.hypot(1.0 / 13.0, 1.0 / (10.0 * size))
    assert np.degrees(arm.start_std[2]) == pytest.approx(twist, rel=0.01)
    assert np.degrees(forearm.start_std[2]) == pytest.approx(np.sqrt(20.0**2 - 5.0**2 - 13.0**2 + twist**2), rel=0.01)


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_a_hinge_shows_how_far_skin_lags_behind_a_twist(size: float) -> None:
    person = simulate_person(3)
    sizes = replace(IDEAL_PRESET, tissue_gain=size, sensor_place=1.0)
    made = simulate(person.lengths, seed=3, imperfections=sizes, clasp_s=40.0, circles=2)
    recording = made.recording()
    subject = calibrate(recording, measured=person.measured, prior=person.prior).subject
    tracked = track(recording, subject)
    uncorrected = track(recording, replace(subject, hinges={}))
    assert tracked.model.tissue_means["torso"].share == pytest.approx(size, abs=0.5)
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
    person = simulate_person(24000, PEOPLE_MEASURED_STD)
    firm = replace(PEOPLE_PRESET, mount="any", tissue_gain=0.3, tissue_random=0.3, sway=0.3, clock_offset=0.0)
    recording = simulate(person.lengths, seed=24000, imperfections=firm, circles=0).recording()
    assert calibrate(recording, measured=person.measured, prior=person.prior).rms_gap < 0.045
