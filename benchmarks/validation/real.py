"""Real recordings with a truth: BROAD, the paper authors' own trial, the RING chain, a UR5 arm.

Heading aligned once, on a stretch that is not scored, and never fitted to the truth afterwards; optical gaps left out.
For RING and UR5 clocks, frames and the tilt of the truth's world are estimated on the first ten seconds, which are not
scored (`registration`); for the authors' trial on the half that is not scored. The static phase's bias is removed for
every filter. RING has no still
phase: there the bias found on the ten seconds is removed; "bias unknown" is without, as a user would have it.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation, Slerp

from wepose_pin.errors import MissingFile
from wepose_pin.evaluation import attitude_error
from wepose_pin.filters.phases import SensorNoise, estimate_noise
from wepose_pin.simulation.imperfections import GRAVITY, MTI_3

from ..trials import (
    RING,
    RING_MOUNTS,
    RING_SEGMENTS,
    Chain,
    Referenced,
    list_ur5,
    read_authors_trial,
    read_broad,
    read_ring,
    read_ur5,
)
from .contenders import list_contenders
from .experiment import Job, Result, align_rotation
from .registration import Registration, register_sensors

UNSCORED_S = 10.0  # [s] of RING and UR5 for the alignment of clocks, frames and headings
BIAS_STD = np.deg2rad(0.05)  # [rad/s] error of biases from RING's ten seconds against its whole recording
# [s] of the authors' trial: the motion begins at 5.0 s; each half is scored with what the other one tells. The first of
# them is aligned on the second; the second on all before it.
AUTHORS_HALVES = ((5.0, 11.0), (11.0, 17.3))
UR5_EXCLUDED = {("circle-100", "radius")}  # its clock has an error of 20 ms, the other sensors' at most 10 ms


def list_experiments(data: Path, quick: bool = False) -> dict[str, list[Job]]:
    """List the jobs of each experiment, for the real recordings in `data`.

    Raises
    ------
    MissingFile
        Nothing of them does.
    """
    few = slice(1 if quick else None)
    experiments: dict[str, list[Job]] = {
        "BROAD": [
            Job(path.stem, _broad, (path,)) for path in sorted((data / "broad").glob("*.mat"))[: 2 if quick else None]
        ]
    }
    authors = data / "wepose_hr" / "prova_HR.txt"
    if authors.is_file():
        experiments["the authors' trial"] = [
            Job(f"{begin:g} to {end:g} s", _authors, (authors, (begin, end)))
            for begin, end in AUTHORS_HALVES[: 1 if quick else None]
        ]
    ring = data / RING
    if ring.is_dir():
        for mount, bias in product(RING_MOUNTS, ("", ", bias unknown")):
            experiments[f"RING, {mount} mounts{bias}"] = [
                Job(f"trial1 {segment}", _ring, (ring, segment, mount, not bias)) for segment in RING_SEGMENTS[few]
            ]
        for mount in RING_MOUNTS:
            experiments[f"RING, link lengths, {mount} mounts"] = [Job("trial1", compare_links, (ring, mount))]
    ur5 = [each for each in list_ur5(data) if each not in UR5_EXCLUDED][few]
    experiments["UR5"] = [Job(" ".join(each), _ur5, (data, *each)) for each in ur5]
    experiments = {name: jobs for name, jobs in experiments.items() if jobs}
    if not experiments:
        raise MissingFile(
            f"{data}: neither broad/*.mat, wepose_hr/prova_HR.txt, {RING} nor ur5/imu in it; see docs/validation.md"
        )
    return experiments


def _broad(path: Path) -> list[Result]:
    """Compute errors over the marked motion; the heading is aligned in the static phase."""
    trial = read_broad(path)
    known = np.isfinite(trial.quat_true).all(axis=1)
    at_rest = np.zeros(len(known), dtype=bool)
    at_rest[trial.static] = known[trial.static]
    true = Rotation.from_quat(np.where(known[:, None], trial.quat_true, [0.0, 0.0, 0.0, 1.0]))
    time = np.flatnonzero(trial.scored) / trial.rate_hz
    noise = estimate_noise(trial.gyro_S[trial.static], trial.accel_S[trial.static], trial.rate_hz)
    results = []
    for contender in list_contenders("real", trial.name):
        R_VS = Rotation.from_quat(contender.orient(trial.gyro_S, trial.accel_S, trial.rate_hz, noise))
        R_WS = align_rotation(R_VS, true, at_rest)
        results.append(Result(contender.label, compute_errors(R_WS[trial.scored], true[trial.scored], time)))
    return results


def _authors(path: Path, scored: tuple[float, float]) -> list[Result]:
    """Compute errors over the interval `scored` [s]; clocks and frames are aligned on the trial's other part.

    Vicon's samples are late by 16 to 18 ms and stand 2.5 deg askew, which every filter would have as an error of its
    own. A pose is compared once, where it arrives: it is repeated until the next, 1 to 40 ms later. That its arrival is
    so irregular stays in the errors of every filter: of the integrated gyroscope's 1.2 deg (rms) against Vicon 0.14 deg
    are left where each pose has a time of its own, which then varies by 7 ms.
    """
    trial = read_authors_trial(path)
    fresh = trial.scored.copy()
    fresh[1:] &= np.any(trial.quat_true[1:] != trial.quat_true[:-1], axis=1)
    time = np.flatnonzero(fresh) / trial.rate_hz
    sensor = Referenced(
        trial.name, trial.rate_hz, trial.gyro_S, trial.accel_S, time, trial.quat_true[fresh], trial.static
    )
    end = AUTHORS_HALVES[-1][1]
    other = (scored[1], end) if scored[1] < end else (0.0, scored[0])
    (registration,) = register_sensors([sensor], other, irregular=True)
    noise = estimate_noise(trial.gyro_S[trial.static], trial.accel_S[trial.static], trial.rate_hz)
    return _score_reference(sensor, registration, noise, Intervals(other, scored))


def compute_errors(estimated: Rotation, true: Rotation, time: np.ndarray) -> dict[str, float]:
    """Compute the root mean square errors [deg] of a trial."""
    error = attitude_error(estimated, true, time)
    return {
        "total [deg]": error.total_rmse,
        "inclination [deg]": error.inclination_rmse,
        "heading [deg]": error.heading_rmse,
    }


def _ring(trial: Path, segment: str, mount: str, bias_known: bool) -> list[Result]:
    """Compute errors of one segment from 10 s on."""
    chain, registered = register_ring(trial)
    sensor, registration = chain.sensors[mount, segment], registered[mount, segment]
    noise = assume_noise(sensor.rate_hz, registration.gyro_bias if bias_known else None)
    return _score_reference(sensor, registration, noise)


def _ur5(data: Path, recording: str, sensor: str) -> list[Result]:
    """Compute errors from 10 s on; noise and bias are from the 0.6 s to 4 s before the arm moves.

    The tilt of the world comes out as 1.0 to 2.6 deg where it is one robot on one base: some 20 mg of error of the
    accelerometers are in it, and in the inclinations.
    """
    trial = read_ur5(data, recording, sensor)
    (registration,) = register_sensors([trial], (0.0, UNSCORED_S))
    noise = estimate_noise(trial.gyro_S[trial.static], trial.accel_S[trial.static], trial.rate_hz)
    return _score_reference(trial, registration, noise)


def compare_links(trial: Path, mount: str) -> list[Result]:
    """Compare lengths of the chain's links, from contenders' orientations and the optical tip, with optical ones."""
    chain, registered = register_ring(trial)
    links = fit_optical_links(chain)
    orientations = []
    for segment in ("seg2", "seg3", "seg4"):
        sensor, registration = chain.sensors[mount, segment], registered[mount, segment]
        noise = assume_noise(sensor.rate_hz, registration.gyro_bias)
        orientations.append(dict(run_orientations(sensor, registration, noise)))
    tip_W = Rotation.from_quat(registered[mount, "seg2"].quat_WV).apply(links.tip_V)
    optical = links.lengths["seg2"] + links.lengths["seg3"], links.lengths["seg4"]
    results = [Result("optical", _name_links(*optical))]
    for contender in list_contenders("real"):
        own_runs = [each[contender.label] for each in orientations]
        fitted = fit_links(tip_W[own_runs[0].scored], *(each.estimated[each.scored] for each in own_runs))
        results.append(Result(contender.label, _name_links(*fitted)))
    return results


def _name_links(both: float, last: float) -> dict[str, float]:
    return {"seg2 and seg3 [mm]": 1e3 * float(both), "seg4 [mm]": 1e3 * float(last)}


class Links(NamedTuple):
    """The RING chain's links from the optical system."""

    lengths: dict[str, float]  # segment → [m], between its joints
    tip_V: np.ndarray  # (m, 3) [m], from the joint of seg1 and seg2 to that of seg4 and seg5; NaN: not seen


