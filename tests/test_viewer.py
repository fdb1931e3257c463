"""The page that plays a motion: whole in itself, true to the motion, and what Chromium draws of it."""

import base64
import json
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import BROWSER, Browser

import wepose_pin as wp
from wepose_pin import Simulation

NASTY = "</script><script>alert(1)</script>@@data@@ <b>&"


@pytest.fixture(scope="module")
def result(half_minute: wp.Recording) -> wp.TrackResult:
    time = half_minute.time + 1.7e9  # seconds since 1970: float32 could not tell the samples apart
    phases = half_minute.phases | {NASTY: ((28.0, 29.0),)}
    moved = {name: tuple((a + 1.7e9, b + 1.7e9) for a, b in spans) for name, spans in phases.items()}
    return wp.track(replace(half_minute, name=NASTY, time=time, phases=moved))


@pytest.fixture(scope="module")
def html(result: wp.TrackResult) -> str:
    return result.show(open=False).html


@pytest.fixture(scope="module")
def data(html: str) -> dict[str, Any]:
    return json.loads(re.findall(r'<script id="wepose-data" type="application/json">(.*?)</script>', html)[0])


def floats(text: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype="<f4").reshape(shape)


def test_it_loads_nothing_from_outside_and_text_from_outside_stays_text(
    html: str, data: dict[str, Any], result: wp.TrackResult
) -> None:
    markup = re.sub(r"(<script[^>]*>).*?</script>", r"\1", html, flags=re.DOTALL)
    assert not re.search(r"\s(src|href|action|poster|srcset)=|@import|url\(", markup)
    policy = unescape(re.findall(r'Content-Security-Policy"\s+content="([^"]*)"', html)[0])
    assert "default-src 'none'" in policy
    assert "http" not in policy
    assert len(re.findall("<script", html)) == 3
    for tag in ("title", "h1"):
        assert unescape(re.findall(rf"<{tag}[^>]*>(.*?)</{tag}>", html)[0]) == NASTY
    assert NASTY in [phase["name"] for phase in data["phases"]]
    assert result.show(open=False).html == html


def test_it_holds_the_motion_the_paths_of_the_hands_and_the_angles(
    data: dict[str, Any], result: wp.TrackResult
) -> None:
    """Of samples of the recording, thirty times a second."""
    offsets = floats(data["offsets"], -1)
    frames = np.searchsorted(result.time - result.time[0], offsets - 1e-3)
    np.testing.assert_allclose((result.time - result.time[0])[frames], offsets, atol=1e-5)
    assert (data["begin"], data["end"]) == (result.time[0], result.time[-1])
    assert len(frames) == pytest.approx(30.0 * (result.time[-1] - result.time[0]), rel=0.02)
    moved = floats(data["motion"], len(data["links"]), len(frames), 7)
    for name, quat in result.quat_WL.items():
        drawn = moved[data["links"].index(name), :, :4]
        np.testing.assert_allclose(np.abs(np.sum(drawn * quat[frames], axis=1)), 1.0, atol=1e-6)
    trails = {each["name"]: floats(each["points"], -1, 3) for each in data["trails"]}
    for name in ("left_palm", "right_palm"):
        np.testing.assert_allclose(trails[name], result.points[name][frames], atol=1e-6)
    (angle,) = (each for each in data["angles"] if each["name"] == "right elbow flexion")
    flexion = np.degrees(wp.joint_angles(result)["right_elbow"]["flexion"])[frames]
    np.testing.assert_allclose(floats(angle["values"], -1), flexion, atol=1e-3)


def test_segments_that_are_not_measured_are_not_drawn(half_minute: wp.Recording) -> None:
    arm = replace(half_minute, sensors={name: half_minute.sensors[name] for name in ("torso", "right_upper_arm")})
    html = wp.track(arm).show(open=False).html
    links = json.loads(re.findall(r'id="wepose-data" type="application/json">(.*?)</script>', html)[0])["links"]
    assert "right_upper_arm" in links
    assert not {"left_upper_arm", "right_forearm"} & set(links)


in_browser = pytest.mark.skipif(BROWSER is None, reason="no chromium or google-chrome")


@pytest.fixture(scope="module")
def page(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "view.html"
    path.write_text(wp.track(simulation.recording("page")).show(open=False).html, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    browser = Browser(600, 537)  # of which the window takes 87 for itself
    yield browser
    browser.close()


def open_page(browser: Browser, page: Path, at: str) -> None:
    """At an address such as ``#t=12``, until it has drawn itself."""
    browser.go("about:blank")  # another place in the same page would not load it anew
    browser.go(page.as_uri() + at)
    browser.wait("document.documentElement.dataset.weposeReady === 'true'")


def share(image: np.ndarray, colour: tuple[int, int, int], tolerance: int = 40) -> float:
    return float((np.abs(image - colour).max(axis=2) < tolerance).mean())


@in_browser
def test_it_draws_the_person_and_the_motion(browser: Browser, page: Path, simulation: Simulation) -> None:
    pictures = []
    for time_s in (2.0, simulation.phases["circles"][0][0] + 3.5):
        open_page(browser, page, f"#t={time_s:.1f}")
        pictures.append(browser.picture())
    standing, circling = pictures
    for image in pictures:
        assert share(image, (225, 113, 58)) > 0.005  # the left sleeve
        assert share(image, (40, 125, 180)) > 0.003  # the right one
        assert share(image, (245, 247, 250), 15) > 0.3  # not all of it is person
    above_the_bar = slice(0, 330)
    changed = (np.abs(standing - circling)[above_the_bar].max(axis=2) > 60).mean()
    assert changed > 0.01  # the right arm is elsewhere


@in_browser
def test_it_plays_by_itself_and_stands_still_at_an_address(browser: Browser, page: Path) -> None:
    now = "parseFloat(document.querySelector('#now').textContent)"
    for at, later in (("#t=20&play", 20.1), ("", 0.1)):
        open_page(browser, page, at)
        browser.wait(f"{now} > {later}")
    open_page(browser, page, "#t=20")
    time.sleep(1.0)
    assert browser.run(now) == pytest.approx(20.0, abs=0.03)
    assert browser.errors == []


@in_browser
def test_angles_for_which_there_is_no_room_scroll(browser: Browser, page: Path) -> None:
    open_page(browser, page, "#t=20")
    size = {"width": 1200, "height": 320, "deviceScaleFactor": 1, "mobile": False}
    browser.call("Emulation.setDeviceMetricsOverride", **size)
    angles, stage = (f"document.getElementById('{name}')" for name in ("angles", "stage"))
    assert browser.wait(f"{angles}.scrollHeight > {angles}.clientHeight")
    assert browser.run(f"{angles}.getBoundingClientRect().bottom <= {stage}.getBoundingClientRect().bottom")
    browser.call("Emulation.clearDeviceMetricsOverride")
