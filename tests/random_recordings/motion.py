"""A person's motion as a function of time: activities one after another, joined smoothly, with sway and breath."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .activities import DEG, Activity
from .curves import Curve, rise, wander
from .people import SIDES, Person, joint_points, segment_origins
from .quaternions import rotation, times, turned

STEP_S = 1e-3  # of the differences that give accelerations: truncation below 1e-3 m/s² at 2 Hz
GRAVITY = 9.80665  # [m/s²]

ANGLES = [f"{part}_{name}" for part in ("torso", "pelvis", "head") for name in ("yaw", "pitch", "roll")]
ANGLES += [f"{side}_{name}" for side in SIDES for name in ("flex", "abd", "rot", "elbow", "pron", "wrist")]


@dataclass
class Motion:
    """Activities with the times at which each begins, and the sway that lies over all.

    `begins` [s] has one entry an activity, the first of them is not looked at: it lasted since ever. `joins` [s] is how
    long the change to each takes. `stance` are angles by which this person's upright stance is off.
    """

    person: Person
    activities: Sequence[Activity]
    begins: Sequence[float]
    joins: Sequence[float]
    sway: dict[str, Curve]
    stance: dict[str, float]
    bending: frozenset[str] = frozenset()  # sides whose wrist bends; else the hand is in line with the forearm

    def angles(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """All angles [rad] and root_x, _y, _z [m], each (n,)."""
        values = {name: np.zeros(len(t)) for name in [*ANGLES, "heading", "root_x", "root_y", "root_z"]}
        calm, free = np.zeros(len(t)), np.ones(len(t))
        for k, activity in enumerate(self.activities):
            if k == 0 or self.begins[k] < t.max():
                for name, lasting in activity.for_good.items():
                    values[name] += lasting(t)
            weight = self._begun(k, t) - self._begun(k + 1, t)
            on = np.flatnonzero(weight)
            if not len(on):
                continue
            calm += weight * activity.calm
            free -= weight * activity.exact
            for name, curve in activity.angles.items():
                values[name][on] += weight[on] * curve(t[on])
        for name, curve in self.sway.items():
            values[name] += calm * curve(t) * (free if name.startswith(SIDES) else 1.0)
        for name, value in self.stance.items():
            values[name] += value * (free if name.startswith(SIDES) else 1.0)
        values["torso_yaw"] += values["heading"]
        values["pelvis_yaw"] += values["heading"]
        return values

    def _begun(self, k: int, t: np.ndarray) -> np.ndarray:
        """How far the change to the k-th activity has come (n,), 0 to 1."""
        if k == len(self.activities) or (k > 0 and self.begins[k] > t.max()):
            return np.zeros(len(t))
        if k == 0 or self.begins[k] + self.joins[k] < t.min():
            return np.ones(len(t))
        return rise((t - self.begins[k]) / self.joins[k])

    def orientations(self, t: np.ndarray) -> dict[str, Rotation]:
        """Segment → n rotations to the world."""
        return self._orientations(self.angles(t))

    def _orientations(self, a: dict[str, np.ndarray]) -> dict[str, Rotation]:
        q = {
            part: turned("ZYX", *(a[f"{part}_{name}"] for name in ("yaw", "pitch", "roll")))
            for part in ("torso", "pelvis", "head")
        }
        q["head"] = times(q["torso"], q["head"])
        for side, out in zip(SIDES, (1.0, -1.0), strict=True):
            arm = turned("YXZ", -a[f"{side}_flex"], out * a[f"{side}_abd"], -out * a[f"{side}_rot"])
            q[f"{side}_upper_arm"] = times(q["torso"], arm)
            lower = turned("YZ", -a[f"{side}_elbow"], -out * a[f"{side}_pron"])
            q[f"{side}_forearm"] = times(q[f"{side}_upper_arm"], lower)
            wrist = turned("Y", -a[f"{side}_wrist"] * (side in self.bending))
            q[f"{side}_hand"] = times(q[f"{side}_forearm"], wrist)
        return {name: rotation(value) for name, value in q.items()}

    def points(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """Joint centres and palms (n, 3) [m] from the root."""
        return joint_points(self.person.lengths, self.orientations(t))

    def origins(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """Where each segment's frame sits (n, 3) [m], from the root."""
        return segment_origins(self.person.lengths, self.orientations(t))

    def at_sensors(
        self, t: np.ndarray, places: dict[str, np.ndarray]
    ) -> tuple[dict[str, Rotation], dict[str, np.ndarray]]:
        """Orientations of segments, and specific force (n, 3) [m/s²] in the world where their sensors are."""
        positions, R = [], {}
        for shift in (-STEP_S, STEP_S, 0.0):
            a = self.angles(t + shift)
            R = self._orientations(a)
            origins = segment_origins(self.person.lengths, R)
            root = np.column_stack([a["root_x"], a["root_y"], a["root_z"]])
            positions.append({s: root + origins[s] + R[s].apply(place) for s, place in places.items()})
        before, after, now = positions
        force = {s: (before[s] - 2.0 * now[s] + after[s]) / STEP_S**2 + np.array([0.0, 0.0, GRAVITY]) for s in places}
        return {s: R[s] for s in places}, force


def draw_sway(rng: np.random.Generator) -> tuple[dict[str, Curve], float]:
    """Sway of someone who stands, and its size: root mean square rate [rad/s] of the trunk; and breath."""
    size = rng.uniform(0.2, 0.6) * DEG
    sway = {name: wander(rng, size) for name in ("torso_yaw", "torso_pitch", "torso_roll")}
    sway |= {f"pelvis_{name}": wander(rng, 0.5 * size) for name in ("yaw", "pitch", "roll")}
    sway |= {f"head_{name}": wander(rng, size) for name in ("yaw", "pitch")}
    for side in SIDES:
        sway |= {f"{side}_{name}": wander(rng, 0.6 * size) for name in ("flex", "abd", "rot", "elbow", "pron")}
    sway["torso_pitch"].waves.append((0.25 * DEG, float(rng.uniform(0.2, 0.3)), float(rng.uniform(0, 6.28))))
    return sway, size


def draw_stance(rng: np.random.Generator) -> dict[str, float]:
    """How this person's upright stance is off the ideal: a degree or two at each joint [rad]."""
    parts = [name for name in ANGLES if not name.endswith(("elbow", "pelvis_yaw", "torso_yaw", "wrist"))]
    return {name: float(rng.normal(0.0, 1.0 if name.startswith(("torso", "pelvis")) else 1.5)) * DEG for name in parts}