def fit_optical_links(chain: Chain) -> Links:
    """Fit lengths and tip to the joints' centres, the points on which two neighbours agree best (least squares).

    A hinge leaves the point open along its own axis. About y and z (seg3 to seg5) that does not touch the lengths,
    which are counted along the links; about x, the link itself (seg2 to seg3), the split is what the hinge's play
    says, and the sum stands.
    """
    known = np.isfinite(chain.quat_VB["seg1"]).all(axis=1)
    R_VB = {segment: Rotation.from_quat(quat[known]).as_matrix() for segment, quat in chain.quat_VB.items()}
    centres = {}
    for near, far in pairwise(RING_SEGMENTS):
        A = np.concatenate([R_VB[near], -R_VB[far]], axis=2).reshape(-1, 6)
        b = (chain.origin_V[far][known] - chain.origin_V[near][known]).ravel()
        solution = np.linalg.lstsq(A, b, rcond=1e-6)[0]
        centres[near, "end"], centres[far, "begin"] = solution[:3], solution[3:]
    lengths = {s: float(centres[s, "end"][0] - centres[s, "begin"][0]) for s in ("seg2", "seg3", "seg4")}
    # The hinge of seg4 and seg5 does not determine the joint's z in seg4: that of the link's other end is used.
    end = np.array([*centres["seg4", "end"][:2], centres["seg4", "begin"][2]])
    tip_V = np.full_like(chain.origin_V["seg4"], np.nan)
    tip_V[known] = chain.origin_V["seg4"][known] + R_VB["seg4"] @ end
    tip_V[known] -= chain.origin_V["seg2"][known] + R_VB["seg2"] @ centres["seg2", "begin"]
    return Links(lengths, tip_V)


