"""Torques: a pendulum in closed form, power against energy, and what cannot have any."""

import numpy as np
import pinocchio as pin
import pytest

from wepose_pin.angles.torques import joint_torques
from wepose_pin.body import load_model
from wepose_pin.errors import WeposeError
from wepose_pin.simulation import Simulation
from wepose_pin.tracking import track

MASS, LENGTH, RATE = 2.0, 0.7, 200.0


def pendulum() -> pin.Model:
    """A point mass below a hinge about y."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "hinge")
    model.appendBodyToJoint(
        joint, pin.Inertia(MASS, np.array([0.0, 0.0, -LENGTH]), np.zeros((3, 3))), pin.SE3.Identity()
    )
    return model


def test_a_pendulum_is_driven_as_its_equation_says() -> None:
    """τ = m l² φ'' + m g l sin φ, of a swing far below the cut-off."""
    t = np.arange(0.0, 10.0, 1.0 / RATE)
    w, most = 2.0 * np.pi * 0.5, 0.8
    phi = most * np.sin(w * t)
    tau = joint_torques(pendulum(), t, phi[:, None], cutoff_hz=20.0).torque["hinge"][:, 0]
    true = -MASS * LENGTH**2 * w**2 * phi + MASS * 9.81 * LENGTH * np.sin(phi)
    inside = slice(200, -200)  # a second from each end
    assert np.abs(tau - true)[inside].max() < 2e-3 * np.abs(true).max()


def swing(model: pin.Model, t: np.ndarray, seed: int) -> np.ndarray:
    """A smooth motion of all joints."""
    rng = np.random.default_rng(seed)
    rows = 0.4 * np.sin(2.0 * np.pi * np.outer(t, rng.uniform(0.2, 0.6, model.nv)) + rng.uniform(0.0, 6.0, model.nv))
    return np.array([pin.integrate(model, pin.neutral(model), row) for row in rows])


def test_the_power_of_all_joints_is_the_growth_of_energy() -> None:
    model = load_model().pin
    t = np.arange(0.0, 8.0, 1.0 / RATE)
    torques = joint_torques(model, t, swing(model, t, 1), cutoff_hz=20.0)
    data = model.createData()
    energy = np.array(
        [
            pin.computeKineticEnergy(model, data, q, v) + pin.computePotentialEnergy(model, data, q)
            for q, v in zip(torques.q, torques.v, strict=True)
        ]
    )
    power = np.zeros(len(t))
    for name, tau in torques.torque.items():
        first = model.idx_vs[model.getJointId(name)]
        power += np.einsum("ni,ni->n", tau, torques.v[:, first : first + tau.shape[1]])
    work = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1])) / RATE])
    inside = slice(200, -200)
    left = (energy - work)[inside]
    assert np.ptp(energy[inside]) > 1.0  # [J]
    assert np.ptp(left) < 2e-3 * np.ptp(energy[inside])


def test_a_hanging_arm_bears_nothing_and_a_raised_one_its_weight(simulation: Simulation) -> None:
    pose = track(simulation.recording())
    assert pose.q is not None
    torques = joint_torques(pose.model.pin, pose.time, pose.q)
    begin, end = simulation.phases["start"][0]
    still = (pose.time > begin + 0.5) & (pose.time < end - 0.5)
    elbow = np.linalg.norm(torques.torque["left_forearm"], axis=1)
    assert elbow[still].max() < 0.1
    begin, end = simulation.phases["clasp"][0]
    assert 0.5 < np.median(elbow[(pose.time > begin) & (pose.time < end)]) < 10.0


def test_what_has_no_torques() -> None:
    t = np.arange(100) / RATE
    bare = pin.Model()
    bare.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "hinge")
    with pytest.raises(WeposeError, match="no moving link has a mass"):
        joint_torques(bare, t, np.zeros((100, 1)))
    with pytest.raises(WeposeError, match="below half the rate, 100 Hz"):
        joint_torques(pendulum(), t, np.zeros((100, 1)), cutoff_hz=120.0)
    with pytest.raises(WeposeError, match="at least 11"):
        joint_torques(pendulum(), t[:5], np.zeros((5, 1)))
