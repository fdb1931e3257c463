"""A case: all that a seed decides, from the person's size to the commands that are given.

Each room of chance has a stream of its own, so that a change in one leaves the others as they were.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from .activities import ACTIVITIES, Activity, Scene, clasp, reach, stand, swing, walk
from .motion import Motion, draw_stance, draw_sway
from .oddities import draw_oddities
from .people import CORE, SIDES, Person, draw_person, sensor_place
from .sensors import DEG, Worn, axes_rotation, draw_errors

METHODS = {"amekf": 0.4, "smoother": 0.15, "smekf": 0.2, "ncf": 0.12, "gdc": 0.13}
RATES = {25: 1, 50: 2, 60: 2, 100: 6, 120: 1, 148: 1, 200: 2, 240: 0.7, 400: 0.7, 1000: 0.7, 2000: 0.4}
MOST_SAMPLES = 24_000  # of a recording


@dataclass
class Clock:
    """When a sensor samples and what the file says of it.

    `stamps`: even, rounded (to a millisecond), jitter (of the stamps), uneven (of the sampling), packets (of four,
    which are stamped as they arrive), none (the rate is stated). `origin` [s] is what the file's clock shows at time
    zero; `separate`: every sensor has its file, its own clock and rate. `twice`: rows written twice.
    """

    rate_hz: float
    stamps: str = "even"
    origin: float = 0.0
    separate: bool = False
    unit: str = "s"
    lost: list[tuple[float, float, str]] = field(default_factory=list)  # begin [s], duration [s], segment or "" for all
    twice: int = 0

    @property
    def late(self) -> float:
        """How far [s] a stamp may be off."""
        step = 1.0 / self.rate_hz
        late = {"jitter": 0.35 * step, "packets": 4.0 * step, "rounded": 1e-3}
        return late.get(self.stamps, 0.0) + (1e-6 if self.origin else 0.0)


@dataclass
class Layout:
    """How the file is written."""

    suffix: str = ".csv"
    gyro_in_deg: bool = False
    accel_in_g: bool = False
    digits: int = 9


@dataclass
class Case:
    """A recording and what is done with it.

    `refusal`: "" where each command must be accepted; else why a command may be ("may: …") or has to be ("must: …")
    refused. `suspects`: segments of which nothing may be believed, with the fault; a word on them is wanted.
    """

    seed: int
    person: Person
    motion: Motion
    worn: dict[str, Worn]
    clock: Clock
    layout: Layout
    duration: float
    start: tuple[float, float] | None  # [s] the start pose as stated; None: not stated
    stood: tuple[float, float]  # [s] in which the person does stand in it
    clasp: tuple[float, float] | None
    begins_in_motion: bool
    method: str
    options: set[str]
    steps: list[str]
    measured: dict[str, float]
    refusal: str = ""
    suspects: dict[str, str] = field(default_factory=dict)
    shared_columns: dict[str, str] = field(default_factory=dict)  # segment → whose columns the file gives it
    about: list[str] = field(default_factory=list)

    def describe(self) -> str:
        """What the case holds, in one paragraph."""
        return f"seed {self.seed}: " + "; ".join(self.about) + "."

    def stream(self, name: str) -> np.random.Generator:
        return stream(self.seed, name)

    def noise(self, sensor: str) -> np.random.Generator:
        """Random numbers of one sensor's errors, the same each time."""
        return stream(self.seed, f"noise-{sensor}")


