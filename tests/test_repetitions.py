"""Repetitions of a movement: found where they are, however fast, with rests, cut at the ends; none where none are."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin.angles.repetitions import Repetitions, compute_cmc, find_repetitions

RATE = 100.0
FLEXION = "right_elbow_flexion"


def angles_of(flexion_deg: np.ndarray, rate_hz: float = RATE) -> wp.Angles:
    """Angles of a right arm whose elbow bends so."""
    upper = np.tile([0.0, 0.0, 0.0, 1.0], (len(flexion_deg), 1))
    forearm = Rotation.from_euler("y", -flexion_deg[:, None], degrees=True).as_quat()
    time = np.arange(len(flexion_deg)) / rate_hz
    return wp.joint_angles(wp.Pose(time, {"right_upper_arm": upper, "right_forearm": forearm}, {}))


def reach(seconds: float, low: float = 10.0, high: float = 90.0, rate_hz: float = RATE) -> np.ndarray:
    """One movement out and back [deg]."""
    phase = np.arange(round(seconds * rate_hz)) / (seconds * rate_hz)
    return low + 0.5 * (high - low) * (1.0 - np.cos(2.0 * np.pi * phase))


def rest(seconds: float, at: float = 10.0, rate_hz: float = RATE) -> np.ndarray:
    return np.full(round(seconds * rate_hz), at)


def chain(*parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The parts one after the other, and begin and end [s] of those that move."""
    ends = np.cumsum([len(part) for part in parts]) / RATE
    spans = [(end - len(part) / RATE, end) for part, end in zip(parts, ends, strict=True) if np.ptp(part) > 0.0]
    return np.concatenate(parts), np.array(spans)


def find(flexion_deg: np.ndarray, **options: object) -> Repetitions:
    return find_repetitions(angles_of(flexion_deg), **options)


def check_spans(repetitions: Repetitions, expected: np.ndarray, share: float = 0.04) -> None:
    """Begin and end within a share of the duration."""
    assert repetitions.reason == ""
    assert len(repetitions.spans) == len(expected)
    duration = np.diff(expected, axis=1)
    assert np.all(np.abs(repetitions.spans - expected) < share * duration + 0.011)


def test_repetitions_without_a_rest_follow_each_other() -> None:
    signal, spans = chain(rest(1.0), *[reach(2.0)] * 6, rest(1.0))
    repetitions = find(signal)
    check_spans(repetitions, spans)
    assert (repetitions.source, repetitions.rising, repetitions.left_out) == (FLEXION, True, 0)
    assert repetitions.cmc > 0.999


@pytest.mark.parametrize("noise_deg", [0.3, 2.0])
def test_rests_of_any_length_between_repetitions_do_not_count(noise_deg: float) -> None:
    rng = np.random.default_rng(1)
    parts = [part for pause in rng.uniform(0.3, 4.0, 8) for part in (rest(pause), reach(1.5))]
    signal, spans = chain(*parts, rest(1.0))
    repetitions = find(signal + rng.normal(0.0, noise_deg, len(signal)))
    check_spans(repetitions, spans, 0.04 if noise_deg < 1.0 else 0.12)


def test_half_repetitions_at_the_ends_are_left_out() -> None:
    whole, spans = chain(*[reach(2.0)] * 6)
    repetitions = find(whole[100:-60])  # from the peak of the first to shortly after that of the last
    check_spans(repetitions, spans[1:-1] - 1.0)
    repetitions = find(whole[40:-40])  # both begin, or end, half way up
    check_spans(repetitions, spans[1:-1] - 0.4)


def test_an_angle_that_rests_high_falls_first() -> None:
    signal, spans = chain(*[part for _ in range(5) for part in (rest(1.0), reach(1.5))], rest(1.0))
    for turned in (-signal, 100.0 - signal):
        repetitions = find(turned)
        assert repetitions.rising is False
        check_spans(repetitions, spans)


def test_other_movements_between_are_left_out() -> None:
    """Standing up, say: an excursion far larger than those that repeat, a small one, and one with a long stop in it."""
    stop = np.concatenate([reach(1.5)[:75], rest(6.0, 88.0), reach(1.5)[75:]])
    signal, spans = chain(
        *(rest(1.0), *[reach(1.5)] * 5, rest(1.0), reach(3.0, 10.0, 240.0), rest(1.0), reach(1.0, 10.0, 30.0)),
        *(rest(1.0), *[reach(1.5)] * 4, rest(1.0), stop, rest(1.0)),
    )
    kept = [k for k in range(len(spans)) if k not in (5, 6, 11)]
    repetitions = find(signal)
    check_spans(repetitions, spans[kept])
    assert repetitions.left_out == 1


