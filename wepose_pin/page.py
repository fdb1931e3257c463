"""Pages of words, tables and figures: blocks, written as Markdown or as one HTML file that opens offline and prints."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

INK, SOFT, LINE, ACCENT = "#1d2935", "#66758a", "#d5dbe3", "#24618f"  # as in viewer_page.html
DPI = 144
COLOURS_A_PNG = 160
WIDTH = 9.0  # [in]
FONT = 9.0  # [pt]
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "font.size": FONT,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlesize": FONT + 0.5,
    "legend.fontsize": FONT,
    "hatch.linewidth": 0.5,
}


class Heading(NamedTuple):
    text: str
    level: int = 2


class Bullets(NamedTuple):
    items: list[str]


class Table(NamedTuple):
    header: list[str]
    rows: list[list[str]]


class Facts(NamedTuple):
    """Names and their values."""

    rows: list[tuple[str, str]]


class Banner(NamedTuple):
    """What the reader must see first; `kind`: "pass", "poor", "fail", or "note"."""

    kind: str
    text: str
    items: list[str]


class Picture(NamedTuple):
    """A figure."""

    stem: str  # of its file
    caption: str
    png: bytes


class Frame(NamedTuple):
    """A page in the page, for screens only."""

    title: str
    caption: str
    html: str


Block = str | Heading | Bullets | Table | Facts | Banner | Picture | Frame  # text: a paragraph


class Sections:
    """Makes the sections of a page, each by itself: one that fails leaves a line in its place and takes nothing along.

    Parameters
    ----------
    failures : takes a line for each section that cannot be made
    """

    def __init__(self, failures: list[str] | None) -> None:
        self._failures = failures if failures is not None else []

    def __call__(self, name: str, make: Callable[[], list[Block]]) -> list[Block]:
        try:
            return make()
        except Exception as error:
            said = f"the section '{name}' cannot be made: {reason(error)}"
            self._failures.append(said)
            return [f"**{capital(said)}.** All else of the page is as it should be."]


def reason(error: Exception) -> str:
    """Kind and text of an error, in one line of bounded length."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:200]}" if text else type(error).__name__


