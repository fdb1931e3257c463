"""What is out of the ordinary in a case: sensors that are broken, samples that are lost, a start pose not stated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .motion import GRAVITY
from .sensors import DEG, Errors

if TYPE_CHECKING:
    from .cases import Case

LONG_GAP_S = 0.05  # what is longer is said to need a consent


def draw_oddities(case: Case, rng: np.random.Generator) -> None:
    """What is out of the ordinary: in three cases of ten, and then one thing, now and then two."""
    draws = {
        "guessed": _guessed,
        "gap": _gap,
        "saturated": _saturated,
        "fault": _fault,
        "identical": _identical,
        "swapped": _swapped,
        "orientations": _orientations,
        "twice": _twice,
        "milliseconds": _milliseconds,
    }
    shares = np.array([4.0, 3.0, 3.0, 4.0, 1.0, 1.0, 3.0, 0.7, 0.5])
    if rng.random() > 0.35:
        unknown = [s for s, w in case.worn.items() if w.axes is None and w.orientation is None]
        if unknown and not case.clasp:
            case.refusal = "must: no mount is known"
        return
    chosen = rng.choice(list(draws), size=1 if rng.random() < 0.85 else 2, replace=False, p=shares / shares.sum())
    for name in sorted(chosen):
        draws[str(name)](case, rng)
    unknown = [s for s, w in case.worn.items() if w.axes is None]
    if unknown and not case.clasp:
        case.refusal = "must: no mount is known"


def _guessed(case: Case, _: np.random.Generator) -> None:
    if case.clasp:
        return  # a calibration needs its phases
    case.start = None
    case.about.append("no phases are stated")
    # Whoever lies or sits more calmly later on, within the beginning, is taken for standing.
    case.refusal = case.refusal or "may: the start pose can only be guessed"


def _gap(case: Case, rng: np.random.Generator) -> None:
    whole = rng.random() < 0.5
    segment = "" if whole and not case.clock.separate else str(rng.choice(list(case.worn)))
    long = rng.random() < 0.7
    step = 1.0 / case.clock.rate_hz
    lasts = rng.uniform(0.1, 4.0) if long else rng.uniform(1.0, max(1.01, 0.045 / step)) * step
    at = (
        rng.uniform(1.0, case.duration - lasts - 1.0)
        if rng.random() < 0.3
        else rng.uniform(case.stood[1] + 0.5, max(case.stood[1] + 0.6, case.duration - lasts - 0.5))
    )
    if case.clock.stamps == "none" and not segment:
        segment = next(iter(case.worn))
    case.clock.lost.append((float(at), float(lasts), segment))
    case.about.append(f"{segment or 'everything'} is lost for {lasts:.2f} s at {at:.1f} s")
    if lasts > LONG_GAP_S - step:
        if rng.random() < 0.85:
            case.options.add("gaps")
            if at < case.stood[1] and at + lasts > case.stood[0]:
                case.refusal = case.refusal or "may: samples are lost in the start pose"
            elif (
                case.clasp
                and case.stood[1] <= at < case.clasp[0] + 2.0
                and (case.method == "smekf" or any(sensor.axes is None for sensor in case.worn.values()))
            ):
                # An orientation is lost with the samples, and what joins it to the start pose tells how a sensor sits.
                case.refusal = case.refusal or "may: samples are lost between the start pose and joined hands"
        else:
            case.refusal = "must: samples are lost" if lasts > LONG_GAP_S + 3.0 * step else "may: samples are lost"


def _saturated(case: Case, rng: np.random.Generator) -> None:
    gyro, accel = rng.choice([125.0, 250.0, 500.0]) * DEG, rng.choice([2.0, 4.0, 16.0]) * GRAVITY
    for name, sensor in case.worn.items():
        e = sensor.errors
        sensor.errors = Errors(**{**e.__dict__, "gyro_range": gyro, "accel_range": accel})
        case.suspects.setdefault(name, "range")
    case.about.append(f"ranges are {gyro / DEG:.0f} deg/s and {accel / GRAVITY:.0f} g")


def _fault(case: Case, rng: np.random.Generator) -> None:
    name = str(rng.choice(list(case.worn)))
    sensor = case.worn[name]
    sensor.fault = str(rng.choice(["dead", "stuck", "frozen", "lost"], p=[0.3, 0.2, 0.35, 0.15]))
    sensor.fault_of = str(rng.choice(["gyro", "accel", "both"], p=[0.6, 0.1, 0.3]))
    sensor.fault_at = float(rng.uniform(case.stood[1] + 2.0, max(case.stood[1] + 2.1, 0.8 * case.duration)))
    case.suspects[name] = "fault"
    when = f" from {sensor.fault_at:.1f} s" if sensor.fault in ("frozen", "lost") else ""
    case.about.append(f"{sensor.fault_of} of {name} is {sensor.fault}{when}")
    case.refusal = case.refusal or f"may: {name} is broken"


def _identical(case: Case, rng: np.random.Generator) -> None:
    if len(case.worn) < 2 or case.clock.separate:
        return
    one, other = (str(v) for v in rng.choice(list(case.worn), size=2, replace=False))
    case.shared_columns[one] = other
    case.suspects |= {one: "identical", other: "identical"}
    case.about.append(f"{one} and {other} have the same columns")
    case.refusal = case.refusal or f"may: {one} and {other} are one sensor"


def _swapped(case: Case, rng: np.random.Generator) -> None:
    if case.clasp is None or case.clock.separate:
        return  # nothing in a recording without a closed chain tells of it; files of their own have clocks of their own
    one, other = [
        ("left_forearm", "right_forearm"),
        ("left_upper_arm", "left_forearm"),
        ("left_upper_arm", "right_upper_arm"),
    ][rng.integers(3)]
    case.shared_columns |= {one: other, other: one}
    case.suspects |= dict.fromkeys(case.worn, "swapped")
    case.about.append(f"{one} and {other} are swapped")
    case.refusal = case.refusal or f"may: {one} and {other} are swapped"


def _orientations(case: Case, rng: np.random.Generator) -> None:
    if any(sensor.axes is None for sensor in case.worn.values()):
        return
    case.options.discard("causal")  # where no filter runs, none runs causally
    for name, sensor in case.worn.items():
        if rng.random() < 0.5 or name == next(iter(case.worn)):
            sensor.orientation = float(rng.uniform(0.0, 1.0) * DEG)
    case.about.append("orientations from " + ", ".join(n for n, s in case.worn.items() if s.orientation is not None))


def _twice(case: Case, rng: np.random.Generator) -> None:
    if case.clock.stamps != "none":
        case.clock.twice = int(rng.integers(1, 6))
        case.about.append(f"{case.clock.twice} rows are written twice")
        case.refusal = case.refusal or "may: rows are written twice"


def _milliseconds(case: Case, rng: np.random.Generator) -> None:
    if case.clock.stamps != "none":
        case.clock.unit = str(rng.choice(["ms", "us"]))
        case.about.append(f"time is in {case.clock.unit}")
        case.refusal = "must: time is not in seconds"