@pytest.mark.parametrize(
    ("signal", "said"),
    [
        (rest(10.0), "has a range of 0.0°, and 10° are needed"),
        (10.0 + np.random.default_rng(0).normal(0.0, 3.0, 3000), "°, and 10° are needed"),
        (chain(rest(2.0), reach(2.0), rest(2.0))[0], "goes out and back once, and 3 times are needed"),
        (chain(rest(2.0), reach(2.0), rest(1.0), reach(2.0), rest(2.0))[0], "goes out and back twice"),
        (np.linspace(0.0, 90.0, 1000), "goes out and back no time"),
        (reach(2.0)[:100], "goes out and back no time"),
    ],
    ids=["still", "noise", "once", "twice", "one way", "half"],
)
def test_where_nothing_repeats_it_says_so(signal: np.ndarray, said: str) -> None:
    repetitions = find(signal)
    assert said in repetitions.reason
    assert repetitions.spans.shape == (0, 2)


def test_a_motion_at_random_is_hardly_ever_taken_for_repetitions() -> None:
    taken = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        sos = butter(2, rng.uniform(0.1, 1.0), fs=RATE, output="sos")
        signal = sosfiltfilt(sos, rng.normal(size=6000))
        repetitions = find(40.0 * signal / signal.std())
        taken += not repetitions.reason
        assert repetitions.reason or repetitions.cmc >= 0.85
    assert taken <= 1


def test_the_main_angle_is_that_of_the_largest_range_that_is_known() -> None:
    wave = np.sin(np.linspace(0.0, 20.0, 1000))
    bent = {"left_forearm": 50.0 * wave, "right_forearm": 20.0 * wave}
    quat_WL = {s: Rotation.from_euler("y", -angle[:, None], degrees=True).as_quat() for s, angle in bent.items()}
    quat_WL |= dict.fromkeys(("left_upper_arm", "right_upper_arm"), np.tile([0.0, 0.0, 0.0, 1.0], (1000, 1)))
    angles = wp.joint_angles(wp.Pose(np.arange(1000) / RATE, quat_WL, {}))
    assert find_repetitions(angles).source == "left_elbow_flexion"
    angles["left_elbow"].values[500:, 2] += 2.0 * np.pi  # pronation: a motion once around the lock
    assert find_repetitions(angles).source == "left_elbow_flexion"
    angles["left_elbow"].gap[:300] = True
    assert find_repetitions(angles).source == FLEXION
    angles["right_elbow"].gap[:] = True
    assert "not determined for even 10 samples" in find_repetitions(angles, FLEXION).reason


def test_a_repetition_in_a_gap_is_left_out() -> None:
    signal, spans = chain(rest(1.0), *[part for _ in range(6) for part in (reach(2.0), rest(1.0))])
    angles = angles_of(signal)
    angles.joints["right_elbow"].gap[450:490] = True  # 0.4 s of the second: bridged by a line, and still much alike
    angles.joints["right_elbow"].gap[700:705] = True
    repetitions = find_repetitions(angles)
    check_spans(repetitions, np.delete(spans, 1, axis=0))
    assert repetitions.left_out == 1


def test_the_cmc_is_kadabas() -> None:
    rng = np.random.default_rng(3)
    curves = np.sin(np.linspace(0.0, 6.0, 50)) + rng.normal(0.0, 0.3, (7, 50))
    within = sum((curves[i, t] - curves[:, t].mean()) ** 2 for i in range(7) for t in range(50)) / (50 * 6)
    total = sum((curves[i, t] - curves.mean()) ** 2 for i in range(7) for t in range(50)) / (7 * 50 - 1)
    assert compute_cmc(curves) == pytest.approx(np.sqrt(1.0 - within / total), abs=1e-12)
    assert compute_cmc(np.tile(curves[0], (3, 1))) == 1.0


def test_the_arm_swings_of_a_real_walk_are_found(data: Path) -> None:
    """A person works at a table, stands up and walks; the period of the swing is the raw gyroscope's."""
    recording = wp.load_session(data / "upper_body" / "session.toml")
    pose = wp.track(recording, method="amekf", open_loop=True).pose
    repetitions = find_repetitions(wp.joint_angles(pose, "XZY"), "left_shoulder_flexion")
    walk = (recording.time > 97.0) & (recording.time < 137.0)
    sensor = recording.sensors["left_upper_arm"]
    assert isinstance(sensor, wp.ImuSensor)
    swing = sensor.gyro_S[walk, np.argmax(sensor.gyro_S[walk].std(axis=0))]
    spectrum = np.abs(np.fft.rfft((swing - swing.mean()) * np.hanning(len(swing)), 16 * len(swing)))
    period = 1.0 / np.fft.rfftfreq(16 * len(swing), 1.0 / recording.rate_hz)[spectrum.argmax()]
    assert np.median(np.diff(repetitions.spans, axis=1)) == pytest.approx(period, rel=0.06)
    assert 38 <= len(repetitions.spans) <= 46
    assert repetitions.spans.min() > 95.0  # none at the table
