"""The report of a tracked recording: what it says, what it warns of, that it opens offline and stays small."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies import TABLE
from commands import run
from PIL import Image
from reading import BROWSER, browse, captions, headings, is_self_contained, rows, text_of, without_frame
from scipy.spatial.transform import Rotation

from wepose_pin.body.kinematics import Pose
from wepose_pin.body.links import compute_axis_std
from wepose_pin.body.subject import Hinge, population_subject
from wepose_pin.diagnostics import INFO, WARNING, Diagnostic, render
from wepose_pin.recording import OrientationSensor, Recording
from wepose_pin.recording.faults import find_saturation
from wepose_pin.report.figures import COLUMNS, envelope
from wepose_pin.report.track import render_track_report
from wepose_pin.simulation import Simulation, simulate, simulate_person
from wepose_pin.tracking import TrackOptions, TrackResult, summarize, track
from wepose_pin.tracking.measures import measure_headings, measure_hinge, measure_tips
from wepose_pin.writers import write_session

POINTS = ("left_palm", "right_palm")
SECTIONS = [
    "What was recorded",
    "Drift of the headings",
    "The hands",
    "Joint angles",
    "The motion in 3D",
    "What was run",
]


@pytest.fixture(scope="module")
def pose(simulation: Simulation) -> TrackResult:
    return track(simulation.recording("anna <3"))


@pytest.fixture(scope="module")
def page(pose: TrackResult) -> str:
    return render_track_report(summarize(pose))


def changed(recording: Recording, name: str, **signals: np.ndarray) -> Recording:
    return replace(recording, sensors={**recording.sensors, name: replace(recording.sensors[name], **signals)})


def with_pose(tracked: TrackResult, **changes: Any) -> TrackResult:
    """The same with another pose."""
    return replace(tracked, pose=replace(tracked.pose, **changes))


def the(code: str, pose: TrackResult, place: str | None = None) -> Diagnostic:
    """The one diagnostic of that code, at that place."""
    diagnostics = summarize(pose).diagnostics
    matching = [each for each in diagnostics if each.code == code and place in (None, each.place)]
    assert len(matching) == 1, diagnostics
    return matching[0]


# What the page says ---------------------------------------------------------------------------------------------------


def test_it_has_its_sections_and_at_most_five_figures_each_with_a_caption(page: str) -> None:
    assert headings(page) == SECTIONS
    pairs = captions(page)
    assert len(pairs) == 5  # the sensors, headings, paths and reach of the hands, joint angles
    assert all(label == caption for label, caption in pairs)
    assert 'title="The motion in 3D"' in page
    assert "anna &lt;3" in page


def test_it_begins_with_what_can_be_relied_on(page: str, pose: TrackResult) -> None:
    """The usual ± of elbows and hands, and of what is least certain; the worst instant stands in the tables."""
    since = pose.time >= pose.segments.start[1]
    hands = max(float(np.median(compute_axis_std(pose.pose.point_cov[name])[since])) for name in POINTS)
    text = text_of(page)
    found = re.search(
        rf"Good for\s+elbow flexion to ± \d+°.* hands to ± {1e3 * hands:.0f} mm from the middle of the hips", text
    )
    assert found is not None
    least = re.search(r"Least certain: [\w ]+, ± \d+°\.", text)
    assert least is not None
    assert found.end() < least.start() < text.index("No warnings.")


def test_it_gives_the_sensors_and_joints_in_numbers(page: str, pose: TrackResult) -> None:
    table = rows(page)
    for name, sensor in pose.recording.sensors.items():
        cells = [cell for row in table if row[0] == name.replace("_", " ") for cell in row]
        orientation = pose.segments.orientation[name]
        assert f"{np.degrees(np.linalg.norm(sensor.gyro_S, axis=1)).max():.0f} °/s" in cells
        assert f"{100 * orientation.static.mean():.0f} %" in cells
        assert f"{orientation.noise.gravity:.3f} m/s²" in cells
    std = {name: np.degrees(np.sqrt(cov[:, 2, 2])) for name, cov in pose.pose.segment_cov.items()}
    elbow = np.hypot(std["right_upper_arm"], std["right_forearm"])[pose.time >= pose.segments.start[1]]
    assert ["right elbow", f"{np.median(elbow):.1f}°", f"{elbow.max():.1f}°"] in [row[:3] for row in table]


def test_warnings_come_first_each_in_words_and_with_what_to_do(pose: TrackResult) -> None:
    guessed = Diagnostic("start-pose-guessed", WARNING, facts={"start": 0.5, "end": 2.5})
    warned = replace(pose, source=replace(pose.segments, diagnostics=(guessed,)))
    text = without_frame(render_track_report(summarize(warned)))
    assert '<section class="banner poor">' in text
    first = text.index(render(guessed).what)
    assert first < text.index(render(guessed).do) < text.index("<h2") < text.index("<figure")


def test_a_known_person_and_nothing_to_say(pose: TrackResult, page: str) -> None:
    assert "wepose calibrate measures those of the person" in text_of(page)
    quiet = replace(pose, subject=replace(pose.subject, name="anna", note=""))
    assert summarize(quiet).diagnostics == ()
    text = text_of(render_track_report(summarize(quiet)))
    assert "No warnings." in text
    assert "wepose calibrate" not in text


def test_it_opens_offline_and_has_a_dark_side(page: str) -> None:
    assert is_self_contained(page)
    assert "@media screen and (prefers-color-scheme: dark)" in page


def test_equal_arguments_give_equal_text_and_a_ready_view_is_taken(pose: TrackResult, page: str) -> None:
    assert render_track_report(summarize(pose)) == page
    assert 'srcdoc="&lt;p&gt;mine&lt;/p&gt;"' in render_track_report(summarize(pose), view="<p>mine</p>")


# What is missing ------------------------------------------------------------------------------------------------------


def test_without_a_covariance_it_says_so(simulation: Simulation) -> None:
    page = render_track_report(summarize(track(simulation.recording("ncf"), method="ncf")))
    assert headings(page) == SECTIONS
    assert "The filter ncf states no uncertainty" in text_of(page)
    assert "± nan" not in page


def test_ready_orientations_and_one_arm(simulation: Simulation, pose: TrackResult) -> None:
    recording = simulation.recording("ready")
    sensors = {
        name: OrientationSensor(quat_VS=pose.quat_WL[name]) for name in ("torso", "right_upper_arm", "right_forearm")
    }  # orientations of segments
    ready = track(replace(recording, sensors=sensors))
    page = render_track_report(summarize(ready))
    assert headings(page) == SECTIONS
    assert "The device states no uncertainty" in text_of(page)
    assert not any(row[0] == "left palm" for row in rows(page))


def test_a_torso_alone_has_no_hands(simulation: Simulation) -> None:
    recording = simulation.recording("torso")
    alone = track(replace(recording, sensors={"torso": recording.sensors["torso"]}))
    page = render_track_report(summarize(alone))
    assert headings(page) == [name for name in SECTIONS if name != "The hands"]
    head = render_track_report(
        summarize(
            track(replace(recording, sensors={"head": recording.sensors["torso"]}, phases={"start": ((0.5, 4.5),)}))
        )
    )
    assert headings(head) == [name for name in SECTIONS if name not in ("The hands", "Joint angles")]


# What it warns of -----------------------------------------------------------------------------------------------------


def test_motion_beyond_the_range(simulation: Simulation) -> None:
    recording = simulation.recording("range")
    gyro = recording.sensors["right_forearm"].gyro_S
    assert gyro is not None
    clipped = np.clip(gyro, -2.1, 2.1)
    count = np.count_nonzero(find_saturation(clipped, 2.0).any(axis=1))
    assert count > 10
    pose = track(changed(recording, "right_forearm", gyro_S=clipped))
    saturated = the("signal-saturated", pose)
    assert (saturated.severity, saturated.place) == (WARNING, "right_forearm")
    assert saturated.value == pytest.approx(count / 100)
    page = render_track_report(summarize(pose))
    assert any(f"{count / 100:.2f} s" in row for row in rows(page) if row[0] == "right forearm")
    known = Diagnostic("signal-saturated", WARNING, "right_forearm", 0.4, facts={"variant": "gyro", "range": 2.1})
    assert [
        each
        for each in summarize(replace(pose, source=replace(pose.segments, diagnostics=(known,)))).diagnostics
        if each.code == known.code
    ] == [known]  # the reader has said it


def test_gaps(simulation: Simulation) -> None:
    recording = simulation.recording("gaps")
    gap = np.zeros(len(recording), dtype=bool)
    gap[3000:3400] = True
    page = render_track_report(summarize(track(changed(recording, "torso", gap=gap))))
    assert any("4.00 s" in row for row in rows(page) if row[0] == "torso")
    assert "Lines break where samples are lost" in text_of(page)


def test_a_large_bias(simulation: Simulation) -> None:
    recording = simulation.recording("off")
    gyro_S = recording.sensors["torso"].gyro_S + np.deg2rad([2.0, 0.0, 0.0])
    bias = the("gyro-bias-large", track(changed(recording, "torso", gyro_S=gyro_S)))
    assert (bias.place, bias.value) == ("torso", pytest.approx(np.deg2rad(2.0), abs=np.deg2rad(1.0)))


def test_a_person_who_never_rests(pose: TrackResult) -> None:
    restless = {name: of._replace(static=np.zeros_like(of.static)) for name, of in pose.segments.orientation.items()}
    never = replace(pose, source=replace(pose.segments, orientation=restless))
    for method, severity in (("amekf", INFO), ("smekf", WARNING)):
        rare = [
            d
            for d in summarize(replace(never, source=replace(never.segments, options=TrackOptions(method)))).diagnostics
            if d.code == "static-phases-rare"
        ]
        assert [d.place for d in rare] == list(restless)
        assert {d.severity for d in rare} == {severity}


def test_headings_that_may_be_far_off(pose: TrackResult) -> None:
    drifting = {
        name: of._replace(attitude_cov=100.0 * of.attitude_cov) for name, of in pose.segments.orientation.items()
    }
    wide = replace(pose, correction=None, source=replace(pose.segments, orientation=drifting))
    uncertain = [d for d in summarize(wide).diagnostics if d.code == "heading-uncertain"]
    assert {d.place for d in uncertain} == {"left_shoulder", "left_elbow", "right_shoulder", "right_elbow"}
    assert {d.severity for d in uncertain} == {WARNING}
    assert [d.value for d in uncertain] == sorted((d.value for d in uncertain), reverse=True)  # type: ignore[type-var]


def test_headings_that_were_turned_far(pose: TrackResult) -> None:
    assert pose.correction is not None
    far_deg = {"right_forearm": 23.0, "torso": 12.0}
    errors = np.deg2rad([[far_deg.get(name, 0.0) for name in pose.correction.segments]])
    turned = replace(pose, correction=replace(pose.correction, errors=errors))
    corrected = the("heading-corrected-far", turned)  # a forearm's start pose may be off by as much, the torso's not
    assert (corrected.place, corrected.value) == ("torso", pytest.approx(np.deg2rad(12.0)))


def bent(forward_deg: np.ndarray, aside_deg: np.ndarray | float = 0.0) -> dict[str, np.ndarray]:
    """Torso and upper arms upright, the left forearm bent in the plane of its elbow and out of it."""
    n = len(forward_deg)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    aside = np.broadcast_to(aside_deg, n)
    fore = Rotation.from_euler("ZY", np.column_stack([aside, -forward_deg]), degrees=True)
    return {"torso": still, "left_upper_arm": still, "left_forearm": fore.as_quat(canonical=True)}


def with_elbow(pose: TrackResult, forward_deg: np.ndarray, aside_deg: np.ndarray | float = 0.0) -> TrackResult:
    quat_WL = {**pose.quat_WL, **bent(forward_deg, aside_deg)}
    return with_pose(pose, quat_WL=quat_WL)


def test_elbows_that_cannot_be(pose: TrackResult) -> None:
    n = len(pose.time)
    usual = {each.code for each in summarize(with_elbow(pose, np.linspace(-10.0, 140.0, n))).diagnostics}
    assert not any(code.startswith("hinge-") for code in usual)
    back = the("hinge-implausible", with_elbow(pose, np.full(n, -30.0)))
    assert (back.severity, back.place, back.value) == (WARNING, "left_elbow", pytest.approx(np.deg2rad(30.0)))
    turned = the("hinge-implausible", with_elbow(pose, np.full(n, 90.0), 40.0))
    assert turned.value == pytest.approx(np.deg2rad(40.0))


def test_a_late_start_pose(pose: TrackResult) -> None:
    late = replace(pose, source=replace(pose.segments, start=(40.0, 44.0)))
    assert the("start-pose-late", late).value == pytest.approx(40.0)


# Its sums -------------------------------------------------------------------------------------------------------------


def test_an_elbow_in_closed_form() -> None:
    forward = np.linspace(-40.0, 150.0, 39)
    pose = Pose(np.arange(39.0), bent(forward), {})
    elbow = measure_hinge(pose, TABLE, "left_elbow")
    assert elbow is not None
    assert measure_hinge(pose, TABLE, "right_elbow") is None
    np.testing.assert_allclose(np.degrees(elbow.flexion), forward, atol=1e-9)
    np.testing.assert_allclose(np.degrees(elbow.bend), np.abs(forward), atol=1e-6)
    np.testing.assert_allclose(elbow.aside, 0.0, atol=1e-12)
    # The same elbow about an axis that is turned with it.
    turn = Rotation.from_euler("z", 25.0, degrees=True)
    fore = (turn * Rotation.from_quat(pose.quat_WL["left_forearm"])).as_quat()
    subject = replace(population_subject(), hinges={"left_elbow": Hinge(turn.apply([0.0, 1.0, 0.0]), 0.05)})
    again = measure_hinge(replace(pose, quat_WL={**pose.quat_WL, "left_forearm": fore}), TABLE, "left_elbow", subject)
    assert again is not None
    np.testing.assert_allclose(np.degrees(again.flexion), forward, atol=1e-9)
    np.testing.assert_allclose(again.aside, 0.0, atol=1e-12)


def test_heading_stds_are_those_of_the_covariance(pose: TrackResult) -> None:
    for name, stated in measure_headings(replace(pose, correction=None)).items():
        of = pose.segments.orientation[name]
        assert of.attitude_cov is not None
        R = Rotation.from_quat(of.quat_VS).as_matrix()
        cov = R @ of.attitude_cov @ R.swapaxes(1, 2)
        std = np.sqrt(cov[:, 2, 2])
        np.testing.assert_allclose(stated.drift, std, rtol=1e-6)
        np.testing.assert_allclose(stated.std, np.sqrt(pose.pose.segment_cov[name][:, 2, 2]), rtol=1e-12)
        held = measure_headings(pose)[name].drift  # by the other sensors
        assert np.all(held <= stated.drift)


def test_hands_are_seen_from_the_torso(pose: TrackResult) -> None:
    turn = Rotation.from_euler("zyx", [70.0, 10.0, -20.0], degrees=True)
    turned = Pose(
        pose.time,
        {"torso": (turn * Rotation.from_quat(pose.quat_WL["torso"])).as_quat()},
        {name: turn.apply(p) + 1.0 for name, p in pose.points.items()},
    )
    as_was, now = (measure_tips(of, pose.recording.rate_hz, TABLE) for of in (pose.pose, turned))
    for name in ("left_palm", "right_palm"):
        np.testing.assert_allclose(now[name].reach, as_was[name].reach, atol=1e-9)
        assert now[name].std is None
        assert now[name].peak_speed == pytest.approx(as_was[name].peak_speed)
    start = as_was["left_palm"].reach[100]
    assert start[1] > 0.1  # the left hand hangs at the left
    assert start[2] < -0.4


def test_an_envelope_keeps_the_extremes_and_the_holes() -> None:
    rng = np.random.default_rng(2)
    time, values = np.arange(100_000.0), rng.normal(size=100_000)
    values[40_000:50_000] = np.nan
    values[77_777] = 50.0
    at, drawn = envelope(time, values)
    assert COLUMNS < len(at) == len(drawn) <= 2 * COLUMNS
    assert np.nanmax(drawn) == 50.0
    assert np.nanmin(drawn) == np.nanmin(values)
    inside = (at > 40_300) & (at < 49_700)
    assert np.isnan(drawn[inside]).all()
    assert np.isfinite(drawn[~((at > 39_700) & (at < 50_300))]).all()
    assert envelope(time[:10], values[:10])[1] is not None
    np.testing.assert_array_equal(envelope(time[:10], values[:10])[1], values[:10])


# The command and the browser ------------------------------------------------------------------------------------------


def test_track_writes_it_unless_told_not_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = simulate(simulate_person(3).lengths, seed=3, clasp_s=5.0, circles=0)
    write_session(tmp_path, made.recording("short"))
    for folder, options in (("with", []), ("without", ["--no-report"])):
        assert run("track", tmp_path, "-o", tmp_path / folder, *options) == 0
        captured = capsys.readouterr()
        assert ("report.html" in captured.out) == (not options)
        assert (tmp_path / folder / "report.html").exists() == (not options)
        assert (tmp_path / folder / "view.html").exists()
        saved = json.loads((tmp_path / folder / "summary.json").read_text(encoding="utf-8"))["diagnostics"]
        assert saved == []  # of a good recording
        assert "lengths: population prior" in captured.out
    assert "Motion of short" in (tmp_path / "with" / "report.html").read_text(encoding="utf-8")


@pytest.mark.skipif(BROWSER is None, reason="no chromium or google-chrome")
def test_in_a_browser_it_has_its_sections_light_and_dark(page: str, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(page, encoding="utf-8")
    assert headings(browse(file, "--dump-dom")) == SECTIONS
    corner = {}
    for scheme, number in (("dark", 0), ("light", 1)):
        picture = tmp_path / f"{scheme}.png"
        browse(file, f"--blink-settings=preferredColorScheme={number}", f"--screenshot={picture}")
        corner[scheme] = np.asarray(Image.open(picture).convert("L"))[5, 5]
    assert corner["dark"] < 60
    assert corner["light"] > 250


def test_what_comes_before_the_start_pose_is_not_in_the_figures_and_said(pose: TrackResult) -> None:
    """A peak before the start pose: it was the largest ± of the page, beside "No warnings"."""
    begin = float(pose.time[0]) + 5.0
    before = pose.time < begin

    def wider(cov: np.ndarray, factor: float) -> np.ndarray:
        return np.where(before[:, None, None], factor**2 * cov, cov)

    late = replace(pose, source=replace(pose.segments, start=(begin, begin + 2.0)))
    peak = with_pose(late, point_cov={name: wider(cov, 60.0) for name, cov in late.pose.point_cov.items()})
    assert rows_of_hands(render_track_report(summarize(peak), view="<p>")) == rows_of_hands(
        render_track_report(summarize(late), view="<p>")
    )
    text = text_of(render_track_report(summarize(peak), view="<p>"))
    assert "the 7 s before its end are left out" in text


def rows_of_hands(page: str) -> list[list[str]]:
    found = [row for row in rows(page) if row[0] in ("left palm", "right palm") and row[-1].endswith("mm")]
    assert len(found) == 2
    return found
