"""Blocks as Markdown and as HTML."""

from __future__ import annotations

from wepose_pin.page import Banner, Bullets, Facts, Frame, Heading, Picture, Table, as_html, capital, markdown, stem

BLOCKS = [
    Heading("A title", 1),
    Heading("First"),
    "A line with `code`, **bold**, <b>no tag</b> and [a link](https://example.org/x).",
    Bullets(["one", "two"]),
    Table(["name", "value"], [["a|b", "1"]]),
    Facts([("rate", "100 Hz")]),
    Banner("poor", "Poor: so so.", ["because"]),
    Picture("one", "A figure [mm].", b"png"),
]


def test_markdown() -> None:
    text = markdown(BLOCKS, "figures")
    assert text.startswith("# A title\n\n## First\n\n")
    for part in ("- one\n- two", "| a\\|b | 1 |", "- rate: 100 Hz", "**Poor: so so.**\n\n- because"):
        assert part in text
    assert "![A figure (mm).](figures/one.png)" in text
    assert markdown([Frame("3D", "turn it", "<p>")], "x") == "\n"


def test_html() -> None:
    text = as_html(BLOCKS, "window @@body@@ & more")
    assert "<title>window @@body@@ &amp; more</title>" in text
    assert "&lt;b&gt;no tag&lt;/b&gt;" in text
    assert '<a href="https://example.org/x">a link</a>' in text
    assert '<nav><a href="#first">First</a></nav>' in text
    assert "<dt>rate</dt><dd>100 Hz</dd>" in text
    assert '<section class="banner poor"><p>Poor: so so.</p><ul><li>because</li></ul></section>' in text
    assert "script-src" not in text


def test_a_page_in_the_page_runs_apart_from_it() -> None:
    text = as_html([Heading("x", 1), Frame("3D", "turn it", '<script>a("&")</script>')], "t")
    assert "script-src 'unsafe-inline'" in text
    assert 'sandbox="allow-scripts" srcdoc="&lt;script&gt;a(&quot;&amp;&quot;)&lt;/script&gt;"' in text


def test_names() -> None:
    assert stem("Upper body, realistic!") == "upper-body-realistic"
    assert capital("") == ""
