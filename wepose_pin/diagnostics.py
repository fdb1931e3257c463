"""What a user should know, as data: `Diagnostic`, and the catalogue of its texts.

A room that finds something says it as a `Diagnostic`; `render` makes words of it where it is shown. The texts of all
codes stand in ``diagnostics.toml``; ``docs/diagnostics.md`` lists them.
"""

import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from html import escape
from pathlib import Path
from string import Formatter
from types import MappingProxyType
from typing import Any, Literal

Severity = Literal["info", "warning", "error"]
INFO: Severity = "info"  # worth knowing; the results are as good as they can be
WARNING: Severity = "warning"  # results may be wrong or uncertain by it
ERROR: Severity = "error"  # results must not be used
MOST_ALIKE = 3  # of diagnostics with the same reason and remedy that are shown in full


@dataclass(frozen=True)
class Diagnostic:
    """Something that a user should know; ``str(diagnostic)`` is its text."""

    code: str  # stable, in the catalogue, listed in docs/diagnostics.md
    severity: Severity  # how much it weighs
    place: str = ""  # segment, sensor, joint, length, phase or file that it is about
    value: float | None = None  # what was found, SI
    limit: float | None = None  # what it should keep to, SI
    # What the text needs besides, SI; ``variant`` names the text where a code has several.
    facts: Mapping[str, float | str] = field(default_factory=dict)

    def __str__(self) -> str:
        """The severity and the text, in one line."""
        return f"{self.severity}: {join_text(render(self))}"


def render(diagnostic: Diagnostic) -> dict[str, str]:
    """Put the diagnostic in words: its ``title``, ``what`` is wrong, ``why`` it matters, and what to ``do``.

    Each part is one or more sentences. `KeyError`: the catalogue has no such code, or a fact of its text is missing.
    """
    template = catalogue()[diagnostic.code]
    for word in str(diagnostic.facts.get("variant", "")).split():
        template = {**template, **template.get("variants", {}).get(word, {})}
    known = {"place": diagnostic.place, "value": diagnostic.value, "limit": diagnostic.limit, **diagnostic.facts}
    return {part: _fill(template[part], known) for part in ("title", "what", "why", "do")}


def join_text(text: Mapping[str, str], titled: bool = False) -> str:
    """Join the parts of `render` in one line; `titled`: with the title before them, in bold."""
    title = f"**{text['title']}.**" if titled else ""
    return " ".join(part for part in (title, text["what"], text["why"], text["do"]) if part)


def render_all(
    diagnostics: Iterable[Diagnostic], remedies: Mapping[str, str] = MappingProxyType({})
) -> list[tuple[Severity, dict[str, str]]]:
    """Put diagnostics in words, the gravest first, alike ones as one; `remedies`: code → another thing to do."""
    alike: dict[Any, tuple[Severity, dict[str, str], dict[str, str]]] = {}  # severity, the first text, `what` → place
    for diagnostic in gravest_first(diagnostics):
        text = render(diagnostic)
        text["do"] = remedies.get(diagnostic.code, text["do"])
        key = (diagnostic.code, diagnostic.severity, *(text[part] for part in text if part != "what" or not text["do"]))
        alike.setdefault(key, (diagnostic.severity, text, {}))[2].setdefault(text["what"], diagnostic.place)
    texts = []
    for severity, text, places in alike.values():
        shown, others = list(places)[:MOST_ALIKE], list(places.values())[MOST_ALIKE:]
        if others:
            shown.append(f"The same holds for {', '.join(dict.fromkeys(others)).replace('_', ' ')}.")
        texts.append((severity, text | {"what": " ".join(shown)}))
    return texts


def lines(diagnostics: Iterable[Diagnostic], titled: bool = False) -> list[tuple[Severity, str]]:
    """`render_all`, each in one line."""
    return [(severity, join_text(text, titled)) for severity, text in render_all(diagnostics)]


def notebook_html(value: object, diagnostics: Iterable[Diagnostic]) -> str:
    """Return what a notebook shows of an object: its one line, and diagnostics in words."""
    entries = "".join(f"<li>{severity}: {escape(line)}</li>" for severity, line in lines(diagnostics))
    return f"<p>{escape(repr(value))}</p>" + (f"<ul>{entries}</ul>" if entries else "")


