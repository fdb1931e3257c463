"""What people do while they wear sensors: each activity draws curves of joint angles [rad] for its time.

Angles: trunk yaw, pitch (forward), roll (to the right); arm flex (forward), abd (outward), rot (inward), elbow, pron,
wrist. What an activity does not name hangs or is upright. Rates stay within what people reach and sensors measure.
"""

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
    angles: Mapping[str, Function] = field(default_factory=dict)
    for_good: Mapping[str, Function] = field(default_factory=dict)
    calm: float = 1.0
    detail: str = ""
    exact: bool = False


@dataclass(frozen=True)
class Scene:
    """Chance, the person, and from when to when [s] an activity lasts."""

    rng: np.random.Generator
    person: Person
    begin: float
    end: float


Draw = Callable[[Scene], Activity]


def _arms(rng: np.random.Generator, **mean_deg: tuple[float, float]) -> dict[str, Curve]:
    """Both arms alike but for a few degrees."""
    return {
        f"{side}_{name}": Curve(rng.uniform(low, high) * DEG)
        for side in SIDES
        for name, (low, high) in mean_deg.items()
    }


def stand(scene: Scene) -> Activity:
    return Activity("stands", {f"{side}_elbow": Curve(abs(scene.rng.normal(0.0, 2.0)) * DEG) for side in SIDES})


def _seated(scene: Scene) -> dict[str, Curve]:
    angles = _arms(scene.rng, flex=(15, 40), abd=(5, 20), elbow=(50, 90), pron=(0, 50))
    angles |= {"root_z": Curve(-0.25 * scene.person.stature), "torso_pitch": Curve(scene.rng.uniform(-5, 15) * DEG)}
    return angles


def sit(scene: Scene) -> Activity:
    return Activity("sits", _seated(scene), calm=0.6)


def lie(scene: Scene) -> Activity:
    on = str(scene.rng.choice(["back", "right side"]))
    pitch, roll = (-90.0, 0.0) if on == "back" else (0.0, 90.0)
    angles = _arms(scene.rng, flex=(0, 30), abd=(5, 30), elbow=(5, 60))
    for part in ("torso", "pelvis"):
        angles |= {f"{part}_pitch": Curve((pitch + scene.rng.normal(0, 3)) * DEG), f"{part}_roll": Curve(roll * DEG)}
    angles["root_z"] = Curve(-0.5 * scene.person.stature)
    return Activity("lies", angles, calm=0.15, detail=f"on the {on}")


def sleep(scene: Scene) -> Activity:
    activity = lie(scene)
    return Activity("sleeps", activity.angles, calm=0.02, detail=activity.detail)


def type_(scene: Scene) -> Activity:
    angles = _seated(scene) | _arms(scene.rng, elbow=(80, 100), pron=(50, 75))
    for side in SIDES:
        pron, flex = angles[f"{side}_pron"], angles[f"{side}_flex"]
        pron.waves += [
            wave(scene.rng, scene.rng.uniform(0.5, 2.0) * DEG, scene.rng.uniform(2.0, 6.0)) for _ in range(2)
        ]
        flex.waves += [
            wave(scene.rng, scene.rng.uniform(0.1, 0.5) * DEG, scene.rng.uniform(0.3, 2.0)) for _ in range(2)
        ]
    return Activity("types", angles, calm=0.5)


def read(scene: Scene) -> Activity:
    angles = _seated(scene) | _arms(scene.rng, flex=(30, 50), elbow=(80, 110), rot=(10, 30))
    angles["head_pitch"] = Curve(scene.rng.uniform(15, 35) * DEG, [wave(scene.rng, 2 * DEG, 0.2)])
    return Activity("reads", angles, calm=0.4)


def overhead(scene: Scene) -> Activity:
    angles = _arms(scene.rng, flex=(150, 172), elbow=(5, 40), rot=(-20, 20))
    for side in SIDES:
        curve = angles[f"{side}_flex"]
        curve.waves += [wave(scene.rng, scene.rng.uniform(1, 6) * DEG, scene.rng.uniform(0.1, 0.8))]
    return Activity("arms overhead", angles)


