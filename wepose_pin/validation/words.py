"""What each experiment is: simulated or recorded, which imperfections were on, what it stands beside, how scored."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..simulation import GRAVITY
from .findings import ANYWHERE, WATERFALL


class Words(NamedTuple):
    """An experiment's text."""

    what: str  # simulated or recorded
    beside: str  # which figures of the paper
    scored: str  # alignment and what counts


_SINGLE = "No Xsens and no Vicon: one simulated sensor, turned and shaken as by a hand, whose truth is exact. "
_UPPER = (
    "Simulated people, sizes drawn from anthropometric distributions, a motion of their own each, truth exact; not the "
    "paper's ten subjects and no Vicon. Hands joined and moved for a minute, then six circles in the air with rests on "
    "a table. Each filter calibrates the lengths from the joined hands with a taped shoulder width (off by 3 mm, one "
    "standard deviation) and tracks with what it calibrated. All rows are of headings that are held together by "
    "the joined hands and the elbows' hinges, as `wepose track` does for every filter with a calibrated subject. "
)
_PEOPLE = (
    "Distance of the right hand to the truth during circles and rests, from the root (the trunk's length counts, which "
    "joined hands do not show) and from the middle of the shoulders (without it). Nothing is fitted to the truth."
)
_BESIDE_HAND = (
    "The paper's hand error over its ten subjects; it does not say from which point it counts, so it stands at both. "
)
_TEN = (
    "Nobody aligned clocks and frames here: the clock's offset, the sensor on its body, the tilt of the truth's world "
    "and the heading are found on the first ten seconds, which are not scored. Optical gaps are left out."
)
EXPERIMENTS: dict[str, Words] = {
    "dynamic": Words(
        _SINGLE + "5 s still, 50 s of free motion without a pause, 5 s still.",
        "The paper's dynamic experiment at the same rate, 12 trials of an Xsens MTi-3 against Vicon.",
        "Errors over the 50 s of motion: absolute angles of the error rotation about the axes of W. Noise and bias are "
        "those of the still phase; the heading is aligned once, in that phase.",
    ),
    "drift": Words(
        _SINGLE + "25 s still, 10 s of fast shaking and turning, 25 s still, at 1 kHz.",
        "The paper's drift experiment, 10 trials; it gives no numbers, but: NCF drifts in yaw, GDC little, sMEKF "
        "negligibly, roll and pitch of all three negligibly.",
        "Mean errors from 1 s after the motion to the end; drift: slope of the heading error there. The heading is "
        "aligned once, in the first still phase.",
    ),
    "upper body, MTi-3 noise alone": Words(
        _UPPER + "Nothing but the sensors' noise and bias disturbs.",
        _BESIDE_HAND + "Its people had all that is off here: this one shows what filter and calibration alone leave.",
        _PEOPLE,
    ),
    "upper body": Words(_UPPER, _BESIDE_HAND, _PEOPLE),
    ANYWHERE: Words(
        "The realistic people, their sensors in any rotation and nothing stated of it: lengths, mounts and headings "
        "come from a minute of joined hands, shoulder width and trunk taped (off by 3 mm, one standard deviation).",
        "Nothing in the paper, which refines lengths only and leaves the headings open.",
        "Lengths but for the trunk; mounts about the vertical (headings) and across it (tilts); all these errors by "
        "the standard deviations that the calibration states; the right hand during circles and rests. Root mean "
        "squares are over all trials together.",
    ),
    WATERFALL: Words(
        "The realistic upper body, smekf; in each row one imperfection is switched off or one part of the chain is "
        "known exactly, with the same person, motion and noise.",
        "Nothing in the paper, which names lengths and attitude as what costs most (5 % and 1° up to 4 cm).",
        _PEOPLE,
    ),
    "BROAD": Words(
        "Recorded: the BROAD benchmark (Laidig et al. 2021, doi 10.3390/data6070072), one sensor on a board, optical "
        "truth, minutes of motion.",
        "Nothing in the paper.",
        "Errors over the marked motion. The heading is aligned once, in the still phase before it, and never fitted to "
        "the truth afterwards; optical gaps are left out.",
    ),
    "the authors' trial": Words(
        "Recorded: the trial that the paper's authors published with their software, 1 kHz, Vicon's truth.",
        "One trial of the paper's kind; its own figures are means over others.",
        "Aligned in full once, at the first Vicon sample, as Vicon's world is not level to a degree.",
    ),
    "gains": Words(
        "The grid searches for the gains of ncf and gdc, on trials of the same kind that are scored nowhere else.",
        "Nothing in the paper.",
        "The total error over the motion, RMSE, mean over the trials: with the best gains of the grid, which the table "
        "gives, and with those that the experiments run with.",
    ),
    "RING, link lengths": Words(
        "Recorded: the RING chain, five segments on hinges; its link lengths by least squares from each filter's "
        "orientations and the optical tip, beside the optical lengths.",
        "The paper's claim that any kinematic chain of known parameters can be tracked; it gives no figures.",
        _TEN,
    ),
    "RING": Words(
        "Recorded: the RING chain, five segments on hinges, a sensor each, optical truth; it is never still.",
        "The paper's claim that any kinematic chain of known parameters can be tracked; it gives no figures.",
        _TEN + " Without a still phase the noise is a data sheet's, and the bias is what those ten seconds say; \"bias "
        'unknown" is without it, as a user would have it.',
    ),
    "UR5": Words(
        "Recorded: sensors on a UR5 robot arm, whose encoders are the truth.",
        "The paper's claim that robot arms can be tracked; it gives no figures.",
        _TEN,
    ),
}

