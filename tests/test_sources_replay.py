"""A recording as a source: nothing lost, nothing early, at any speed."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin import BadOption, ImuSensor, OrientationSensor, Recording, WeposeError
from wepose_pin.live.sources import open_source
from wepose_pin.live.sources.replay import ReplaySource


def recording(n: int = 300, rate_hz: float = 100.0) -> Recording:
    rng = np.random.default_rng(5)
    sensors = {
        name: ImuSensor(gyro_S=rng.normal(size=(n, 3)), accel_S=rng.normal(size=(n, 3)))
        for name in ("torso", "left_upper_arm")
    }
    return Recording("r", 20.0 + np.arange(n) / rate_hz, rate_hz, sensors)


def drained(source: ReplaySource, pause_s: float = 0.0) -> dict[str, np.ndarray]:
    """Time, gyro and accel (n, 7) of each sensor, to the end."""
    rows: dict[str, list[np.ndarray]] = {}
    source.open()
    while (came := source.read(0.05)) is not None:
        now = source.clock()
        for samples in came:
            assert samples.time[-1] <= now + 1e-9
            rows.setdefault(samples.sensor, []).append(np.column_stack([samples.time, samples.gyro_S, samples.accel_S]))
        time.sleep(pause_s)
    source.close()
    return {name: np.concatenate(parts) for name, parts in rows.items()}


@pytest.mark.parametrize(("speed", "pause_s"), [(math.inf, 0.0), (20.0, 0.0), (20.0, 0.03)])
def test_every_sample_comes_once_and_in_order(speed: float, pause_s: float) -> None:
    r = recording()
    samples = drained(ReplaySource(r, speed), pause_s)
    assert list(samples) == list(r.sensors)
    for name, sensor in r.sensors.items():
        np.testing.assert_array_equal(samples[name], np.column_stack([r.time, sensor.gyro_S, sensor.accel_S]))


def test_the_clock_runs_at_the_speed() -> None:
    source = ReplaySource(recording(), 10.0)
    before = time.monotonic()
    source.open()
    after = time.monotonic()
    time.sleep(0.05)
    least, now, most = time.monotonic() - after, source.clock(), time.monotonic() - before
    assert 20.0 + 10.0 * least <= now <= 20.0 + 10.0 * most


def test_no_sample_in_a_marked_gap() -> None:
    r = recording()
    gap = (r.time > 21.0) & (r.time < 22.0)
    sensors = {name: replace(sensor, gap=gap if name == "torso" else None) for name, sensor in r.sensors.items()}
    samples = drained(ReplaySource(replace(r, sensors=sensors), math.inf))
    np.testing.assert_array_equal(samples["torso"][:, 0], r.time[~gap])
    assert len(samples["left_upper_arm"]) == len(r)


def test_nothing_due_is_nothing() -> None:
    source = ReplaySource(recording(), 1e-6)
    source.open()
    assert source.read(0.0) is not None  # the first sample
    assert source.read(0.0) == []


def test_measured_orientations_come_as_six_numbers() -> None:
    r = recording()
    quat_VS = Rotation.random(len(r), rng=np.random.default_rng(0)).as_quat()
    source = ReplaySource(replace(r, sensors={"torso": OrientationSensor(quat_VS, aligned=True)}), math.inf)
    source.open()
    [first] = source.read(0.0) or []
    assert source.orientations == {"torso": True}
    np.testing.assert_array_equal(np.column_stack([first.gyro_S, first.accel_S[:, 0]]), quat_VS[: len(first.time)])


@pytest.mark.parametrize(
    ("spec", "options", "words"),
    [
        ("torso", {}, "source 'torso' is not known; there is: lsl:NAME"),
        ("rplay:x", {}, "did you mean 'replay:PATH'"),
        ("udp:", {}, "source 'udp:' is not known"),
        ("replay:nothing", {}, "nothing"),
        ("replay:x", {"speed": "fast"}, "speed: 'fast'; a positive number"),
        ("replay:x", {"speed": 0.0}, "speed: '0.0'"),
        ("udp:port", {}, "source 'udp:port': port: a port or HOST:PORT"),
        ("udp:0.0.0.0:70000", {}, "0.0.0.0:70000: a port or HOST:PORT"),
        ("lsl:a'b", {}, "has no quote"),
        ("udp:9000", {"sensors": ["trunk"]}, "'trunk' is not a segment"),
        ("udp:9000,gyro_unit=rpm", {}, "gyro_unit 'rpm' is not known; there is: rad/s, deg/s"),
        ("udp:9000,unit=g", {}, "'unit=g' is no unit"),
        ("udp:0.0.0.0:70000", {}, "70000: a port or HOST:PORT"),
        ("lsl:", {}, "source 'lsl:' is not known"),
    ],
)
def test_a_wrong_spec_says_what_is_right(spec: str, options: dict, words: str) -> None:
    with pytest.raises(WeposeError) as error:
        open_source(spec, **options)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_session_is_replayed(tmp_path) -> None:
    lines = ["time,gx,gy,gz,ax,ay,az", *(f"{k / 100},0.0,0.0,0.3,0,0,9.81" for k in range(200))]
    (tmp_path / "r.csv").write_text("\n".join(lines))
    (tmp_path / "session.toml").write_text(
        '[data]\nfile = "r.csv"\ntime = "time"\ngyro_unit = "rad/s"\naccel_unit = "m/s^2"\n'
        '[sensors.torso]\ngyro = ["gx", "gy", "gz"]\naccel = ["ax", "ay", "az"]\n'
    )
    source = open_source(f"replay:{tmp_path}", speed="max")
    assert source.sensors == ("torso",)
    assert source.rate_hz == pytest.approx(100.0)
    assert drained(source)["torso"].shape == (200, 7)
    with pytest.raises(BadOption, match="no sensor head"):
        open_source(f"replay:{tmp_path}", sensors=["head"])
