"""The page engine: sections of one template, text from outside, figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from wepose_pin.diagnostics import render
from wepose_pin.report.figures import draw_over_time
from wepose_pin.report.page import Banner, Facts, Frame, Item, Page, PageWriter, Table, inline

NASTY = '<script>alert("x")</script> & {{ 7 * 7 }} ](javascript:x)'


def made(*items: Item, title: str = "A section") -> str:
    page = Page("A title & more")
    page.add(title, lambda: items)
    return page.html()


def test_a_page_has_its_titles_menu_and_policy() -> None:
    text = made("one `two` **three**", title="First things")
    assert "<title>A title &amp; more</title>" in text
    assert '<nav><a href="#first-things">First things</a>' in text
    assert '<h2 id="first-things">First things</h2>' in text
    assert "<p>one <code>two</code> <b>three</b></p>" in text
    assert "default-src 'none'" in text
    assert "script-src" not in text


def test_text_from_outside_stays_text() -> None:
    figure = draw_over_time(np.arange(3.0), {NASTY: {NASTY: np.arange(3.0)}}, NASTY, {NASTY: {"label": NASTY}})
    for item in (
        NASTY,
        Table([NASTY], [[NASTY]], NASTY),
        Facts([(NASTY, NASTY)]),
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


def test_a_section_that_fails_leaves_a_line_and_the_others() -> None:
    def fail() -> list[Item]:
        raise ValueError("no\nway")

    failures: list[str] = []
    page = Page("t", failures)
    page.add("Second", fail)
    page.add("Third", lambda: ["there"])
    page.add("Fourth", lambda: None)
    (failure,) = failures
    assert failure.startswith("the section 'Second' cannot be made: ")
    assert "\n" not in failure
    text = page.html()
    assert "<b>The section &#39;Second&#39; cannot be made" in text
    assert "<p>there</p>" in text
    assert "Fourth" not in text


@pytest.mark.parametrize("values", [[np.nan], [3.0], [0.0, 0.0], [1e-9, 2e-9], [-1e6, 1e6]])
def test_any_numbers_give_a_figure_and_equal_ones_equal_text(values: list[float]) -> None:
    time = np.arange(len(values), dtype=float)
    texts = [draw_over_time(time, {"a": {"b": np.array(values)}}, "c", {"b": {}}).svg() for _ in range(2)]
    assert texts[0] == texts[1]


def test_a_page_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        (tmp_path / name).write_text("old")
    writer = PageWriter(tmp_path, ["a.html", "b.html"])
    assert writer.write("a.html", lambda _: "new") == "new"
    assert writer.write("b.html", lambda _: 1 / 0) is None  # type: ignore[arg-type,return-value]
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]
    (diagnostic,) = writer.diagnostics
    assert (diagnostic.code, diagnostic.place) == ("output-incomplete", "b.html")
    assert "ZeroDivisionError" in render(diagnostic).what
