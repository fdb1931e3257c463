"""Writes ``docs/diagnostics.md`` from the texts in ``wepose_pin/diagnostics.toml``."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import wepose_pin
from wepose_pin.diagnostics import WARNING, Diagnostic, render

PAGE = Path(__file__).with_name("diagnostics.md")
TEXTS = Path(wepose_pin.__file__).with_name("diagnostics.toml")
HEAD = """# Troubleshooting

Look a message up here by its words or by its code: what is wrong, and **what to do**. The message also
says why it matters. Its severity is *info* (good to know), *warning* (results may be wrong or uncertain) or
*error* (do not use the results). `summary.json` and `calibration.json` hold all messages of a result under
`diagnostics`, with code, place, value and limit in SI units. The values here are examples.

`python docs/diagnostics_page.py` writes this page from `wepose_pin/diagnostics.toml`.
"""


def load_groups() -> dict[str, dict[str, Any]]:
    """Group → code → its table."""
    return tomllib.loads(TEXTS.read_text(encoding="utf-8"))


def list_examples() -> dict[tuple[str, str], Diagnostic]:
    """Code and variant, or an empty text → the example of the table."""
    examples = {}
    for tables in load_groups().values():
        for code, table in tables.items():
            for variant, changed in {"": {}, **table.get("variants", {})}.items():
                facts = {**table["example"], **({"variant": variant} if variant else {}), **changed.get("example", {})}
                place, value, limit = (facts.pop(name, None) for name in ("place", "value", "limit"))
                examples[code, variant] = Diagnostic(code, WARNING, place or "", value, limit, facts)
    return examples


def document() -> str:
    """The page; a variant that says something else is wrong has a paragraph of its own."""
    lines, examples = [HEAD], list_examples()
    for group, tables in load_groups().items():
        lines.append(f"## {group.replace('-', ' ').capitalize()}\n")
        for code, table in tables.items():
            lines.append(f"### {code}\n")
            base = render(examples[code, ""])
            lines.append(f"{base['what']}\n**{base['do']}**\n")
            for variant, changed in table.get("variants", {}).items():
                if {"what", "why"} <= set(changed):
                    text = render(examples[code, variant])
                    lines.append(f"{text['what']}\n" + (f"**{text['do']}**\n" if text["do"] != base["do"] else ""))
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(document(), encoding="utf-8")
