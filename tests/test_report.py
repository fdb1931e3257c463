"""The calibration's report: what it says, that it opens offline, that it bears what is missing."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run
from reading import captions, headings, is_self_contained, rows, text_of, without_frame

import wepose_pin as wp
from wepose_pin import MILD_PRESET, simulate_person
from wepose_pin.writers import write_session

SECTIONS = ["Lengths", "Sensors", "Palm to palm over time"]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sensors in any rotation; joined hands for thirty seconds."""
    world, folder = replace(MILD_PRESET, mount="any"), tmp_path_factory.mktemp("session")
    lengths = simulate_person(3).lengths
    made = wp.simulate(lengths, seed=3, imperfections=world, clasp_s=30.0, circles=0, rate_hz=50.0)
    write_session(folder, made.recording("anna <3"))
    return folder


def calibrate(session: Path, out: Path, *options: str) -> tuple[int, str, wp.Subject]:
    """The exit code, the page and the subject."""
    code = run("calibrate", session, "-o", out, *options)
    return code, (out / "report.html").read_text(encoding="utf-8"), wp.load_subject(out)


def test_it_says_how_well_lengths_and_mounts_are_known(session: Path, tmp_path: Path) -> None:
    code, page, subject = calibrate(session, tmp_path / "a", "--measured", "biacromial=0.41")
    assert headings(page) == SECTIONS
    table = [[re.sub("<.*?>", "", cell) for cell in row] for row in rows(page)]
    for name, value in subject.lengths.items():
        known = f"{1e3 * value:.1f} ± {1e3 * subject.std(name):.1f}"
        assert [name.replace("_", " "), known] in [row[:2] for row in table]
    for name in subject.mounts:
        assert f"{np.degrees(subject.std(f'mounts.{name}.z')):.1f}°" in page
    assert re.search(r"samples used: \d+\.\d mm", text_of(page))
    banner = re.findall(r'<section class="banner (\w+)">', page)
    assert banner == [{0: "pass", 3: "poor", 4: "fail"}[code]]

    assert is_self_contained(page)
    assert len(page) < 1e6
    assert "anna &lt;3" in page
    assert "anna <3" not in without_frame(page)
    [(label, caption)] = captions(page)  # of the gap
    assert label == caption


def test_the_quality_comes_first_with_its_reasons(session: Path, tmp_path: Path) -> None:
    """Without a measured length the scale is not known."""
    code, page, _ = calibrate(session, tmp_path / "a")
    assert code == 3
    own = without_frame(page)
    reasons = [line for line in (tmp_path / "a" / "calibration.json").read_text().splitlines() if '"what"' in line]
    what = re.findall(r'"what": "(.*)"', reasons[0])[0]
    assert own.index('<section class="banner poor">') < own.index("Poor:") < own.index("<h2") < own.index("<figure")
    assert text_of(page).index("Poor:") < text_of(page).index(what[:40])


def test_free_motion_has_no_gap(session: Path, tmp_path: Path) -> None:
    _, page, _ = calibrate(session, tmp_path / "a", "--protocol", "free")
    assert headings(page) == [name for name in SECTIONS if name != "Palm to palm over time"]
    assert is_self_contained(page)


def test_one_hand_at_a_point(session: Path, tmp_path: Path) -> None:
    own = tmp_path / "corner.toml"
    own.write_text('[[closure]]\nphase = "clasp"\nkind = "fixed_point"\npoints = ["left_palm"]\n')
    _, page, _ = calibrate(session, tmp_path / "a", "--protocol", str(own))
    assert "Gap of the palms over time" in headings(page)
    assert "Not in the chain, known by the prior's proportions" in text_of(page)
