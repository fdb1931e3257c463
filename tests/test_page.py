"""`view.html` of a tracked recording in headless Chromium: it draws the person, and it plays."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from reading import BROWSER, browse

from wepose_pin.report.viewer import pose_html
from wepose_pin.simulation import Simulation
from wepose_pin.tracking import track

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium or google-chrome")


@pytest.fixture(scope="module")
def page(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording = simulation.recording("page")
    pose = track(recording)
    path = tmp_path_factory.mktemp("page") / "view.html"
    path.write_text(pose_html(pose.model, pose.pose, phases=recording.phases, title="page"), encoding="utf-8")
    return path


def picture(page: Path, at: str) -> np.ndarray:
    file = page.with_name(f"{re.sub(r'[^0-9]', '', at)}.png")
    browse(page, f"--screenshot={file}", at=at)
    return np.asarray(Image.open(file).convert("RGB")).astype(int)


def share(image: np.ndarray, colour: tuple[int, int, int], tolerance: int = 40) -> float:
    return float((np.abs(image - colour).max(axis=2) < tolerance).mean())


def test_it_draws_the_person_and_the_motion(page: Path, simulation: Simulation) -> None:
    standing, circling = picture(page, "#t=2"), picture(page, f"#t={simulation.phases['circles'][0][0] + 3.5:.1f}")
    for image in (standing, circling):
        assert share(image, (225, 113, 58)) > 0.005  # the left sleeve
        assert share(image, (40, 125, 180)) > 0.003  # the right one
        assert share(image, (245, 247, 250), 15) > 0.3  # not all of it is person
    above_the_bar = slice(0, 330)
    changed = (np.abs(standing - circling)[above_the_bar].max(axis=2) > 60).mean()
    assert changed > 0.01  # the right arm is elsewhere


def test_it_plays_by_itself_and_stands_still_at_an_address(page: Path) -> None:
    def now(at: str, milliseconds: int) -> float:
        dump = browse(page, "--dump-dom", at=at, milliseconds=milliseconds)
        assert 'data-wepose-ready="true"' in dump
        match = re.search(r'id="now"[^>]*>\s*([0-9.]+)', dump)
        assert match is not None
        return float(match[1])

    assert now("#t=20", 4000) == pytest.approx(20.0, abs=0.03)
    assert now("#t=20&play", 6000) > 20.1
    assert now("", 6000) > 0.1
