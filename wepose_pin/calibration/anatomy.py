"""What arms cannot do: elbows that bend backward, or sideways, tell sensors that sit elsewhere than the session says.

Joined hands close the chain for exchanged sensors as well: left for right, or upper arm for forearm of a side, give the
same gap to the last digit. The solution's elbows then bend backward, or about no axis at all. Any other exchange opens
the chain. Only where the labels as stated contradict anatomy are all others tried: first which closes the chain, then,
of those that the chain cannot tell apart, which is a person.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..alignment import STATED_LIMIT_DEG, STATED_WARNING_DEG, heading_to, nominal_mount
from ..diagnostics import ERROR, Diagnostic, Severity
from ..filters.sensors import FilteredRecording
from ..recording import Recording
from ..subject import Subject

E_Z = np.array([0.0, 0.0, 1.0])
SIDES = ("left", "right")
PARTS = ("upper_arm", "forearm")
PLACES = ("torso", *(f"{side}_{part}" for side in SIDES for part in PARTS))

# What a person's arms stay within; soft tissue, and headings some degrees off, included.
FLEXION_DEG = (-15.0, 165.0)  # 0 is straight
BACKWARD = 0.15  # share of looks out of that
SIDEWAYS_DEG = 14.0  # rms of the forearm off the plane in which it bends
BEHIND = 0.3  # share of looks with a hand further than `BACK` [m] behind the shoulders
BACK = 0.1
OPEN = 0.06  # [m] rms of the palm-to-palm gap
# Another labelling is the true one where it is within these limits, and this much nearer to them than the stated one.
BETTER = 0.6


class Arms(NamedTuple):
    """How the arms moved; angles [deg], shares of looks."""

    flexion: dict[str, np.ndarray]  # side → (n,) elbow, 0 straight, positive forward
    backward: dict[str, float]  # side → share of looks with the elbow out of its range
    sideways: dict[str, float]  # side → rms of the forearm off the plane in which it bends
    behind: float  # share of looks with a hand behind the shoulders
    gap: float  # [m] rms

    def doubt(self) -> float:
        """How far from a person: the worst of all over its limit."""
        return max(doubt for doubt, _ in self._doubts())

    def contradiction(self) -> Diagnostic:
        """What is worst."""
        return max(self._doubts(), key=lambda pair: pair[0])[1]

    def _doubts(self) -> list[tuple[float, Diagnostic]]:
        """Each value over its limit, and what it is about."""
        found = [
            ("calibration-hands-behind", "", self.behind, BEHIND),
            ("calibration-chain-open", "", self.gap, OPEN),
        ]
        found += [("calibration-elbow-backward", f"{s}_elbow", v, BACKWARD) for s, v in self.backward.items()]
        doubts = [(value / limit, Diagnostic(code, ERROR, place, value, limit)) for code, place, value, limit in found]
        for side, angle in self.sideways.items():
            sideways = np.deg2rad([angle, SIDEWAYS_DEG]).tolist()
            code = "calibration-elbow-sideways"
            doubts.append((angle / SIDEWAYS_DEG, Diagnostic(code, ERROR, f"{side}_elbow", *sideways)))
        return doubts


@dataclass(frozen=True)
class Labels:
    """Whether the sensors sit where the session says.

    Parameters
    ----------
    doubt : of the labels as stated, above 1 where a person cannot move so
    contradiction : what a person cannot do; None where all is well
    moved : segment → segment whose name the sensor on it carries, of the labelling that is a person's; empty where that
        is the stated one, or none is
    """

    doubt: float = 0.0
    contradiction: Diagnostic | None = None
    moved: Mapping[str, str] = field(default_factory=dict)

    def diagnostic(self, severity: Severity = ERROR) -> Diagnostic:
        """Which sensors sit elsewhere than labelled, or how far the arms move from a person's."""
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


