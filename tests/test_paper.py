"""The paper's formulation of the calibration, and tracking without heading correction."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from bodies import SEGMENTS
from commands import run
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin import Calibration, OrientationSensor, Recording, Simulation, WeposeError, calibrate, track
from wepose_pin.simulation import Person, simulate, simulate_person
from wepose_pin.writers import write_session

SENSORS = SEGMENTS[:5]


@pytest.fixture(scope="module")
def made() -> tuple[Person, Simulation, Recording]:
    """Usual imperfections, so that nothing closes exactly."""
    person = simulate_person(5)
    simulation = simulate(person.lengths, seed=5, imperfections=wp.MILD_PRESET, clasp_s=36.0, circles=1)
    return person, simulation, simulation.recording()


@pytest.fixture(scope="module")
def estimated(made: tuple[Person, Simulation, Recording]) -> Calibration:
    person, _, recording = made
    measured = {"shoulder_width": person.lengths["shoulder_width"]}
    return calibrate(recording, measured=measured, prior=person.prior, method="smekf", formulation="paper")


def gap_by_length(made: tuple[Person, Simulation, Recording], time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gap by the shoulder width (3 n,), and by upper arm and forearm with hand of both sides (3 n, 4).

    Of the orientations of `track` at times (n,) [s]: the gap is R_t e_y w + u_l a_l + f_l b_l − u_r a_r − f_r b_r.
    """
    person, _, recording = made
    tracked = track(recording, person.prior, method="smekf", open_loop=True)
    assert tracked.correction is None
    samples = np.searchsorted(tracked.time, time - 1e-6)
    np.testing.assert_allclose(tracked.time[samples], time, atol=1e-9)
    R = {name: Rotation.from_quat(tracked.quat_WL[name][samples]) for name in SENSORS}
    columns = [
        sign * R[f"{side}_{part}"].apply([0.0, 0.0, -1.0])
        for side, sign in (("left", 1.0), ("right", -1.0))
        for part in ("upper_arm", "forearm")
    ]
    return R["torso"].apply([0.0, 1.0, 0.0]).reshape(-1), np.stack(columns, axis=2).reshape(-1, 4)


def test_lengths_are_those_of_numpys_least_squares(
    made: tuple[Person, Simulation, Recording], estimated: Calibration
) -> None:
    """With a known shoulder width."""
    person, _, _ = made
    across, columns = gap_by_length(made, estimated.time)
    width = person.lengths["shoulder_width"]
    expected, squares, *_ = np.linalg.lstsq(columns, -width * across)
    lengths = estimated.subject.lengths
    arms = [
        value
        for side in ("left", "right")
        for value in (lengths[f"{side}_upper_arm"], lengths[f"{side}_forearm"] + lengths[f"{side}_hand"])
    ]
    np.testing.assert_allclose(arms, expected, atol=1e-8)
    assert lengths["shoulder_width"] == pytest.approx(width, abs=1e-12)
    assert estimated.rms_gap == pytest.approx(np.sqrt(squares[0] / len(estimated.time)), rel=1e-9)
    assert estimated.rms_gap > 5e-3  # there is something to minimise
    # What the gap does not show is the population's.
    assert lengths["trunk"] == pytest.approx(person.prior.lengths["trunk"], abs=1e-12)
    for side in ("left", "right"):
        share, population = (
            of[f"{side}_hand"] / (of[f"{side}_forearm"] + of[f"{side}_hand"]) for of in (lengths, person.prior.lengths)
        )
        assert share == pytest.approx(population, abs=1e-9)


def test_the_covariance_is_that_of_the_same_least_squares(
    made: tuple[Person, Simulation, Recording], estimated: Calibration
) -> None:
    person, _, _ = made
    _, columns = gap_by_length(made, estimated.time)
    variance = np.sum(estimated.gap**2) / (len(columns) - 4) * len(estimated.gap) / estimated.effective_sample_size
    expected = variance * np.linalg.inv(columns.T @ columns)
    # A measured length that is off by one standard deviation scales all that the gap shows.
    names = ["left_upper_arm", "left_forearm", "left_hand", "right_upper_arm", "right_forearm", "right_hand"]
    sums = np.zeros((4, 6))
    sums[[0, 1, 1, 2, 3, 3], range(6)] = 1.0
    arms = sums @ [estimated.subject.lengths[name] for name in names]
    width, std = person.lengths["shoulder_width"], 0.003
    expected += np.outer(arms, arms) * (std / width) ** 2
    np.testing.assert_allclose(sums @ estimated.subject.lengths_covariance(names) @ sums.T, expected, rtol=1e-6)
    assert estimated.subject.std("shoulder_width") == pytest.approx(std, rel=1e-9)
    assert estimated.subject.std("trunk") == pytest.approx(person.prior.std("trunk"), rel=1e-9)
    assert np.linalg.eigvalsh(estimated.subject.covariance)[0] > 0.0


