"""Subjects: the anthropometric prior, the file, what is wrong in one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies import LENGTHS, TABLE

import wepose_pin as wp
from wepose_pin import WeposeError, load_model, load_subject, population_subject


def test_the_average_man_of_de_leva() -> None:
    """Joint to joint, male, 1.741 m (de Leva 1996, Table 4)."""
    lengths = population_subject(1.741, "m").lengths
    expected = {"trunk": 0.5155, "left_upper_arm": 0.2817, "right_forearm": 0.2689, "left_hand": 0.0681}
    for name, value in expected.items():
        assert lengths[name] == pytest.approx(value, abs=5e-4)
    woman = population_subject(1.735, "f").lengths
    assert woman["left_upper_arm"] == pytest.approx(0.2751, abs=5e-4)
    between = population_subject(1.74).lengths["left_upper_arm"]
    assert woman["left_upper_arm"] < between < lengths["left_upper_arm"]


def test_stature_narrows_the_prior_and_left_follows_right() -> None:
    wide, narrow = population_subject(), population_subject(1.75)
    assert wide.std("left_upper_arm") > 1.3 * narrow.std("left_upper_arm")
    cov = wide.lengths_covariance(("left_upper_arm", "right_upper_arm"))
    difference = np.sqrt(cov[0, 0] + cov[1, 1] - 2 * cov[0, 1])
    assert difference == pytest.approx(np.sqrt(2) * 0.01 * wide.lengths["left_upper_arm"], rel=1e-6)
    assert np.linalg.eigvalsh(wide.lengths_covariance())[0] > 0


def test_the_file_gives_back_what_a_calibration_found(tmp_path: Path) -> None:
    """Lengths, mounts, hinges, girdles, how the person stands and how the sensors drift, and the covariance of all."""
    person = wp.simulate_person(3)
    recording = wp.simulate(person.lengths, seed=3, imperfections=wp.MILD_PRESET, clasp_s=10.0, circles=0).recording()
    subject = replace(wp.calibrate(recording, prior=person.prior).subject, name='Ann "A" Ö\n\\', note="by hand")
    exact = subject.hinges["left_elbow"]._replace(std=0.0)  # as of a rigid mechanism
    subject = replace(subject, hinges={**subject.hinges, "left_elbow": exact})
    subject.save(tmp_path)
    for path in (tmp_path, tmp_path / "subject.toml"):
        again = load_subject(path)
        again.check_body(TABLE)
        assert (again.name, again.note, again.quality) == (subject.name, subject.note, subject.quality)
        assert again.order == subject.order
        assert again.lengths == pytest.approx(dict(subject.lengths), abs=1e-6)
        np.testing.assert_allclose(again.covariance, subject.covariance, rtol=1e-8, atol=1e-15)
        for name in ("mounts", "girdles", "hinges", "start_pose_offset", "heading_drift"):
            assert getattr(subject, name).keys() == getattr(again, name).keys() != set()
        for name in subject.mounts:
            np.testing.assert_allclose(again.mounts[name], subject.mounts[name], atol=1e-9)
            stood, offset = (each.start_pose_offset[name] for each in (again, subject))
            np.testing.assert_allclose(stood, offset, atol=1e-5)
            assert again.heading_drift[name] == pytest.approx(subject.heading_drift[name], rel=1e-3, abs=1e-8)
        for name, hinge in subject.hinges.items():
            np.testing.assert_allclose(again.hinges[name].axis, hinge.axis, atol=1e-6)
            assert again.hinges[name].std == pytest.approx(hinge.std, rel=1e-3)
        for name, girdle in subject.girdles.items():
            np.testing.assert_allclose(again.girdles[name], girdle, atol=1e-6)
    assert again.std("girdles.left_shoulder.raised_z") == pytest.approx(subject.std("girdles.left_shoulder.raised_z"))
    assert np.isnan(again.std("left_palm"))
    body = again.shape(load_model())
    assert body.lengths == pytest.approx(dict(again.lengths))


def test_a_hand_written_file_needs_lengths_only(tmp_path: Path) -> None:
    lines = ["format = 2", "[lengths]", *(f"{name} = 0.3" for name in LENGTHS), "[lengths_std]", "trunk = 0.02"]
    (tmp_path / "subject.toml").write_text("\n".join(lines), encoding="utf-8")
    subject = load_subject(tmp_path)
    assert subject.std("trunk") == pytest.approx(0.02)
    assert subject.mounts == {}


HINGE = "x = 0.0\ny = 0.5\nz = 0.0\nstd_deg = 2.0\ntwist_lag = 0.0\nper_twist = -0.1"
GIRDLE = "law = 0\nrest_x = 0\nrest_y = 0\nrest_z = 0\nraised_x = 0\nraised_y = 0"  # without raised_z


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("format = 1", "as `wepose calibrate` writes one, has format = 2"),
        ("format = 2\n[lengths]\ntrunk = 'long'", "lengths.trunk = 'long'; a finite number [m] above 0"),
        ("format = 2\n[lengths]\ntrunk = -0.5", "lengths.trunk = -0.5"),
        ("format = 2\n[lengths]\ntrunk = 0.5", "lengths: shoulder_width, left_upper_arm"),
        ("format 1", "not valid TOML"),
        ("format = 2\nquality = 'pas'\n[lengths]", "quality = 'pas' is not known; did you mean 'pass'"),
        (
            "ALL\n[mounts.torso]\nqx = 1.0\nqy = 1.0\nqz = 0.0\nqw = 0.0",
            "mounts.torso: no unit quaternion x, y, z, w: length 1.4",
        ),
        (
            "ALL\n[covariance]\norder = ['trunk']\nmatrix = [[1.0, 2.0]]",
            "covariance has the shape (1, 2); (1, 1) is needed",
        ),
        ("ALL\n[covariance]\norder = ['trunk', 'trunk']\nmatrix = [[1.0, 0.0], [0.0, 1.0]]", "names a row twice"),
        ("ALL\n[mounts.torso]\nqx = 0\nqy = 0\nqz = 0\nqw = 1\nqv = 0", "mounts.torso.qv is not a known key"),
        ("ALL\n[covariance]\norder = ['trunk']\nmatrix = [['a']]", "covariance.matrix: rows of numbers are needed"),
        (
            "ALL\n[start_pose_offset.tors]\nx_deg = 1\ny_deg = 1\nstd_deg = 1",
            "start_pose_offset: 'tors' is not known; did you mean 'torso'",
        ),
        (
            "ALL\n[start_pose_offset.torso]\nx_deg = 1",
            "torso.y_deg is missing; a number [deg] from -180 to 180 is needed",
        ),
        (
            "ALL\n[heading_drift.torso]\nrate_deg_min = 1\nstd_deg_min = -1",
            "std_deg_min = -1; a number [deg/min] from 0 to 6000 is",
        ),
        (
            f"ALL\n[girdles.left_shoulder]\n{GIRDLE}",
            "left_shoulder.raised_z is missing; a number from -3 to 3 is needed",
        ),
        (f"ALL\n[girdles.left_shoulder]\n{GIRDLE}\nraised_z = 5.0", "girdles.left_shoulder"),
        (
            f"ALL\n[girdles.left_sholder]\n{GIRDLE}\nraised_z = 0",
            "girdles: 'left_sholder' is not known; did you mean 'left_shoulder'",
        ),
        (
            "ALL\n[covariance]\norder = ['girdles.left_shoulder.rest']\nmatrix = [[1.0]]",
            "covariance.order: 'girdles.left_shoulder.rest' is not known",
        ),
        ("ALL\n[heading_drift]\ntorso = 1", "heading_drift.torso = 1 is not a table"),
        ("ALL\n[hinges.middle_elbow]\n" + HINGE.replace("0.5", "1.0"), "hinges: 'middle_elbow' is not known"),
        (f"ALL\n[hinges.left_elbow]\n{HINGE}", "hinges.left_elbow.axis: no unit vector: length 0.5"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, says: str) -> None:
    every = "format = 2\n[lengths]\n" + "\n".join(f"{name} = 0.3" for name in LENGTHS)
    (tmp_path / "subject.toml").write_text(text.replace("ALL", every), encoding="utf-8")
    with pytest.raises(WeposeError) as caught:
        load_subject(tmp_path).check_body(TABLE)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_body_without_girdles_has_its_own_shoulders() -> None:
    """As human URDFs of others: a calibrated subject fits them, without what it knows of shoulders."""
    body = load_model()
    bare = replace(body, table=replace(body.table, girdles={}))
    subject = replace(population_subject(), girdles={name: np.ones(7) for name in body.table.girdles})
    subject.check_body(bare.table)
    assert not subject.shape(bare).girdles
    assert set(subject.shape(body).girdles) == set(body.table.girdles)