def stream(seed: int, name: str) -> np.random.Generator:
    """Random numbers of one room of a seed."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def draw_case(seed: int, ordinary: bool = False) -> Case:
    """The case of a seed: always the same; `ordinary`: without what is out of the ordinary."""
    person = draw_person(stream(seed, "person"))
    clock = _clock(stream(seed, "clock"))
    rng = stream(seed, "motion")
    calibrates = rng.random() < 0.35
    sensors = _segments(stream(seed, "segments"), calibrates)
    activities, begins, joins, spans, duration, in_motion = _timeline(rng, person, clock.rate_hz, calibrates)
    sway, size = draw_sway(stream(seed, "sway"))
    bending = frozenset(side for side in SIDES if f"{side}_hand" in sensors)
    motion = Motion(person, activities, begins, joins, sway, draw_stance(stream(seed, "stance")), bending)
    worn, mounts = _worn(stream(seed, "sensors"), sensors, person, calibrates)
    stated, layout = spans["start"], _layout(stream(seed, "files"))
    about = (duration, stated, stated, spans.get("clasp"), in_motion)
    case = Case(seed, person, motion, worn, clock, layout, *about, "amekf", set(), [], {})
    case.about += [
        f"{person.sex}, {person.stature:.2f} m, sways {size / DEG:.1f} deg/s",
        f"{len(worn)} sensors ({mounts}): {', '.join(worn)}",
        f"{duration:.0f} s at {clock.rate_hz:g} Hz, clock {clock.stamps}"
        + (f" from {clock.origin:g} s" if clock.origin else "")
        + (", one file a sensor" if clock.separate else ""),
        "then ".join(
            f"{a.name}{f' ({a.detail})' if a.detail else ''} from {b:.1f} s "
            for a, b in zip(activities, begins, strict=True)
        ),
        f"start pose stated {spans['start'][0]:.2f} to {spans['start'][1]:.2f} s",
    ]
    _commands(case, stream(seed, "commands"))
    if not ordinary:
        draw_oddities(case, stream(seed, "oddities"))
    case.about.append(f"by {case.method} {' '.join(sorted(case.options))}, then {', '.join(case.steps)}")
    return case


def _clock(rng: np.random.Generator) -> Clock:
    rates, weights = np.array(list(RATES)), np.array(list(RATES.values()))
    clock = Clock(float(rng.choice(rates, p=weights / weights.sum())))
    kinds = {"even": 0.6, "none": 0.1, "rounded": 0.08, "jitter": 0.1, "uneven": 0.06, "packets": 0.06}
    clock.stamps = str(rng.choice(list(kinds), p=list(kinds.values())))
    if clock.stamps == "rounded" and clock.rate_hz > 200.0:
        clock.stamps = "even"
    if clock.stamps != "none":
        clock.origin = float(
            rng.choice([0.0, rng.uniform(1.0, 5000.0), 1.7e9 + rng.uniform(0, 1e6)], p=[0.65, 0.15, 0.2])
        )
    clock.separate = clock.stamps == "even" and clock.rate_hz <= 400 and rng.random() < 0.12
    return clock


def _segments(rng: np.random.Generator, calibrates: bool) -> tuple[str, ...]:
    """Which segments wear a sensor."""
    kind = rng.random()
    extra = tuple(s for s in ("pelvis", "head") if rng.random() < 0.5)
    hands = tuple(f"{side}_hand" for side in SIDES if rng.random() < 0.7)
    side = str(rng.choice(SIDES))
    if kind < 0.6:
        return CORE
    if kind < 0.78 or calibrates:
        return CORE + extra + hands
    if kind < 0.92:
        return ("torso", f"{side}_upper_arm", f"{side}_forearm", *((f"{side}_hand",) if rng.random() < 0.3 else ()))
    return tuple(s for s in CORE if rng.random() < 0.75) or ("torso",)


def _timeline(
    rng: np.random.Generator, person: Person, rate_hz: float, calibrates: bool
) -> tuple[list[Activity], list[float], list[float], dict[str, tuple[float, float]], float, bool]:
    """Activities with begins and joins [s], the spans of the phases, the duration, whether it begins in motion."""
    most = MOST_SAMPLES / rate_hz
    total = min(most, float(np.exp(rng.uniform(np.log(20.0), np.log(120.0)))))
    held = float(np.exp(rng.uniform(np.log(0.6), np.log(10.0))))
    held = min(held, 0.4 * total)
    in_motion = bool(rng.random() < 0.25) and total > 20.0
    t = rng.uniform(3.0, 8.0) if in_motion else 0.0
    activities, begins, joins = [stand(Scene(rng, person, 0.0, t))], [0.0], [1.0]
    if in_motion:
        before = [reach, walk, swing][rng.integers(3)]
        activities = [before(Scene(rng, person, 0.0, t)), activities[0]]
        begins, joins = [0.0, t], [1.0, rng.uniform(0.8, 1.5)]
        t += joins[-1] + 0.3
    first = t + rng.uniform(0.0, 1.5)
    spans = {"start": (first, first + held)}
    t = first + held + 0.2
    names = list(ACTIVITIES)
    weights = np.array([ACTIVITIES[name][1] for name in names])
    clasped = not calibrates
    while True:
        join = rng.uniform(0.9, 2.0)
        left = total - t - join
        if not clasped:
            lasts = min(rng.uniform(30.0, 65.0), max(left, 20.0))
            moved = float(rng.choice([1.0, 0.2], p=[0.88, 0.12]))
            activity = clasp(Scene(rng, person, t, t + join + lasts), moved)
            spans["clasp"] = (t + join + 0.1, t + join + lasts - 0.1)
            clasped = True
        elif left < 3.0:
            break
        else:
            draw, _, least, longest = ACTIVITIES[str(rng.choice(names, p=weights / weights.sum()))]
            lasts = min(rng.uniform(least, longest), max(left, 3.0))
            activity = draw(Scene(rng, person, t + join, t + join + lasts))
        if activity.name in ("lies", "sleeps") or activities[-1].name in ("lies", "sleeps"):
            join = max(join, rng.uniform(1.8, 3.0))
        activities.append(activity)
        begins.append(t)
        joins.append(join)
        t += join + lasts
    return activities, begins, joins, spans, max(t, spans["start"][1] + 1.0), in_motion


def _worn(
    rng: np.random.Generator, segments: tuple[str, ...], person: Person, calibrates: bool
) -> tuple[dict[str, Worn], str]:
    """Sensors strapped on, nearly as stated or anyhow; and which of both in words."""
    anyhow = rng.random() < (0.3 if calibrates else 0.02)
    pairs = [(a, b) for a in "+x -x +y -y +z -z".split() for b in "+x -x +y -y +z -z".split() if a[1] != b[1]]
    common = pairs[rng.integers(len(pairs))]
    most = rng.choice([3.0, 10.0, 20.0])
    worn = {}
    for segment in segments:
        axes = common if rng.random() < 0.7 else pairs[rng.integers(len(pairs))]
        off = rng.standard_normal(3)
        off *= rng.uniform(0.0, most) * DEG / np.linalg.norm(off)
        mount = Rotation.random(random_state=rng) if anyhow else Rotation.from_rotvec(off) * axes_rotation(*axes)
        place = sensor_place(segment, person.lengths, rng)
        worn[segment] = Worn(segment, place, mount, None if anyhow else axes, draw_errors(rng))
    return worn, "mounts not stated" if anyhow else f"mounts within {most:g} deg of the stated"


def _layout(rng: np.random.Generator) -> Layout:
    suffix, in_deg, in_g = str(rng.choice([".csv", ".parquet"])), rng.random() < 0.5, rng.random() < 0.4
    return Layout(suffix, bool(in_deg), bool(in_g), int(rng.choice([7, 9, 15])))


def _commands(case: Case, rng: np.random.Generator) -> None:
    """Method, options, and what follows `track`."""
    case.method = str(rng.choice(list(METHODS), p=list(METHODS.values())))
    options = {"covariance": 0.3, "report": 0.2, "causal": 0.12, "torques": 0.04}
    for option, share in options.items():
        if rng.random() < share and not (option == "causal" and case.method == "smoother"):
            case.options.add(option)
    rng.random()  # of an option that there was: a seed keeps its case
    whole = case.method == "smoother" or bool(case.options & {"causal", "torques"})  # not tracked in chunks
    steps = ["calibrate"] if case.clasp else []
    steps.append("track")
    after = {"evaluate": 0.3, "view": 0.15, "export": 0.5, "info": 0.15, "again": 0.1, "chunks": 0.3, "retarget": 0.03}
    for step, share in after.items():
        if rng.random() < share and not (step == "chunks" and whole):
            steps.append(step)
    case.steps = steps
    if case.clasp:
        if rng.random() < 0.6:
            case.measured["shoulder_width"] = round(case.person.lengths["shoulder_width"] + rng.normal(0.0, 0.004), 3)
        if rng.random() < 0.5:
            case.measured["stature"] = round(case.person.stature + rng.normal(0.0, 0.01), 2)
