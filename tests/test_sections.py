"""The page engine: sections of one template, text from outside, figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from wepose_pin.diagnostics import render
from wepose_pin.report.figures import draw_over_time
from wepose_pin.report.page import Banner, Frame, Item, inline, render_page, write_pages
from wepose_pin.report.words import Table

NASTY = '<script>alert("x")</script> & {{ 7 * 7 }} ](javascript:x)'


def made(*items: Item, title: str = "A section") -> str:
    return render_page("A title & more", [], {title: items, "Empty": []})


def test_a_page_has_its_titles_menu_and_policy() -> None:
    text = made("one `two` **three**", title="First things")
    assert "<title>A title &amp; more</title>" in text
    assert '<nav><a href="#first-things">First things</a>' in text
    assert '<h2 id="first-things">First things</h2>' in text
    assert "<p>one <code>two</code> <b>three</b></p>" in text
    assert "default-src 'none'" in text
    assert "script-src" not in text
    assert "Empty" not in text


def test_text_from_outside_stays_text() -> None:
    figure = draw_over_time(np.arange(3.0), {NASTY: {NASTY: np.arange(3.0)}}, NASTY, {NASTY: {"label": NASTY}})
    for item in (
        NASTY,
        Table(NASTY, [NASTY], [[NASTY]]),
        Table("", [], [(NASTY, NASTY)]),
        Banner("poor", NASTY, [("warning", NASTY)]),
        Frame(NASTY, NASTY),
        figure,
    ):
        body = made(item, title=NASTY).split("<body>")[1]
        assert "<script" not in body
        assert "{{ 7 * 7 }}" in body
        assert "href" not in body.replace('href="#', "")
    assert inline("a < b **`c`**") == "a &lt; b <b><code>c</code></b>"


def test_a_page_in_the_page_runs_apart_from_it() -> None:
    text = made(Frame('<script>a("&")</script>'))
    assert "script-src 'unsafe-inline'" in text
    assert 'sandbox="allow-scripts" srcdoc="&lt;script&gt;a(&#34;&amp;&#34;)&lt;/script&gt;"' in text


@pytest.mark.parametrize("values", [[np.nan], [3.0], [0.0, 0.0], [1e-9, 2e-9], [-1e6, 1e6]])
def test_any_numbers_give_a_figure_and_equal_ones_equal_text(values: list[float]) -> None:
    time = np.arange(len(values), dtype=float)
    texts = [draw_over_time(time, {"a": {"b": np.array(values)}}, "c", {"b": {}}).svg() for _ in range(2)]
    assert texts[0] == texts[1]


def test_a_page_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        (tmp_path / name).write_text("old")
    (tmp_path / "summary.json").write_text('{"diagnostics": []}')
    (diagnostic,) = write_pages(
        tmp_path,
        {"a.html": lambda: "new", "b.html": lambda: 1 / 0},  # type: ignore[arg-type,return-value]
        "summary.json",
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.html", "summary.json"]
    assert (tmp_path / "a.html").read_text() == "new"
    assert (diagnostic.code, diagnostic.place) == ("output-incomplete", "b.html")
    assert "ZeroDivisionError" in render(diagnostic).what
    (saved,) = json.loads((tmp_path / "summary.json").read_text())["diagnostics"]
    assert saved["text"]["what"] == render(diagnostic).what
