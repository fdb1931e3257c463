"""The page engine: sections from templates, text from outside, charts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wepose_pin.diagnostics import render
from wepose_pin.report.chart import Chart, Key, Panel, Picture, category_rows, log_ticks, round_ticks
from wepose_pin.report.page import Page, PageWriter, Table, inline, load_template
from wepose_pin.report.words import capital, slug

PARTS = "report/templates/parts.html.j2"
NASTY = '<script>alert("x")</script> & {{ 7 * 7 }} ](javascript:x)'


def made(macro: str, heading: str = "", **values: Any) -> str:
    page = Page(PARTS, "A title")
    page.add(macro, lambda: values, heading)
    return page.html("a window & more")


def test_a_page_has_its_titles_menu_and_policy() -> None:
    text = made("bullets", "First things", items=["one `two` **three**"])
    assert "<title>a window &amp; more</title>" in text
    assert '<nav><a href="#first-things">First things</a>' in text
    assert '<h2 id="first-things">First things</h2>' in text
    assert "<li>one <code>two</code> <b>three</b></li>" in text
    assert "default-src 'none'" in text
    assert "script-src" not in text


def test_text_from_outside_stays_text() -> None:
    table = Table([NASTY], [[NASTY]])
    for text in (
        made("table", NASTY, of=table),
        made("facts", rows=[(NASTY, NASTY)]),
        made("banner", kind="poor", text=NASTY, entries=[("warning", NASTY)]),
        made("failure", text=NASTY),
        made("frame", title=NASTY, caption=NASTY, page=NASTY),
    ):
        body = text.split("<body>")[1]
        assert "<script" not in body
        assert "{{ 7 * 7 }}" in body
        assert "href" not in re.sub(r'href="#', "", body)
    assert inline("a < b **`c`**") == "a &lt; b <b><code>c</code></b>"


def test_a_page_in_the_page_runs_apart_from_it() -> None:
    text = made("frame", title="3D", caption="drag", page='<script>a("&")</script>')
    assert "script-src 'unsafe-inline'" in text
    assert 'sandbox="allow-scripts" srcdoc="&lt;script&gt;a(&#34;&amp;&#34;)&lt;/script&gt;"' in text


@pytest.mark.parametrize("kind", ["its values", "its macro", "a value that it lacks"])
def test_a_section_that_fails_leaves_a_line_and_the_others(kind: str) -> None:
    def values() -> dict[str, Any]:
        if kind == "its values":
            raise ValueError("no\nway")
        return {} if kind == "a value that it lacks" else {"items": [], "more": 1}

    failures: list[str] = []
    page = Page(PARTS, "t", failures)
    page.add("bullets", values, "Second")
    page.add("bullets", lambda: {"items": ["there"]}, "Third")
    page.add("bullets", lambda: None, "Fourth")
    (failure,) = failures
    assert failure.startswith("the section 'Second' cannot be made: ")
    assert "\n" not in failure
    text = page.html("t")
    assert "<b>The section &#39;Second&#39; cannot be made" in text
    assert "<li>there</li>" in text
    assert "Fourth" not in text


def test_a_page_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        (tmp_path / name).write_text("old")
    writer = PageWriter(tmp_path, ["a.html", "b.html"])
    assert writer.write("a.html", lambda _: "new") == "new"
    assert writer.write("b.html", lambda _: 1 / 0) is None  # type: ignore[arg-type,return-value]
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]
    (diagnostic,) = writer.diagnostics
    assert (diagnostic.code, diagnostic.place) == ("page-incomplete", "b.html")
    assert "ZeroDivisionError" in render(diagnostic).what


def test_names() -> None:
    assert slug("Upper body, realistic!") == "upper-body-realistic"
    assert capital("") == ""


# Charts ---------------------------------------------------------------------------------------------------------------


def drawn(panel: Panel, **options: Any) -> str:
    chart: Any = load_template("report/templates/chart.svg.j2").module
    return str(chart.svg(Picture("one", "A caption", Chart([[panel]], [100.0], **options))))


def points(d: str) -> np.ndarray:
    """The points of a path of absolute beginnings and relative steps, in tenths of a pixel."""
    return np.concatenate(
        [np.cumsum(np.array(re.findall(r"-?\d+", run), float).reshape(-1, 2), axis=0) for run in d.split("M")[1:]]
    )


def test_a_line_is_where_its_numbers_are_and_breaks_at_nan() -> None:
    x, y = np.linspace(0.0, 10.0, 101), np.sin(np.linspace(0.0, 10.0, 101))
    y[40:45] = np.nan
    panel = Panel(x=(0.0, 10.0), y=(-1.0, 1.0))
    panel.line(x, y, "left")
    text = drawn(panel)
    (d,) = re.findall(r'class="line left" d="([^"]+)"', text)
    (width,) = re.findall(r'<svg width="([\d.]+)"', text)
    assert d.count("M") == 2
    vertices, known = points(d), np.isfinite(y)
    assert len(vertices) == known.sum()
    np.testing.assert_allclose(vertices[:, 0], float(width) * x[known], atol=0.6)
    np.testing.assert_allclose(vertices[:, 1], 500.0 * (1.0 - y[known]), atol=0.6)


def test_equal_axes_flipped_ones_and_logarithmic_ones() -> None:
    panel = Panel(equal=True, flip_x=True)
    panel.line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "left")
    ((dx, dy),) = [np.diff(points(d), axis=0)[0] for d in re.findall(r'class="line left" d="([^"]+)"', drawn(panel))]
    assert dx == pytest.approx(dy, abs=2)  # up and to the left, by as much
    assert dx < 0.0
    panel = Panel(y=(0.1, 100.0), log_y=True, x=(0.0, 1.0))
    panel.markers([0.5, 0.5, 0.5], [0.1, 1.0, 10.0], "circle", "left")
    (d,) = re.findall(r'class="marker left" d="([^"]+)"', drawn(panel))
    assert [int(y) for _, y in re.findall(r"M(\d+) (\d+)m", d)] == [1000, 667, 333]


def test_boxes_spans_and_names() -> None:
    panel = Panel(x=(0.0, 4.0))
    assert category_rows(panel, ["above", "below"]) == [1.0, 0.0]
    panel.spans([(1.0, 2.0)], "phase")
    panel.boxes(np.zeros((0, 2)), (0.0, 1.0), "none")
    panel.text(2.0, 0.0, "2 < 3")
    text = drawn(panel, legend=[Key("a phase", "phase", "box"), Key("a line", "left")])
    (d,) = re.findall(r'd="([^"]+)"/>\s*</svg>\s*<path class="axes"', text)
    assert d.endswith("V0H" + re.findall(r"M(\d+)", d)[0] + "z")  # to the panel's upper edge
    assert text.index(">above<") < text.index(">below<")
    assert "2 &lt; 3" in text
    assert "a phase" in text
    assert 'class="area none"' not in text


@pytest.mark.parametrize("values", [[], [np.nan], [3.0], [0.0, 0.0], [1e-9, 2e-9], [-1e6, 1e6]])
def test_any_numbers_give_a_chart(values: list[float]) -> None:
    panel = Panel()
    panel.line(np.array(values), np.array(values), "left")
    panel.area(np.array(values), np.array(values), "left")
    assert "nan" not in drawn(panel).replace("standalone", "")


def test_ticks_are_round_numbers() -> None:
    assert [label for _, label in round_ticks(0.0, 1.0, 5)] == ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
    assert [label for _, label in round_ticks(-55.0, 61.0, 3)] == ["−50", "0", "50"]
    assert [label for _, label in round_ticks(0.0, 118.8, 12)][:2] == ["0", "10"]
    assert [label for _, label in log_ticks(0.5, 14.0)] == ["0.5", "1", "2", "5", "10"]
    for low in np.random.default_rng(0).lognormal(0.0, 8.0, 200):
        ticks = round_ticks(-low, 1.3 * low, 6)
        assert 3 <= len(ticks) <= 9
        assert all(-low <= value <= 1.3 * low for value, _ in ticks)