def arms(quat_WL: Mapping[str, np.ndarray], lengths: Mapping[str, float], gap: float) -> Arms:
    """How the arms moved, of segment orientations (n, 4) xyzw where the palms touch."""
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
    return Arms(flexion, backward, sideways, max(behind, default=0.0), gap)


def check_labels(stated: Arms, solve: Callable[[Mapping[str, str]], Arms], places: Sequence[str]) -> Labels:
    """Whether the labels are a person's, and where they are not, which are.

    Parameters
    ----------
    stated : how the arms moved as the session labels them
    solve : segment → label of the sensor on it → how the arms moved then
    places : segments with sensors
    """
    doubt = stated.doubt()
    if doubt <= 1.0:
        return Labels(doubt)
    # Labellings that close the same chain, fewest moves first: one of each tells whether it closes.
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
        found = solve(labelling)
        if found.doubt() < best:
            best, moved = found.doubt(), labelling
    return Labels(doubt, stated.contradiction(), moved if best < min(1.0, BETTER * doubt) else {})


def relabelled(
    recording: Recording, found: FilteredRecording, moved: Mapping[str, str]
) -> tuple[Recording, FilteredRecording]:
    """The same with other sensors on the segments; a stated mount goes with its sensor."""

    def of(values: Mapping[str, Any]) -> dict[str, Any]:
        return {segment: values[moved.get(segment, segment)] for segment in values}

    return (
        replace(recording, sensors=of(recording.sensors)),
        found._replace(R_VS=of(found.R_VS), at_start=of(found.at_start)),
    )


def segments_at(found: FilteredRecording, mounts: Mapping[str, np.ndarray], at: np.ndarray) -> dict[str, np.ndarray]:
    """Segment → `quat_WL` (n, 4) xyzw at the samples `at`, of sensors with a mount `quat_LS`: as `track` would."""
    quat_WL = {}
    for name in found.R_VS.keys() & mounts.keys():
        R_LS = Rotation.from_quat(mounts[name])
        turn = Rotation.from_rotvec([0.0, 0.0, heading_to(found.at_start[name], R_LS)])
        quat_WL[name] = (turn * found.R_VS[name][at] * R_LS.inv()).as_quat()
    return {name: quat_WL[name] for name in found.R_VS if name in quat_WL}


def without_mounts(recording: Recording, prior: Subject, names: Collection[str]) -> tuple[Recording, Subject]:
    """The same, with nothing known of these sensors' mounts."""
    sensors = {
        name: replace(sensor, stated_quat_LS=None) if name in names else sensor
        for name, sensor in recording.sensors.items()
    }
    mounts = {name: mount for name, mount in prior.mounts.items() if name not in names}
    return replace(recording, sensors=sensors), replace(prior, mounts=mounts)


def against_gravity(recording: Recording, prior: Subject, found: FilteredRecording) -> dict[str, float]:
    """Segment → [deg] by which gravity in the start pose contradicts its mount, of those that cannot be meant so."""
    off = {}
    for name, at_start in found.at_start.items():
        mount = nominal_mount(recording, name, prior)
        if mount is not None and name in recording.imus:
            up_V = (at_start * Rotation.from_quat(mount).inv()).apply(E_Z)
            off[name] = float(np.degrees(np.arccos(np.clip(up_V[2], -1.0, 1.0))))
    return {name: angle for name, angle in off.items() if angle > STATED_LIMIT_DEG}


def against_motion(recording: Recording, prior: Subject, mounts: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Segment → [deg] by which its mount is off the one that was found without it, of those that cannot be meant so."""
    off = {}
    for name, quat_LS in mounts.items():
        mount = nominal_mount(recording, name, prior)
        if mount is not None and name in recording.imus:
            off[name] = float(np.degrees((Rotation.from_quat(quat_LS) * Rotation.from_quat(mount).inv()).magnitude()))
    return {name: angle for name, angle in off.items() if angle > STATED_WARNING_DEG}