def test_a_measured_length_that_nobody_has_is_named(made: tuple[Person, Simulation, Recording]) -> None:
    person, _, recording = made
    calibration = calibrate(recording, measured={"shoulder_width": 0.6}, prior=person.prior, formulation="paper")
    quality = calibration.quality
    (contradicted,) = [each for each in quality.reasons if each.code == "length-contradicted"]
    assert quality.quality == "fail"
    width = 1e3 * person.prior.lengths["shoulder_width"]
    assert f"was measured as 600 mm. All else gives {width:.0f} mm ±" in str(contradicted)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "needs one measured length that fixes the scale, as in `measured` biacromial=0.41; there is: shoul"),
        ({"measured": {"trunk": 0.5, "left_hand": 0.07}}, "needs one measured length that fixes the scale"),
        ({"measured": {"shoulder_width": 0.4}, "protocol": "table"}, "points of the body coincide .* not 'table'"),
        ({"measured": {"shoulder_width": 0.4}, "protocol": "t_pose"}, "points of the body coincide .* not 't_pose'"),
        (
            {"prior": replace(wp.population_subject(), order=(), covariance=np.zeros((0, 0)))},
            "lengths need a covariance",
        ),
        ({"formulation": "linear"}, "formulation = 'linear' is not known; .*full, paper"),
    ],
)
def test_what_it_needs_is_said(options: dict[str, Any], said: str, made: tuple[Person, Simulation, Recording]) -> None:
    with pytest.raises(WeposeError, match=said):
        calibrate(made[2], **({"formulation": "paper"} | options))


def test_another_start_pose_is_refused(made: tuple[Person, Simulation, Recording]) -> None:
    """Its orientations are relative to the start pose: in the T-pose they would be those of other arms."""
    expected = "start_pose = 't_pose'; record a start in n_pose, or use `formulation` full"
    with pytest.raises(WeposeError, match=expected):
        calibrate(replace(made[2], start_pose="t_pose"), measured={"shoulder_width": 0.4}, formulation="paper")


@pytest.mark.parametrize(
    ("swing", "said"),
    [(0.0, "the motion does not determine the lengths"), (0.3, r"the gap is least with .* = -?\d+ mm")],
)
def test_hands_that_are_not_joined_give_no_lengths(swing: float, said: str) -> None:
    """Arms that hang, or swing on their own: the gap cannot close, and arms of no length are its least."""
    person = simulate_person(11)
    simulation = simulate(person.lengths, seed=11, noise=wp.NOISE_FREE, clasp_s=6.0, circles=0)
    since = np.clip(simulation.time - 5.0, 0.0, None)
    sensors = {}
    for k, name in enumerate(simulation.quat_WL):
        angles = k * swing * np.sin((1.0 + 0.3 * k) * since)[:, None] * [0.3, 1.0, 0.0]
        sensors[name] = OrientationSensor(quat_VS=Rotation.from_rotvec(angles).as_quat())
    with pytest.raises(WeposeError, match=said):
        calibrate(
            replace(simulation.recording("apart"), sensors=sensors),
            measured={"shoulder_width": 0.38},
            formulation="paper",
        )


def test_the_commands(
    made: tuple[Person, Simulation, Recording], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    person, simulation, recording = made
    (tmp_path / "session").mkdir()
    write_session(tmp_path / "session", recording, simulation.truth())
    options = ["--formulation", "paper", "--method", "smekf_published"]
    words = ["calibrate", tmp_path / "session", *options, "-o", tmp_path / "anna"]
    assert run(*words) == 2
    captured = capsys.readouterr().err
    assert captured.count("\n") == 1
    assert "--measured biacromial=0.41" in captured
    assert not (tmp_path / "anna").exists()
    assert run(*words, "--measured", f"shoulder_width={person.lengths['shoulder_width']:.4f}") in (0, 3)
    captured = capsys.readouterr()
    assert "Mounts" not in captured.out
    content = json.loads((tmp_path / "anna" / "calibration.json").read_text())
    assert content["provenance"]["options"]["formulation"] == "paper"
    assert wp.load_subject(tmp_path / "anna").mounts == {}
    assert {values[0] for values in wp.load_subject(tmp_path / "anna").girdles.values()} == {-1.0}  # fixed shoulders
    page = (tmp_path / "anna" / "report.html").read_text(encoding="utf-8")
    assert "leave out errors of mounts" in page

    out = tmp_path / "result"
    options = ["--method", "smekf_published", "--open-loop", "--no-view", "--no-report"]
    assert run("track", tmp_path / "session", "--subject", tmp_path / "anna", *options, "-o", out) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["heading_correction"] is None
    assert summary["provenance"]["options"]["open_loop"] is True
    tracked = track(recording, wp.load_subject(tmp_path / "anna"), method="smekf_published", open_loop=True)
    palm = pl.read_parquet(out / "pose.parquet", columns=["right_palm_x"]).to_series().to_numpy()
    np.testing.assert_allclose(palm, tracked.points["right_palm"][:, 0], atol=1e-9)
