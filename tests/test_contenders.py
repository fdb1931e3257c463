"""The filters that are compared: none is handicapped, and each gives an orientation in our convention."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.validation import gains as tuning
from benchmarks.validation.contenders import DEFAULT_GAINS, PUBLISHED, Contender, list_contenders
from benchmarks.validation.experiment import align_rotation
from benchmarks.validation.gains import STATED, compute_rmse, list_trials, make_gains
from wepose_pin.evaluation import attitude_error
from wepose_pin.filters import METHODS, GdcParams, NcfParams
from wepose_pin.filters.noise import estimate_noise
from wepose_pin.simulation import SingleSensor, simulate_paper_dynamic

SETTING = "simulated 100 Hz"
ALL = list_contenders(SETTING)
NAMES = [contender.label for contender in ALL]


@pytest.fixture(scope="module")
def sensor() -> SingleSensor:
    return simulate_paper_dynamic(50, 100.0)


def at_rest(sensor: SingleSensor) -> np.ndarray:
    return (sensor.time >= 0.5) & (sensor.time <= 4.5)


def test_who_takes_part() -> None:
    others = ["ncf", "gdc", "ncf, default gains", "gdc, default gains"]
    ours = [method for method in METHODS if method not in (*others, PUBLISHED)]
    assert NAMES[: len(ours) + 5] == [*ours, PUBLISHED, *others]
    assert {contender.label for contender in ALL if contender.method} == set(ours)


def test_peers_take_part_where_they_are_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.validation.contenders.find_spec", lambda name: name == "vqf" or None)
    labels = [contender.label for contender in list_contenders(SETTING)]
    assert labels[-2:] == ["vqf", "offline vqf"]
    assert "imufusion" not in labels


@pytest.mark.parametrize("contender", ALL, ids=NAMES)
def test_orientations_are_xyzw_from_sensor_to_a_world_with_z_up(contender: Contender, sensor: SingleSensor) -> None:
    """Another order or the inverse is off by tens of degrees."""
    rest = at_rest(sensor)
    noise = estimate_noise(sensor.gyro_S[rest], sensor.accel_S[rest], sensor.rate_hz)
    quat = contender.orient(sensor.gyro_S, sensor.accel_S, sensor.rate_hz, noise)
    assert quat.shape == (len(sensor.time), 4)
    np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0, atol=1e-12)
    true = Rotation.from_quat(sensor.quat_WS)
    error = attitude_error(align_rotation(Rotation.from_quat(quat), true, rest), true, sensor.time)
    print(f"{contender.label}: {error.total_rmse:.2f} deg")
    assert error.total_rmse < (8.0 if "default gains" in contender.label else 3.0)


@pytest.mark.parametrize("contender", ALL, ids=NAMES)
def test_the_bias_is_removed_for_all_but_as_it_comes(contender: Contender, sensor: SingleSensor) -> None:
    rest, bias = at_rest(sensor), np.deg2rad([1.5, -1.0, 0.5])
    noise = estimate_noise(sensor.gyro_S[rest], sensor.accel_S[rest], sensor.rate_hz)
    biased = replace(noise, gyro_bias=noise.gyro_bias + bias)
    without, with_ = (
        Rotation.from_quat(contender.orient(gyro, sensor.accel_S, sensor.rate_hz, measured))
        for gyro, measured in ((sensor.gyro_S, noise), (sensor.gyro_S + bias, biased))
    )
    apart = np.degrees((without * with_.inv()).magnitude().max())
    if contender.label in [f"{name}, default gains" for name in DEFAULT_GAINS]:
        assert apart > 20.0
    else:
        assert apart < (0.05 if contender.label == "imufusion" else 1e-4)  # that one counts in single precision


def test_a_tuning_trial_is_scored_as_the_experiments_do() -> None:
    trial = tuning._make_dynamic_trial(tuning.DYNAMIC_SEEDS[0], 100.0)
    sensor = simulate_paper_dynamic(tuning.DYNAMIC_SEEDS[0], 100.0)
    true, rest = Rotation.from_quat(sensor.quat_WS), at_rest(sensor)
    moving = (sensor.time >= sensor.moving[0]) & (sensor.time <= sensor.moving[1])
    for contender in ALL:
        if contender.label in ("ncf", "gdc"):
            quat = contender.orient(sensor.gyro_S, sensor.accel_S, sensor.rate_hz, trial.noise)
            R_WS = align_rotation(Rotation.from_quat(quat), true, rest)
            expected = attitude_error(R_WS[moving], true[moving], sensor.time[moving]).total_rmse
            params = getattr(make_gains(SETTING), contender.label)
            assert compute_rmse(trial, params) == pytest.approx(expected, rel=0.02)


def test_tuning_trials_are_scored_nowhere_else() -> None:
    assert min(tuning.DYNAMIC_SEEDS) > 11
    assert min(tuning.PERSON_SEEDS) > 9
    assert not tuning.HALVES[0] & tuning.HALVES[1]
    assert make_gains("real", "01_undisturbed_slow_rotation_A") is STATED["BROAD, second half"]
    assert make_gains("real", "03_undisturbed_slow_rotation_C") is STATED["BROAD, first half"]
    assert make_gains("real", "prova_HR") is make_gains("real") is STATED["BROAD"]


@pytest.mark.peer
@pytest.mark.parametrize("setting", STATED)
def test_the_stated_gains_are_the_best_around(setting: str, request: pytest.FixtureRequest) -> None:
    """No neighbour on the grid is better, and the grid goes on beyond them; "gains" searches all of it."""
    folder: Path | None = None
    if setting.startswith("BROAD"):
        folder = request.getfixturevalue("data")
        if not any((folder / "broad").glob("*.mat")):
            pytest.skip(f"no real recordings at {folder / 'broad'}")
    trials = list_trials(setting, folder)

    def score(params: NcfParams | GdcParams) -> float:
        return float(np.mean([compute_rmse(trial, params) for trial in trials]))

    def around(axis: tuple[float, ...], value: float) -> list[float]:
        at = axis.index(value)
        assert at < len(axis) - 1, f"{value} is the end of the grid"
        return [float(point) for point in axis[max(at - 1, 0) : at + 2]]

    ncf, gdc = STATED[setting]
    neighbours: list[NcfParams | GdcParams] = [
        NcfParams(*point)
        for point in product(around(tuning.PROPORTIONAL, ncf.proportional), around(tuning.INTEGRAL, ncf.integral))
    ]
    assert score(ncf) <= min(score(params) for params in neighbours) + 1e-6
    assert score(gdc) <= min(score(GdcParams(gain)) for gain in around(tuning.DESCENT, gdc.gain)) + 1e-6