def stem(text: str) -> str:
    """A name as a file's: "upper body, realistic" → "upper-body-realistic"."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower().replace("'", "")).strip("-") or "experiment"


def capital(text: str) -> str:
    return text[:1].upper() + text[1:]


# Markdown and HTML ---------------------------------------------------------------------------------------------------


def markdown(blocks: Sequence[Block], folder: str) -> str:
    """The page as Markdown, its figures in `folder` beside it."""
    out = []
    for block in blocks:
        match block:
            case Heading(text, level):
                out.append(f"{'#' * level} {text}")
            case Bullets(items):
                out.append("\n".join(f"- {item}" for item in items))
            case Table(header, rows):
                lines = [header, ["---", *["---" if _of_words(rows) else "---:"] * (len(header) - 1)], *rows]
                escaped = [[cell.replace("|", "\\|") for cell in line] for line in lines]
                out.append("\n".join(f"| {' | '.join(line)} |" for line in escaped))
            case Facts(pairs):
                out.append("\n".join(f"- {name}: {value}" for name, value in pairs))
            case Banner(_, text, items):
                out.append("\n".join([f"**{text}**", *(["", *(f"- {item}" for item in items)] if items else [])]))
            case Picture(name, caption, _):
                out.append(f"![{caption.replace('[', '(').replace(']', ')')}]({folder}/{name}.png)\n\n*{caption}*")
            case Frame():
                continue
            case _:
                out.append(block)
    return "\n\n".join(out) + "\n"


def as_html(blocks: Sequence[Block], title: str) -> str:
    """The page as one HTML file with its figures in it; `title` is the window's."""
    contents, out = [], []
    for block in blocks:
        match block:
            case Heading(text, level):
                name = stem(text)
                if level == 2:
                    contents.append(f'<a href="#{name}">{html.escape(text)}</a>')
                out.append(f'<h{level} id="{name}">{html.escape(text)}</h{level}>')
                if level == 1:
                    out.append("@@contents@@")
            case Bullets(items):
                out.append(_list(items))
            case Table(header, rows):
                head = "".join(f"<th>{_inline(cell)}</th>" for cell in header)
                lines = "".join(f"<tr>{''.join(f'<td>{_inline(cell)}</td>' for cell in row)}</tr>" for row in rows)
                kind = ' class="words"' if _of_words(rows) else ""
                table = f"<table{kind}><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table>"
                out.append(f'<div class="wide">{table}</div>')
            case Facts(pairs):
                lines = "".join(f"<dt>{_inline(name)}</dt><dd>{_inline(value)}</dd>" for name, value in pairs)
                out.append(f"<dl>{lines}</dl>")
            case Banner(kind, text, items):
                inner = f"<p>{_inline(text)}</p>" + (_list(items) if items else "")
                out.append(f'<section class="banner {kind}">{inner}</section>')
            case Picture(_, caption, png):
                data, text = base64.b64encode(png).decode("ascii"), _inline(caption)
                image = f'<img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
                out.append(f"<figure>{image}<figcaption>{text}</figcaption></figure>")
            case Frame(name, caption, inside):
                # srcdoc lives under this page's policy and, without allow-same-origin, apart from this page.
                frame = f'<iframe title="{html.escape(name)}" sandbox="allow-scripts" srcdoc="{html.escape(inside)}">'
                text = f"<figcaption>{_inline(caption)}</figcaption>"
                out.append(f'<figure class="screen">{frame}</iframe>{text}</figure>')
            case _:
                warning = ' class="warning"' if block.startswith("**") else ""
                out.append(f"<p{warning}>{_inline(block)}</p>")
    scripts = any(isinstance(block, Frame) for block in blocks)
    parts = {
        "title": html.escape(title),
        "policy": _POLICY + (" blob:; script-src 'unsafe-inline'" if scripts else ""),
        "body": "\n".join(out).replace("@@contents@@", f"<nav>{' '.join(contents)}</nav>", 1),
    }
    return re.sub(r"@@(\w+)@@", lambda found: parts[found[1]], _HTML)


