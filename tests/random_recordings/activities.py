"""What people do while they wear sensors: each activity draws curves of joint angles [rad] for its time.

Angles: trunk yaw, pitch (forward), roll (to the right); arm flex (forward), abd (outward), rot (inward), elbow, pron,
wrist. What an activity does not name hangs or is upright. Rates stay within what people reach and sensors measure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from .curves import Curve, Function, Steady, wave
from .people import SIDES, Person

DEG = np.pi / 180.0


@dataclass
class Activity:
    """Angles by name while it lasts; `for_good` adds to heading or root_x from then on; `calm`: the usual sway's share.

    `exact`: the arms are where `angles` say, without sway or the stance's own angles.
    """

    name: str
    angles: dict[str, Function] = field(default_factory=dict)
    for_good: dict[str, Function] = field(default_factory=dict)
    calm: float = 1.0
    detail: str = ""
    exact: bool = False


Draw = Callable[[np.random.Generator, Person, float, float], Activity]


def _arms(rng: np.random.Generator, **mean_deg: tuple[float, float]) -> dict[str, Function]:
    """Both arms alike but for a few degrees."""
    return {
        f"{side}_{name}": Curve(rng.uniform(low, high) * DEG)
        for side in SIDES
        for name, (low, high) in mean_deg.items()
    }


def stand(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    return Activity("stands", {f"{side}_elbow": Curve(abs(rng.normal(0.0, 2.0)) * DEG) for side in SIDES})


def sit(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    angles = _arms(rng, flex=(15, 40), abd=(5, 20), elbow=(50, 90), pron=(0, 50))
    angles |= {"root_z": Curve(-0.25 * person.stature), "torso_pitch": Curve(rng.uniform(-5, 15) * DEG)}
    return Activity("sits", angles, calm=0.6)


def lie(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    on = str(rng.choice(["back", "right side"]))
    pitch, roll = (-90.0, 0.0) if on == "back" else (0.0, 90.0)
    angles = _arms(rng, flex=(0, 30), abd=(5, 30), elbow=(5, 60))
    for part in ("torso", "pelvis"):
        angles |= {f"{part}_pitch": Curve((pitch + rng.normal(0, 3)) * DEG), f"{part}_roll": Curve(roll * DEG)}
    angles["root_z"] = Curve(-0.5 * person.stature)
    return Activity("lies", angles, calm=0.15, detail=f"on the {on}")


def sleep(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    activity = lie(rng, person, begin, end)
    return Activity("sleeps", activity.angles, calm=0.02, detail=activity.detail)


def type_(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    angles = sit(rng, person, begin, end).angles | _arms(rng, elbow=(80, 100), pron=(50, 75))
    for side in SIDES:
        pron, flex = angles[f"{side}_pron"], angles[f"{side}_flex"]
        assert isinstance(pron, Curve) and isinstance(flex, Curve)
        pron.waves += [wave(rng, rng.uniform(0.5, 2.0) * DEG, rng.uniform(2.0, 6.0)) for _ in range(2)]
        flex.waves += [wave(rng, rng.uniform(0.1, 0.5) * DEG, rng.uniform(0.3, 2.0)) for _ in range(2)]
    return Activity("types", angles, calm=0.5)


def read(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    angles = sit(rng, person, begin, end).angles | _arms(rng, flex=(30, 50), elbow=(80, 110), rot=(10, 30))
    angles["head_pitch"] = Curve(rng.uniform(15, 35) * DEG, [wave(rng, 2 * DEG, 0.2)])
    return Activity("reads", angles, calm=0.4)


def overhead(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    angles = _arms(rng, flex=(150, 172), elbow=(5, 40), rot=(-20, 20))
    for side in SIDES:
        curve = angles[f"{side}_flex"]
        assert isinstance(curve, Curve)
        curve.waves += [wave(rng, rng.uniform(1, 6) * DEG, rng.uniform(0.1, 0.8))]
    return Activity("arms overhead", angles)


def swing(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    frequency, amplitude = rng.uniform(1.2, 1.6), rng.uniform(55, 85)
    phase = rng.uniform(0, 2 * np.pi)
    both = rng.random() < 0.5
    angles: dict[str, Function] = {}
    for side in SIDES:
        opposite = 0.0 if both or side == "left" else np.pi
        angles[f"{side}_flex"] = Curve(20 * DEG, [(amplitude * DEG, frequency, phase + opposite)])
        angles[f"{side}_elbow"] = Curve(rng.uniform(5, 25) * DEG)
    peak = amplitude * 2 * np.pi * frequency
    return Activity("swings the arms", angles, detail=f"{frequency:.1f} Hz, {peak:.0f} deg/s")


def walk(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    step, phase = rng.uniform(1.6, 2.1), rng.uniform(0, 2 * np.pi)
    angles: dict[str, Function] = {
        "root_z": Curve(0.0, [(0.02, step, 2 * phase)]),
        "torso_yaw": Curve(0.0, [(4 * DEG, step / 2, phase)]),
        "pelvis_yaw": Curve(0.0, [(-5 * DEG, step / 2, phase)]),
        "torso_pitch": Curve(3 * DEG, [(1.0 * DEG, step, phase)]),
    }
    for side, sign in zip(SIDES, (1.0, -1.0)):
        angles[f"{side}_flex"] = Curve(5 * DEG, [(sign * rng.uniform(12, 25) * DEG, step / 2, phase)])
        angles[f"{side}_elbow"] = Curve(20 * DEG, [(sign * 8 * DEG, step / 2, phase)])
    way = {"root_x": Steady(begin, end, 1.0, rng.uniform(0.6, 1.4))}
    return Activity("walks", angles, way)


def drum(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    angles = _arms(rng, flex=(15, 30), abd=(5, 20), elbow=(75, 95), pron=(40, 70))
    for side in SIDES:
        curve = angles[f"{side}_elbow"]
        assert isinstance(curve, Curve)
        curve.waves += [wave(rng, rng.uniform(8, 20) * DEG, rng.uniform(2.5, 4.5))]
    return Activity("drums", angles)


def throw(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    side = str(rng.choice(SIDES))
    flex, elbow, yaw = Curve(-20 * DEG), Curve(90 * DEG), Curve(0.0)
    t, fastest = begin + 1.0, 1.0
    while t < end - 2.5:
        duration = rng.uniform(0.25, 0.5)
        fastest = min(fastest, duration)
        for curve, size in ((flex, rng.uniform(110, 150)), (elbow, -rng.uniform(50, 80)), (yaw, rng.uniform(10, 30))):
            curve.moves += [(t, duration, size * DEG), (t + duration + 0.2, 1.2, -size * DEG)]
        t += duration + rng.uniform(1.5, 4.0)
    angles: dict[str, Function] = {f"{side}_flex": flex, f"{side}_elbow": elbow, "torso_yaw": yaw}
    return Activity("throws", angles, detail=f"{side} arm, within {fastest:.2f} s")


def reach(rng: np.random.Generator, person: Person, begin: float, end: float, hanging: str = "") -> Activity:
    """Moves from place to place, with or without pauses."""
    limits = {"flex": (-20, 130), "abd": (0, 60), "rot": (-30, 40), "elbow": (5, 120), "pron": (-30, 60)}
    limits |= {"wrist": (-20, 30)}
    pause = rng.choice([0.1, 1.0, 5.0])
    names = [(side, name, of) for side in SIDES if side != hanging for name, of in limits.items()]
    curves = {f"{side}_{name}": Curve(rng.uniform(*of) * DEG * 0.3) for side, name, of in names}
    trunk = {"torso_yaw": (-30, 30), "torso_pitch": (-5, 25), "torso_roll": (-10, 10), "head_yaw": (-50, 50)}
    curves |= {name: Curve(0.0) for name in trunk}
    at = {name: curve.constant for name, curve in curves.items()}
    spans = {f"{side}_{name}": of for side, name, of in names} | trunk
    t = begin
    while t < end:
        duration = rng.uniform(0.5, 1.8)
        for name, (low, high) in spans.items():
            if rng.random() < (0.6 if "_" in name and name.split("_")[0] in SIDES else 0.25):
                target = rng.uniform(low, high) * DEG
                curves[name].moves.append((t, duration, target - at[name]))
                at[name] = target
        t += duration + rng.exponential(pause)
    return Activity("reaches about", dict(curves))


def one_arm_hangs(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    side = str(rng.choice(SIDES))
    activity = reach(rng, person, begin, end, hanging=side)
    return Activity("works with one arm", activity.angles, detail=f"the {side} one hangs")


def turn_on_spot(rng: np.random.Generator, person: Person, begin: float, end: float) -> Activity:
    """An office chair, or slowly on foot: a steady rate about the vertical, either way."""
    on_chair = rng.random() < 0.6
    activity = (sit if on_chair else stand)(rng, person, begin, end)
    rate = float(np.exp(rng.uniform(np.log(2.0), np.log(180.0 if on_chair else 60.0))) * rng.choice([-1, 1]))
    turn = Steady(begin + 0.5, end - 0.5, min(rng.uniform(0.3, 1.5), (end - begin - 1.0) / 3.0), rate * DEG)
    where = "on an office chair" if on_chair else "on foot"
    about = f"{where}, {rate:.1f} deg/s"
    return Activity("turns on the spot", activity.angles, {"heading": turn}, rng.uniform(0.1, 0.5), about)


def clasp(rng: np.random.Generator, person: Person, begin: float, end: float, span: float = 1.0) -> Activity:
    """Palms together, moved freely in front of the body: elbows follow by inverse kinematics."""
    arm = {side: [person.lengths[f"{side}_upper_arm"], _palm(person, side)] for side in SIDES}
    shoulder = {
        side: np.array([0.0, sign * person.lengths["shoulder_width"] / 2.0, person.lengths["trunk"]])
        for side, sign in zip(SIDES, (1.0, -1.0))
    }
    least = min(sum(lengths) for lengths in arm.values())
    size = span * least * np.array([0.2, 0.6, 1.1])
    path = [Curve(0.0, [wave(rng, float(s) / 3.0, rng.uniform(0.1, 0.5)) for _ in range(3)]) for s in size]
    middle = np.array([0.6 * least, 0.0, person.lengths["trunk"] - 0.1 * least])
    swivel = {side: Curve(rng.uniform(15, 45) * DEG, [wave(rng, 12 * span * DEG, rng.uniform(0.05, 0.3))]) for side in SIDES}
    pron = {
        side: Curve(rng.uniform(20, 50) * DEG, [wave(rng, 20 * span * DEG, rng.uniform(0.05, 0.3))]) for side in SIDES
    }
    times = np.linspace(begin, end, 400)
    offsets = np.column_stack([curve(times) for curve in path])
    scale = 1.0
    for _ in range(40):
        gaps = [np.linalg.norm(middle + scale * offsets - shoulder[s], axis=1) / sum(arm[s]) for s in SIDES]
        if max(g.max() for g in gaps) < 0.95 and min(g.min() for g in gaps) > 0.4:
            break
        scale *= 0.92

    def angle(side: str, name: str) -> Function:
        def of(t: np.ndarray) -> np.ndarray:
            hands = middle + scale * np.column_stack([curve(t) for curve in path])
            return arm_angles(side, hands - shoulder[side], *arm[side], swivel[side](t))[name]

        return of

    angles: dict[str, Function] = {}
    for side in SIDES:
        angles |= {f"{side}_{name}": angle(side, name) for name in ("flex", "abd", "rot", "elbow")}
        angles[f"{side}_pron"] = pron[side]
    for name, degrees in (("yaw", 20.0), ("pitch", 12.0), ("roll", 8.0)):
        angles[f"torso_{name}"] = Curve(0.0, [wave(rng, span * degrees * DEG, rng.uniform(0.08, 0.25))])
    detail = "" if span > 0.5 else "hardly moving them"
    return Activity("joins the hands", angles, exact=True, detail=detail)


def _palm(person: Person, side: str) -> float:
    return person.lengths[f"{side}_forearm"] + person.lengths[f"{side}_hand"]


def arm_angles(side: str, palm: np.ndarray, upper: float, lower: float, swivel: np.ndarray) -> Mapping[str, np.ndarray]:
    """Angles of a two-link arm whose palm is at `palm` (n, 3) [m] from the shoulder; the elbow hangs, `swivel` lifts it."""
    outward = 1.0 if side == "left" else -1.0
    reach_ = np.linalg.norm(palm, axis=1)
    along = palm / reach_[:, None]
    down = np.array([0.0, 0.0, -1.0]) + along * along[:, 2:3]
    down /= np.linalg.norm(down, axis=1)[:, None]
    aside = np.cross(along, down)
    aside *= np.sign(aside[:, 1] * outward)[:, None]
    cosine = (upper**2 + reach_**2 - lower**2) / (2.0 * upper * reach_)
    sine = np.sqrt(1.0 - cosine**2)
    off = np.cos(swivel)[:, None] * down + np.sin(swivel)[:, None] * aside
    first = cosine[:, None] * along + sine[:, None] * off
    second = (palm - upper * first) / lower
    bend = np.arccos(np.clip(np.sum(first * second, axis=1), -1.0, 1.0))
    x = second - np.sum(first * second, axis=1)[:, None] * first
    x /= np.linalg.norm(x, axis=1)[:, None]
    z = -first
    R = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=2))
    flex, abd, rot = R.as_euler("YXZ").T
    return {"flex": -flex, "abd": outward * abd, "rot": -outward * rot, "elbow": bend}


# How often each is drawn, and how long it lasts at least and at most [s].
ACTIVITIES: dict[str, tuple[Draw, float, float, float]] = {
    "stand": (stand, 1.0, 3.0, 20.0),
    "sit": (sit, 1.0, 5.0, 20.0),
    "lie": (lie, 0.6, 6.0, 20.0),
    "sleep": (sleep, 0.5, 20.0, 60.0),
    "type": (type_, 0.9, 6.0, 30.0),
    "read": (read, 0.8, 6.0, 30.0),
    "overhead": (overhead, 0.7, 4.0, 12.0),
    "swing": (swing, 0.8, 4.0, 12.0),
    "walk": (walk, 1.2, 5.0, 20.0),
    "drum": (drum, 0.7, 4.0, 12.0),
    "throw": (throw, 0.8, 6.0, 15.0),
    "reach": (reach, 2.0, 5.0, 30.0),
    "one_arm_hangs": (one_arm_hangs, 1.2, 5.0, 30.0),
    "turn": (turn_on_spot, 1.6, 5.0, 60.0),
}
