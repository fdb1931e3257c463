"""The page of all commands with their help, as `wepose X --help` prints it: generated/commands.md."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path

from sphinx.application import Sphinx

from wepose_pin.commands import main
from wepose_pin.commands.options import COMMANDS

HEAD = """# Commands

What `wepose COMMAND --help` prints. Every command ends with 0 on success and with 2 on wrong options or input, with
one line that says what is wrong. `wepose calibrate` also ends with 3 (poor) and 4 (fail). Outputs are written whole or
not at all, and nothing is overwritten without `--force`.
"""


def print_help(command: str) -> str:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([command, "--help"])
    return text.getvalue()


def write_commands(app: Sphinx) -> None:
    os.environ["COLUMNS"] = "100"
    sections = [f"## wepose {name}\n\n```text\n{print_help(name)}```\n" for name in COMMANDS]
    page = Path(app.srcdir) / "generated" / "commands.md"
    page.parent.mkdir(exist_ok=True)
    page.write_text("\n".join([HEAD, *sections]), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", write_commands)
    return {"parallel_read_safe": True}
