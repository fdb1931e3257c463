"""Subjects: the anthropometric prior, the file, what is wrong in one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies import LENGTHS, SEGMENTS, TABLE

from wepose_pin.body import load_model
from wepose_pin.body.girdle import PARAMETERS
from wepose_pin.body.subject import (
    HeadingDrift,
    Hinge,
    StartPoseOffset,
    Subject,
    girdle_rows,
    load_subject,
    mount_rows,
    population_subject,
    subject_toml,
)
from wepose_pin.errors import WeposeError


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


def test_the_file_gives_back_what_was_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    average = population_subject(1.8, "f")
    order = (*LENGTHS, "mounts.torso.x", "mounts.torso.y", "mounts.torso.z")
    root = rng.normal(scale=0.01, size=(len(order), len(order)))
    subject = Subject(
        'Ann "A" Ö',
        average.lengths,
        order,
        root @ root.T,
        {"torso": np.array([0.5, -0.5, 0.5, 0.5])},
        "by hand",
        start_pose_offset={"torso": StartPoseOffset(np.array([0.01, -0.07]), 0.02)},
        heading_drift={"torso": HeadingDrift(np.deg2rad(-0.7) / 60.0, np.deg2rad(0.3) / 60.0)},
        quality="poor",
    )
    (tmp_path / "subject.toml").write_text(subject_toml(subject), encoding="utf-8")
    for path in (tmp_path, tmp_path / "subject.toml"):
        again = load_subject(path)
        assert again.name == subject.name
        assert again.lengths == pytest.approx(dict(subject.lengths), abs=1e-6)
        assert again.order == order
        assert again.quality == "poor"
        np.testing.assert_allclose(again.covariance, subject.covariance, rtol=1e-8)
        np.testing.assert_allclose(again.mounts["torso"], subject.mounts["torso"], atol=1e-9)
        np.testing.assert_allclose(again.start_pose_offset["torso"].tilt, [0.01, -0.07], atol=1e-6)
        assert again.start_pose_offset["torso"].std == pytest.approx(0.02, rel=1e-3)
        assert again.heading_drift["torso"] == pytest.approx(subject.heading_drift["torso"], rel=1e-3)
    assert "rate_deg_min = -0.7000" in subject_toml(subject)
    assert np.isnan(again.std("left_palm"))


def girdled(rng: np.random.Generator) -> Subject:
    """A person whose lengths and girdles are known jointly."""
    average = population_subject(1.8, "f")
    order = (*LENGTHS, *girdle_rows(TABLE))
    root = rng.normal(scale=0.01, size=(len(order), len(order)))
    girdles = {name: rng.normal(scale=0.01, size=len(PARAMETERS)) for name in TABLE.girdles}
    return replace(average, order=order, covariance=root @ root.T, girdles=girdles).check()


def test_girdles_travel_in_the_file(tmp_path: Path) -> None:
    subject = girdled(np.random.default_rng(2))
    (tmp_path / "subject.toml").write_text(subject_toml(subject), encoding="utf-8")
    again = load_subject(tmp_path)
    again.check_body(TABLE)
    assert again.order == subject.order
    assert set(again.girdles) == set(TABLE.girdles) == {"left_shoulder", "right_shoulder"}
    for name, values in subject.girdles.items():
        np.testing.assert_allclose(again.girdles[name], values, atol=1e-6)
    np.testing.assert_allclose(again.shape_covariance(TABLE), subject.shape_covariance(TABLE), rtol=1e-8)
    assert again.std("girdles.left_shoulder.raised_z") == pytest.approx(subject.std("girdles.left_shoulder.raised_z"))
    body = again.shape(load_model())
    assert body.lengths == pytest.approx(dict(again.lengths))
    for name in TABLE.girdles:
        np.testing.assert_array_equal(body.girdle_parameters(name), again.girdles[name])
    assert not population_subject().shape(load_model()).girdle_parameters("left_shoulder").any()


def test_a_hand_written_file_needs_lengths_only(tmp_path: Path) -> None:
    lines = ["format = 2", "[lengths]", *(f"{name} = 0.3" for name in LENGTHS), "[lengths_std]", "trunk = 0.02"]
    (tmp_path / "subject.toml").write_text("\n".join(lines), encoding="utf-8")
    subject = load_subject(tmp_path)
    assert subject.std("trunk") == pytest.approx(0.02)
    assert subject.mounts == {}


GIRDLE = "law = 0\nrest_x = 0\nrest_y = 0\nrest_z = 0\nraised_x = 0\nraised_y = 0"  # without raised_z


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("format = 1", "as `wepose calibrate` writes one, has format = 2"),
        ("format = 2\n[lengths]\ntrunk = 'long'", "lengths.trunk = 'long'; a number [m] from"),
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
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, says: str) -> None:
    every = "format = 2\n[lengths]\n" + "\n".join(f"{name} = 0.3" for name in LENGTHS)
    (tmp_path / "subject.toml").write_text(text.replace("ALL", every), encoding="utf-8")
    with pytest.raises(WeposeError) as caught:
        load_subject(tmp_path).check_body(TABLE)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


EXTREME: dict[str, dict[str, Any]] = {
    "a start tilt beyond 90 deg": {
        "start_pose_offset": {"torso": StartPoseOffset(np.deg2rad([-118.0, 60.0]), np.deg2rad(170.0))}
    },
    "a drift of tens of degrees a second": {"heading_drift": {"head": HeadingDrift(-1.5, 1.5)}},
    "a hinge that is hardly one": {"hinges": {"left_elbow": Hinge(np.array([0.6, 0.0, -0.8]), 0.999)}},
    "a name that TOML wants escaped": {"name": 'a\x7f\x00\n"\\\u2028é\ud800', "note": "\x7f"},
    "headings that may be anywhere": {
        "order": (*LENGTHS, *(row for s in SEGMENTS for row in mount_rows(s))),
        "covariance": np.full((len(LENGTHS) + 3 * len(SEGMENTS),) * 2, np.pi**2 / 3.0),
    },
}


@pytest.mark.parametrize("case", EXTREME)
def test_what_is_written_can_be_read(case: str, tmp_path: Path) -> None:
    """Whether it is plausible the quality of the calibration says; a subject that cannot be read helps nobody."""
    subject = replace(population_subject(), **EXTREME[case])
    (tmp_path / "subject.toml").write_text(subject_toml(subject), encoding="utf-8")
    again = load_subject(tmp_path)
    assert again.name.replace("?", "") == subject.name.replace("\ud800", "")
    assert again.note == subject.note
    for name, start in subject.start_pose_offset.items():
        np.testing.assert_allclose(again.start_pose_offset[name].tilt, start.tilt, atol=1e-5)
        assert again.start_pose_offset[name].std == pytest.approx(start.std, abs=1e-5)
    for name, drift in subject.heading_drift.items():
        assert again.heading_drift[name].rate == pytest.approx(drift.rate, rel=1e-4)
    np.testing.assert_allclose(again.covariance, subject.covariance, rtol=1e-8, atol=1e-12)
    assert subject_toml(again) == subject_toml(replace(subject, name=again.name))


def test_a_body_without_girdles_has_its_own_shoulders() -> None:
    """As human URDFs of others: a calibrated subject fits them, without what it knows of shoulders."""
    body = load_model()
    bare = replace(body, table=replace(body.table, girdles={}))
    subject = replace(population_subject(), girdles={name: np.ones(7) for name in body.table.girdles})
    subject.check_body(bare.table)
    assert not subject.shape(bare).girdles
    assert set(subject.shape(body).girdles) == set(body.table.girdles)
