"""Runs the scripts of examples/ when the site is built: a page each, with the code, what it prints, and what it draws.

A script that writes view.html or figures (SVG) into the folder in which it runs has them on its page.
"""

from __future__ import annotations

import ast
import html
import os
import shutil
import subprocess
import sys
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

ROOT = Path(__file__).resolve().parents[2]
LONGEST_S = 600
WAITING = ("live_consumer.py", "robot_receiver.py")  # for ever, for a live session: their first line is shown
PICTURES = {"move_robot": "robot.webp", "track_recording": "demo.webp"}  # of docs/, of what their pages show in 3D
INDEX = """# Gallery

Start from one of these scripts of `examples/`. Each was run when this site was built; its page has what it printed and
drew.

"""


def run_script(script: Path, folder: Path) -> str:
    """Run it in an empty folder and return what it prints."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    command, environment = [sys.executable, "-W", "error", str(script)], {**os.environ, "PYTHONPATH": str(ROOT)}
    if script.name in WAITING:
        with subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True) as waiting:
            assert waiting.stdout is not None
            printed = waiting.stdout.readline()
            waiting.terminate()
        if not printed:
            raise ExtensionError(f"{script.name}: printed nothing")
        return printed
    run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LONGEST_S)
    if run.returncode != 0:
        raise ExtensionError(f"{script.name}: {run.stderr[-2000:]}")
    return run.stdout


def make_title(script: Path) -> str:
    return script.stem.replace("_", " ").capitalize()


def write_page(script: Path, pages: Path, drawn: Path) -> str:
    """Write the page of a script; returns its entry in the index, with its first figure."""
    code = script.read_text(encoding="utf-8")
    first, _, rest = (ast.get_docstring(ast.parse(code)) or "").partition("\n")
    printed = run_script(script, drawn / script.stem)
    body = code.split('"""', 2)[2].strip()
    parts = [f"# {first.rstrip('.')}", rest.strip("\n"), f"```python\n{body}\n```"]
    parts += [f"It prints:\n```text\n{printed.rstrip()}\n```"]
    line = f"- [{make_title(script)}]({script.stem}.md): {first}"
    if script.stem in PICTURES:
        line += f"\n\n  ![{first}](../../{PICTURES[script.stem]})"
    for file in sorted((drawn / script.stem).rglob("*.*")):
        address = f"../../{file.relative_to(drawn.parent).as_posix()}"
        if file.suffix == ".html":
            title = html.escape(first)
            parts += [f'<iframe class="motion" src="{address}" title="{title}" loading="lazy"></iframe>']
            parts += [f'<p><a href="{address}">This page by itself</a>: one file, which opens offline.</p>']
        elif file.suffix == ".svg":
            picture = f'<img class="drawn" src="{address}" alt="{html.escape(file.stem)}">'
            parts += [picture]
            line += f"\n\n  {picture}" if "<img" not in line else ""
    (pages / f"{script.stem}.md").write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return line


def write_gallery(app: Sphinx) -> None:
    if app.builder.format != "html":
        return
    pages, drawn = Path(app.srcdir) / "generated" / "gallery", Path(app.outdir) / "gallery"
    shutil.rmtree(pages, ignore_errors=True)
    pages.mkdir(parents=True)
    lines = [write_page(script, pages, drawn) for script in sorted((ROOT / "examples").glob("*.py"))]
    entries = [f"{make_title(script)} <{script.stem}>" for script in sorted((ROOT / "examples").glob("*.py"))]
    contents = ["", "```{toctree}", ":hidden:", *entries, "```", ""]
    (pages / "index.md").write_text("\n".join([INDEX, *lines, *contents]), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", write_gallery)
    return {"parallel_read_safe": True}
