"""The closest pose within limits: against brute force, the limits, and the recording of a person."""

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import polars as pl
import pytest
from bodies import measure_residuals
from commands import run
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from wepose_pin.body import BodyModel, load_model
from wepose_pin.body.configuration import solve_configuration
from wepose_pin.body.kinematics import compute_link_poses
from wepose_pin.readers import load_session
from wepose_pin.simulation import Person, simulate
from wepose_pin.tracking import track
from wepose_pin.writers import write_session

ARM = ["left_upper_arm", "left_forearm", "left_hand"]
HINGES = ("jLeftElbow_roty", "jLeftElbow_rotz", "jLeftWrist_rotx", "jLeftWrist_rotz")


@pytest.fixture(scope="module")
def body(data: Path) -> BodyModel:
    """Elbows and wrists of two axes."""
    return load_model(data / "human_urdf" / "humanSubject01_48dof.urdf")


def places(model: pin.Model, names: tuple[str, ...] = HINGES) -> list[int]:
    return [model.idx_qs[model.getJointId(name)] for name in names]


def motion(body: BodyModel, n: int, seed: int, off_deg: float, reach: float = 0.6) -> dict[str, np.ndarray]:
    """A smooth motion of torso and left arm inside its limits, measured `off_deg` off in each axis."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 2.0 * np.pi, n)
    q = np.tile(pin.neutral(body.pin), (n, 1))
    at = places(body.pin)
    low, high = body.pin.lowerPositionLimit[at], body.pin.upperPositionLimit[at]
    swing = np.sin(np.outer(t, rng.uniform(1.0, 3.0, 4)) + rng.uniform(0.0, 6.0, 4))
    q[:, at] = (low + high) / 2.0 + reach * (high - low) / 2.0 * swing
    first = body.pin.idx_qs[body.pin.getJointId("LeftUpperArm")]
    q[:, first : first + 4] = Rotation.from_rotvec(np.sin(np.outer(t, [1.0, 1.3, 0.7]))).as_quat()
    R_WL, _ = compute_link_poses(body, q, ["torso", *ARM])
    quat_WL = {name: Rotation.from_matrix(R_WL[:, k]).as_quat() for k, name in enumerate(["torso", *ARM])}
    off = {name: Rotation.from_rotvec(np.deg2rad(off_deg) * rng.normal(size=3)) for name in ARM}
    return quat_WL | {name: (Rotation.from_quat(quat_WL[name]) * off[name]).as_quat() for name in ARM}


def cost(body: BodyModel, q: np.ndarray, quat_WL: dict[str, np.ndarray]) -> float:
    """What is to be least, by forward kinematics and SciPy alone."""
    residuals = measure_residuals(body, q[None], {name: quat_WL[name] for name in ARM})
    return float(np.sum(np.square(list(residuals.values()))))


def test_nothing_is_nearer_by_another_minimiser(body: BodyModel) -> None:
    quat_WL = motion(body, 40, 1, 15.0, reach=1.3)
    solution = solve_configuration(body, quat_WL)
    model, at = body.pin, places(body.pin)
    first = model.idx_vs[model.getJointId("LeftUpperArm")]
    columns = [*range(first, first + 3), *(model.idx_vs[model.getJointId(name)] for name in HINGES)]
    for k in (0, 7, 13, 26, 39):
        target = {name: quat[k] for name, quat in quat_WL.items()}

        def left(step: np.ndarray, k: int = k, target: dict[str, np.ndarray] = target) -> float:
            v = np.zeros(model.nv)
            v[columns] = step
            return cost(body, pin.integrate(model, solution[k], v), target)

        low, high = model.lowerPositionLimit[at] - solution[k, at], model.upperPositionLimit[at] - solution[k, at]
        free = [(-3.0, 3.0)] * 3 + [(min(a, 0.0), max(b, 0.0)) for a, b in zip(low, high, strict=True)]
        best = minimize(left, np.zeros(7), bounds=free, options={"ftol": 1e-15, "gtol": 1e-9})
        assert cost(body, solution[k], target) < best.fun + 1e-9


def test_limits_are_kept_and_the_rest_of_the_arm_takes_its_share(body: BodyModel) -> None:
    quat_WL = motion(body, 200, 2, 5.0, reach=1.5)
    q = solve_configuration(body, quat_WL)
    at = places(body.pin)
    lower, upper = body.pin.lowerPositionLimit[at], body.pin.upperPositionLimit[at]
    assert np.all((q[:, at] >= lower) & (q[:, at] <= upper))
    assert np.any((q[:, at] == lower) | (q[:, at] == upper))
    residuals = measure_residuals(body, q, quat_WL)
    assert all(np.rad2deg(np.sqrt(np.mean(residuals[name] ** 2))) > 2.0 for name in ARM)


def test_what_can_be_followed_within_limits_is_followed_exactly(body: BodyModel) -> None:
    quat_WL = motion(body, 200, 4, 0.0, reach=0.9)
    q = solve_configuration(body, quat_WL)
    assert max(angle.max() for angle in measure_residuals(body, q, quat_WL).values()) < 1e-7
    assert np.abs(np.diff(q, axis=0)).max() < 0.2  # it does not jump


@pytest.mark.slow
def test_a_person_on_48_degrees_of_freedom(data: Path, body: BodyModel) -> None:
    """The arms hang in both standing phases, though the elbows have two axes and an end."""
    recording = load_session(data / "upper_body" / "session.toml")
    pose = track(recording, model=body)
    missed = pose.summary["orientation_residual_rms_deg"]
    assert set(missed) == {f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm", "hand")}
    assert max(missed.values()) < 20.0
    arms = [f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm")]
    for interval, most in (((40.2, 44.4), 3.0), ((84.5, 88.0), 15.0)):
        span = recording.span(interval)
        R, _ = compute_link_poses(body, pose.q[span], arms)
        down = np.degrees(np.arccos(np.clip(R[:, :, 2, 2].mean(axis=0), -1.0, 1.0)))
        assert np.all(down < most)
    at = places(body.pin)
    lower, upper = body.pin.lowerPositionLimit[at], body.pin.upperPositionLimit[at]
    assert np.all((pose.q[:, at] >= lower) & (pose.q[:, at] <= upper))


@pytest.mark.slow
def test_torques_are_written_as_estimates(data: Path, person: Person, tmp_path: Path) -> None:
    simulation = simulate(person.lengths, seed=3, rate_hz=25.0)
    write_session(tmp_path, simulation.recording())
    words = ("--model", data / "human_urdf" / "humanSubject01_48dof.urdf", "--torques", "--no-view", "--no-report")
    assert run("track", tmp_path, *words, "-o", tmp_path / "out") == 0
    table = pl.read_parquet(tmp_path / "out" / "torques.parquet")
    assert {"time", "LeftUpperArm_x_nm", "jLeftElbow_rotz_nm"} <= set(table.columns)
    assert not [name for name in table.columns if "Knee" in name]
    torques = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["torques"]
    assert torques["note"].startswith("estimates")
    assert torques["95_percent_below"].keys() == torques["rms"].keys() >= {"LeftUpperArm", "jRightElbow_rotz"}
