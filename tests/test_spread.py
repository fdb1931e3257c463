"""The stated covariance of a calibration against the spread over draws of all that it claims to model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from bodies import LENGTHS, RIGID_SHOULDERS, TABLE
from scipy.spatial.transform import Rotation

from wepose_pin.alignment import SEGMENT_ATTITUDE_STD
from wepose_pin.calibration import load_protocol
from wepose_pin.calibration.lengths import Calibration, solve_calibration
from wepose_pin.calibration.priors import (
    DRIFT_STD,
)
from wepose_pin.calibration.problem import CalibrationProblem
from wepose_pin.calibration.quality import GAP
from wepose_pin.calibration.weights import LEAST_CORRELATION_S
from wepose_pin.filters.sensors import FilteredRecording
from wepose_pin.model import load_model
from wepose_pin.model.girdle import PARAMETERS
from wepose_pin.recording import ImuSensor, Recording
from wepose_pin.simulation import NOISE_FREE, Person, simulate, simulate_person
from wepose_pin.subject import compute_girdle_prior, mount_rows

UP = np.array([0.0, 0.0, 1.0])
SENSORS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
START = (0.5, 4.5)
MODEL, ELBOW = load_model(), TABLE.hinges["left_elbow"]
RATE_HZ = 4.0  # of the recording and its observations: half of the usual, in half of the time
DRAWS = 100
# What of the covariance is compared: name → the rows whose sum it is. Forearm and hand are seen as one.
GROUPS: dict[str, list[tuple[str, ...]]] = {
    "shoulder width": [("shoulder_width",)],
    "upper arms": [("left_upper_arm",), ("right_upper_arm",)],
    "forearms with hands": [("left_forearm", "left_hand"), ("right_forearm", "right_hand")],
    "hands": [("left_hand",), ("right_hand",)],
    "trunk": [("trunk",)],
    "heading of the torso": [("mounts.torso.z",)],
    "headings of the upper arms": [("mounts.left_upper_arm.z",), ("mounts.right_upper_arm.z",)],
    "headings of the forearms": [("mounts.left_forearm.z",), ("mounts.right_forearm.z",)],
    "laws of the girdles": [(f"girdles.{name}.law",) for name in RIGID_SHOULDERS],
    "shoulders at rest": [(f"girdles.{name}.rest_{axis}",) for name in RIGID_SHOULDERS for axis in "xyz"],
    "shoulders raised": [(f"girdles.{name}.raised_{axis}",) for name in RIGID_SHOULDERS for axis in "xyz"],
    "tilts": [(f"mounts.{name}.{axis}",) for name in SENSORS for axis in "xy"],
}


class Motion(NamedTuple):
    """Of one person, exact, at the observations."""

    person: Person
    time: np.ndarray  # (n,) [s]
    R_WL: dict[str, Rotation]  # n of each sensor's segment


class Draw(NamedTuple):
    """What a calibration made of one draw."""

    calibration: Calibration
    error: np.ndarray  # (k,) of lengths [m], mounts [rad] and girdles [m], in the covariance's order


@pytest.fixture(scope="module")
def motion() -> Motion:
    return motion_of(5)


def motion_of(seed: int) -> Motion:
    person = simulate_person(seed)
    simulation = simulate(person.lengths, seed=seed, noise=NOISE_FREE, circles=0)
    begin, end = simulation.phases["clasp"][0]
    stride = round(simulation.rate_hz / RATE_HZ)
    at = np.flatnonzero((simulation.time >= begin) & (simulation.time <= end))[::stride]
    return Motion(person, simulation.time[at], {s: Rotation.from_quat(simulation.quat_WL[s][at]) for s in SENSORS})


def draws(motion: Motion, count: int, seed: int = 0) -> Iterator[Draw]:
    """Everything drawn as the calibration's priors and weights have it, and what it finds."""
    person, time, rng = motion.person, motion.time, np.random.default_rng(seed)
    protocol = load_protocol("clasp")
    # Palms slip, and both shoulders leave their law: in the weights of the gap that is one.
    leaving = [np.mean(np.square(girdle.residual_std)) for girdle in TABLE.girdles.values()]
    slip = float(np.sqrt(protocol.closures[0].slip ** 2 + sum(leaving)))
    start_time = np.arange(0.0, START[1] + 0.5, 1.0 / RATE_HZ)
    recording = Recording(
        name="drawn",
        time=np.concatenate((start_time, time)),
        rate_hz=RATE_HZ,
        sensors={s: ImuSensor(gyro_S=_none(start_time, time), accel_S=_none(start_time, time)) for s in SENSORS},
        phases={"start": (START,), "clasp": ((time[0] - 1e-3, time[-1] + 1e-3),)},
    )
    blocks = ((time - time[0]) / LEAST_CORRELATION_S).astype(int)

    def slow(std: float) -> np.ndarray:
        """(n, 3), the same for as long as the calibration takes errors to last."""
        return rng.normal(scale=std, size=(blocks[-1] + 1, 3))[blocks]

    mean = np.array([person.lengths[name] for name in LENGTHS])
    for _ in range(count):
        # The person stays and the prior is drawn: the same difference.
        drawn = rng.multivariate_normal(mean, person.prior.lengths_covariance())
        own = rng.multivariate_normal(np.concatenate(list(RIGID_SHOULDERS.values())), compute_girdle_prior(TABLE))
        prior = replace(
            person.prior,
            lengths=dict(zip(LENGTHS, drawn.tolist(), strict=True)),
            girdles=dict(zip(RIGID_SHOULDERS, np.split(own, len(RIGID_SHOULDERS)), strict=True)),
        )
        width = person.lengths["shoulder_width"] + rng.normal(scale=person.measured_std)
        measured = {"shoulder_width": (width, person.measured_std)}
        R_WL = _slipped(motion, slow(slip))
        common = rng.normal(scale=ELBOW.common_std)
        mirrored = rng.normal(scale=ELBOW.mirror_std)
        for side, x in (("left", common + mirrored), ("right", common - mirrored)):
            R_WL = _hinged(R_WL, side, np.array([x, 1.0, rng.normal(scale=ELBOW.tilt_std)]))
        R_VS, R_VS_start, mounts = {}, {}, {}
        for name in SENSORS:
            psi, drift = rng.uniform(-np.pi, np.pi), rng.normal(scale=DRIFT_STD)
            tilt = Rotation.from_rotvec([*rng.normal(scale=TABLE.segments[name].start_std[:2]), 0.0])
            tissue = rng.normal(size=(3, 3)) * np.array(TABLE.segments[name].soft_tissue_std)[:, None]
            turned = R_WL[name]
            for _ in range(8):
                turned = R_WL[name] * Rotation.from_rotvec((turned.inv().apply(UP) - UP) @ tissue.T).inv()
            turned = turned * Rotation.from_rotvec(slow(SEGMENT_ATTITUDE_STD))
            Q = _about_z(-psi - drift * (time - START[1])) * turned * tilt.inv() * _about_z(psi)
            mounts[name] = Rotation.random(random_state=rng)
            R_VS_start[name] = _about_z(-psi) * tilt * mounts[name]
            R_VS[name] = Rotation.concatenate([*[R_VS_start[name]] * len(start_time), Q * R_VS_start[name]])
        filtered = FilteredRecording(R_VS, R_VS_start, {}, START, START, [])
        calibration = solve_calibration(CalibrationProblem(recording, filtered, protocol, prior, measured, MODEL))
        error = dict(zip(LENGTHS, np.array([calibration.subject.lengths[s] for s in LENGTHS]) - mean, strict=True))
        for name, rigid in RIGID_SHOULDERS.items():
            rows = [f"girdles.{name}.{parameter}" for parameter in PARAMETERS]
            error |= dict(zip(rows, calibration.subject.girdles[name] - rigid, strict=True))
        for name in SENSORS:
            off = (Rotation.from_quat(calibration.subject.mounts[name]) * mounts[name].inv()).as_rotvec()
            error |= dict(zip(mount_rows(name), off, strict=True))
        yield Draw(calibration, np.array([error[row] for row in calibration.subject.order]))


