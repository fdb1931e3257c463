"""What the user should know of a calibration besides its numbers: a line each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..alignment import mount_advice
from ..subject import LENGTHS, Subject
from .problem import K, Layout, Looks
from .protocols import Closure, Protocol
from .weighing import CONTRADICTED, TOUCHED, Tape

LOOSE_SCALE = 0.6  # of the prior's relative standard deviation, from which on a gauge is said to tell little
LEAST_LOOSE_SCALE = 0.025  # ... but not below this: a taped shoulder width leaves about 2 %
UNUSUAL = 4.0  # standard deviations of a length from the average person's, from which on it is said
UNSEEN_HEADING_STD = np.deg2rad(15.0)  # [rad] from which on a heading is said to be unknown
# What it means that a closure does not hold.
OPEN = {
    "coincide": "the palms were apart",
    "fixed_point": "the palm was off its point",
    "distance": "the hands did not keep their distance",
}


def on_lengths(
    protocol: Protocol,
    lengths: np.ndarray,
    covariance: np.ndarray,
    without_data: np.ndarray,
    prior: Subject,
    free_scale_std: float | None,
    tapes: Mapping[str, Tape],
) -> list[str]:
    """What the user should know of the result; `free_scale_std`: relative, where no gauge fixes the scale."""
    lines = []
    if not protocol.closures:
        return [
            f"what was done ({protocol.title}) tells headings and no length: those are the average person's "
            f"({prior.note or prior.name}), or taped"
        ]
    if free_scale_std is not None:
        lines.append(
            f"no gauge in the chain: what was done ({protocol.title}) fixes the proportions, not the scale, which is "
            f"the prior's ({prior.note or prior.name}): all lengths may be off together by "
            f"{100 * free_scale_std:.1f} %; tape one, as in --measured {protocol.tape}"
        )
    arms = [LENGTHS.index(name) for name in protocol.chain if name.endswith(("upper_arm", "forearm"))]
    share = np.zeros(K)
    share[arms] = 1.0 / lengths[arms] / max(len(arms), 1)
    scale_std, before = (float(np.sqrt(share @ C @ share)) for C in (covariance, prior.lengths_covariance()))
    if free_scale_std is None and scale_std > max(LOOSE_SCALE * before, LEAST_LOOSE_SCALE):
        lines.append(
            f"the gauge hardly tells the scale of the arms, which may be off together by {100 * scale_std:.1f} %: "
            f"tape another length, as in --measured {protocol.tape}"
        )
    contradicted = [tape.said(name) for name, tape in tapes.items() if tape.off > CONTRADICTED]
    lines += contradicted
    off = {n: (at - prior.lengths[n]) / prior.std(n) for n, at in zip(LENGTHS, lengths, strict=True)}
    unusual = [name for name in off if abs(off[name]) > UNUSUAL]
    if unusual and not contradicted:
        each = ", ".join(f"{name} by {abs(off[name]):.1f}" for name in unusual)
        lines.append(
            f"lengths far from the average person's, in standard deviations: {each}; check mounts, phases and the gauge"
        )
    # Closures tell proportions: those must be known better than from the average person and the tape.
    arms = [LENGTHS.index(name) for name in protocol.chain if name.endswith("upper_arm")]
    for a, b in ((arm, other) for arm in arms for other in map(LENGTHS.index, protocol.chain) if other not in arms):
        share = np.zeros(K)
        share[a], share[b] = 1.0 / lengths[a], -1.0 / lengths[b]
        if share @ covariance @ share < 0.5 * share @ without_data @ share:
            break
    else:
        lines.append(
            f"too little motion ({protocol.title}) to tell the lengths, which are mostly the average person's: move "
            f"through the whole reach"
        )
    return lines


def on_headings(protocol: Protocol, layout: Layout, covariance: np.ndarray, gauge: Mapping[str, float]) -> list[str]:
    """What the protocol, as it was done, does not tell."""
    lines = []
    std = np.sqrt(np.diag(covariance)[layout.heading])
    if np.any(std > UNSEEN_HEADING_STD):
        said = ", ".join(
            f"{name} ± {np.degrees(s):.0f} deg"
            for name, s in zip(layout.sensors, std, strict=True)
            if s > UNSEEN_HEADING_STD
        )
        lines.append(f"headings that the motion hardly told: {said}; move through more of the reach, trunk as well")
    lines += [
        f"{closure.gauge} = {closure.metres:g} m is the protocol's, not measured: give yours, as in --measured "
        f"{closure.gauge}={closure.metres:g}"
        for closure in protocol.closures
        if closure.gauge and closure.gauge not in gauge
    ]
    return lines


def on_unseen(unseen: Sequence[str], protocol: Protocol) -> list[str]:
    """Sensors whose mount neither the session states nor this protocol finds."""
    if not unseen:
        return []
    return [
        f"protocol '{protocol.name}' does not see {', '.join(unseen)}: no mount is stated for them and none is found; "
        f"before `wepose track`, {mount_advice(unseen)}"
    ]


def on_looks(time: np.ndarray, kept: np.ndarray, looks: Looks) -> list[str]:
    """A line on the moments at which each closure was open."""
    lines = []
    for closure, span in looks.spans():
        apart = kept[span] < TOUCHED
        if not isinstance(closure, Closure) or not apart.any():
            continue
        edges = span.start + np.flatnonzero(np.diff(np.concatenate(([0], apart.view(np.int8), [0]))))
        spans = [(time[a], time[b - 1]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        longest = sorted(spans, key=lambda span: span[0] - span[1])[:3]
        said = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in sorted(longest))
        lines.append(f"{OPEN[closure.kind]} for {100 * apart.mean():.0f} % of the phase, left out: {said}")
    return lines
