"""Headings of neighbours by the acceleration of the joint between them, in tracking."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.body import load_model
from wepose_pin.body.subject import population_subject
from wepose_pin.observations.joint_accelerations import JointPair, linearize_joint
from wepose_pin.recording import ImuSensor, Recording
from wepose_pin.rotations import heading
from wepose_pin.simulation import MILD_PRESET, NOISE_FREE, Simulation, simulate, simulate_person
from wepose_pin.tracking import TrackResult, track
from wepose_pin.tracking.heading_filter import HeadingFilter
from wepose_pin.tracking.heading_problem import PERSON_NOISE, HeadingProblem
from wepose_pin.tracking.headings import JointAccelerationFilter

LIMB = ("torso", "right_upper_arm", "right_forearm")


@pytest.fixture(scope="module")
def moving() -> Simulation:
    return simulate(simulate_person(3).lengths, seed=3, imperfections=MILD_PRESET, clasp_s=60.0, circles=2)


def without_phases(recording: Recording) -> Recording:
    return replace(recording, phases={"start": recording.phases["start"]})


def biased(simulation: Simulation, deg_s: float) -> Recording:
    """The gyroscope of the right forearm turns about the vertical of the start pose, from its end on."""
    recording = without_phases(simulation.recording())
    sensor = recording.imus["right_forearm"]
    after = recording.time > recording.phases["start"][0][1]
    up_S = Rotation.from_quat(simulation.quat_WS["right_forearm"]).inv().apply([0.0, 0.0, 1.0])
    gyro_S = sensor.gyro_S + np.deg2rad(deg_s) * after[:, None] * up_S
    return replace(recording, sensors={**recording.sensors, "right_forearm": replace(sensor, gyro_S=gyro_S)})


def heading_errors(simulation: Simulation, tracked: TrackResult, from_s: float) -> dict[tuple[str, str], np.ndarray]:
    """Heading [deg] of each sensor's world of the right arm against its neighbour's."""
    rows = np.flatnonzero(tracked.time > from_s)[::20]
    at = np.searchsorted(simulation.time, tracked.time[rows] - 1e-9)
    off = {}
    for name in LIMB:
        R_WS = Rotation.from_quat(tracked.quat_WL[name][rows]) * Rotation.from_quat(tracked.segments.quat_LS[name])
        off[name] = heading((Rotation.from_quat(simulation.quat_WS[name][at]) * R_WS.inv()).as_quat())
    return {(a, b): np.degrees(np.angle(np.exp(1j * (off[a] - off[b])))) for a, b in pairwise(LIMB)}


def test_exact_motion_fits_with_the_true_levers() -> None:
    simulation = simulate(simulate_person(2).lengths, seed=2, noise=NOISE_FREE, clasp_s=20.0, circles=0)
    upper = simulation.lengths["left_upper_arm"]
    levers_L = [simulation.p_LS["left_upper_arm"] + [0.0, 0.0, upper], simulation.p_LS["left_forearm"]]
    names = ("left_upper_arm", "left_forearm")
    R_LS = [Rotation.from_quat(simulation.quat_LS[name]) for name in names]
    levers = [R.inv().apply(lever) for R, lever in zip(R_LS, levers_L, strict=True)]
    near, far = (np.concatenate((lever, np.zeros(4))) for lever in levers)
    R_WS = np.stack([Rotation.from_quat(simulation.quat_WS[name]).as_matrix() for name in names], axis=1)
    accel_S = np.stack([simulation.accel_S[name] for name in names], axis=1)
    whole = JointAccelerationFilter(2, simulation.rate_hz).push(R_WS, accel_S)[::12]
    for angle, least, most in ((0.0, 0.0, 0.02), (0.2, 0.05, 1.0)):
        e, _, force = linearize_joint(whole[:, 0], whole[:, 1], angle, near, far)
        misfit, signal = np.sqrt(np.mean(e**2)), np.sqrt(np.mean(force**2))
        assert least * signal <= misfit < most * signal
    # An accelerometer that is late by 5 ms, and the delay that says so.
    late = accel_S.copy()
    step = round(0.005 * simulation.rate_hz) or 1
    late[step:, 1] = accel_S[:-step, 1]
    B = JointAccelerationFilter(2, simulation.rate_hz).push(R_WS, late)[::12]
    delay = np.concatenate((far[:6], [step / simulation.rate_hz]))
    known, unknown = (linearize_joint(B[:, 0], B[:, 1], 0.0, near, side)[0] for side in (delay, far))
    assert np.mean(known**2) < 0.1 * np.mean(unknown**2)


def test_in_an_even_spin_a_wrong_tilt_is_not_taken_for_an_acceleration_of_the_joint() -> None:
    """Two sensors on an office chair, each with a tilt of a degree wrong; their joint is on the axis."""
    rng, rate_hz, knot_s = np.random.default_rng(5), 50.0, 2.0
    samples = round(knot_s * rate_hz)
    turned = np.deg2rad(90.0) / rate_hz * np.arange(25 * samples)
    spin = Rotation.from_rotvec(np.outer(turned, [0.0, 0.0, 1.0])).as_matrix()
    names = ("torso", "head")
    pair = JointPair(*names, np.zeros(6), 0.01, False)
    zeros = np.zeros(2)
    filters = np.zeros((4, 2))
    problem = HeadingProblem(
        names, load_model(), population_subject(), (pair,), (), np.zeros((0, 3)), None, PERSON_NOISE, rate_hz, 1,
        samples, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)), np.zeros(2, dtype=bool), zeros, np.full(2, 1e-4),
        np.deg2rad([0.1, 20.0]) ** 2, zeros, 0.0,
    )  # fmt: skip
    z = []
    for _ in range(20):
        tilt = Rotation.from_rotvec(np.deg2rad(1.0) * rng.normal(size=(2, 3)) * [1.0, 1.0, 0.0]).as_matrix()
        off = rng.normal(scale=np.deg2rad(20.0))
        R_WS = np.stack([spin @ tilt[0], Rotation.from_rotvec([0.0, 0.0, -off]).as_matrix() @ spin @ tilt[1]], axis=1)
        accel_S = np.broadcast_to([0.0, 0.0, 9.81], (len(spin), 2, 3)) + rng.normal(scale=0.02, size=(len(spin), 2, 3))
        accelerations, state = JointAccelerationFilter(2, rate_hz), HeadingFilter(problem, filters)
        for begin in range(0, len(spin), samples):
            rows = slice(begin, begin + samples)
            sides = accelerations.push(R_WS[rows], accel_S[rows])[::5]
            quats = np.tile([0.0, 0.0, 0.0, 1.0], (1, 2, 1))
            list(state.step(quats, sides, np.zeros(len(quats), dtype=bool), np.zeros(2, dtype=bool), filters))
        z.append((off - state.x[1] + state.x[0]) / np.sqrt(state.P[1, 1] + state.P[0, 0] - 2.0 * state.P[0, 1]))
    assert np.sqrt(np.mean(np.square(z))) < 1.5


@pytest.mark.parametrize("causal", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_forearm_that_drifts_is_corrected_without_calibration_and_clasp(moving: Simulation, causal: bool) -> None:
    recording = biased(moving, 0.15)
    rms = {}
    for open_loop in (True, False):
        tracked = track(recording, open_loop=open_loop, causal=causal)
        errors = heading_errors(moving, tracked, 30.0)
        rms[open_loop] = {pair: float(np.sqrt(np.mean(error**2))) for pair, error in errors.items()}
    elbow = LIMB[1:]
    assert rms[True][elbow] > 5.0
    assert rms[False][elbow] < 2.0
    correction = tracked.correction
    assert correction is not None
    assert set(correction.summarize()["joint_accelerations"]) == {
        f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm")
    }
    rows = tracked.time[tracked.time > 30.0][::20]
    for near, far in pairwise(LIMB):
        by_std = heading_errors(moving, tracked, 30.0)[near, far] / np.degrees(correction.relative_std(near, far, rows))
        assert np.sqrt(np.mean(by_std**2)) < 1.6


@pytest.mark.parametrize("causal", [False, True])
def test_arms_that_hang_still_stay_as_the_filter_has_them(moving: Simulation, causal: bool) -> None:
    rng = np.random.default_rng(1)
    n = 6000
    sensors = {}
    for name, sensor in moving.recording().imus.items():
        accel_S = sensor.accel_S[200] + rng.normal(0.0, 0.02, (n, 3))
        sensors[name] = ImuSensor(
            gyro_S=rng.normal(0.0, 2e-3, (n, 3)), accel_S=accel_S, stated_quat_LS=sensor.stated_quat_LS
        )
    recording = Recording("still", np.arange(n) / 100.0, 100.0, sensors, {"start": ((0.5, 4.5),)})
    corrected, alone = (track(recording, causal=causal, open_loop=open_loop) for open_loop in (False, True))
    for name, quat in alone.quat_WL.items():
        turned = Rotation.from_quat(corrected.quat_WL[name]) * Rotation.from_quat(quat).inv()
        assert np.degrees(turned.magnitude().max()) < 3.0  # by the hinges, of arms whose start pose is known to 13 deg
