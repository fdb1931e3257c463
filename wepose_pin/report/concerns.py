"""What to look at before one believes a tracked recording: in words, with what to do."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ..recording import OrientationSensor
from ..recording.limits import STANDARD_GRAVITY
from ..tracking import TrackedRecording
from .measures import BENT, Budget, Elbow, Hand, Signal, between, from_start, largest, longest
from .words import capital, listed, plain

GRAVITY_OFF = 0.02
BIAS_LARGE = np.deg2rad(1.5)  # [rad/s], three times what is usual from the factory
BIAS_MOVED = np.deg2rad(0.3)  # [rad/s]
LITTLE_REST, LONG_MOTION_S = 0.02, 120.0
LATE_START_S = 10.0
LOST = 0.01  # share of samples
JITTER = 0.2  # of a step, one standard deviation
HEADING = np.deg2rad(10.0)  # one standard deviation, between the segments of a joint
PLACE = 0.1  # [m], one standard deviation of a hand: what 10 deg of heading do at the end of an arm
TURNED_DEG = 10.0  # by which elbows and joined hands turned a heading
# An elbow: what the start pose calls straight is bent by some 5 to 15 deg, and few elbows open by more than 10 beyond.
BACKWARD, FOLDED = np.deg2rad(-20.0), np.deg2rad(160.0)
ASIDE = np.deg2rad(30.0)
APART = np.deg2rad(15.0)  # between the halves of a recording
LASTING_S = 1.0

# What to do about what the rooms before say; what is not in here says it by itself.
ADVICE = (
    (r"no phases\.start", "State `phases.start` in the session: the seconds in which the person stands in the pose."),
    (r"holds several intervals", "Leave only the interval that is meant."),
    (
        r"^resampled",
        "Where the samples were even in truth, give `rate_hz` in place of a time column; else leave it so.",
    ),
    (r"long gaps accepted", "Do not use those stretches (`<segment>_gap` in pose.parquet); bring the receiver nearer."),
    (r"short gaps bridged", "Nothing needs to be done; where they are many, bring the receiver nearer."),
    (
        r"the scale is taken from it",
        "Calibrate the accelerometer (six positions at rest), or check its unit and range.",
    ),
    (r"mount is \d+ deg off what gravity", "Check which of its axes points up and which forward, or calibrate."),
    (r"mounts and headings are uncertain", "Choose quieter seconds, or let the person lean on a wall for the pose."),
    (r"^no sensor on", "Strap a sensor on, or do without those points."),
    (
        r"joints are too few or end too soon",
        "Use a body model with as many joints there (`--model`), let its limits go (`--no-limits`), or do without "
        "those segments.",
    ),
)
HARMLESS = r"short gaps|^resampled|several intervals|the scale is taken from it|^no sensor on"


class Concern(NamedTuple):
    """Something to look at."""

    grave: bool  # figures may be wrong by it
    said: str
    do: str

    def line(self) -> str:
        return f"**{capital(self.said)}.** {self.do}".rstrip()


def concerns(
    pose: TrackedRecording,
    signals: Mapping[str, Signal],
    budgets: Mapping[str, Budget],
    elbows: Mapping[str, Elbow],
    hands: Mapping[str, Hand],
    warnings: list[str],
) -> list[Concern]:
    """The grave ones first; `warnings` are those of the pose's summary."""
    found = [
        *(_of_warning(text) for text in warnings),
        *_of_signals(pose, signals, "\n".join(warnings)),
        *_of_headings(pose, budgets),
        *_of_hands(pose, hands),
        *_of_the_time_before(pose, budgets, hands),
        *_of_elbows(pose.recording.rate_hz, elbows),
        *_of_subject(pose),
    ]
    return sorted(found, key=lambda concern: not concern.grave)


def _of_warning(text: str) -> Concern:
    do = next((advice for pattern, advice in ADVICE if re.search(pattern, text)), "")
    return Concern(not re.search(HARMLESS, text), text, do)