def _none(*parts: np.ndarray) -> np.ndarray:
    return np.zeros((sum(map(len, parts)), 3))


def _about_z(angle: np.ndarray | float) -> Rotation:
    return Rotation.from_rotvec(np.multiply.outer(angle, UP))


def _slipped(motion: Motion, slip: np.ndarray) -> dict[str, Rotation]:
    """The arms turned as little as brings the left palm `slip` (n, 3) [m] off the right one."""
    R_WL = dict(motion.R_WL)
    for side, share in (("left", 0.5), ("right", -0.5)):
        size = {part: motion.person.lengths[f"{side}_{part}"] for part in ("upper_arm", "forearm", "hand")}
        ways = {"upper_arm": size["upper_arm"], "forearm": size["forearm"] + size["hand"]}

        def way(part: str, R_WL: dict[str, Rotation] = R_WL, side: str = side, ways: dict = ways) -> np.ndarray:
            return -ways[part] * R_WL[f"{side}_{part}"].apply(UP)

        goal = way("upper_arm") + way("forearm") + share * slip
        for _ in range(4):
            left = goal - way("upper_arm") - way("forearm")
            lever = sum(np.sum(way(p) ** 2, axis=1)[:, None, None] * np.eye(3) for p in ways)
            lever = lever - sum(np.einsum("ni,nj->nij", way(p), way(p)) for p in ways)
            pull = np.linalg.solve(lever, left[:, :, None])[:, :, 0]
            turns = {part: Rotation.from_rotvec(np.cross(way(part), pull)) for part in ways}
            R_WL |= {f"{side}_{part}": turn * R_WL[f"{side}_{part}"] for part, turn in turns.items()}
    return R_WL