AS_IT_COMES = " as it comes"  # ends the label of a filter's second row
METHODS = {
    "smekf": "the paper's Algorithm 1, nothing added: corrects only at rest",
    "amekf": "ours: the same error state, corrected in motion too",
    "smoother": "ours: forward and backward over the whole recording",
    "ncf": "Mahony et al. 2008",
    "gdc": "Madgwick et al. 2011",
    "vqf": "VQF (Laidig and Seel 2023), its own package with its defaults",
    "offline vqf": "VQF over the whole recording, forward and backward: it knows the future",
    "imufusion": "Fusion (x-io), its own package, set as its examples are",
}

# Field of `Imperfections` → words, factor to the unit, unit.
_SIZES = {
    "soft_tissue_deg": ("sensors that turn on soft tissue", 1.0, "° rms"),
    "palm_slip": ("palms that slip in the clasp", 1e3, " mm rms"),
    "shoulder_wander": ("shoulder centres that wander", 1e3, " mm at 90° of elevation"),
    "start_elbow_deg": ("elbows bent in the start pose", 1.0, "°"),
    "start_segment_deg": ("arm segments off the start pose", 1.0, "° rms"),
    "sway_deg_s": ("sway while standing", 1.0, "°/s rms"),
    "gyro_scale": ("gyroscope scale", 100.0, " %"),
    "accel_scale": ("accelerometer scale", 100.0, " %"),
    "misalignment_deg": ("misaligned axes", 1.0, "°"),
    "g_sensitivity_deg_s": ("g-sensitivity", 1.0, "°/s per g"),
    "gyro_range_deg_s": ("gyroscope range", 1.0, "°/s"),
    "accel_range_g": ("accelerometer range", 1.0, " g"),
    "bits": ("quantisation", 1.0, " bits"),
    "clock_jitter": ("clock jitter", 1e3, " ms"),
    "clock_offset": ("clocks apart", 1e3, " ms"),
    "dropped": ("samples lost", 100.0, " %"),
}


def words(experiment: str) -> Words | None:
    """The text of an experiment, by the longest name that it begins with; None: nothing is known of it."""
    names = [name for name in EXPERIMENTS if experiment.startswith(name)]
    return EXPERIMENTS[max(names, key=len)] if names else None


def world_of(experiment: str) -> str | None:
    """The name of the simulated world that an experiment was made in; None: recorded, or not known."""
    if experiment.startswith(("dynamic", "drift")):
        return "MTi-3 noise alone"
    return "realistic" if experiment == WATERFALL else experiment.partition("upper body, ")[2] or None


def world_text(experiment: str, worlds: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Which imperfections were on, with their sizes, and how the mounts were known."""
    world = worlds.get(world_of(experiment) or "")
    if world is None:
        return []
    sizes = world.get("imperfections", {})
    on = [text for name, value in sizes.items() if (text := _size(name, value))]
    off = [_SIZES[name][0] for name, value in sizes.items() if name in _SIZES and not _size(name, value)]
    text = "Imperfections on: the sensors' noise and bias"
    if len(on) < len(off):
        text += f", {', '.join(on)}" if on else ""
        text += "; all others are off." if on else " and no other."
    else:
        text += f"; {', '.join(on)}" + (f". Off: {', '.join(off)}." if off else ".")
    if experiment.startswith(("dynamic", "drift")):
        return [text]
    known = "known" if world.get("mounts_known") else "not known: only which axes of the sensors point up and forward"
    return [f"{text} The sensors' mounts are {known}."]


def noise_text(noise: Mapping[str, float]) -> str:
    """The simulated sensors' noise in the units of data sheets; empty where the file does not say."""
    scales = {
        "gyro_density": ("gyroscope", math.degrees(1.0), "°/s/√Hz"),
        "gyro_bias_std": ("turn-on bias", math.degrees(1.0), "°/s"),
        "gyro_bias_instability": ("in-run bias", math.degrees(3600.0), "°/h"),
        "accel_density": ("accelerometer", 1e6 / GRAVITY, " µg/√Hz"),
        "accel_bias_std": ("turn-on bias", 1e3 / GRAVITY, " mg"),
        "accel_bias_instability": ("in-run bias", 1e3 / GRAVITY, " mg"),
    }
    parts = [f"{what} {scale * noise[name]:.3g}{unit}" for name, (what, scale, unit) in scales.items() if name in noise]
    return f"Noise of the simulated sensors (Xsens MTi-3): {', '.join(parts)}." if parts else ""


def method_text(method: str, methods: Sequence[str], gains: Mapping[str, Mapping[str, Any]]) -> str:
    """What a filter is, and how it was set."""
    name = method.removesuffix(AS_IT_COMES)
    text = METHODS.get(name, "")
    if name not in ("ncf", "gdc"):
        return text
    if name != method or name + AS_IT_COMES not in methods:
        of = gains.get(AS_IT_COMES.strip(), {}).get(name)
        text += ", published gains" + (f" ({_gains(of)})" if of else "")
        return f"{text}, the bias starts at zero" if name != method else text
    searched = (f"{setting}: {_gains(of[name])}" for setting, of in gains.items() if name in of)
    found = "; ".join(of for of in searched if not of.startswith(AS_IT_COMES.strip()))
    return f"{text}, gains by a grid search on trials that are not scored with them" + (f" ({found})" if found else "")


def _gains(of: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in of.items())


def _size(name: str, value: Any) -> str:
    if value is None or isinstance(value, str) or not value:  # without end, the kind of mount, off
        return ""
    what, factor, unit = _SIZES.get(name, (name.replace("_", " "), 1.0, ""))
    return f"{what} {factor * value:.4g}{unit}"
