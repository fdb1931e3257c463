"""Words of the reports: names, numbers with their units, lists."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np

from ..body import BodyTable
from ..recording import format_span
from ..writers.result import versions as package_versions


def capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def slug(text: str) -> str:
    """A name as a file's or an anchor's: "upper body, realistic" → "upper-body-realistic"."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower().replace("'", "")).strip("-") or "experiment"


def plain(name: str) -> str:
    """A segment's or point's name as people write it."""
    return name.replace("_", " ")


def plural(noun: str) -> str:
    """The plural of a segment's or point's name."""
    return {"foot": "feet"}.get(noun, f"{noun}s")


def kinds(table: BodyTable, names: Iterable[str]) -> list[str]:
    """What segments or points of a body are, without their sides: "left_elbow", "right_elbow" → "elbows"."""
    return [plural(name) for name in dict.fromkeys(plain(table.shared_name(name)) for name in names)]


def listed(parts: Sequence[str]) -> str:
    """``a, b and c``."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def degrees(value: float) -> str:
    """An angle in degrees, to a tenth."""
    return f"{value:.1f}°" if np.isfinite(value) else "not known"


def intervals(spans: Sequence[tuple[float, float]]) -> str:
    """Intervals [s]."""
    return ", ".join(map(format_span, spans))


def plus_minus(value: float, std: float, unit: str, digits: int = 1) -> str:
    """A number with its standard deviation and its unit."""
    if not np.isfinite(value):
        return "not known"
    text = f"{value:.{digits}f}"
    return f"{text} ± {std:.{digits}f} {unit}" if np.isfinite(std) else f"{text} {unit}, ± not known"


def signed(value: float) -> str:
    """A number with its sign, to a tenth."""
    if not np.isfinite(value):
        return "not known"
    return f"{value:+.1f}".replace("-", "−") if abs(value) >= 0.05 else "0.0"


def whole(value: float) -> str:
    """A number without decimals, its minus a minus."""
    return f"{round(float(value)):d}".replace("-", "−") if np.isfinite(value) else "not known"


def versions() -> str:
    """What a report was made with."""
    return ", ".join(f"{name} {number}" for name, number in package_versions().items())
