"""The calibration's report: what it says, that it opens offline, that it bears what is missing."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from reading import captions, headings, is_self_contained, text_of, without_frame

from wepose_pin.calibration import Calibration, calibrate, load_protocol
from wepose_pin.diagnostics import WARNING, Diagnostic, render
from wepose_pin.recording import Recording
from wepose_pin.report.calibration import render_calibration_report
from wepose_pin.report.words import plus_minus
from wepose_pin.simulation import MILD_PRESET, simulate, simulate_person
from wepose_pin.tracking import TrackResult, track

Made = tuple[Calibration, Recording, TrackResult]
UNCERTAIN = Diagnostic("length-uncertain", WARNING, "left_upper_arm", 0.013, 0.010)


@pytest.fixture(scope="module")
def made() -> Made:
    person = simulate_person(3)
    world = replace(MILD_PRESET, mount="any")
    recording = simulate(person.lengths, seed=3, imperfections=world, clasp_s=30.0, circles=0).recording("anna <3")
    calibration = calibrate(recording, measured=person.measured, prior=person.prior)
    return calibration, recording, track(recording, calibration.subject)


def graded(calibration: Calibration, quality: Literal["poor", "fail"]) -> Calibration:
    return replace(calibration, quality=replace(calibration.quality, quality=quality, reasons=(UNCERTAIN,)))


@pytest.fixture(scope="module")
def page(made: Made) -> str:
    return render_calibration_report(graded(made[0], "poor"), made[1], tracked=made[2])


def test_it_says_what_was_found_and_how_well_it_is_known(made: Made, page: str) -> None:
    calibration = made[0]
    for name, value in calibration.subject.lengths.items():
        assert f"<td>{name.replace('_', ' ')}</td>" in page
        assert plus_minus(1e3 * value, 1e3 * calibration.subject.std(name)) in page
        assert (
            plus_minus(1e3 * calibration.problem.prior.lengths[name], 1e3 * calibration.problem.prior.std(name)) in page
        )
    for name in calibration.subject.mounts:
        assert f"{np.degrees(calibration.subject.std(f'mounts.{name}.z')):.1f}°" in page
    assert f"{1e3 * calibration.prior_rms_gap:.1f} mm before, {1e3 * calibration.rms_gap:.1f} mm after" in text_of(page)
    assert headings(page) == ["Lengths", "Sensors", "Palm to palm over time", "The motion in 3D", "What was run"]


def test_the_quality_comes_first_with_its_reasons(made: Made, page: str) -> None:
    failed = render_calibration_report(graded(made[0], "fail"), made[1], tracked=made[2])
    for text, word, heading in ((page, "poor", "Poor:"), (failed, "fail", "Fail:")):
        text = without_frame(text)
        assert text.index(f'<section class="banner {word}">') < text.index(heading)
        assert text.index(heading) < text.index(render(UNCERTAIN).what) < text.index("<h2") < text.index("<figure")


def test_it_opens_offline_and_is_one_small_file(page: str) -> None:
    assert is_self_contained(page)
    assert 'sandbox="allow-scripts"' in page
    assert len(page) < 3e6
    assert re.search(r"@media print \{.*\.screen.*display: none", page, re.DOTALL)
    assert "anna &lt;3" in page
    assert "anna <3" not in without_frame(page)


def test_every_figure_has_a_caption_and_equal_arguments_give_equal_text(made: Made, page: str) -> None:
    pairs = captions(page)
    assert len(pairs) == 2  # lengths, gap
    assert all(label == caption for label, caption in pairs)
    assert render_calibration_report(graded(made[0], "poor"), made[1], tracked=made[2]) == page


def test_what_is_missing_is_left_out_or_called_so(made: Made) -> None:
    calibration = made[0]
    bare = replace(
        calibration,
        subject=replace(
            calibration.subject, order=(), covariance=np.zeros((0, 0)), start_pose_offset={}, heading_drift={}
        ),
        gap=np.full_like(calibration.gap, np.nan),
        prior_gap=np.full_like(calibration.gap, np.nan),
        problem=replace(calibration.problem, measured={}),
        hinge_rms={},
    )
    page = render_calibration_report(bare, made[1], tracked=made[2])
    assert headings(page) == ["Lengths", "Sensors", "The motion in 3D", "What was run"]
    assert "The uncertainty of the lengths is not known." in page
    assert is_self_contained(page)
    few = replace(
        calibration,
        time=calibration.time[:1],
        gap=calibration.gap[:1],
        prior_gap=calibration.prior_gap[:1],
        contact=calibration.contact[:1],
    )
    assert "Palm to palm over time" not in headings(render_calibration_report(few, made[1], tracked=made[2]))


def test_without_a_mount_it_says_why_there_is_no_motion(made: Made) -> None:
    calibration = replace(made[0], subject=replace(made[0].subject, mounts={}))
    page = render_calibration_report(calibration, made[1])
    assert re.search("The motion cannot be tracked: .*mount is not known", page)
    assert headings(page) == ["Lengths", "Palm to palm over time", "The motion in 3D", "What was run"]


def test_one_hand_at_a_point(made: Made, tmp_path: Path) -> None:
    own = tmp_path / "corner.toml"
    own.write_text('[[closure]]\nphase = "clasp"\nkind = "fixed_point"\npoints = ["left_palm"]\n')
    problem = replace(made[0].problem, protocol=load_protocol(own))
    page = render_calibration_report(replace(made[0], problem=problem), made[1], tracked=made[2])
    assert "Gap of the palms over time" in headings(page)
    assert "Not in the chain, known by the prior's proportions" in text_of(page)
    assert "joined" not in without_frame(page)