def _of_signals(pose: TrackedRecording, signals: Mapping[str, Signal], told: str) -> Iterator[Concern]:
    recording = pose.recording
    assert recording is not None

    def which(values: Mapping[str, str]) -> str:
        return listed([f"{plain(name)} {value}".strip() for name, value in values.items()])

    cut = {
        name: f"{np.count_nonzero(signal.cut) / recording.rate_hz:.2g} s"
        for name, signal in signals.items()
        if signal.cut.any() and not re.search(rf"sensors\.{name}\.\w+: \d+ samples on . stand", told)
    }
    if cut:
        yield Concern(
            True,
            f"motion beyond the sensor's range: {which(cut)} are cut off",
            "Choose a larger range; what turned meanwhile is lost, and the heading with it.",
        )
    lost = {
        name: f"{100 * float(signal.gap.mean()):.1f} %" for name, signal in signals.items() if signal.gap.mean() > LOST
    }
    if lost:
        yield Concern(
            True,
            f"samples were lost: {which(lost)}",
            "The stretches are bridged by a guess and marked in pose.parquet; do not use them.",
        )
    step = np.diff(recording.time) * recording.rate_hz
    if float(step.std()) > JITTER:
        yield Concern(
            True,
            f"the time stamps are uneven, by {100 * float(step.std()):.0f} % of a step",
            "Such stamps are often those of arrival: give `rate_hz` in place of the time column if the sensor is even.",
        )
    off = {
        name: f"{signal.gravity:.2f} m/s² ({100 * (signal.gravity / STANDARD_GRAVITY - 1):+.1f} %)"
        for name, signal in signals.items()
        if abs(signal.gravity / STANDARD_GRAVITY - 1.0) > GRAVITY_OFF and f"sensors.{name}.accel: norm" not in told
    }
    if off:
        yield Concern(
            False,
            f"gravity does not measure as {STANDARD_GRAVITY:.2f} m/s²: {which(off)}",
            "The common scale is taken out, so that it does little harm; axes that differ from each other tilt the "
            "segment. Calibrate the accelerometer by resting it on its six sides.",
        )
    biases = {name: np.linalg.norm(signal.bias, axis=1) for name, signal in signals.items() if signal.bias is not None}
    large = {name: f"{np.degrees(b.max()):.1f} °/s" for name, b in biases.items() if b.max() > BIAS_LARGE}
    if large:
        yield Concern(
            False,
            f"the gyroscope's bias is large: {which(large)}",
            "It is taken out; but was the sensor at rest in the still phase, and had it been on for some minutes?",
        )
    moved = {
        name: f"by {np.degrees(np.linalg.norm(signal.bias[1] - signal.bias[0])):.2f} °/s"
        for name, signal in signals.items()
        if signal.bias is not None and np.linalg.norm(signal.bias[1] - signal.bias[0]) > BIAS_MOVED
    }
    if moved:
        yield Concern(
            False,
            f"the gyroscope's bias at the end is another than in the still phase: {which(moved)}",
            "The person swayed there, or the sensor warmed up. Record the sensors lying on a table first and name "
            "those seconds `phases.static`.",
        )
    restless = {
        name: f"{100 * float(signal.rest.mean()):.1f} % of the time, {seconds:.0f} s without"
        for name, signal in signals.items()
        if signal.rest is not None
        and ((seconds := longest(~signal.rest, recording.rate_hz)) > LONG_MOTION_S or signal.rest.mean() < LITTLE_REST)
    }
    if restless:
        yield Concern(
            pose.options.method == "smekf",
            f"little rest: {which(restless)}",
            "Let the person hold still for a second or two every half minute; a rest shows the gyroscope's bias.",
        )
    late = pose.segments.start[0] - float(recording.time[0])
    if late > LATE_START_S:
        yield Concern(
            False,
            f"the start pose comes {late:.0f} s into the recording",
            "Headings are set there and drift in both directions of time, and the uncertainty stated here counts from "
            "the first sample: it is too large near the start pose and too small long before it. Begin the recording "
            "with the start pose, or cut what was before.",
        )


def _of_headings(pose: TrackedRecording, budgets: Mapping[str, Budget]) -> Iterator[Concern]:
    since = from_start(pose)
    wide = {joint: most for joint, std in between(budgets).items() if (most := largest(std[since])) > HEADING}
    if wide:
        worst = max(wide, key=wide.__getitem__)
        others = f", and of {len(wide) - 1} more joint{'s' * (len(wide) > 2)} by over {np.degrees(HEADING):.0f}°"
        yield Concern(
            True,
            f"the headings at the {worst} may be off against each other by ± {np.degrees(wide[worst]):.0f}°"
            + others * (len(wide) > 1),
            hold(pose),
        )
    if pose.correction is None:
        return
    turned = {name: value for name, value in pose.correction.largest_deg.items() if value > TURNED_DEG}
    if turned:
        yield Concern(
            True,
            "sensors drift apart: elbows and joined hands turned the heading of "
            + listed([f"{plain(name)} by {value:.0f}°" for name, value in turned.items()]),
            "What they cannot see stays uncertain. Let the person rest more often, and warm the sensors up before.",
        )


def _of_hands(pose: TrackedRecording, hands: Mapping[str, Hand]) -> Iterator[Concern]:
    since = from_start(pose)
    wide = {name: most for name, hand in hands.items() if (most := _largest_mm(hand, since)) > 1e3 * PLACE}
    if wide:
        each = [f"the {plain(name)} by ± {most:.0f} mm" for name, most in wide.items()]
        yield Concern(True, f"places may be off: {listed(each)}", hold(pose))


