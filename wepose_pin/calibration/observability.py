"""What the motion of a calibration does not show, and what was assumed in its place, as diagnostics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..diagnostics import INFO, WARNING, Diagnostic
from ..recording import span_text
from ..subject import LENGTHS, Subject
from .problem import K, Looks
from .protocols import PROTOCOLS, Closure, Protocol, load_protocol
from .weighing import TOUCHED

LOOSE_SCALE = 0.6  # of the prior's relative standard deviation, from which on a measured length is said to tell little
LEAST_LOOSE_SCALE = 0.025  # ... but not below this: a measured shoulder width leaves about 2 %
MOST_OPEN = 0.10  # share of a phase in which the closure may be open
MOST_INTERVALS = 3  # of an open closure that are named, the longest


def unobserved_lengths(
    protocol: Protocol,
    lengths: np.ndarray,
    covariance: np.ndarray,
    without_data: np.ndarray,
    prior: Subject,
    free_scale_std: float | None,
) -> list[Diagnostic]:
    """What the motion does not determine of the lengths; `free_scale_std`: relative, where no length was measured."""
    names: dict[str, float | str] = {"protocol": protocol.title, "prior": prior.note or prior.name}
    if not protocol.closures:
        return [Diagnostic("lengths-not-observed", INFO, facts=names)]
    found = []
    if free_scale_std is not None:
        facts = names | {"measured": protocol.tape}
        found.append(Diagnostic("scale-from-prior", INFO, value=free_scale_std, facts=facts))
    arms = [LENGTHS.index(name) for name in protocol.chain if name.endswith(("upper_arm", "forearm"))]
    share = np.zeros(K)
    share[arms] = 1.0 / lengths[arms] / max(len(arms), 1)
    scale_std, before = (float(np.sqrt(share @ C @ share)) for C in (covariance, prior.lengths_covariance()))
    limit = max(LOOSE_SCALE * before, LEAST_LOOSE_SCALE)
    if free_scale_std is None and scale_std > limit:
        found.append(Diagnostic("scale-uncertain", WARNING, "", scale_std, limit, {"measured": protocol.tape}))
    # Closures tell proportions: those must be known better than from the prior and the measured lengths.
    arms = [LENGTHS.index(name) for name in protocol.chain if name.endswith("upper_arm")]
    for a, b in ((arm, other) for arm in arms for other in map(LENGTHS.index, protocol.chain) if other not in arms):
        share = np.zeros(K)
        share[a], share[b] = 1.0 / lengths[a], -1.0 / lengths[b]
        if share @ covariance @ share < 0.5 * share @ without_data @ share:
            break
    else:
        found.append(Diagnostic("lengths-mostly-prior", WARNING, facts={"protocol": protocol.title}))
    return found


def assumed_distances(protocol: Protocol, gauge: Mapping[str, float]) -> list[Diagnostic]:
    """Distances of the protocol that nobody measured."""
    return [
        Diagnostic("protocol-distance-assumed", INFO, c.gauge, c.metres, facts={"metres": f"{c.metres:g}"})
        for c in protocol.closures
        if c.gauge and c.gauge not in gauge
    ]


def unknown_mounts(segments: Sequence[str], protocol: Protocol) -> list[Diagnostic]:
    """Sensors whose mount neither the session states nor this protocol finds."""
    found = []
    for segment in segments:
        facts: dict[str, float | str] = {"protocol": protocol.name}
        others = [name for name in PROTOCOLS if segment in load_protocol(name).segments]
        facts |= {"protocols": ", ".join(others)} if others else {"variant": "stated-only"}
        found.append(Diagnostic("mount-unknown", WARNING, segment, facts=facts))
    return found


def open_closures(time: np.ndarray, kept: np.ndarray, looks: Looks) -> list[Diagnostic]:
    """The share and the moments at which each closure was open."""
    found = []
    for closure, span in looks.spans():
        apart = kept[span] < TOUCHED
        if isinstance(closure, Closure) and apart.any():
            facts = {"intervals": longest_intervals(intervals_of(time[span], apart)), "variant": closure.kind}
            share = float(apart.mean())
            found.append(Diagnostic("closure-open", INFO, closure.phase, share, MOST_OPEN, facts))
    return found


def intervals_of(time: np.ndarray, which: np.ndarray) -> list[tuple[float, float]]:
    """From when to when [s] `which` (n,) bool holds, at the times (n,) [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], which.view(np.int8), [0]))))
    return [(float(time[a]), float(time[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def longest_intervals(intervals: Sequence[tuple[float, float]]) -> str:
    """The longest of some intervals [s], in the order of time."""
    longest = sorted(intervals, key=lambda interval: interval[0] - interval[1])[:MOST_INTERVALS]
    return ", ".join(span_text((round(a, 1), round(b, 1))) for a, b in sorted(longest))
