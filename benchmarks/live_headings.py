"""Relative headings of an hour, live, with clasps of two seconds: with and without correction, and offline."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from wepose_pin.body.subject import Subject, mount_rows
from wepose_pin.recording import Recording
from wepose_pin.rotations import heading
from wepose_pin.simulation import PEOPLE_PRESET, Person, Simulation, simulate, simulate_person
from wepose_pin.simulation.motion import TASKS
from wepose_pin.simulation.signals import make_pulse
from wepose_pin.tracking import TrackOptions, track_chunks

from .free_motion import FreeMotion
from .headings import LIMBS, UNSCORED_S
from .tables import Column, Section, Table

MINUTES = 60.0
CLASP_S, EVERY_S = 2.0, 600.0  # [s] of a clasp, and from one to the next
APPROACH_S = 1.5  # [s] in which the hands come together
CLASP_REACH = 0.4  # share of the range of a calibration's clasp in which hands meet
CHUNK_S = 120.0
SCORED_HZ = 4.0
# What a calibration leaves: of the population's standard deviations of lengths, and of each axis of a mount [rad].
CALIBRATED, MOUNT_STD = 0.3, np.deg2rad((1.5, 1.5, 3.0))
PERSON = 1
PRESET = replace(PEOPLE_PRESET, start_heading_deg=0.0)  # the torso's turn against W is none of the headings'


class ClaspedFreeMotion(FreeMotion):
    """Hands that move at random and clasp for two seconds every ten minutes."""

    name = "free_clasped"

    @property
    def clasps(self) -> list[tuple[float, float]]:
        """When the hands are joined [s]."""
        begins = np.arange(self.clasp[0] + EVERY_S / 2.0, self.clasp[1] - CLASP_S - 2.0 * APPROACH_S, EVERY_S)
        return [(float(begin), float(begin) + CLASP_S) for begin in begins]

    def prepare(self, rng: np.random.Generator) -> None:
        super().prepare(rng)
        self.phases["clasp"] = self.clasps

    def _palms(self, t: np.ndarray, motion_share: np.ndarray, clasp_T: np.ndarray) -> dict[str, np.ndarray]:
        joined = np.zeros_like(t)
        for begin, end in self.clasps:
            joined += make_pulse(t, begin - APPROACH_S, end + APPROACH_S, APPROACH_S)
        shoulders_T = np.array((0.0, 0.0, self.lengths["trunk"]))
        meeting_T = shoulders_T + self._clasp_point(t, CLASP_REACH * motion_share)
        free = super()._palms(t, motion_share, clasp_T)
        return {side: palm_T + joined[:, None] * (meeting_T - palm_T) for side, palm_T in free.items()}


class Errors(NamedTuple):
    """Errors of relative headings."""

    time: np.ndarray  # (n,) [s]
    by_joint: dict[str, np.ndarray]  # "far to near" → (n,) [rad]
    by_std: dict[str, float]  # rms of error over stated standard deviation; empty in open loop


def sections(minutes: float) -> dict[str, Section]:
    """Name → a function that measures it."""
    return {"headings live": partial(measure_live_headings, minutes)}


def measure_live_headings(minutes: float) -> Table:
    """One calibrated person of preset people; clasps are marked, or not."""
    person = simulate_person(PERSON)
    simulation = simulate_clasped_motion(person, 60.0 * minutes)
    subject = calibrate_person(person, simulation)
    recording = simulation.recording()
    unmarked = replace(recording, phases={"start": recording.phases["start"]})
    errors = {
        "open": estimate_errors(simulation, unmarked, subject, TrackOptions(causal=True, open_loop=True)),
        "live": estimate_errors(simulation, unmarked, subject, TrackOptions(causal=True)),
        "marked": estimate_errors(simulation, recording, subject, TrackOptions(causal=True)),
        "offline": estimate_errors(simulation, recording, subject, TrackOptions()),
    }
    table = Table(
        f"Relative headings, live: {minutes:g} min of random motion of preset people, a clasp of {CLASP_S:g} s every "
        f"{EVERY_S / 60.0:g} min",
        (
            Column("open", "without correction [deg]", 2),
            Column("live", "live [deg]", 2),
            Column("live_by_std", "by its std", 2),
            Column("marked", "clasps marked [deg]", 2),
            Column("marked_by_std", "by its std", 2),
            Column("offline", "offline [deg]", 2),
            Column("offline_by_std", "by its std", 2),
        ),
    )
    for joint in errors["open"].by_joint:
        row = {kind: _rms_deg(each.by_joint[joint]) for kind, each in errors.items()}
        row |= {f"{kind}_by_std": each.by_std[joint] for kind, each in errors.items() if each.by_std}
        table.rows[joint] = row
    for quantile in (0.5, 0.95):
        table.rows[f"all, {100.0 * quantile:.0f} % of the time below"] = {
            kind: float(np.degrees(np.quantile(np.abs(_stack(each)), quantile))) for kind, each in errors.items()
        }
    for begin, end in pairwise(np.arange(0.0, recording.time[-1] + EVERY_S, EVERY_S).tolist()):
        rows = {kind: (each.time >= begin) & (each.time < end) for kind, each in errors.items()}
        if rows["open"].sum() > SCORED_HZ * CHUNK_S:
            name = f"all, {begin / 60.0:.0f} to {end / 60.0:.0f} min"
            table.rows[name] = {kind: _rms_deg(_stack(each)[:, rows[kind]]) for kind, each in errors.items()}
    table.notes.append(
        "Rms of the heading of a sensor's world against its neighbour's, soft tissue left out. Lengths and mounts as a "
        "calibration leaves them; no static phase."
    )
    return table


def simulate_clasped_motion(person: Person, seconds: float) -> Simulation:
    """Simulate the person's hands moving at random, with clasps."""
    TASKS.setdefault(ClaspedFreeMotion.name, ClaspedFreeMotion)
    return simulate(
        person.lengths, seed=PERSON, imperfections=PRESET, clasp_s=seconds, circles=0, protocol=ClaspedFreeMotion.name
    )


