"""The pages of a validation run, from small documents made by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from wepose_pin.cli import main
from wepose_pin.errors import BadData, MissingFile
from wepose_pin.validation import Document, Result, document_text, read_document, summary
from wepose_pin.validation.document import as_document
from wepose_pin.validation.figures import pictures
from wepose_pin.validation.findings import (
    at_a_glance,
    beaten,
    order,
    target_line,
    targets,
    waterfall,
    waterfall_lines,
    worse,
)
from wepose_pin.validation.page import as_html, experiment_table, how_many, markdown, page, table_note
from wepose_pin.validation.words import world_text

TIME = np.linspace(0.0, 10.0, 61)


def curve(scale: float) -> list[float]:
    return [float(value) for value in scale * (1.1 + np.sin(TIME))]


def dynamic(method: str, roll: float, pitch: float, yaw: float, trial: int = 0) -> Result:
    figures = {"roll": [roll, 0.5], "pitch": [pitch, 0.5], "yaw": [yaw, 0.5], "total_rmse": 2.0}
    series = {} if trial else {"time": TIME.tolist(), "total_deg": curve(pitch)}
    return Result("dynamic 100 Hz", str(trial), method, figures, series)


def hand(experiment: str, method: str, root: float, shoulders: float, trial: int = 0) -> Result:
    figures = {
        key: {"mean": value, "std": 2.0, "rmse": value + 1.0, "worst": 3 * value}
        for key, value in (("hand_mm", root), ("hand_from_shoulders_mm", shoulders))
    }
    true = {f"true_{axis}_mm": curve(100.0 + k) for k, axis in enumerate("xyz")}
    paths = {f"{axis}_mm": curve(102.0 + k) for k, axis in enumerate("xyz")}
    series = {"time": TIME.tolist(), "error_mm": curve(root), **paths, **true}
    return Result(experiment, str(trial), method, figures, {} if trial else series)


def board(method: str, trial: str, inclination: float | None) -> Result:
    figures = {"inclination_rmse": inclination, "heading_rmse": 4.0, "total_rmse": 4.5}
    return Result("BROAD", trial, method, figures)


DYNAMIC = [
    dynamic(method, *errors, trial)
    for trial in (0, 1)
    for method, errors in {"smekf": (1.0, 1.52, 1.3), "ncf": (2.0, 1.2, 2.4), "gdc": (1.5, 1.6, 2.0)}.items()
]
REALISTIC, ALONE = "upper body, realistic", "upper body, MTi-3 noise alone"
WATERFALL = "error budget"
RESULTS = [
    *DYNAMIC,
    *(hand(REALISTIC, m, *e) for m, e in {"smekf": (18.04, 17.0), "ncf": (25.0, 24.0), "gdc": (24.0, 23.0)}.items()),
    hand(ALONE, "smekf", 12.0, 13.0),
    *(
        hand(WATERFALL, m, e, e, 1)
        for m, e in {"all on": 12.0, "soft tissue off": 4.0, "mounts as stated": 19.0}.items()
    ),
    *(board(m, t, 1.0) for m in ("smekf", "vqf", "a new one") for t in ("01_slow", "02_fast")),
    Result(
        "never heard of", "x", "somebody", {"depth_mm": 3.0, "count": 4, "odd": None, "why": "text", "pair": [1, 2]}
    ),
    Result("never heard of", "x", "else", {"depth_mm": float("nan"), "list": [1, 2, 3]}),
]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "validation.json"
    path.write_text(document_text(RESULTS, True, {"wepose-pin": "0.0"}), encoding="utf-8")
    return path


@pytest.fixture
def document(file: Path) -> Document:
    return read_document(file)


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(stop.value.code or 0)


def test_the_file_comes_back_as_it_was(document: Document, file: Path) -> None:
    assert [result[:3] for result in document.results] == [result[:3] for result in RESULTS]
    assert document.quick
    assert document.results[-1].figures["depth_mm"] is None
    assert document.worlds["realistic"]["imperfections"]["soft_tissue_deg"] == 1.5
    assert document.worlds["MTi-3 noise alone"]["imperfections"]["gyro_range_deg_s"] is None
    assert len(file.read_text(encoding="utf-8").split('"results": [\n')[1].splitlines()) == len(RESULTS) + 2


def test_means_and_both_kinds_of_deviation() -> None:
    rows = summary([dynamic("smekf", 1.0, 1.0, 1.0, 0), dynamic("smekf", 3.0, 1.0, 1.0, 1)])
    assert rows[0].figures["roll"] == 2.0
    assert rows[0].figures["roll std"] == 0.5
    assert rows[0].figures["roll between"] == pytest.approx(np.sqrt(2.0))
    assert rows[0].names() == ["roll", "pitch", "yaw"]
    header, (line,) = experiment_table(rows, whole=True)
    assert header[:2] == ["filter", "roll [deg]"]
    assert line[:2] == ["smekf", "2.00 ± 0.50 (1.41)"]
    assert line[header.index("paper: pitch")] == "1.46 ± 1.71"
    assert "between the trials" in table_note(rows)


def test_the_papers_order_and_what_is_worse() -> None:
    rows = summary(DYNAMIC)
    said = order(rows)
    assert said[0] == "The paper's order of the filters, smekf before gdc before ncf, comes back in roll and yaw."
    assert "In pitch" in said[1]
    assert "ncf 1.20°, smekf 1.52°, gdc 1.60°" in said[1]
    assert worse(rows) == ["Worse than the paper: smekf pitch 1.52° against 1.46°; gdc roll 1.50° against 1.38°."]
    better = beaten(rows, DYNAMIC)
    assert better[0] == "Better than smekf in pitch (1.52°): ncf 1.20° (in 2 of 2 trials)."
    assert "only while the sensor rests" in better[1]
    glance = at_a_glance(rows, DYNAMIC)
    assert glance == ["roll, yaw", "pitch", "smekf: pitch; gdc: roll", "ncf: pitch"]
    best = summary([dynamic("smekf", 0.1, 0.1, 0.1), dynamic("ncf", 0.3, 0.3, 0.3)])
    assert worse(best) == ["No figure is worse than the paper's."]
    assert beaten(best, DYNAMIC) == ["No other filter has a smaller error than smekf here."]


def test_a_glance_tells_a_larger_mean_from_a_larger_deviation() -> None:
    wide = dynamic("smekf", 0.1, 0.1, 0.1)._replace(
        figures={name: {"mean": 0.1, "std": std} for name, std in (("roll", 9.0), ("pitch", 0.1), ("yaw", 0.1))}
    )
    cells = at_a_glance(summary([wide]), [wide])
    assert cells is not None
    assert cells[2] == "smekf: roll (± only)"


def test_small_gains_are_not_rounded_away() -> None:
    rows = summary([Result("gains", "BROAD", "gdc, BROAD", {"gain": 0.000562, "integral": 0.0, "total_rmse_deg": 1.0})])
    assert experiment_table(rows, whole=True).rows == [["gdc, BROAD", "0.000562", "0", "1.00"]]
    assert how_many("gains", 7) == "7 kinds of motion"
    assert how_many("drift", 1) == "1 trial"


def test_what_is_won_without_correcting_is_not_said_to_be_won_by_it() -> None:
    gains = {"simulated 100 Hz": {"ncf": {"proportional": 0.0, "integral": 0.0}}}
    said = " ".join(beaten(summary(DYNAMIC), DYNAMIC, gains))
    assert "left ncf no correction" in said
    assert "only while the sensor rests" not in said


def test_a_difference_within_the_scatter_is_called_so() -> None:
    pitches = [(1.0, 0.4), (1.0, 1.5), (1.0, 0.9)]
    results = [
        dynamic(method, 1.0, pitch, 1.0, trial)
        for trial, pair in enumerate(pitches)
        for method, pitch in zip(("smekf", "gdc"), pair, strict=True)
    ]
    said = beaten(summary(results), results)
    assert said == [
        "Better than smekf in pitch (1.00°), but within the scatter between the trials: gdc 0.93° (in 2 of 3 trials)."
    ]


def test_targets_are_met_or_missed() -> None:
    found = {(t.experiment, t.counted): t for t in targets(summary(RESULTS))}
    assert len(found) == 4
    assert not found[REALISTIC, "from the root"].met
    assert "18.04 mm" in target_line(found[REALISTIC, "from the root"])
    assert found[REALISTIC, "from the middle of the shoulders"].met
    assert found[ALONE, "from the root"].met
    assert "13.0 mm, at most 12 mm wanted: missed." in target_line(found[ALONE, "from the middle of the shoulders"])
    assert targets(summary(DYNAMIC)) == []


def test_the_waterfall_adds_in_quadrature() -> None:
    found = waterfall(RESULTS)
    assert found is not None
    assert found.full["hand"] == 13.0
    assert [part.name for part in found.parts] == ["soft tissue"]
    assert found.parts[0].added["hand"] == pytest.approx(12.0)  # √(13² − 5²)
    assert found.more[0].added["hand"] == pytest.approx(np.sqrt(20.0**2 - 13.0**2))
    assert "12.0 mm (soft tissue)" in waterfall_lines(found)[0]
    assert waterfall(DYNAMIC) is None


def test_figures_are_made(document: Document) -> None:
    made = {picture.stem: picture for _, picture in pictures(document)}
    assert set(made) == {
        "dynamic-100-hz-bars",
        "dynamic-100-hz-over-time",
        "upper-body-realistic-bars",
        "upper-body-realistic-over-time",
        "upper-body-realistic-path",
        "upper-body-mti-3-noise-alone-bars",
        "upper-body-mti-3-noise-alone-over-time",
        "upper-body-mti-3-noise-alone-path",
        "where-the-millimetres-come-from-waterfall",
        "broad-trials",
    }
    for picture in made.values():
        assert picture.png.startswith(b"\x89PNG")


def test_the_page_says_what_it_must(document: Document) -> None:
    blocks = page(document)
    text = markdown(blocks)
    for words in (
        "Worse than the paper: smekf pitch 1.52° against 1.46°",
        "**missed**",
        "**met**",
        "A quick run",
        "wepose validate --from validation.json",
        "soft tissue 1.5° rms",
        "Never heard of",
        "| somebody | 3.00 | 4.00 | 1.00 ± 2.00 |",
        "validation/dynamic-100-hz-bars.png",
        "wepose-pin 0.0",
    ):
        assert words in text, words
    assert markdown(page(document)) == text
    whole = as_html(blocks)
    assert whole.count("data:image/png;base64,") == len(list(pictures(document)))
    assert 'src="http' not in whole
    assert "A quick run" not in markdown(page(document._replace(quick=False)))


def test_which_imperfections_were_on(document: Document) -> None:
    (alone,) = world_text("dynamic 1 kHz", document.worlds)
    assert alone == "Imperfections on: the sensors' noise and bias and no other."
    (realistic,) = world_text(REALISTIC, document.worlds)
    assert "palms that slip in the clasp 8 mm rms" in realistic
    assert "gyroscope range 2000°/s" in realistic
    assert world_text("BROAD", document.worlds) == []


def test_pages_anew_from_a_file(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "docs"
    assert run("validate", "--from", file, "-o", out) == 0
    said = capsys.readouterr().out
    assert "dynamic 100 Hz, 2 trials [deg], a quick run" in said
    assert "Worse than the paper" in said
    assert all(len(line) <= 110 for line in said.splitlines() if "/" not in line)
    assert not (out / "validation.json").exists()
    text = (out / "validation.md").read_text(encoding="utf-8")
    assert (out / "validation.html").is_file()
    for name in {line.split("](")[1].rstrip(")") for line in text.splitlines() if line.startswith("![")}:
        with Image.open(out / name) as image:
            assert image.size[0] > 1000
    assert run("validate", "--from", file, "-o", out) == 2
    assert run("validate", "--from", file, "-o", out, "--force") == 0
    assert (out / "validation.md").read_text(encoding="utf-8") == text
    assert run("validate", "--from", file) == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("no json", "is no JSON"),
        ("[]", "results"),
        ("{}", "results"),
        ('{"results": []}', "empty"),
        ('{"results": [{"experiment": "drift"}]}', r"results[0].trial: nothing"),
        ('{"results": [{"experiment": "a", "trial": 1, "method": "b"}]}', r"results[0].trial: int"),
        ('{"results": [{"experiment": "a", "trial": "1", "method": "b", "figures": []}]}', "figures: list"),
    ],
)
def test_a_bad_file_gets_one_line(text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "validation.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BadData):
        read_document(path)
    assert run("validate", "--from", path, "-o", tmp_path / "out") == 2
    complaint = capsys.readouterr().err
    assert words in complaint
    assert len(complaint.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_missing_file_and_options_that_do_not_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(MissingFile):
        read_document(tmp_path / "nothing.json")
    for words in (("--from", tmp_path / "nothing.json"), ("--from", tmp_path / "nothing.json", "--quick")):
        assert run("validate", *words) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


def test_broken_figures_in_a_whole_file_do_not_break_the_page() -> None:
    item: dict[str, Any] = {"experiment": "dynamic 100 Hz", "trial": "0", "method": "smekf", "figures": {}}
    blocks = page(as_document({"results": [item, {**item, "experiment": "drift", "series": {}}]}, "made"))
    assert "Dynamic 100 Hz" in markdown(blocks)
    assert json.dumps(as_html(blocks))
