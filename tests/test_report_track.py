"""The report of a tracked recording: what it says, what it warns of, that it opens offline and stays small."""

import json
import re
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from browser import BROWSER, Browser
from commands import run
from reading import captions, headings, is_self_contained, rows, text_of, without_frame
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin.report.pages import write_track_pages
from wepose_pin.tracking import summarize
from wepose_pin.writers import write_session

SECTIONS = ["What was recorded", "Drift of the headings", "The hands", "Joint angles", "The motion in 3D"]


def report(result: wp.TrackResult) -> str:
    """The page, without the motion in 3D."""
    with TemporaryDirectory() as folder:
        write_track_pages(Path(folder), summarize(result), view=False)
        return without_frame((Path(folder) / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def recording(half_minute: wp.Recording) -> wp.Recording:
    return replace(half_minute, name="anna <3")


@pytest.fixture(scope="module")
def result(recording: wp.Recording) -> wp.TrackResult:
    return wp.track(recording)


@pytest.fixture(scope="module")
def page(result: wp.TrackResult, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = result.save(tmp_path_factory.mktemp("report") / "result")
    return (folder / "report.html").read_text(encoding="utf-8")


def changed(recording: wp.Recording, name: str, **signals: np.ndarray) -> wp.Recording:
    return replace(recording, sensors={**recording.sensors, name: replace(recording.sensors[name], **signals)})


def only(recording: wp.Recording, *names: str) -> wp.Recording:
    return replace(recording, sensors={name: recording.sensors[name] for name in names})


def the(code: str, result: wp.TrackResult) -> wp.Diagnostic:
    (one,) = (each for each in result.diagnostics if each.code == code)
    return one


def test_it_opens_offline_with_its_sections_and_five_figures_each_with_a_caption(page: str) -> None:
    assert headings(page) == SECTIONS
    pairs = captions(page)
    assert len(pairs) == 5  # the sensors, headings, paths and reach of the hands, joint angles
    assert all(label == caption for label, caption in pairs)
    assert 'title="The motion in 3D"' in page
    assert 'sandbox="allow-scripts"' in page
    assert re.search(r"@media print \{.*\.screen.*display: none", page, re.DOTALL)
    assert "anna &lt;3" in page
    assert is_self_contained(page)
    assert "@media screen and (prefers-color-scheme: dark)" in page


def test_it_says_that_the_calibration_failed(result: wp.TrackResult) -> None:
    failed = replace(result, subject=replace(result.subject, quality="fail"))
    assert "; quality of the calibration: fail." in text_of(report(failed))


def test_it_begins_with_what_can_be_relied_on(page: str, result: wp.TrackResult) -> None:
    """The usual ± of elbows and hands, and of what is least certain; the worst instant stands in the tables."""
    text = text_of(page)
    good = re.search(r"Good for\s+elbow flexion to ± \d+°.* hands to ± (\d+) mm from the middle of the hips", text)
    least = re.search(r"Least certain: [\w ]+, ± \d+°\.", text)
    assert good is not None
    assert least is not None
    assert good.end() < least.start() < text.index("No warnings.")
    since = result.time >= result.phases["start"][0][1]
    variances = [
        result.pose.point_cov[f"{side}_palm"][since].trace(axis1=1, axis2=2) / 3.0 for side in ("left", "right")
    ]
    assert int(good[1]) == round(1e3 * max(np.median(np.sqrt(each)) for each in variances))


def test_it_gives_the_sensors_and_joints_in_numbers(page: str, result: wp.TrackResult) -> None:
    for name, sensor in result.recording.imus.items():
        cells = [cell for row in rows(page) if row[0] == name.replace("_", " ") for cell in row]
        assert f"{np.degrees(np.linalg.norm(sensor.gyro_S, axis=1)).max():.0f} °/s" in cells
        assert any(re.fullmatch(r"9\.\d{3} m/s²", cell) for cell in cells)
    std = {name: np.degrees(np.sqrt(cov[:, 2, 2])) for name, cov in result.pose.segment_cov.items()}
    elbow = np.hypot(std["right_upper_arm"], std["right_forearm"])[result.time >= result.phases["start"][0][1]]
    assert ["right elbow", f"{np.median(elbow):.1f}°", f"{elbow.max():.1f}°"] in [row[:3] for row in rows(page)]


def test_a_known_person_and_nothing_to_say(result: wp.TrackResult, page: str) -> None:
    assert "wepose calibrate measures the lengths of the person" in text_of(page)
    text = text_of(report(replace(result, subject=replace(result.subject, name="anna", note=""))))
    assert "No warnings." in text
    assert "wepose calibrate" not in text


def test_without_a_covariance_it_says_so(recording: wp.Recording) -> None:
    page = report(wp.track(recording, method="ncf"))
    assert headings(page) == SECTIONS
    assert "The filter ncf states no uncertainty" in text_of(page)
    assert "± nan" not in page


def test_measured_orientations_and_one_arm(recording: wp.Recording, result: wp.TrackResult) -> None:
    names = ("torso", "right_upper_arm", "right_forearm")
    sensors = {name: wp.OrientationSensor(quat_VS=result.quat_WL[name]) for name in names}  # those of segments
    page = report(wp.track(replace(recording, sensors=sensors)))
    assert headings(page) == SECTIONS
    assert text_of(page).count("The device states no uncertainty: each ± assumes") == 2  # beside "Good for", and drift
    assert not any(row[0] == "left palm" for row in rows(page))


@pytest.mark.parametrize(("name", "missing"), [("torso", {"The hands"}), ("head", {"The hands", "Joint angles"})])
def test_one_sensor_has_no_hands(recording: wp.Recording, name: str, missing: set[str]) -> None:
    alone = replace(recording, sensors={name: recording.sensors["torso"]}, phases={"start": ((0.5, 4.5),)})
    assert headings(report(wp.track(alone))) == [each for each in SECTIONS if each not in missing]


def test_warnings_come_first_each_in_words_and_with_what_to_do(recording: wp.Recording) -> None:
    """The forearm's gyroscope was cut off by its range, and nobody said when the start pose was."""
    gyro_S = np.clip(recording.imus["right_forearm"].gyro_S, -2.1, 2.1)
    result = wp.track(replace(changed(recording, "right_forearm", gyro_S=gyro_S), phases={}))
    saturated = the("signal-saturated", result)
    assert saturated.place == "right_forearm"
    assert saturated.value == pytest.approx(0.01 * (np.abs(gyro_S) >= 2.1).any(axis=1).sum(), rel=0.1)
    page = report(result)
    assert any(f"{saturated.value:.2f} s" in row for row in rows(page) if row[0] == "right forearm")
    assert '<section class="banner poor">' in page
    assert {"signal-saturated", "start-pose-guessed"} <= {each.code for each in result.diagnostics}
    for each in result.diagnostics:
        what, _, do = str(each).partition(": ")[2].partition(". ")
        assert text_of(page).index(what) < text_of(page).index("What was recorded", 200)
        assert do.split(". ")[-1].rstrip(".") in text_of(page)


def test_gaps(recording: wp.Recording) -> None:
    gap = (recording.time > 15.0) & (recording.time <= 19.0)
    page = report(wp.track(changed(recording, "torso", gap=gap)))
    assert any("4.00 s" in row for row in rows(page) if row[0] == "torso")
    assert "Lines break where samples are lost" in text_of(page)
    assert re.search(r"Good for [^.]* while no sensor is lost \(one is for 1\d% of the time\)\.", text_of(page))


def test_a_large_bias(recording: wp.Recording) -> None:
    gyro_S = recording.imus["torso"].gyro_S + np.deg2rad([4.0, 0.0, 0.0])
    bias = the("gyro-bias-large", wp.track(changed(recording, "torso", gyro_S=gyro_S)))
    assert (bias.place, bias.value) == ("torso", pytest.approx(np.deg2rad(4.0), abs=np.deg2rad(1.0)))


def elbow(forward_deg: float, aside_deg: float = 0.0, start: tuple[float, float] = (0.5, 4.5)) -> wp.TrackResult:
    """After the start pose, the N-pose, a left forearm bends in the plane of its elbow and out of it; half a minute."""
    time = np.arange(3000) / 100.0
    bent = np.clip(time - start[1], 0.0, 1.0)
    fore = Rotation.from_euler("ZY", np.column_stack([aside_deg * bent, -forward_deg * bent]), degrees=True)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    quat = {"torso": still, "left_upper_arm": still, "left_forearm": fore.as_quat()}
    return wp.track(wp.Recording.from_arrays(100.0, phases={"start": (start,)}, **quat))


def test_a_late_start_pose_and_what_came_before_it() -> None:
    """What comes before the start pose is in no figure, and the page says so."""
    late = elbow(90.0, start=(20.0, 24.0))
    assert the("start-pose-late", late).value == pytest.approx(20.0)
    assert "after the start pose, so the first 24 s are left out" in text_of(report(late))


@pytest.mark.parametrize(("forward_deg", "aside_deg", "is_bad"), [(140.0, 0.0, 0), (-30.0, 0.0, 1), (90.0, 80.0, 1)])
def test_elbows_that_cannot_be(forward_deg: float, aside_deg: float, is_bad: int) -> None:
    """Backwards, and out of the plane."""
    result = elbow(forward_deg, aside_deg)
    hinges = [each for each in result.diagnostics if each.code.startswith("hinge-")]
    assert ("No ± holds" in text_of(report(result))) == is_bad
    assert [(each.code, each.place) for each in hinges] == [("hinge-implausible", "left_elbow")] * is_bad
    assert all(np.degrees(each.value or 0.0) > 29.0 for each in hinges)


def test_track_writes_it_unless_told_not_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lengths: Any = wp.population_subject(1.75).lengths
    write_session(tmp_path, wp.simulate(lengths, seed=3, clasp_s=5.0, circles=0).recording("short"))
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
    browser, corner = Browser(600, 450), {}
    try:
        browser.go(file.as_uri())
        browser.wait("document.querySelector('h2') && document.readyState === 'complete'")
        assert headings(browser.run("document.documentElement.outerHTML")) == SECTIONS
        for scheme in ("dark", "light"):
            browser.emulate(prefers_color_scheme=scheme)
            corner[scheme] = browser.picture()[5, 5]
    finally:
        browser.close()
    assert corner["dark"].max() < 60
    assert corner["light"].min() > 250