def calibrate_person(person: Person, simulation: Simulation) -> Subject:
    """The person's subject, with lengths and mounts off by the errors of a calibration; girdles as the population's."""
    prior, rng = person.prior, np.random.default_rng(PERSON)
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


def estimate_errors(simulation: Simulation, recording: Recording, subject: Subject, options: TrackOptions) -> Errors:
    """Track a recording chunk by chunk and return the errors of its relative headings."""
    stride = round(recording.rate_hz / SCORED_HZ)
    times: list[np.ndarray] = []
    sensor: dict[str, list[np.ndarray]] = {}
    correction = None
    for tracked in track_chunks(recording, subject, options=options, chunk_s=CHUNK_S):
        rows = np.flatnonzero(tracked.time > UNSCORED_S)[::stride]
        times.append(tracked.time[rows])
        at = np.searchsorted(simulation.time, tracked.time[rows] - 1e-9)
        for name, quat_WL in tracked.quat_WL.items():
            R_WS = Rotation.from_quat(quat_WL[rows]) * Rotation.from_quat(tracked.segments.quat_LS[name])
            error = (Rotation.from_quat(simulation.quat_WS[name][at]) * R_WS.inv()).as_quat()
            sensor.setdefault(name, []).append(heading(error))
        correction = tracked.correction
    time, headings = np.concatenate(times), {name: np.concatenate(parts) for name, parts in sensor.items()}
    by_joint, by_std = {}, {}
    for limb in LIMBS:
        for near, far in pairwise(limb):
            error = np.angle(np.exp(1j * (headings[near] - headings[far])))
            by_joint[f"{far} to {near}"] = error
            if correction is not None:
                std = correction.relative_std(near, far, time)
                by_std[f"{far} to {near}"] = float(np.sqrt(np.mean((error / std) ** 2)))
    return Errors(time, by_joint, by_std)


def _stack(errors: Errors) -> np.ndarray:
    return np.array(list(errors.by_joint.values()))


def _rms_deg(values: np.ndarray) -> float:
    return float(np.degrees(np.sqrt(np.mean(np.square(values)))))