def swing(scene: Scene) -> Activity:
    frequency, amplitude = scene.rng.uniform(1.2, 1.6), scene.rng.uniform(55, 85)
    phase = scene.rng.uniform(0, 2 * np.pi)
    both = scene.rng.random() < 0.5
    angles: dict[str, Function] = {}
    for side in SIDES:
        opposite = 0.0 if both or side == "left" else np.pi
        angles[f"{side}_flex"] = Curve(20 * DEG, [(amplitude * DEG, frequency, phase + opposite)])
        angles[f"{side}_elbow"] = Curve(scene.rng.uniform(5, 25) * DEG)
    peak = amplitude * 2 * np.pi * frequency
    return Activity("swings the arms", angles, detail=f"{frequency:.1f} Hz, {peak:.0f} deg/s")


def walk(scene: Scene) -> Activity:
    step, phase = scene.rng.uniform(1.6, 2.1), scene.rng.uniform(0, 2 * np.pi)
    angles: dict[str, Function] = {
        "root_z": Curve(0.0, [(0.02, step, 2 * phase)]),
        "torso_yaw": Curve(0.0, [(4 * DEG, step / 2, phase)]),
        "pelvis_yaw": Curve(0.0, [(-5 * DEG, step / 2, phase)]),
        "torso_pitch": Curve(3 * DEG, [(1.0 * DEG, step, phase)]),
    }
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        angles[f"{side}_flex"] = Curve(5 * DEG, [(sign * scene.rng.uniform(12, 25) * DEG, step / 2, phase)])
        angles[f"{side}_elbow"] = Curve(20 * DEG, [(sign * 8 * DEG, step / 2, phase)])
    way = {"root_x": Steady(scene.begin, scene.end, 1.0, scene.rng.uniform(0.6, 1.4))}
    return Activity("walks", angles, way)


def drum(scene: Scene) -> Activity:
    angles = _arms(scene.rng, flex=(15, 30), abd=(5, 20), elbow=(75, 95), pron=(40, 70))
    for side in SIDES:
        curve = angles[f"{side}_elbow"]
        curve.waves += [wave(scene.rng, scene.rng.uniform(8, 20) * DEG, scene.rng.uniform(2.5, 4.5))]
    return Activity("drums", angles)


def throw(scene: Scene) -> Activity:
    side = str(scene.rng.choice(SIDES))
    flex, elbow, yaw = Curve(-20 * DEG), Curve(90 * DEG), Curve(0.0)
    t, fastest = scene.begin + 1.0, 1.0
    while t < scene.end - 2.5:
        duration = scene.rng.uniform(0.25, 0.5)
        fastest = min(fastest, duration)
        for curve, size in (
            (flex, scene.rng.uniform(110, 150)),
            (elbow, -scene.rng.uniform(50, 80)),
            (yaw, scene.rng.uniform(10, 30)),
        ):
            curve.moves += [(t, duration, size * DEG), (t + duration + 0.2, 1.2, -size * DEG)]
        t += duration + scene.rng.uniform(1.5, 4.0)
    angles: dict[str, Function] = {f"{side}_flex": flex, f"{side}_elbow": elbow, "torso_yaw": yaw}
    return Activity("throws", angles, detail=f"{side} arm, within {fastest:.2f} s")


def reach(scene: Scene, hanging: str = "") -> Activity:
    """Moves from place to place, with or without pauses."""
    limits = {"flex": (-20, 130), "abd": (0, 60), "rot": (-30, 40), "elbow": (5, 120), "pron": (-30, 60)}
    limits |= {"wrist": (-20, 30)}
    pause = scene.rng.choice([0.1, 1.0, 5.0])
    names = [(side, name, of) for side in SIDES if side != hanging for name, of in limits.items()]
    curves = {f"{side}_{name}": Curve(scene.rng.uniform(*of) * DEG * 0.3) for side, name, of in names}
    trunk = {"torso_yaw": (-30, 30), "torso_pitch": (-5, 25), "torso_roll": (-10, 10), "head_yaw": (-50, 50)}
    curves |= {name: Curve(0.0) for name in trunk}
    at = {name: curve.constant for name, curve in curves.items()}
    spans = {f"{side}_{name}": of for side, name, of in names} | trunk
    t = scene.begin
    while t < scene.end:
        duration = scene.rng.uniform(0.5, 1.8)
        for name, (low, high) in spans.items():
            if scene.rng.random() < (0.6 if "_" in name and name.split("_")[0] in SIDES else 0.25):
                target = scene.rng.uniform(low, high) * DEG
                curves[name].moves.append((t, duration, target - at[name]))
                at[name] = target
        t += duration + scene.rng.exponential(pause)
    return Activity("reaches about", dict(curves))


