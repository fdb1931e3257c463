"""Tables that more than one command prints."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from .output import print_table

if TYPE_CHECKING:
    from ..evaluation import PositionError
    from ..subject import Subject


def print_lengths(
    title: str,
    subject: Subject,
    prior: Subject,
    measured: Collection[str],
    truth: Mapping[str, float] | None = None,
    prior_name: str = "population prior",
) -> None:
    """Each length with its standard deviation beside the prior's, and the truth where it is known."""
    rows = []
    for name, value in subject.lengths.items():
        true = [] if truth is None else [f"{1e3 * truth[name]:.1f}"]
        before = f"{1e3 * prior.lengths[name]:.1f} ± {1e3 * prior.std(name):.1f}"
        cells = f"{1e3 * value:.1f}", f"± {1e3 * subject.std(name):.1f}", before
        rows.append((name, *true, *cells, "measured" if name in measured else ""))
    columns = [] if truth is None else ["true"]
    print_table(title, ("length [mm]", *columns, "estimated", "std", prior_name, ""), rows)


def mean_std(error: PositionError) -> str:
    """``mean ± std`` [mm]."""
    return f"{error.mean:.1f} ± {error.std:.1f}"
