"""Diagnostics of what the motion of a calibration does not show, and of assumptions in its place."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from ..body import BodyModel
from ..diagnostics import INFO, WARNING, Diagnostic
from ..recording import format_span, format_time
from .conditions import Loop, choose_variant, find_segments
from .least_squares import Observations
from .problem import CalibrationProblem
from .protocols import PROTOCOLS, load_protocol
from .result import MIN_CONTACT

MOST_OPEN = 0.10  # share of a phase in which the closure may be open
MOST_INTERVALS = 3  # of an open closure that are named, the longest


def diagnose_lengths(
    problem: CalibrationProblem,
    lengths: np.ndarray,
    covariance: np.ndarray,
    prior_covariance: np.ndarray,
    free_scale_std: float | None,
) -> list[Diagnostic]:
    """Lengths and scale that the motion does not determine.

    Parameters
    ----------
    lengths, covariance : (8,) [m] and (8, 8) [m²] with the motion
    prior_covariance : (8, 8) [m²] without it, with measured lengths
    free_scale_std : relative, where no length was measured
    """
    protocol, prior = problem.protocol, problem.prior
    names: dict[str, float | str] = {"protocol": protocol.title, "prior": prior.note or prior.name}
    if not protocol.closures:
        return [Diagnostic("lengths-not-observed", INFO, facts=names)]
    diagnostics = []
    if free_scale_std is not None:
        facts = names | {"variant": "prior", "measured": problem.measured_example}
        diagnostics.append(Diagnostic("scale-uncertain", INFO, value=free_scale_std, facts=facts))
    # Closures show proportions: those must be known better than from the prior and the measured lengths.
    names_of_lengths = list(problem.model.lengths)
    chain = {name: names_of_lengths.index(name) for name in problem.lengths_in_closures}
    first = [k for name, k in chain.items() if _is_first(problem, name)]
    others = [k for k in chain.values() if k not in first]
    after, before = (C / np.outer(lengths, lengths) for C in (covariance, prior_covariance))
    for a, b in product(first, others):
        if after[a, a] + after[b, b] - 2.0 * after[a, b] < 0.5 * (before[a, a] + before[b, b] - 2.0 * before[a, b]):
            return diagnostics
    if first:
        diagnostics.append(Diagnostic("lengths-not-observed", WARNING, facts=names | {"variant": "hardly"}))
    return diagnostics


def _is_first(problem: CalibrationProblem, length: str) -> bool:
    """Return whether a length is that of a limb's first segment."""
    segments, parents = problem.model.table.segments, problem.model.parents
    own = [part.segment for part in problem.model.table.lengths[length].stretches]
    if any(segments[name].spine or segments[name].rigid_without_sensor for name in own):
        return False
    return all((above := parents[name]) is None or segments[above].spine for name in own)


def diagnose_mounts(segments: Sequence[str], problem: CalibrationProblem) -> list[Diagnostic]:
    """Sensors whose mount neither the session states nor this protocol estimates."""
    diagnostics = []
    for segment in segments:
        facts: dict[str, float | str] = {"protocol": problem.protocol.name}
        others = [name for name in PROTOCOLS if segment in find_segments(load_protocol(name), problem.model)]
        facts |= {"protocols": ", ".join(others)} if others else {"variant": "stated-only"}
        diagnostics.append(Diagnostic("mount-unknown", WARNING, segment, facts=facts))
    return diagnostics


def diagnose_closures(
    time: np.ndarray, contact: np.ndarray, observations: Observations, model: BodyModel
) -> list[Diagnostic]:
    """The share and the intervals in which each closure was open."""
    diagnostics = []
    for closure, span in observations.spans():
        apart = contact[span] < MIN_CONTACT
        if isinstance(closure, Loop) and apart.any():
            facts = {
                "intervals": format_longest(find_intervals(time[span], apart)),
                "variant": choose_variant(closure.closure, model.table),
            }
            share = float(apart.mean())
            diagnostics.append(Diagnostic("closure-open", INFO, closure.closure.phase, share, MOST_OPEN, facts))
    return diagnostics


def find_intervals(time: np.ndarray, mask: np.ndarray) -> list[tuple[float, float]]:
    """Intervals [s] in which `mask` (n,) bool holds, at times (n,) [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.view(np.int8), [0]))))
    return [(float(time[a]), float(time[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def format_longest(intervals: Sequence[tuple[float, float]]) -> str:
    """The text of the longest intervals [s], in the order of time."""
    longest = sorted(intervals, key=lambda interval: interval[0] - interval[1])[:MOST_INTERVALS]
    rounded = [(round(a, 1) + 0.0, round(b, 1) + 0.0) for a, b in sorted(longest)]  # without a negative zero
    return ", ".join(f"{format_time(a)} s" if a == b else format_span((a, b)) for a, b in rounded)
