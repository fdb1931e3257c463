"""Runs the notebook of examples/ when the site is built: generated/notebook.md, with what each cell shows."""

from __future__ import annotations

import html
import re
import shutil
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from sphinx.application import Sphinx
from traitlets.config import Config

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "recording_to_robot.ipynb"
LONGEST_S = 600


def show(output: nbformat.NotebookNode, file: Path) -> str:
    """Write an output's page or figure beside the site's page, and return the lines that show it."""
    data = output.get("data", {})
    text = str(output.get("text", data.get("text/plain", "")))
    page = re.search(r'srcdoc="(.*?)"', data.get("text/html", ""), re.DOTALL)
    if page:
        file.with_suffix(".html").write_text(html.unescape(page[1]), encoding="utf-8")
        return f'<iframe class="motion" src="../notebook/{file.stem}.html" title="motion" loading="lazy"></iframe>'
    if "image/svg+xml" in data:
        file.with_suffix(".svg").write_text(data["image/svg+xml"], encoding="utf-8")
        return f'<img class="drawn" src="../notebook/{file.stem}.svg" alt="{html.escape(text)}">'
    if "text/html" in data:
        inside = re.sub(r"\n\s*\n", "\n", data["text/html"])
        return f'<div class="output">{inside}</div>'
    return f"```text\n{text.rstrip()}\n```"


def write_notebook(app: Sphinx) -> None:
    if app.builder.format != "html":
        return
    drawn, work = Path(app.outdir) / "notebook", Path(app.doctreedir) / "notebook"
    for folder in (drawn, work):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    with tempfile.TemporaryDirectory() as sockets:  # over TCP the kernel warns that others on this machine could listen
        config = Config(AsyncKernelManager={"transport": "ipc", "ip": f"{sockets}/kernel"})
        place = {"metadata": {"path": str(work)}}
        NotebookClient(notebook, config=config, timeout=LONGEST_S, resources=place).execute()
    parts = []
    for k, cell in enumerate(notebook.cells):
        if cell.cell_type == "markdown":
            parts.append(cell.source)
        else:
            parts.append(f"```python\n{cell.source}\n```")
            parts += [show(output, drawn / f"cell-{k}-{i}") for i, output in enumerate(cell.outputs)]
    page = Path(app.srcdir) / "generated" / "notebook.md"
    page.parent.mkdir(exist_ok=True)
    page.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", write_notebook)
    return {"parallel_read_safe": True}
