"""The simulator against what shares no code with it: integrals, splines, geometry of the points."""

import numpy as np
import pytest
from bodies import LENGTHS
from scipy.spatial.transform import Rotation
from simulated import SEGMENTS, SIDES, SUBJECT, G, check_accel, check_gyro, within

from wepose_pin import NOISE_FREE, ImuNoise, Simulation, simulate


@pytest.fixture(scope="module")
def perfect() -> Simulation:
    return simulate(SUBJECT, seed=3, noise=NOISE_FREE)


@pytest.fixture(scope="module")
def fast() -> Simulation:
    return simulate(SUBJECT, seed=4, rate_hz=1000.0, noise=NOISE_FREE, clasp_s=10.0, circles=1)


def rotation_WS(sim: Simulation, segment: str) -> Rotation:
    return Rotation.from_quat(sim.quat_WL[segment]) * Rotation.from_quat(sim.quat_LS[segment])


@pytest.mark.parametrize("segment", SEGMENTS)
def test_gyro_integrates_to_the_orientation(perfect: Simulation, segment: str) -> None:
    check_gyro(perfect, segment, rotation_WS(perfect, segment), 60.0)


@pytest.mark.parametrize("segment", SEGMENTS)
def test_accel_integrates_to_the_position(fast: Simulation, segment: str) -> None:
    # from rest through the transition into the clasp
    moved = check_accel(fast, segment, rotation_WS(fast, segment), 4.5, 14.5)
    assert moved.max() > 0.1


@pytest.mark.parametrize("side", SIDES)
def test_segments_keep_their_length(perfect: Simulation, side: str) -> None:
    for part, segment, a, b in (
        ("upper_arm", "upper_arm", "shoulder", "elbow"),
        ("forearm", "forearm", "elbow", "wrist"),
        ("hand", "forearm", "wrist", "palm"),
    ):
        p_W = perfect.points[f"{side}_{b}"] - perfect.points[f"{side}_{a}"]
        p_L = Rotation.from_quat(perfect.quat_WL[f"{side}_{segment}"]).inv().apply(p_W)
        assert np.abs(p_L - [0.0, 0.0, -SUBJECT[f"{side}_{part}"]]).max() < 1e-12


def test_n_pose(perfect: Simulation) -> None:
    start = within(perfect, "start")
    for segment in SEGMENTS:
        np.testing.assert_allclose(perfect.quat_WL[segment][start] - [0.0, 0.0, 0.0, 1.0], 0.0, atol=1e-15)
    arm = sum(SUBJECT[f"left_{part}"] for part in ("upper_arm", "forearm", "hand"))
    hand = [0.0, SUBJECT["shoulder_width"] / 2, SUBJECT["trunk"] - arm]
    np.testing.assert_allclose(perfect.points["left_palm"][0], hand, atol=1e-15)
    assert perfect.phases["start"] == [(0.5, 4.5)]


def test_palms_coincide_in_the_clasp(perfect: Simulation) -> None:
    clasp = within(perfect, "clasp")
    palm = perfect.points["left_palm"][clasp]
    assert np.abs(palm - perfect.points["right_palm"][clasp]).max() < 1e-9
    assert clasp.sum() > 5900
    # a large region before the body: belly to above the head, in and out, left and right
    p_T = Rotation.from_quat(perfect.quat_WL["torso"][clasp]).inv().apply(palm) - [0.0, 0.0, SUBJECT["trunk"]]
    assert (np.ptp(p_T, axis=0) > [0.3, 0.4, 0.5]).all()
    assert p_T[:, 0].min() > 0.15
    turn = np.rad2deg(Rotation.from_quat(perfect.quat_WL["torso"][clasp]).as_euler("ZYX"))
    assert (np.ptp(turn, axis=0) > 20).all()
    assert np.abs(turn).max() < 15


def test_rests_and_start_are_still(perfect: Simulation) -> None:
    still = within(perfect, "start", "rest")
    assert len(perfect.phases["rest"]) == 7
    for segment in SEGMENTS:
        assert np.abs(perfect.gyro_S[segment][still]).max() < 1e-12
        np.testing.assert_allclose(np.linalg.norm(perfect.accel_S[segment][still], axis=1), G, rtol=0, atol=1e-10)
    hand = perfect.points["right_palm"][within(perfect, "rest")]
    assert np.abs(hand - hand[0]).max() < 1e-12  # always the same point of the table


def test_same_seed_same_bits() -> None:
    one, same, other = (simulate(SUBJECT, seed=s, clasp_s=5.0, circles=1) for s in (7, 7, 8))
    for segment in SEGMENTS:
        for field in ("quat_WL", "gyro_S", "accel_S", "quat_LS", "gyro_bias", "accel_bias"):
            assert np.array_equal(getattr(one, field)[segment], getattr(same, field)[segment])
        for field in ("gyro_S", "accel_S", "quat_LS"):
            a, b = getattr(one, field)[segment], getattr(other, field)[segment]
            assert not np.allclose(a[:500], b[:500], atol=1e-6)


def test_white_noise_has_the_stated_density() -> None:
    rate_hz = 400.0
    noise = ImuNoise(gyro_bias_std=0.0, gyro_bias_instability=0.0, accel_bias_std=0.0, accel_bias_instability=0.0)
    options = {"seed": 2, "rate_hz": rate_hz, "clasp_s": 20.0, "circles": 1}
    noisy, clean = simulate(SUBJECT, noise=noise, **options), simulate(SUBJECT, noise=NOISE_FREE, **options)
    for segment in SEGMENTS:
        gyro = noisy.gyro_S[segment] - clean.gyro_S[segment]
        accel = noisy.accel_S[segment] - clean.accel_S[segment]
        # data sheet: 0.007 deg/s/sqrt(Hz), 120 ug/sqrt(Hz)
        np.testing.assert_allclose(gyro.std(axis=0), np.deg2rad(0.007) * np.sqrt(rate_hz), rtol=0.06)
        np.testing.assert_allclose(accel.std(axis=0), 120e-6 * G * np.sqrt(rate_hz), rtol=0.06)
        white = np.corrcoef(np.column_stack((gyro, accel)).T) - np.eye(6)
        assert np.abs(white).max() < 0.1
        assert np.abs(np.sum(gyro[1:] * gyro[:-1], axis=0) / np.sum(gyro**2, axis=0)).max() < 0.1


def test_wrong_input_is_named() -> None:
    short = {"left_upper_arm": 0.1, "left_forearm": 0.1, "left_hand": 0.02}
    for lengths, options, said in (
        ({k: SUBJECT[k] for k in LENGTHS if k != "left_hand"}, {}, "left_hand"),
        ({**SUBJECT, "trunk": -0.5}, {}, r"trunk.*-0\.5"),
        (SUBJECT, {"clasp_s": 1.0}, r"clasp_s = 1\.0"),
        ({**SUBJECT, **short}, {}, "does not reach"),
    ):
        with pytest.raises(ValueError, match=said):
            simulate(lengths, seed=0, **options)