def _of_the_time_before(
    pose: TrackedRecording, budgets: Mapping[str, Budget], hands: Mapping[str, Hand]
) -> Iterator[Concern]:
    """What is less certain before the start pose than ever after it, for longer than filters take to begin."""
    since, before = from_start(pose), pose.time < pose.segments.start[0]
    stds = [
        ("headings between neighbours", np.degrees(1.0), "°", HEADING, list(between(budgets).values())),
        ("the hands", 1e3, " mm", PLACE, [hand.std for hand in hands.values() if hand.std is not None]),
    ]
    said = []
    for what, scale, unit, limit, of in stds:
        wide = [std[before & (std > max(limit, largest(std[since])))] for std in of]
        wide = [std for std in wide if len(std) / pose.recording.rate_hz > LASTING_S]
        if wide:
            said.append(f"{what} ± {scale * max(map(largest, wide)):.0f}{unit}")
    if said:
        yield Concern(
            False,
            f"the pose is less certain in the {pose.segments.start[0] - pose.time[0]:.3g} s before the start pose: "
            f"{' and '.join(said)}",
            "Use the motion from the start pose on; the ± summed up below counts from its end.",
        )


def _largest_mm(hand: Hand, which: np.ndarray) -> float:
    return 1e3 * largest(hand.std[which]) if hand.std is not None else float("nan")


def hold(pose: TrackedRecording) -> str:
    """What to do about headings that drift."""
    said = "Let the person rest for a second now and then"
    if pose.options.method == "smekf":
        said += ", or use the method amekf, which corrects in motion too"
    if pose.correction is None:
        return f"{said}, and calibrate the person: then the elbows and joined hands (phase `clasp`) hold headings."
    if not pose.recording or not pose.recording.phases.get("clasp"):
        return f"{said}, or hold the hands together (phase `clasp`)."
    return f"{said}, and hold the hands together more often (phase `clasp`)."


def _of_elbows(rate_hz: float, elbows: Mapping[str, Elbow]) -> Iterator[Concern]:
    for side, elbow in elbows.items():
        in_plane = np.abs(elbow.aside) < np.deg2rad(45.0)
        back = in_plane & (elbow.forward < BACKWARD) & (elbow.bend < np.deg2rad(90.0))
        if np.count_nonzero(back) / rate_hz > LASTING_S:
            yield Concern(
                True,
                f"the {side} elbow bends backward, to {np.degrees(-elbow.forward[back].min()):.0f}°, "
                f"{np.count_nonzero(back) / rate_hz:.0f} s in all",
                "Were the arms straight in the start pose? What it held counts as straight. Are left and right, upper "
                "arm and forearm where the session says?",
            )
        folded = elbow.bend > FOLDED
        if np.count_nonzero(folded) / rate_hz > LASTING_S:
            yield Concern(
                True,
                f"the {side} elbow is bent by {np.degrees(largest(elbow.bend)):.0f}°, more than an elbow can",
                "Check the mounts of the two sensors, and whether one slipped.",
            )
        aside = (elbow.bend > BENT) & (np.abs(elbow.aside) > ASIDE)
        if np.count_nonzero(aside) / rate_hz > LASTING_S:
            most = float(np.degrees(np.abs(elbow.aside[aside]).max()))
            said = f"the {side} forearm leaves the plane of its elbow, by up to {most:.0f}°"
            early, late = _halves(elbow)
            if abs(late - early) > APART:
                yield Concern(
                    True,
                    f"{said}, by {np.degrees(early):.0f}° in the first half of the recording and "
                    f"{np.degrees(late):.0f}° in the second",
                    "The headings of upper arm and forearm drift apart: more rest, and a calibrated person, hold them.",
                )
            else:
                yield Concern(
                    True,
                    said,
                    "A mount is turned about the arm against what the session states, or the upper arm's skin slides: "
                    "`wepose calibrate` finds the mounts; strap the upper arm's sensor near the elbow.",
                )


def _halves(elbow: Elbow) -> tuple[float, float]:
    """Median [rad] by which the bent forearm is out of plane, in the first and the second half."""
    half = len(elbow.bend) // 2
    parts = [elbow.aside[of][elbow.bend[of] > BENT] for of in (slice(half), slice(half, None))]
    if not all(len(part) for part in parts):
        return 0.0, 0.0
    return float(np.median(parts[0])), float(np.median(parts[1]))


def _of_subject(pose: TrackedRecording) -> Iterator[Concern]:
    if pose.subject.name == "average":
        yield Concern(
            False,
            "the lengths are an average person's",
            "Positions are off by centimetres where this person differs. Let the person hold the hands together for a "
            "minute, `wepose calibrate` it with one taped length, and track with `--subject`.",
        )
    fused = [plain(name) for name, sensor in pose.recording.sensors.items() if isinstance(sensor, OrientationSensor)]
    if fused:
        yield Concern(
            False,
            f"measured orientations of the device: {listed(fused)}",
            "They are taken as they come: their noise, bias, rest and uncertainty are the device's, not known here.",
        )
    if pose.recording.remounted and pose.subject.mounts:
        yield Concern(
            False,
            "the sensors were strapped on anew: of the subject only the lengths are used",
            "The mounts are the session's; headings are not held together by the elbows. Calibrate in this strapping.",
        )
