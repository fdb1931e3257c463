"""People of all sizes, and where the joints of their bodies are.

Nothing here knows the project: own names, own geometry. Frames: world z up; every segment's frame equals the world's
while the person stands upright, arms hanging, facing x (left is y). Metres, radians; rotations take segment to world.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

SIDES = ("left", "right")
CORE = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
EXTRA = ("pelvis", "head", "left_hand", "right_hand")
SEGMENTS = CORE + EXTRA

# Lengths as shares of stature: Winter, Biomechanics and Motor Control of Human Movement, Fig. 4.1 (Drillis & Contini);
# the middle of the palm at half of the hand. Spread of a person's share about it, one standard deviation, relative.
SHARES = {"trunk": 0.288, "shoulder_width": 0.21, "upper_arm": 0.159, "forearm": 0.150, "hand": 0.038}
SHARE_SPREAD = {"trunk": 0.04, "shoulder_width": 0.05, "upper_arm": 0.04, "forearm": 0.04, "hand": 0.1}
STATURE = {"f": (1.63, 0.07), "m": (1.76, 0.07)}  # [m] mean and standard deviation


@dataclass(frozen=True)
class Person:
    """A body: `lengths` [m] by name (trunk, shoulder_width, left_upper_arm, …), stature [m], sex f or m."""

    stature: float
    sex: str
    lengths: Mapping[str, float]


def draw_person(rng: np.random.Generator) -> Person:
    """Any adult; left and right differ by about a hundredth."""
    sex = str(rng.choice(["f", "m"]))
    mean, std = STATURE[sex]
    stature = float(np.clip(rng.normal(mean, std), 1.45, 2.05))
    share = {name: value * (1.0 + _within_two(rng) * SHARE_SPREAD[name]) for name, value in SHARES.items()}
    lengths = {name: share[name] * stature for name in ("trunk", "shoulder_width")}
    for side in SIDES:
        for name in ("upper_arm", "forearm", "hand"):
            lengths[f"{side}_{name}"] = share[name] * stature * (1.0 + 0.01 * _within_two(rng))
    return Person(stature, sex, lengths)


def _within_two(rng: np.random.Generator) -> float:
    return float(np.clip(rng.standard_normal(), -2.0, 2.0))


def joint_points(lengths: Mapping[str, float], R_WL: Mapping[str, Rotation]) -> dict[str, np.ndarray]:
    """Joint centres and palms (n, 3) [m] from the middle between the hips, of those whose segments are given.

    A hand that is not given is in line with its forearm.
    """
    points = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        if "torso" not in R_WL:
            break
        at = R_WL["torso"].apply([0.0, sign * lengths["shoulder_width"] / 2.0, lengths["trunk"]])
        points[f"{side}_shoulder"] = at
        carrier = ""
        for segment, point in (("upper_arm", "elbow"), ("forearm", "wrist"), ("hand", "palm")):
            name = f"{side}_{segment}"
            if name in R_WL:
                carrier = name
            elif segment != "hand" or not carrier:
                break
            at = at + R_WL[carrier].apply([0.0, 0.0, -lengths[name]])
            points[f"{side}_{point}"] = at
    return points


def segment_origins(lengths: Mapping[str, float], R_WL: Mapping[str, Rotation]) -> dict[str, np.ndarray]:
    """Where each segment's frame sits (n, 3) [m]: its joint with what carries it."""
    points = joint_points(lengths, R_WL)
    n = len(R_WL["torso"])
    origins = {"torso": np.zeros((n, 3)), "pelvis": np.zeros((n, 3))}
    origins["head"] = R_WL["torso"].apply([0.0, 0.0, lengths["trunk"] + 0.08])
    for side in SIDES:
        for segment, point in (("upper_arm", "shoulder"), ("forearm", "elbow"), ("hand", "wrist")):
            origins[f"{side}_{segment}"] = points[f"{side}_{point}"]
    return origins


def sensor_place(segment: str, lengths: Mapping[str, float], rng: np.random.Generator) -> np.ndarray:
    """Where a sensor is strapped, (3,) [m] in its segment's frame: where straps usually go, on the skin."""
    around = rng.uniform(-np.pi, np.pi)
    off = 0.04 * np.array([np.cos(around), np.sin(around), 0.0])
    if segment == "torso":
        return np.array([rng.choice([0.1, -0.1]), rng.normal(0.0, 0.02), lengths["trunk"] * rng.uniform(0.55, 0.9)])
    if segment == "pelvis":
        return np.array([-0.1, rng.normal(0.0, 0.02), rng.uniform(0.0, 0.1)])
    if segment == "head":
        return np.array([rng.choice([0.09, -0.1]), 0.0, rng.uniform(0.08, 0.15)])
    if segment.endswith("hand"):
        return np.array([0.0, rng.choice([0.02, -0.02]), -lengths[segment]])
    return off + np.array([0.0, 0.0, -lengths[segment] * rng.uniform(0.4, 0.85)])
