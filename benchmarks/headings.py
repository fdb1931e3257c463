"""Relative headings of simulated people who move at random, with and without their correction; and of an hour, live."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from wepose_pin.body.subject import Subject, mount_rows
from wepose_pin.rotations import heading
from wepose_pin.simulation import (
    MILD_PRESET,
    MTI_3,
    PEOPLE_PRESET,
    SIDES,
    Imperfections,
    Person,
    Simulation,
    measure_motion,
    simulate_person,
)
from wepose_pin.simulation.motion import Motion, aim_ray
from wepose_pin.simulation.people import Flaws, place_shoulder
from wepose_pin.simulation.signals import Wander, make_pulse
from wepose_pin.tracking import Tracker, TrackResult, track, track_chunks
from wepose_pin.tracking.headings import HeadingCorrection

from .tables import Column, Section, Table, rms

PERSONS, SECONDS = 5, 600.0
FEW_PERSONS, FEW_SECONDS = 2, 120.0
LIVE_MINUTES, FEW_LIVE_MINUTES = 60.0, 10.0
UNSCORED_S = 10.0  # [s] at the beginning, in which causal tracking knows little more than the start pose
SCORED_HZ = 4.0
LIMBS = (("torso", "left_upper_arm", "left_forearm"), ("torso", "right_upper_arm", "right_forearm"))
# The torso's turn against W is none of the headings': W's x is where it faces.
PRESETS = {"people": replace(PEOPLE_PRESET, start_heading_deg=0.0), "mild": MILD_PRESET}
PAUSE_S = 20.0  # [s] from one pause of the hands to the next
# Around the middle, from the shoulder: azimuth outwards and elevation [deg], distance as a share of the arm's reach.
MIDDLE, SPREAD = (15.0, -20.0, 0.64), (35.0, 45.0, 0.2)
CLASP_S, EVERY_S, APPROACH_S = 2.0, 600.0, 1.5  # [s] of a clasp, from one to the next, in which the hands come together
CLASP_REACH = 0.4  # share of the range of a calibration's clasp in which hands meet
CHUNK_S = 120.0
# What a calibration leaves: of the population's standard deviations of lengths, and of each axis of a mount [rad].
CALIBRATED, MOUNT_STD = 0.3, np.deg2rad((1.5, 1.5, 3.0))
NOTE = "Rms of the heading of a sensor's world against its neighbour's, soft tissue left out."


class FreeMotion(Motion):
    """Hands that move at random before the body, each by itself, pause and go on, in the time of the clasp."""

    name = "free"
    closes = False  # hands that miss their aim by millimetres are as good

    def prepare(self, rng: np.random.Generator) -> None:
        self.hand = {side: [Wander(rng) for _ in MIDDLE] for side in SIDES}
        super().prepare(rng)
        self.phases.pop(self.name)

    def _palms(self, t: np.ndarray, motion_share: np.ndarray, _clasp_T: np.ndarray) -> dict[str, np.ndarray]:
        omega = 2.0 * np.pi / PAUSE_S
        own_time = t + np.sin(omega * t) / omega  # stands still in a pause
        palms = {}
        for side, y in SIDES.items():
            azimuth, elevation, distance = (
                middle + spread * motion_share * wander(own_time)
                for middle, spread, wander in zip(MIDDLE, SPREAD, self.hand[side], strict=True)
            )
            reach = (sum(self.arm[side]) * distance)[:, None]
            ray = aim_ray(y * np.deg2rad(azimuth), np.deg2rad(elevation))
            palms[side] = place_shoulder(y, self.lengths) + reach * ray
        return palms


class ClaspedFreeMotion(FreeMotion):
    """Hands that move at random and clasp for two seconds every ten minutes."""

    name = "free_clasped"

    def prepare(self, rng: np.random.Generator) -> None:
        super().prepare(rng)
        begins = np.arange(self.clasp[0] + EVERY_S / 2.0, self.clasp[1] - CLASP_S - 2.0 * APPROACH_S, EVERY_S)
        self.phases["clasp"] = [(begin, begin + CLASP_S) for begin in begins.tolist()]

    def _palms(self, t: np.ndarray, motion_share: np.ndarray, clasp_T: np.ndarray) -> dict[str, np.ndarray]:
        joined = np.zeros_like(t)
        for begin, end in self.phases["clasp"]:
            joined += make_pulse(t, begin - APPROACH_S, end + APPROACH_S, APPROACH_S)
        meeting_T = self._clasp_point(t, CLASP_REACH * motion_share) + [0.0, 0.0, self.lengths["trunk"]]
        free = super()._palms(t, motion_share, clasp_T)
        return {side: palm_T + joined[:, None] * (meeting_T - palm_T) for side, palm_T in free.items()}


def sections(quick: bool, live: bool = False) -> list[Section]:
    """List the functions that measure."""
    if live:
        return [partial(measure_live_headings, FEW_LIVE_MINUTES if quick else LIVE_MINUTES)]
    size = (FEW_PERSONS, FEW_SECONDS) if quick else (PERSONS, SECONDS)
    return [partial(measure_headings, name, preset, *size) for name, preset in PRESETS.items()]


def measure_headings(name: str, preset: Imperfections, persons: int, seconds: float) -> Table:
    """Measure persons who were not calibrated, their mounts stated."""
    table = Table(
        f"Relative headings: {persons} people of preset {name}, {seconds / 60.0:g} min of random motion each",
        (
            Column("open", "open loop [deg]", 2),
            *(Column(key, header, 2) for way in ("offline", "causal") for key, header in _head(way)),
            Column("segment_open", "segments, open loop [deg]", 2),
            Column("segment_offline", "segments, offline [deg]", 2),
            Column("segment_causal", "segments, causal [deg]", 2),
        ),
        notes=[
            f"{NOTE} Those of the segments include soft tissue and start pose, which no heading corrects. No clasp, no "
            "static phase, no calibration."
        ],
    )
    squares: dict[str, dict[str, list[float]]] = {}
    for seed in range(1, persons + 1):
        simulation = simulate_free_motion(FreeMotion, simulate_person(seed), seed, preset, seconds)
        recording = simulation.recording()
        recording = replace(recording, phases={"start": recording.phases["start"]})
        for way in ("open", "offline", "causal"):
            tracked = [track(recording, open_loop=way == "open", causal=way == "causal")]
            for joint, (_, error, std) in compare_headings(simulation, tracked).items():
                figures = {way: error} if way == "open" else {way: error, f"{way}_by_std": error / std}
                for key, values in figures.items():
                    squares.setdefault(joint, {}).setdefault(key, []).append(float(np.mean(values**2)))
            for joint, (_, error, _) in compare_headings(simulation, tracked, segments=True).items():
                squares[joint].setdefault(f"segment_{way}", []).append(float(np.mean(error**2)))
    for joint, columns in squares.items():
        roots = {key: float(np.sqrt(np.mean(values))) for key, values in columns.items()}
        table.rows[joint] = {key: value if "by_std" in key else np.degrees(value) for key, value in roots.items()}
    return table


def _head(way: str) -> Iterable[tuple[str, str]]:
    return (way, f"{way} [deg]"), (f"{way}_by_std", "by its std")


def simulate_free_motion(
    motion: type[FreeMotion], person: Person, seed: int, preset: Imperfections, seconds: float
) -> Simulation:
    """Simulate a person whose hands move at random."""
    hands = motion(Flaws(preset, seed, person.lengths), [motion.name], seconds, 0)
    return measure_motion(hands, rate_hz=100.0, noise=MTI_3)


def compare_headings(
    simulation: Simulation, tracked: Iterable[TrackResult], *, segments: bool = False
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray | float]]:
    """Compare each segment with its neighbour in results one after the other.

    Returns
    -------
    "far to near" → times (n,) [s], errors of the relative heading of the sensors' worlds, or of the segments (n,)
    [rad], and stated standard deviations (n,) [rad], NaN in open loop
    """
    times: list[np.ndarray] = []
    headings: dict[str, list[np.ndarray]] = {}
    for each in tracked:
        rows = np.flatnonzero(each.time > UNSCORED_S)[:: round(each.recording.rate_hz / SCORED_HZ)]
        times.append(each.time[rows])
        at = np.searchsorted(simulation.time, each.time[rows] - 1e-9)
        for name, quat_WL in each.quat_WL.items():
            estimated, true = Rotation.from_quat(quat_WL[rows]), simulation.quat_WL
            if not segments:
                estimated, true = estimated * Rotation.from_quat(each.segments.quat_LS[name]), simulation.quat_WS
            error = Rotation.from_quat(true[name][at]) * estimated.inv()
            headings.setdefault(name, []).append(heading(error.as_quat()))
    time = np.concatenate(times)
    result = {}
    for limb in LIMBS:
        for near, far in pairwise(limb):
            error = np.angle(np.exp(1j * (np.concatenate(headings[near]) - np.concatenate(headings[far]))))
            std = np.nan if each.correction is None else find_relative_std(each.correction, near, far, time)
            result[f"{far} to {near}"] = time, error, std
    return result


def find_relative_std(correction: HeadingCorrection, near: str, far: str, time: np.ndarray) -> np.ndarray:
    """Return the standard deviation (n,) [rad] of the heading between two segments at these times [s]."""
    signs = np.array([(name == near) - float(name == far) for name in correction.filter.names])
    return np.sqrt(np.interp(time, correction.time, correction.covariance @ signs @ signs))


def measure_live_headings(minutes: float) -> Table:
    """Measure one calibrated person of preset people, chunk by chunk; clasps are marked offline, not live."""
    person, preset = simulate_person(1), PRESETS["people"]
    simulation = simulate_free_motion(ClaspedFreeMotion, person, 1, preset, 60.0 * minutes)
    subject = calibrate_person(person, simulation)
    recording = simulation.recording()
    unmarked = replace(recording, phases={"start": recording.phases["start"]})
    ways = {
        "open": (unmarked, Tracker(subject, causal=True, open_loop=True)),
        "live": (unmarked, Tracker(subject, causal=True)),
        "offline": (recording, Tracker(subject)),
    }
    errors = {
        way: compare_headings(simulation, track_chunks(tracker, of, CHUNK_S)) for way, (of, tracker) in ways.items()
    }
    table = Table(
        f"Relative headings, live: {minutes:g} min of random motion of preset people, a clasp of {CLASP_S:g} s every "
        f"{EVERY_S / 60.0:g} min",
        (
            Column("open", "without correction [deg]", 2),
            *(Column(key, header, 2) for way in ("live", "offline") for key, header in _head(way)),
        ),
        notes=[f"{NOTE} Lengths and mounts as a calibration leaves them; no static phase."],
    )
    for joint in errors["open"]:
        for way, by_joint in errors.items():
            _, error, std = by_joint[joint]
            row = table.rows.setdefault(joint, {})
            row |= {way: np.degrees(rms(error)), f"{way}_by_std": rms(error / std)}
    for begin, end in pairwise(np.arange(0.0, recording.time[-1], EVERY_S).tolist()):
        row = {}
        for way, by_joint in errors.items():
            values = [error[(time >= begin) & (time < end)] for time, error, _ in by_joint.values()]
            row[way] = np.degrees(rms(np.concatenate(values)))
        table.rows[f"all, {begin / 60.0:.0f} to {end / 60.0:.0f} min"] = row
    return table


def calibrate_person(person: Person, simulation: Simulation) -> Subject:
    """The person's subject, with lengths and mounts off by the errors of a calibration; girdles as the population's."""
    prior, rng = person.prior, np.random.default_rng(1)
    covariance = CALIBRATED**2 * prior.covariance
    off = rng.multivariate_normal(np.zeros(len(covariance)), covariance)
    lengths = {name: person.lengths[name] + off[prior.order.index(name)] for name in prior.lengths}
    mounts = {}
    for name, quat_LS in simulation.quat_LS.items():
        error_L = Rotation.from_rotvec(MOUNT_STD * rng.standard_normal(3))
        mounts[name] = (error_L * Rotation.from_quat(quat_LS)).as_quat()
    order = (*prior.order, *(row for name in mounts for row in mount_rows(name)))
    joint = block_diag(covariance, np.diag(np.tile(np.square(MOUNT_STD), len(mounts))))
    return replace(prior, name="calibrated", lengths=lengths, mounts=mounts, order=order, covariance=joint)