def _hinged(R_WL: dict[str, Rotation], side: str, axis: np.ndarray) -> dict[str, Rotation]:
    """The upper arm turned about its own length such that the forearm stays across `axis` (x, 1, z)."""
    upper, forearm = f"{side}_upper_arm", f"{side}_forearm"
    x, y, z = (R_WL[upper].inv() * R_WL[forearm]).apply(-UP).T
    # (x', y') is (x, y) turned by −φ: axis_x x' + y' + axis_z z = 0.
    across = np.hypot(x, y) * np.hypot(axis[0], 1.0)
    phase = np.arctan2(y, x) + np.arctan2(axis[0], 1.0)
    phi = phase - np.arcsin(np.clip(-axis[2] * z / across, -1.0, 1.0))
    return R_WL | {upper: R_WL[upper] * _about_z(phi)}


def ratios(motion: Motion, count: int, seed: int = 0) -> dict[str, float]:
    """Spread of each group over what is stated of it, but for calibrations that failed, as their palms do not meet."""
    made = [draw for draw in draws(motion, count, seed) if draw.calibration.rms_gap < GAP.poor]
    assert len(made) >= 0.98 * count
    order = made[0].calibration.subject.order
    ratio = {}
    for group, parts in GROUPS.items():
        T = np.array([[float(row in part) for row in order] for part in parts])
        error = np.array([T @ draw.error for draw in made])
        stated = np.array([np.diag(T @ draw.calibration.subject.covariance @ T.T) for draw in made])
        ratio[group] = float(np.sqrt(np.mean(error**2) / np.mean(stated)))
    return ratio


@pytest.mark.monte_carlo
def test_the_spread_is_what_is_stated(motion: Motion) -> None:
    ratio_of = ratios(motion, DRAWS)
    print({name: round(value, 2) for name, value in ratio_of.items()})
    assert all(0.7 < value < 1.3 for value in ratio_of.values()), ratio_of