def _list(items: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{_inline(item)}</li>' for item in items)}</ul>"


def _of_words(rows: Sequence[Sequence[str]]) -> bool:
    """Tables of words are set to the left, and may break their lines."""
    return any(len(cell) > 40 for row in rows for cell in row)


def _inline(text: str) -> str:
    text = html.escape(text)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    text = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", text)
    # Elsewhere on the web, or a page that lies beside this one.
    return re.sub(r"\[([^\]]+)\]\((https://[^)]+|[\w%-][\w./%-]*\.html)\)", r'<a href="\2">\1</a>', text)


_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
_HTML = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="@@policy@@">
<title>@@title@@</title>
<style>
  :root { color-scheme: light; --ink: #1d2935; --soft: #5a697d; --line: #d5dbe3; --accent: #24618f; --paper: #fff;
          --code: #edf0f4; --pass: #24618f; --pass-paper: #eef5fa; --poor: #d9772b; --poor-paper: #fdf3ea;
          --fail: #b23a48; --fail-paper: #fbeef0; --dim: 1; }
  @media screen and (prefers-color-scheme: dark) {
    :root { color-scheme: dark; --ink: #dde4ec; --soft: #9aa8b8; --line: #36424f; --accent: #7fb8e0; --paper: #161c23;
            --code: #27313c; --pass: #5fa3d3; --pass-paper: #1b2a37; --poor: #e08a45; --poor-paper: #33271c;
            --fail: #e0707e; --fail-paper: #361f24; --dim: .9; }
  }
  * { box-sizing: border-box; }
  body { margin: 0 auto; max-width: 1000px; padding: 28px 24px 60px; color: var(--ink); background: var(--paper);
         font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
  h1 { margin: 0 0 10px; font-size: 28px; letter-spacing: -.01em; }
  h2 { margin: 46px 0 8px; padding-top: 14px; border-top: 1px solid var(--line); font-size: 20px; }
  p, ul { margin: 8px 0; max-width: 78ch; }
  ul { padding-left: 20px; }
  li { margin: 3px 0; }
  a { color: var(--accent); }
  nav { display: flex; flex-wrap: wrap; gap: 2px 16px; margin: 0 0 18px; font-size: 13.5px; }
  code { padding: 0 3px; border-radius: 3px; background: var(--code); font-size: .92em; }
  .warning { padding: 9px 13px; border-left: 4px solid var(--poor); background: var(--poor-paper); }
  .wide { margin: 14px 0 6px; overflow-x: auto; }
  table { border-collapse: collapse; font-size: 13.5px; font-variant-numeric: tabular-nums; }
  th, td { padding: 4px 12px 4px 0; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
  th { color: var(--soft); font-weight: 600; border-bottom-color: var(--soft); vertical-align: bottom; }
  th:first-child, td:first-child { text-align: left; }
  .words th, .words td { text-align: left; white-space: normal; vertical-align: top; }
  dl { display: grid; grid-template-columns: max-content 1fr; gap: 3px 22px; margin: 12px 0; font-size: 13.5px; }
  dt { color: var(--soft); }
  dd { margin: 0; overflow-wrap: anywhere; }
  .banner { margin: 14px 0; padding: 12px 18px; border: 1px solid; border-left-width: 6px; border-radius: 4px;
            break-inside: avoid; }
  .banner > p { margin: 0; font-size: 17px; }
  .banner ul { margin: 6px 0 0; }
  .pass { border-color: var(--pass); background: var(--pass-paper); }
  .poor, .note { border-color: var(--poor); background: var(--poor-paper); }
  .fail { border-color: var(--fail); background: var(--fail-paper); }
  .note > p { font-size: inherit; font-weight: 600; }
  figure { margin: 20px 0; break-inside: avoid; }
  figure img { display: block; width: 100%; max-width: 940px; height: auto; border-radius: 4px;
               filter: brightness(var(--dim)); }
  figcaption { margin-top: 5px; color: var(--soft); font-size: 13px; max-width: 90ch; }
  iframe { display: block; width: 100%; height: 620px; border: 1px solid var(--line); border-radius: 4px; }
  @page { size: A4; margin: 16mm 15mm; }
  @media print {
    body { max-width: none; padding: 0; font-size: 10pt; }
    nav { display: none; }
    h2 { margin-top: 22px; padding-top: 8px; }
    h2, h2 + p { break-after: avoid; }
    p, li { orphans: 3; widows: 3; }
    table, dl { font-size: 8.8pt; }
    tr, .wide { break-inside: avoid; }
    .wide { overflow: visible; }
    .screen, h2:has(+ .screen) { display: none; }
    figure { margin: 12px 0; }
    .banner, .warning { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  }
</style>
</head>
<body>
@@body@@
</body>
</html>
"""


# How figures look ----------------------------------------------------------------------------------------------------


def new_figure(height: float) -> Figure:
    """A figure as wide as the page; `height` [in]. Draw it, and turn it into bytes, under `rc_context(STYLE)`."""
    return Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained", facecolor="white")


def png_of(figure: Figure) -> bytes:
    """The figure's bytes; the same figure gives the same bytes."""
    for axes in figure.axes:
        axes.set_axisbelow(True)
        axes.tick_params(which="both", color=SOFT, labelcolor=INK)
        for side, spine in axes.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color(SOFT)
    out = io.BytesIO()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    drawn = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    pixels = Image.fromarray(drawn).convert("RGB")
    pixels.quantize(COLOURS_A_PNG).save(out, "png", compress_level=6)  # a third of the size; no eye sees it
    return out.getvalue()
