"""The pages of a validation run, from small documents made by hand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from wepose_pin.cli import main
from wepose_pin.errors import BadData, MissingFile
from wepose_pin.simulation import PRESETS
from wepose_pin.validation import Document, Result, format_document, read_document, summarize
from wepose_pin.validation.document import parse_document
from wepose_pin.validation.figures import draw_pictures
from wepose_pin.validation.page import render_html, render_markdown
from wepose_pin.validation.tables import (
    ARBITRARY_MOUNTING,
    compare_with_paper,
    compute_error_budget,
    describe_table,
    make_experiment_table,
    make_imperfections_table,
    make_noise_table,
    make_overview_table,
    make_targets_table,
)

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
        for key, value in (("hand_from_shoulders_mm", shoulders), ("hand_mm", root))
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
MILD, IDEAL = "upper body, mild", "upper body, ideal"
BUDGET = "error budget, mild"
RESULTS = [
    *DYNAMIC,
    *(hand(MILD, m, *e) for m, e in {"smekf": (18.04, 17.0), "ncf": (25.0, 24.0), "gdc": (24.0, 23.0)}.items()),
    hand(IDEAL, "smekf", 12.0, 13.0),
    *(hand(BUDGET, m, e, e, 1) for m, e in {"all on": 12.0, "soft tissue off": 4.0, "mounts as stated": 19.0}.items()),
    *(board(m, t, 1.0) for m in ("smekf", "vqf", "a new one") for t in ("01_slow", "02_fast")),
    Result(
        "never heard of", "x", "somebody", {"depth_mm": 3.0, "count": 4, "odd": None, "why": "text", "pair": [1, 2]}
    ),
    Result("never heard of", "x", "else", {"depth_mm": float("nan"), "list": [1, 2, 3]}),
]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "validation.json"
    path.write_text(format_document(RESULTS, True, {"wepose-pin": "0.0"}), encoding="utf-8")
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
    assert document.presets["mild"]["imperfections"]["soft_tissue_deg"] == 1.5
    assert document.presets["ideal"]["imperfections"]["gyro_range_deg_s"] is None
    assert document.presets["mild"]["measured_std"] == 0.003
    assert len(file.read_text(encoding="utf-8").split('"results": [\n')[1].splitlines()) == len(RESULTS) + 2


def test_means_and_both_kinds_of_deviation() -> None:
    rows = summarize([dynamic("smekf", 1.0, 1.0, 1.0, 0), dynamic("smekf", 3.0, 1.0, 1.0, 1)])
    assert rows[0].figures["roll"] == 2.0
    assert rows[0].figures["roll std"] == 0.5
    assert rows[0].figures["roll between"] == pytest.approx(np.sqrt(2.0))
    assert rows[0].names() == ["roll", "pitch", "yaw"]
    header, (line,) = make_experiment_table(rows, whole=True)
    assert header[:2] == ["filter", "roll [deg]"]
    assert line[:2] == ["smekf", "2.00 ± 0.50 (1.41)"]
    assert line[header.index("paper: pitch")] == "1.46 ± 1.71"
    assert "between the trials" in describe_table(rows)


def test_an_overview_beside_the_paper_and_the_best() -> None:
    rows = make_overview_table(summarize(DYNAMIC)).rows
    assert rows == [
        ["dynamic 100 Hz", "roll [deg]", "1.00", "1.10", "1.00", "smekf"],
        ["dynamic 100 Hz", "pitch [deg]", "**1.52**", "1.46", "1.20", "ncf"],
        ["dynamic 100 Hz", "yaw [deg]", "1.30", "1.35", "1.30", "smekf"],
    ]


def test_every_row_that_is_worse_than_the_papers_is_listed() -> None:
    poor = [dynamic("ncf, default gains", 2.0, 9.0, 2.0), dynamic("amekf", 9.0, 9.0, 9.0)]
    compared = compare_with_paper(summarize([*DYNAMIC, *poor]))
    assert compared.figures == 12
    assert compared.larger.rows == [
        ["dynamic 100 Hz", "smekf", "pitch [deg]", "1.52", "1.46"],
        ["dynamic 100 Hz", "gdc", "roll [deg]", "1.50", "1.38"],
        ["dynamic 100 Hz", "ncf, default gains", "pitch [deg]", "9.00", "2.70"],
    ]
    assert compare_with_paper(summarize([dynamic("smekf", 1.0, 1.0, 1.0)])).larger.rows == []


def test_the_page_claims_no_more_than_the_figures(document: Document) -> None:
    """Its words on the paper follow from the rows."""
    assert "| dynamic 100 Hz | gdc | roll [deg] | 1.50 | 1.38 |" in text_of(document)
    assert "is larger than that" not in text_of(document)
    better = document._replace(results=[dynamic("smekf", 1.0, 1.0, 1.0)])
    assert "None of the 3 mean errors" in text_of(better)
    shortened = text_of(document._replace(quick=False, planned={"dynamic 100 Hz": 12, "BROAD": 2, "drift": 10}))
    assert "Fewer trials than a full run has" in shortened
    assert ": dynamic 100 Hz 2 of 12; drift 0 of 10.**" in shortened
    assert "2 of 12 trials" in shortened
    assert "was not checked on a cohort" in " ".join(text_of(document).split()).replace("It was not", "was not")


def test_small_gains_are_not_rounded_away() -> None:
    rows = summarize(
        [Result("gains", "BROAD", "gdc, BROAD", {"gain": 0.000562, "integral": 0.0, "total_rmse_deg": 1.0})]
    )
    assert make_experiment_table(rows, whole=True).rows == [["gdc, BROAD", "0.000562", "0", "1.00"]]


def test_targets_are_met_or_missed() -> None:
    row_of = {(row[0], row[2]): row for row in make_targets_table(summarize(RESULTS)).rows}
    assert len(row_of) == 4
    assert row_of[MILD, "hand from root"][3:] == ["18.04 mm", "at most 18 mm", "**missed**"]
    assert row_of[MILD, "hand from shoulders"][-1] == "met"
    assert row_of[IDEAL, "hand from root"][-1] == "met"
    assert row_of[IDEAL, "hand from shoulders"][-1] == "**missed**"
    assert make_targets_table(summarize(DYNAMIC)).rows == []
    mounting = Result(f"{ARBITRARY_MOUNTING}, mild", "0", "amekf", {"errors_by_std_rms": 0.6, "lengths_rms_mm": 7.0})
    assert [row[3:] for row in make_targets_table(summarize([mounting])).rows] == [
        ["7.00 mm", "at most 8 mm", "met"],
        ["0.60", "0.7 to 1.5", "**missed**"],
    ]


def test_the_error_budget_adds_in_quadrature() -> None:
    budget = compute_error_budget(RESULTS)
    assert budget is not None
    assert budget.full["from root"] == 13.0
    assert [part.name for part in budget.parts] == ["soft tissue"]
    assert budget.parts[0].added["from root"] == pytest.approx(12.0)  # √(13² − 5²)
    assert budget.more[0].added["from root"] == pytest.approx(np.sqrt(20.0**2 - 13.0**2))
    assert compute_error_budget(DYNAMIC) is None


def test_figures_are_made(document: Document) -> None:
    made = {picture.stem: picture for _, picture in draw_pictures(document)}
    assert set(made) == {
        "dynamic-100-hz-bars",
        "dynamic-100-hz-over-time",
        "upper-body-mild-bars",
        "upper-body-mild-over-time",
        "upper-body-mild-path",
        "upper-body-ideal-bars",
        "upper-body-ideal-over-time",
        "upper-body-ideal-path",
        "error-budget-mild-parts",
        "broad-trials",
    }


def text_of(document: Document) -> str:
    return render_markdown(document, list(draw_pictures(document)))


def test_the_page_says_what_it_must(document: Document) -> None:
    text = text_of(document)
    for words in (
        "| dynamic 100 Hz | pitch [deg] | **1.52** | 1.46 | 1.20 | ncf |",
        "**missed** |",
        "| met |",
        "A quick run",
        "wepose validate --from validation.json",
        "## Dynamic 100 Hz\n\nOne simulated sensor",
        "**Known beforehand:** noise, gyroscope bias and tilt, from the 5 s before the motion",
        "**Known beforehand:** the shoulder width between the joint centres, off by 3 mm",
        "## Never heard of",
        "| somebody | 3.00 | 4.00 | 1.00 ± 2.00 |",
        "validation/dynamic-100-hz-bars.svg",
        "wepose-pin 0.0",
    ):
        assert words in text, words
    assert text_of(document) == text
    page = render_html(text, list(draw_pictures(document)))
    assert page.count('<svg class="chart"') == len(list(draw_pictures(document)))
    assert 'src="' not in page
    assert '<a href="#never-heard-of">' in page
    assert '<td style="text-align:right"><strong>1.52</strong></td>' in page
    assert "A quick run" not in text_of(document._replace(quick=False))


def test_text_of_a_file_stays_text() -> None:
    nasty = "<script>alert(1)</script>"
    document = parse_document(
        {"results": [{"experiment": nasty, "trial": "0", "method": nasty, "figures": {"a": 1}}]}, "x"
    )
    page = render_html(text_of(document), [])
    assert "<script" not in page.split("<body>")[1]
    assert "alert(1)" in page


def test_which_imperfections_were_on(document: Document) -> None:
    table = make_imperfections_table(document.presets)
    assert table.header == ["imperfection", *PRESETS]
    sizes = {row[0]: row[1:3] for row in table.rows}
    assert all(set(row[1:]) != {"–"} for row in table.rows)
    assert sizes["slip of the palms in the clasp, rms"] == ["–", "8 mm"]
    assert sizes["gyroscope range"] == ["–", "2000°/s"]
    assert ["gyroscope, turn-on bias", "0.2°/s"] in make_noise_table(document.noise).rows


def test_pages_anew_from_a_file(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "docs"
    assert run("validate", "--from", file, "-o", out) == 0
    printed = capsys.readouterr().out
    assert "dynamic 100 Hz, 2 trials [deg], a quick run" in printed
    assert "Targets for the mean errors" in printed
    assert all(len(line) <= 110 for line in printed.splitlines() if "/" not in line)
    assert not (out / "validation.json").exists()
    text = (out / "validation.md").read_text(encoding="utf-8")
    assert (out / "validation.html").is_file()
    for name in {line.split("](")[1].rstrip(")") for line in text.splitlines() if line.startswith("![")}:
        assert ElementTree.parse(out / name).getroot().tag == "{http://www.w3.org/2000/svg}svg"
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
    document = parse_document({"results": [item, {**item, "experiment": "drift", "series": {}}]}, "made")
    assert "Dynamic 100 Hz" in text_of(document)
    assert render_html(text_of(document), [])


def test_figures_of_the_readme_are_those_of_the_page() -> None:
    root = Path(__file__).resolve().parents[1]
    readme, page = ((root / name).read_text(encoding="utf-8") for name in ("README.md", "docs/validation.md"))

    def figure(experiment: str, column: int) -> float:
        [section] = re.findall(rf"^## {experiment}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
        [row] = re.findall(r"^\| amekf \|(.*)", section, re.MULTILINE)
        return float(re.findall(r"[\d.]+", row.split("|")[column])[0])

    broad, ur5 = [figure("BROAD", column) for column in (0, 1)], figure("UR5", 2)
    mild, people = (figure(f"Arbitrary sensor mounting, {preset}", 0) for preset in ("mild", "people"))
    stated = re.findall(r"^\|.*\| ([^|]*\d(?:°|mm| mm)[^|]*) \|", readme, re.MULTILINE)
    assert stated == [
        f"{broad[0]:.1f}° inclination, {broad[1]:.1f}° heading (rmse)",
        f"{ur5:.1f}° (rmse)",
        f"{mild:.0f} mm",
        f"{people:.0f} mm",
    ]