def gravest_first(diagnostics: Iterable[Diagnostic]) -> list[Diagnostic]:
    """Sort errors, then warnings, then the rest, each in the order in which they came."""
    return sorted(diagnostics, key=lambda diagnostic: (ERROR, WARNING, INFO).index(diagnostic.severity))


def merge(diagnostics: Sequence[Diagnostic], others: Iterable[Diagnostic]) -> tuple[Diagnostic, ...]:
    """Append those of `others` whose code and place are not among the first: two rooms may find the same."""
    known = {(diagnostic.code, diagnostic.place) for diagnostic in diagnostics}
    return (*diagnostics, *(each for each in others if (each.code, each.place) not in known))


def drop_consequences(diagnostics: Iterable[Diagnostic]) -> list[Diagnostic]:
    """Leave out what follows from another diagnostic, as a tilted segment from a moved start pose."""
    diagnostics = list(diagnostics)
    codes = {diagnostic.code for diagnostic in diagnostics}
    return [each for each in diagnostics if codes.isdisjoint(catalogue()[each.code].get("follows", ()))]


def as_json(diagnostic: Diagnostic) -> dict[str, Any]:
    """Return the diagnostic with its text, for a JSON file; numbers that are not finite become null."""

    def convert(value: Any) -> Any:
        return value if value is None or isinstance(value, str) else float(value) if math.isfinite(value) else None

    facts = {name: convert(fact) for name, fact in diagnostic.facts.items()}
    own = {name: convert(getattr(diagnostic, name)) for name in ("code", "severity", "place", "value", "limit")}
    return own | {"facts": facts, "text": render(diagnostic)}


def from_json(content: Mapping[str, Any]) -> Diagnostic:
    """Return the diagnostic of `as_json`, whose text is not read; `ValueError`: no such severity."""
    severity, place, value, limit, facts = (content[name] for name in ("severity", "place", "value", "limit", "facts"))
    if severity not in (INFO, WARNING, ERROR):
        raise ValueError(f"severity '{severity}' is not known")
    return Diagnostic(content["code"], severity, place, value, limit, facts)


# Unit → factor from SI, name with the space before it, and least number of significant digits.
_UNITS = {
    "deg": (180.0 / math.pi, "°", 2),
    "deg/s": (180.0 / math.pi, "°/s", 2),
    "deg/min": (60.0 * 180.0 / math.pi, "°/min", 2),
    "rad/s": (1.0, " rad/s", 3),
    "mm": (1e3, " mm", 2),
    "m": (1.0, " m", 3),
    "m/s2": (1.0, " m/s²", 3),
    "s": (1.0, " s", 2),
    "ms": (1e3, " ms", 2),
    "time": (1.0, " s", 15),  # as it stands in the file
    "hz": (1.0, " Hz", 4),
    "kg": (1.0, " kg", 3),
    "percent": (100.0, " %", 2),
    "count": (1.0, "", 2),
    "number": (1.0, "", 2),
}


def quantity(value: float | None, unit: str) -> str:
    """Write a number in SI as a user reads it: ``quantity(0.5, "deg")`` is "29°"; of ``+deg`` with its sign."""
    factor, name, digits = _UNITS[unit.removeprefix("+")]
    if value is None or not math.isfinite(value):
        return "not known"
    shown = factor * value
    decimals = 3 if unit == "time" else max(0, min(6, digits - 1 - math.floor(math.log10(abs(shown))))) if shown else 0
    text = f"{shown:{'+' * unit.startswith('+')}.{decimals}f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text) + name


class _Formatter(Formatter):
    """Fills in a text: ``{value:deg}`` with its unit, ``{place:name}`` a name in words, ``{reason}`` as it is."""

    def format_field(self, value: Any, unit: str) -> str:
        return str(value).replace("_", " ") if unit == "name" else quantity(value, unit) if unit else str(value)


def _fill(template: str, known: Mapping[str, Any]) -> str:
    text = _Formatter().vformat(template, (), known).replace("  ", " ")  # a sensor alone has no name
    # A name at the beginning of a sentence; a file's name stays as it is.
    return text[:1].upper() + text[1:] if re.match(r"\{\w+:name\}", template) else text


@lru_cache(maxsize=1)
def catalogue() -> Mapping[str, Mapping[str, Any]]:
    """Return code → its table in diagnostics.toml."""
    groups = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    return {code: table for codes in groups.values() for code, table in codes.items()}