def fit_links(tip_W: np.ndarray, R_W2: Rotation, R_W3: Rotation, R_W4: Rotation) -> np.ndarray:
    """Fit the lengths (2,) [m] of seg2 and seg3 together, and of seg4: tip = l₂₃ x₂₃ + l₄ x₄, least squares.

    seg3 turns on seg2 about the link itself: both have one axis x₂₃, the mean of the two, and only their sum is seen.
    `tip_W` (n, 3) [m]; n orientations of each segment.
    """
    x2, x3, x4 = (R.as_matrix()[:, :, 0] for R in (R_W2, R_W3, R_W4))
    x23 = x2 + x3
    x23 /= np.linalg.norm(x23, axis=1, keepdims=True)
    return lsq_linear(np.column_stack([x23.ravel(), x4.ravel()]), tip_W.ravel()).x


@lru_cache(maxsize=1)
def register_ring(folder: Path) -> tuple[Chain, dict[tuple[str, str], Registration]]:
    """Register all ten sensors of the chain together: one clock, one optical world."""
    chain = read_ring(folder)
    return chain, dict(
        zip(chain.sensors, register_sensors(list(chain.sensors.values()), (0.0, UNSCORED_S)), strict=True)
    )


class Intervals(NamedTuple):
    """Parts of a recording [s] by the reference's clock."""

    aligned: tuple[float, float]
    scored: tuple[float, float]


AFTER_TEN_SECONDS = Intervals((0.0, UNSCORED_S), (np.nextafter(UNSCORED_S, np.inf), np.inf))


class Compared(NamedTuple):
    """A contender's orientations and the truth, at the truth's times."""

    estimated: Rotation  # body to W, of m samples; the heading aligned
    true: Rotation  # of m samples; identity where missing
    scored: np.ndarray  # (m,) bool


def run_orientations(
    sensor: Referenced, registration: Registration, noise: SensorNoise, intervals: Intervals = AFTER_TEN_SECONDS
) -> Iterator[tuple[str, Compared]]:
    """Run each contender; iterates over label and orientations."""
    time = sensor.time + registration.offset_s
    clock = np.arange(len(sensor.gyro_S)) / sensor.rate_hz
    known = np.isfinite(sensor.quat_VB).all(axis=1) & (time >= 0.0) & (time <= clock[-1])
    R_VB = Rotation.from_quat(np.where(known[:, None], sensor.quat_VB, [0.0, 0.0, 0.0, 1.0]))
    true, R_SB = Rotation.from_quat(registration.quat_WV) * R_VB, Rotation.from_quat(registration.quat_BS).inv()
    aligned, scored = (known & (sensor.time >= begin) & (sensor.time <= end) for begin, end in intervals)
    for contender in list_contenders("real"):
        R_WS = Rotation.from_quat(contender.orient(sensor.gyro_S, sensor.accel_S, sensor.rate_hz, noise))
        R_WB = Slerp(clock, R_WS)(np.clip(time, 0.0, clock[-1])) * R_SB
        yield contender.label, Compared(align_rotation(R_WB, true, aligned), true, scored)


def assume_noise(rate_hz: float, gyro_bias: np.ndarray | None = None) -> SensorNoise:
    """Assume the noise of a sensor without static phases, from the MTi-3's data sheet.

    `gyro_bias` (3,) [rad/s]: as found on ten seconds, right to `BIAS_STD`; None: zero, with the usual turn-on
    bias of 0.2 deg/s for its standard deviation (that of RING's sensors is 0.2 to 0.9 deg/s in all).
    """
    gyro = MTI_3.gyro_density**2 * rate_hz * np.eye(3)
    accel_var = (MTI_3.accel_density / GRAVITY) ** 2 * rate_hz
    known = gyro_bias is not None
    return SensorNoise(
        gyro_bias=np.array(gyro_bias) if known else np.zeros(3),
        gyro_bias_cov=(BIAS_STD if known else MTI_3.gyro_bias_std) ** 2 * np.eye(3),
        gyro_cov=gyro,
        accel_cov=accel_var * np.eye(3),
        bias_step_cov=2.0 * gyro,
        gravity=GRAVITY,
        accel_step_var=2.0 * accel_var,
    )


def _score_reference(
    sensor: Referenced, registration: Registration, noise: SensorNoise, intervals: Intervals = AFTER_TEN_SECONDS
) -> list[Result]:
    return [
        Result(label, compute_errors(run.estimated[run.scored], run.true[run.scored], sensor.time[run.scored]))
        for label, run in run_orientations(sensor, registration, noise, intervals)
    ]