def one_arm_hangs(scene: Scene) -> Activity:
    side = str(scene.rng.choice(SIDES))
    activity = reach(scene, hanging=side)
    return Activity("works with one arm", activity.angles, detail=f"the {side} one hangs")


def turn_on_spot(scene: Scene) -> Activity:
    """An office chair, or slowly on foot: a steady rate about the vertical, either way."""
    rng, lasts = scene.rng, scene.end - scene.begin
    on_chair = rng.random() < 0.6
    activity = (sit if on_chair else stand)(scene)
    rate = float(np.exp(rng.uniform(np.log(2.0), np.log(180.0 if on_chair else 60.0))) * rng.choice([-1, 1]))
    turn = Steady(scene.begin + 0.5, scene.end - 0.5, min(rng.uniform(0.3, 1.5), (lasts - 1.0) / 3.0), rate * DEG)
    where = "on an office chair" if on_chair else "on foot"
    about = f"{where}, {rate:.1f} deg/s"
    return Activity("turns on the spot", activity.angles, {"heading": turn}, rng.uniform(0.1, 0.5), about)


def clasp(scene: Scene, span: float = 1.0) -> Activity:
    """Palms together, moved freely in front of the body: elbows follow by inverse kinematics."""
    rng, person = scene.rng, scene.person
    arm = {side: [person.lengths[f"{side}_upper_arm"], _palm(person, side)] for side in SIDES}
    shoulder = {
        side: np.array([0.0, sign * person.lengths["shoulder_width"] / 2.0, person.lengths["trunk"]])
        for side, sign in zip(SIDES, (1.0, -1.0), strict=True)
    }
    least = min(sum(lengths) for lengths in arm.values())
    size = span * least * np.array([0.2, 0.6, 1.1])
    path = [Curve(0.0, [wave(rng, float(s) / 3.0, rng.uniform(0.1, 0.5)) for _ in range(3)]) for s in size]
    middle = np.array([0.6 * least, 0.0, person.lengths["trunk"] - 0.1 * least])
    swivel = {
        side: Curve(rng.uniform(15, 45) * DEG, [wave(rng, 12 * span * DEG, rng.uniform(0.05, 0.3))]) for side in SIDES
    }
    pron = {
        side: Curve(rng.uniform(20, 50) * DEG, [wave(rng, 20 * span * DEG, rng.uniform(0.05, 0.3))]) for side in SIDES
    }
    times = np.linspace(scene.begin, scene.end, 400)
    offsets = np.column_stack([curve(times) for curve in path])
    scale = 1.0
    for _ in range(40):
        gaps = [np.linalg.norm(middle + scale * offsets - shoulder[s], axis=1) / sum(arm[s]) for s in SIDES]
        if max(g.max() for g in gaps) < 0.95 and min(g.min() for g in gaps) > 0.4:
            break
        scale *= 0.92
    # Joints blend into and out of the activity, so that it is followed a little before and after as well.
    around = np.column_stack([curve(np.linspace(scene.begin - 5.0, scene.end + 5.0, 2000)) for curve in path])
    while (
        max(np.max(np.linalg.norm(middle + scale * around - shoulder[s], axis=1)) / sum(arm[s]) for s in SIDES) > 0.99
    ):
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
    """Angles of a two-link arm whose palm is `palm` (n, 3) [m] from the shoulder; `swivel` lifts the elbow."""
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
