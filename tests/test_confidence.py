"""Standard deviations that are carried from filter and calibration to the points."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from bodies import GIRDLE_ROWS, LENGTHS, TABLE
from commands import run
from scipy.spatial.transform import Rotation

from wepose_pin import (
    joint_angles,
    load_model,
    load_result,
    load_session,
    population_subject,
    simulate,
    simulate_person,
    track,
)
from wepose_pin.body.configuration import compute_pose
from wepose_pin.body.kinematics import compute_point_covariances
from wepose_pin.writers import write_session
from wepose_pin.writers.motion import resample

ARMS = [f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm")]


@pytest.mark.parametrize("with_hands", [False, True])
def test_point_covariance_is_what_drawing_errors_gives(with_hands: bool) -> None:
    """Draw orientations and shape from their covariances, let Pinocchio place the points, and look at the cloud.

    The headings are drawn with something in common.
    """
    rng = np.random.default_rng(0)
    n = 40000
    names = ["torso", *ARMS, *(["left_hand", "right_hand"] if with_hands else [])]
    mean = {name: Rotation.random(random_state=rng) for name in names}
    cov = {name: np.diag(rng.uniform(0.5, 2.0, 3) * 4e-4) for name in names}
    share = dict(zip(names, rng.uniform(-0.8, 0.8, len(names)), strict=True))  # of each heading's deviation, in common
    heading_std = {name: np.sqrt(cov[name][2, 2]) for name in names}
    heading_cov = {
        (near, far): np.array([share[near] * heading_std[near] * share[far] * heading_std[far]])
        for near, far in combinations(names, 2)
    }
    own = {name: np.array([-0.3, *rng.normal(scale=0.01, size=6)]) for name in TABLE.girdles}
    body = replace(population_subject(), girdles=own)
    shape_cov = 0.04 * body.shape_covariance(TABLE)
    still = {name: rotation.as_quat()[None] for name, rotation in mean.items()}
    model = body.shape(load_model())
    points = compute_pose(model, np.zeros(1), still).points
    segment_cov = {name: c[None] for name, c in cov.items()}
    point_cov = compute_point_covariances(model, still, segment_cov, shape_cov, heading_cov=heading_cov)
    assert set(point_cov) == set(points)
    # After hours of drift the headings are all but unknown, each and in common.
    drifted = {name: c + np.diag([0.0, 0.0, 1e6 * c[0, 2, 2]]) for name, c in segment_cov.items()}
    together = {pair: 1e6 * shared for pair, shared in heading_cov.items()}
    for c in compute_point_covariances(model, still, drifted, shape_cov, heading_cov=together).values():
        assert (np.linalg.eigvalsh(c) >= 0.0).all()

    common, drawn = rng.normal(size=n), {}
    for name in names:
        error = rng.multivariate_normal(np.zeros(3), cov[name], n)
        error[:, 2] = np.sqrt(1.0 - share[name] ** 2) * error[:, 2] + share[name] * heading_std[name] * common
        drawn[name] = (Rotation.from_rotvec(error) * mean[name]).as_quat()
    R_torso = mean["torso"].as_matrix()
    longer = [replace(body, lengths={**body.lengths, s: body.lengths[s] + 1e-3}) for s in LENGTHS]
    for girdle, values in own.items():
        longer += [replace(body, girdles={**own, girdle: values + step}) for step in 1e-3 * np.eye(7)]
    moved = [compute_pose(other.shape(model), np.zeros(1), still).points for other in longer]
    for name, p in compute_pose(model, np.zeros(n), drawn).points.items():
        turned = np.cov(p.T)
        # The shape's share is linear: by finite differences of Pinocchio's points.
        J = (np.array([of[name][0] for of in moved]) - points[name]).T / 1e-3
        # What leaves the law moves the shoulder of this side in the torso.
        leaving = np.diag(np.square(TABLE.girdles[f"{name.partition('_')[0]}_shoulder"].residual_std))
        expected = turned + J @ shape_cov @ J.T + R_torso @ leaving @ R_torso.T
        np.testing.assert_allclose(point_cov[name][0], expected, atol=0.04 * np.trace(expected))


def test_the_columns_of_the_result(tmp_path: Path) -> None:
    person = simulate_person(1)
    simulation = simulate(person.lengths, seed=1, clasp_s=5.0, circles=1)
    write_session(tmp_path, simulation.recording())
    for name, *switch in (("a",), ("b", "--covariance"), ("c", "--method", "ncf")):
        assert run("track", tmp_path, "--no-view", "--no-report", "-o", tmp_path / name, *switch) == 0
    plain, full, without = (pl.read_parquet(tmp_path / name / "pose.parquet") for name in "abc")
    assert {"torso_std", "left_palm_std", "right_elbow_std"} <= set(plain.columns)
    assert not [name for name in plain.columns if "_cov_" in name]
    entries = ["xx", "xy", "xz", "yy", "yz", "zz"]
    assert {f"torso_cov_{e}" for e in entries} | {f"left_palm_cov_{e}" for e in entries} <= set(full.columns)
    trace = full["left_palm_cov_xx"] + full["left_palm_cov_yy"] + full["left_palm_cov_zz"]
    np.testing.assert_allclose(np.sqrt(trace / 3), full["left_palm_std"])
    assert not [name for name in without.columns if name.endswith("_std")]  # NCF has no covariance
    assert plain["torso_std"].is_finite().all()
    read, even = load_result(tmp_path / "b"), track(load_session(tmp_path))
    for other in (read, resample(even, 100.0)):
        np.testing.assert_allclose(joint_angles(other)["left_elbow"].std, joint_angles(even)["left_elbow"].std)


def test_the_parts_of_the_error_budget_add_up_in_variance() -> None:
    recording = simulate(simulate_person(1).lengths, seed=1, clasp_s=5.0, circles=1).recording()
    tracked = track(recording)
    budget = tracked.summary["error_budget_mm"]
    assert set(budget) == set(tracked.points)
    for point, parts in budget.items():
        total = 1e3 * np.sqrt(np.mean(np.trace(tracked.pose.point_cov[point], axis1=1, axis2=2)) / 3.0)
        assert np.sqrt(sum(std**2 for std in parts.values())) == pytest.approx(total, rel=0.02)
        assert list(parts.values()) == sorted(parts.values(), reverse=True)
    # A person who is known exactly has no share of lengths, and of girdles what leaves the law.
    order = (*LENGTHS, *GIRDLE_ROWS)
    exact = replace(population_subject(), order=order, covariance=np.zeros((len(order), len(order))))
    parts = track(recording, exact).summary["error_budget_mm"]["right_palm"]
    assert "lengths" not in parts
    leaving = np.sqrt(np.mean(np.square(TABLE.girdles["right_shoulder"].residual_std)))
    assert parts["shoulder girdle"] == pytest.approx(1e3 * leaving, rel=0.02)
