"""Equal physics gives equal results: the same recording written or sampled otherwise, tracked, and compared."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from . import adapter
from .adapter import Result
from .cases import Case
from .oracles import ALL_AXES, FLOOR_RAD, Failure
from .recordings import Variant, other_side, record

# Bounds [deg]. The first four change nothing but rounding, in the sixteenth digit (in the tenth for times of 1.7e9 s);
# what decides by a threshold may then decide otherwise for one sample, and a sample's noise moves a filter by less than
# a hundredth of a degree.
ROUNDING_DEG = 0.01
# amekf takes the axes of a measurement one after the other and doubts each by itself: their order tells where it does.
AXES_DEG = 0.05
THRESHOLD_SHARE = 0.1  # of the stated standard deviation
# gdc states none, and its step has one size: at its solution it goes to and fro, and the tenth digit of the sampling
# time decides in which phase.
CHATTER_DEG = 0.5
# The others give a filter more or less of the same samples, or the same noise at another rate. That may move a pose by
# a share of its ± beside what those samples tell; where nothing is stated, by so many degrees.
MOST_Z, UNSTATED_DEG = 1.0 / 3.0, 5.0
STANDING_S = 60.0


@dataclass(frozen=True)
class Invariance:
    """`variant` against `base`, and what may differ [deg]; None: by what is stated."""

    variant: Variant
    base: Variant = field(default_factory=Variant)
    most_deg: float | None = ROUNDING_DEG
    unstated_deg: float = 0.0  # of a method that states no standard deviation, where that is more


INVARIANCES: Mapping[str, Invariance] = {
    "sensor axes rotated": Invariance(Variant(axes=True), most_deg=AXES_DEG),
    "units changed": Invariance(Variant(other_units=True)),
    "mirrored": Invariance(Variant(mirrored=True)),
    "time shifted by 1.7e9 s": Invariance(Variant(shift=1.7e9), unstated_deg=CHATTER_DEG),
    "stillness before": Invariance(
        Variant(before=STANDING_S), Variant(before=STANDING_S, written=(0.0, np.inf)), most_deg=None
    ),
    "stillness after": Invariance(
        Variant(after=STANDING_S), Variant(after=STANDING_S, written=(-np.inf, 1.0)), most_deg=None
    ),
    "end cut off": Invariance(Variant(written=(-np.inf, 0.8)), most_deg=None),
    "rate doubled": Invariance(Variant(finer=2), Variant(half=2), most_deg=None),
}


def choose(case: Case) -> list[str]:
    """The invariance that is tried on this case, or none."""
    rng, fits = case.stream("invariance"), list_fitting(case)
    return [str(rng.choice(fits))] if fits and rng.random() < 0.4 else []


def list_fitting(case: Case) -> list[str]:
    """The invariances that can be tried on this case."""
    if case.refusal or case.suspects or any(sensor.axes is None for sensor in case.worn.values()):
        return []
    clock = case.clock
    fits = ["sensor axes rotated", "units changed", "mirrored"]
    if clock.stamps != "none" and not clock.origin > 1e9 and not clock.separate:
        fits.append("time shifted by 1.7e9 s")
    plain = not clock.lost and not clock.separate and not clock.twice and clock.stamps in ("even", "none")
    if plain and not case.begins_in_motion and case.start is not None:
        fits.append("stillness before")
    if plain and case.start is not None:
        fits.append("stillness after")
        if max(span[1] for span in (case.start, case.clasp) if span is not None) < 0.75 * case.duration:
            fits.append("end cut off")
    if plain and clock.rate_hz <= 240 and "causal" not in case.options:
        fits.append("rate doubled")
    return fits


def compare(case: Case, name: str, folder: Path) -> tuple[list[Failure], list]:
    """Track both and compare; failures, and how the commands ended."""
    of = INVARIANCES[name]
    results, outcomes = [], []
    for which, variant in (("base", of.base), ("variant", of.variant)):
        recorded = record(case, variant)
        # All digits: what is written shorter is another recording.
        units = (unit != variant.other_units for unit in (case.layout.gyro_in_deg, case.layout.accel_in_g))
        layout = type(case.layout)(case.layout.suffix, *units, 15)
        session = adapter.write_session(folder / which, recorded, layout)
        options = case.options - {"report"}
        outcome = adapter.run(adapter.track(session, folder / f"{which}-result", case.method, options))
        outcomes.append(outcome)
        if outcome.code:
            message = f"{which} of '{name}': exit {outcome.code}: {adapter.refusal(outcome)[-300:]}"
            return [Failure("equal physics is accepted alike", " ".join(outcome.argv), message)], outcomes
        results.append((adapter.read_result(folder / f"{which}-result"), recorded.origin))
    over = _find_difference(*results, of)
    shown = " ".join(outcomes[-1].argv)
    return [Failure(f"equal physics: {name}", shown, f"{over}, {case.method}")] if over else [], outcomes


def _find_difference(base: tuple[Result, float], other: tuple[Result, float], of: Invariance) -> str:
    """The first segment that differs by more than it may, in words; empty: none does."""
    (one, at), (two, two_at) = base, other
    mirrored = of.variant.mirrored
    rows, rows_two = _common(one.time - at, two.time - two_at)
    if not len(rows):
        return "no common times"
    for segment, quat in one.quat.items():
        quat_two = two.quat[other_side(segment) if mirrored else segment][rows_two]
        if mirrored:
            quat_two = quat_two * [-1.0, 1.0, -1.0, 1.0]
        angle = (Rotation.from_quat(quat[rows]).inv() * Rotation.from_quat(quat_two)).magnitude()
        std = one.quat_std.get(segment)
        k = int(np.argmax(angle))
        degrees, z = float(np.degrees(angle[k])), 0.0
        if std is not None and of.most_deg is None:
            over, var = np.maximum(angle - FLOOR_RAD, 0.0) / ALL_AXES, np.maximum(std[rows], 1e-9) ** 2
            if of.variant.finer > 1:
                # When a motion ends is known to a sample of the coarser recording: what a filter corrects there, the
                # other rate may correct within that sample, and what both agree on at the next one is no difference.
                ratio = np.minimum(over[1:] / np.sqrt(var[1:]), over[:-1] / np.sqrt(var[:-1]))
            else:
                # Samples that one of them lacks tell of all times. A right estimate moves by what it learns, whose mean
                # square is what its variance falls by: its corrections and the error that is left are uncorrelated.
                learned = np.abs(var - two.quat_std[segment][rows_two] ** 2)
                ratio = over / np.sqrt(var + learned / MOST_Z**2)
            z = float(ratio.max())
        most = of.most_deg if of.most_deg is not None else UNSTATED_DEG if std is None else None
        if most is not None and std is None:
            most = max(most, of.unstated_deg)
        if of.most_deg is not None and std is not None:  # what is known to degrees may turn on a threshold by a tenth
            most = max(of.most_deg, THRESHOLD_SHARE * float(np.degrees(std[rows][k])))
        if (most is not None and degrees > most) or z > MOST_Z:
            return f"{segment} is {degrees:.3g} deg off at {one.time[rows][k] - at:.1f} s, z = {z:.1f}"
    return ""


def _common(one: np.ndarray, two: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the two time bases that are the same time, to a tenth of a step."""
    step = float(np.median(np.diff(one)))
    near = np.clip(np.searchsorted(two, one), 1, len(two) - 1)
    near = np.where(np.abs(two[near - 1] - one) < np.abs(two[near] - one), near - 1, near)
    same = np.abs(two[near] - one) < 0.1 * step
    return np.flatnonzero(same), near[same]
