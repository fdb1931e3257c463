"""Anatomical limits of the arms, which show sensors that sit on other segments than the session says.

Joined hands close the chain for some exchanged sensors as well: left for right, or upper arm for forearm of a side,
give the same gap. The solution's elbows then bend backward, or sideways. Any other exchange opens the chain. Where the
stated labels contradict anatomy, all others are tried: first which of them close the chain, then which of these have
the arms of a person.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..diagnostics import ERROR, Diagnostic, Severity

E_Z = np.array([0.0, 0.0, 1.0])
SIDES = ("left", "right")
PARTS = ("upper_arm", "forearm")
PLACES = ("torso", *(f"{side}_{part}" for side in SIDES for part in PARTS))

# Limits of a person's arms, with soft tissue and headings some degrees off.
FLEXION_DEG = (-15.0, 165.0)  # 0 is straight
BACKWARD = 0.15  # share of samples out of that
SIDEWAYS_DEG = 14.0  # rms of the forearm off the plane in which it bends
BEHIND = 0.3  # share of samples with a hand further than `BACK` [m] behind the shoulders
BACK = 0.1
OPEN = 0.06  # [m] rms of the palm-to-palm gap
BETTER = 0.6  # times the doubt of the stated labels, below which another labelling is the true one


class ArmMotion(NamedTuple):
    """How the arms moved; angles [deg], shares of samples."""

    flexion: dict[str, np.ndarray]  # side → (n,) elbow, 0 straight, positive forward
    backward: dict[str, float]  # side → share of samples with the elbow out of its range
    sideways: dict[str, float]  # side → rms of the forearm off the plane in which it bends
    behind: float  # share of samples with a hand behind the shoulders
    gap: float  # [m] rms

    def doubt(self) -> float:
        """The largest ratio of a value to its limit; above 1 a person cannot move so."""
        return max(doubt for doubt, _ in self._doubts())

    def contradiction(self) -> Diagnostic:
        """The value that is furthest beyond its limit."""
        return max(self._doubts(), key=lambda pair: pair[0])[1]

    def _doubts(self) -> list[tuple[float, Diagnostic]]:
        """The ratio of each value to its limit, and its diagnostic."""
        values = [
            ("calibration-hands-behind", "", self.behind, BEHIND),
            ("calibration-chain-open", "", self.gap, OPEN),
        ]
        values += [("calibration-elbow-backward", f"{s}_elbow", v, BACKWARD) for s, v in self.backward.items()]
        doubts = [(value / limit, Diagnostic(code, ERROR, place, value, limit)) for code, place, value, limit in values]
        for side, angle in self.sideways.items():
            sideways = np.deg2rad([angle, SIDEWAYS_DEG]).tolist()
            code = "calibration-elbow-sideways"
            doubts.append((angle / SIDEWAYS_DEG, Diagnostic(code, ERROR, f"{side}_elbow", *sideways)))
        return doubts


@dataclass(frozen=True)
class LabelCheck:
    """Whether the sensors sit where the session says.

    Parameters
    ----------
    doubt : of the stated labels, above 1 where a person cannot move so
    contradiction : the movement that a person cannot make; None where all is well
    moved : segment → label of the sensor on it, of the labelling with a person's arms; empty where that is the stated
        one, or none is
    """

    doubt: float = 0.0
    contradiction: Diagnostic | None = None
    moved: Mapping[str, str] = field(default_factory=dict)

    def diagnostic(self, severity: Severity = ERROR) -> Diagnostic:
        """The sensors that sit on other segments, or the movement that a person cannot make."""
        if not self.moved:
            return Diagnostic("arm-motion-implausible", severity, "", self.doubt, 1.0)
        pairs = {tuple(sorted(pair, key=PLACES.index)) for pair in self.moved.items()}
        exchanged = all(self.moved[b] == a for a, b in self.moved.items())
        variant = {} if exchanged else {"variant": "mixed"}
        place = ", ".join(f"{label} sits on the {place}" for place, label in sorted(self.moved.items()))
        if exchanged:
            place = ", ".join(f"{a} and {b}" for a, b in sorted(pairs))
            if pairs == {(f"left_{part}", f"right_{part}") for part in PARTS}:
                variant = {"variant": "sides"}
        return Diagnostic("sensors-exchanged", severity, place, self.doubt, 1.0, variant)


def measure_arms(quat_WL: Mapping[str, np.ndarray], lengths: Mapping[str, float], gap: float) -> ArmMotion:
    """How the arms moved, from segment orientations (n, 4) xyzw where the palms touch."""
    R = {name: Rotation.from_quat(quat) for name, quat in quat_WL.items()}
    flexion, backward, sideways, behind = {}, {}, {}, []
    for side in SIDES:
        if f"{side}_upper_arm" not in R or f"{side}_forearm" not in R:
            continue
        upper, fore = R[f"{side}_upper_arm"], R[f"{side}_forearm"]
        along = (upper.inv() * fore).apply(-E_Z)
        flexion[side] = angle = np.degrees(np.arctan2(along[:, 0], -along[:, 2]))
        backward[side] = float(np.mean((angle < FLEXION_DEG[0]) | (angle > FLEXION_DEG[1])))
        sideways[side] = float(np.degrees(np.linalg.svd(along, compute_uv=False)[-1] / np.sqrt(len(along))))
        reach = upper.apply(-E_Z) * lengths[f"{side}_upper_arm"]
        reach = reach + fore.apply(-E_Z) * (lengths[f"{side}_forearm"] + lengths[f"{side}_hand"])
        if "torso" in R:
            behind.append(float(np.mean(R["torso"].inv().apply(reach)[:, 0] < -BACK)))
    return ArmMotion(flexion, backward, sideways, max(behind, default=0.0), gap)


def check_labels(
    stated: ArmMotion, solve: Callable[[Mapping[str, str]], ArmMotion], places: Sequence[str]
) -> LabelCheck:
    """Whether the stated labels give a person's arms, and where they do not, the labelling that does.

    Parameters
    ----------
    stated : how the arms moved with the stated labels
    solve : segment → label of the sensor on it → how the arms moved with these
    places : segments with sensors
    """
    doubt = stated.doubt()
    if doubt <= 1.0:
        return LabelCheck(doubt)
    # Labellings that close the same chain, fewest moves first: one of each shows whether it closes.
    alike: dict[frozenset, list[dict[str, str]]] = {}
    places = [place for place in PLACES if place in places]
    for order in permutations(places):
        moved = dict(zip(places, order, strict=True))
        sides = frozenset(frozenset(moved[p] for p in places if p.startswith(side)) for side in SIDES)
        alike.setdefault(sides, []).append({a: b for a, b in moved.items() if a != b})
    gaps = {}
    for sides, labellings in alike.items():
        labellings.sort(key=len)
        gaps[sides] = solve(labellings[0]).gap
    best, moved = np.inf, dict[str, str]()
    closing = [sides for sides, gap in gaps.items() if gap < OPEN and gap < 2.0 * min(gaps.values())]
    for labelling in (labelling for sides in closing for labelling in alike[sides]):
        arms = solve(labelling)
        if arms.doubt() < best:
            best, moved = arms.doubt(), labelling
    return LabelCheck(doubt, stated.contradiction(), moved if best < min(1.0, BETTER * doubt) else {})
