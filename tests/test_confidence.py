"""Standard deviations that are carried from filter and calibration to the points."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from bodies import LENGTHS, TABLE
from commands import run
from scipy.spatial.transform import Rotation

from wepose_pin.body import load_model
from wepose_pin.body.girdle import PARAMETERS
from wepose_pin.body.kinematics import compute_pose
from wepose_pin.body.links import compute_axis_std, compute_point_covariances
from wepose_pin.body.subject import girdle_rows, population_subject
from wepose_pin.simulation import MTI_3, simulate, simulate_person
from wepose_pin.tracking import track
from wepose_pin.tracking.measures import PERIOD_S, compute_error_budget
from wepose_pin.writers import write_session

ARMS = [f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm")]
EXACT = np.zeros_like(population_subject().shape_covariance(TABLE))  # lengths and girdles without errors


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

    common, drawn = rng.normal(size=n), {}
    for name in names:
        error = rng.multivariate_normal(np.zeros(3), cov[name], n)
        error[:, 2] = np.sqrt(1.0 - share[name] ** 2) * error[:, 2] + share[name] * heading_std[name] * common
        drawn[name] = (Rotation.from_rotvec(error) * mean[name]).as_quat()
    R_torso = mean["torso"].as_matrix()
    longer = [replace(body, lengths={**body.lengths, s: body.lengths[s] + 1e-3}) for s in LENGTHS]
    for girdle, values in own.items():
        longer += [replace(body, girdles={**own, girdle: values + step}) for step in 1e-3 * np.eye(len(PARAMETERS))]
    moved = [compute_pose(other.shape(model), np.zeros(1), still).points for other in longer]
    for name, p in compute_pose(model, np.zeros(n), drawn).points.items():
        turned = np.cov(p.T)
        # The shape's share is linear: by finite differences of Pinocchio's points.
        J = (np.array([of[name][0] for of in moved]) - points[name]).T / 1e-3
        # What leaves the law moves the shoulder of this side in the torso.
        leaving = np.diag(np.square(TABLE.girdles[f"{name.partition('_')[0]}_shoulder"].residual_std))
        expected = turned + J @ shape_cov @ J.T + R_torso @ leaving @ R_torso.T
        np.testing.assert_allclose(point_cov[name][0], expected, atol=0.04 * np.trace(expected))


def test_a_shoulder_whose_law_is_not_known_is_less_certain() -> None:
    """Without a sensor on the upper arm nobody knows how far it is raised."""
    still = {name: np.array([[0.0, 0.0, 0.0, 1.0]]) for name in ("torso", *ARMS)}
    model, shape_cov = load_model(), population_subject().shape_covariance(TABLE)
    of = [
        compute_point_covariances(model, {name: still[name] for name in names}, _certain(names), shape_cov)
        for names in (["torso", *ARMS], ["torso"])
    ]
    for name in ("left_shoulder", "right_shoulder"):
        assert np.all(np.diagonal(of[1][name][0]) > np.diagonal(of[0][name][0]) + 0.005**2)


def _certain(names: list[str]) -> dict[str, np.ndarray]:
    return {name: np.eye(3)[None] * 1e-8 for name in names}


def test_points_beyond_a_segment_without_covariance_have_none() -> None:
    still = {name: np.array([[0.0, 0.0, 0.0, 1.0]]) for name in ("torso", *ARMS)}
    model = load_model()
    cov = {name: np.eye(3)[None] * 1e-4 for name in ("torso", "left_upper_arm", "right_forearm")}
    point_cov = compute_point_covariances(model, still, cov, EXACT)
    assert set(point_cov) == {"left_shoulder", "left_elbow", "right_shoulder"}
    assert compute_point_covariances(model, still, {}, EXACT) == {}


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


def test_the_parts_of_the_error_budget_add_up_in_variance() -> None:
    recording = simulate(simulate_person(1).lengths, seed=1, clasp_s=5.0, circles=1, noise=MTI_3).recording()
    tracked = track(recording)
    parts_of = compute_error_budget(tracked)
    assert set(parts_of) == set(tracked.points)
    rows = np.arange(0, len(tracked.time), round(PERIOD_S * recording.rate_hz))
    for point, parts in parts_of.items():
        total = np.sqrt(np.mean(np.square(compute_axis_std(tracked.pose.point_cov[point][rows]))))
        assert np.sqrt(sum(std**2 for std in parts.values())) == pytest.approx(total, rel=1e-4)
        assert list(parts.values()) == sorted(parts.values(), reverse=True)
        assert min(parts.values()) >= 1e-4
        side = point.partition("_")[0]
        of = {part.partition(": ")[0] for part in parts} - {"shoulder girdle", "lengths"}
        assert {"shoulder girdle", "lengths"} < set(parts)
        # A segment matters for what it carries, with its sensor and with the soft tissue below that.
        carrying = ["torso", *(f"{side}_{part}" for part in ("upper_arm", "forearm"))]
        assert of == set(carrying[: {"shoulder": 1, "elbow": 2}.get(point.partition("_")[2], 3)])
    assert parts_of["left_palm"]["shoulder girdle"] == pytest.approx(
        parts_of["left_shoulder"]["shoulder girdle"], rel=1e-9
    )
    # A person who is known exactly has no share of lengths and girdles.
    order = (*LENGTHS, *girdle_rows(TABLE))
    exact = replace(population_subject(), order=order, covariance=np.zeros((len(order), len(order))))
    parts = compute_error_budget(track(recording, exact))["right_palm"]
    assert "lengths" not in parts
    leaving = np.sqrt(np.mean(np.square(TABLE.girdles["right_shoulder"].residual_std)))
    assert parts["shoulder girdle"] == pytest.approx(leaving, rel=1e-9)  # what leaves the law is nobody's parameter
