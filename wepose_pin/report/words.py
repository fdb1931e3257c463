"""Words of the reports: names, numbers with their units, lists; and tables, which commands print as pages show them."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..body import BodyTable
from ..body.mounts import MEASURED_ORIENTATION_STD
from ..tracking import TrackResult


class Table(NamedTuple):
    """A table; a cell may hold `code` and **bold**."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def longest(self) -> int:
        """Letters of its longest cell: where those are sentences, columns are set to the left and may break."""
        return max((len(cell) for row in self.rows for cell in row), default=0)


def plain(name: str) -> str:
    """A segment's or point's name as people write it."""
    return name.replace("_", " ")


def plural(noun: str) -> str:
    """The plural of a segment's or point's name."""
    return {"foot": "feet"}.get(noun, f"{noun}s")


def kinds(table: BodyTable, names: Iterable[str]) -> list[str]:
    """What segments or points of a body are, without their sides: "left_elbow", "right_elbow" → "elbows"."""
    return [plural(name) for name in dict.fromkeys(plain(table.shared_name(name)) for name in names)]


def name_tips(table: BodyTable, points: Iterable[str]) -> str:
    """What these points whose path is drawn are on, as "hands"."""
    return listed(kinds(table, [(table.drawn_limbs[name].segments or (name,))[-1] for name in points]))


def explain_no_covariance(tracked: TrackResult) -> str:
    """What a ± means, or why there is none, where filter or device state no uncertainty."""
    if not tracked.recording.imus:
        return (
            f"The device states no uncertainty: each ± assumes that its orientations are right to "
            f"± {np.degrees(MEASURED_ORIENTATION_STD):.0f}° about each axis and that its headings do not drift."
        )
    return (
        f"The filter {tracked.options['method']} states no uncertainty: how far angles and positions may be off is not "
        "known. The methods amekf, smoother, smekf and smekf_published state it."
    )


def listed(parts: Sequence[str]) -> str:
    """``a, b and c``."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def number(value: float, digits: int = 1, unit: str = "", sign: str = "", unknown: str = "not known") -> str:
    """A number with its unit, its minus a minus; `sign` "+": with its sign."""
    if not np.isfinite(value):
        return unknown
    rounded = round(float(value), digits) + 0.0  # no minus zero
    return f"{rounded:{sign if rounded else ''}.{digits}f}".replace("-", "−") + unit


def spread(std: float, digits: int = 1, unit: str = "") -> str:
    """A standard deviation with its sign and unit."""
    return f"± {number(std, digits, unit)}" if np.isfinite(std) else "not known"


def plus_minus(value: float, std: float, unit: str = "", digits: int = 1) -> str:
    """A number with its standard deviation, where it is known, and its unit."""
    known = f" ± {std:.{digits}f}" if np.isfinite(value) and np.isfinite(std) else ""
    return number(value, digits, f"{known}{unit}")
