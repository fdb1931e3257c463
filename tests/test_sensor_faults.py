"""Sensors that do not measure: named while reading, lost from where they stop, never believed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation
from test_bad_input import refused

from wepose_pin import ImuSensor, Recording, Simulation, WeposeError, estimate_orientation, load_session, track
from wepose_pin.recording.faults import check_sensors
from wepose_pin.recording.plausibility import find_unseen_rate
from wepose_pin.simulation import simulate, simulate_person
from wepose_pin.writers import write_session

BROKEN = "left_forearm"
RATE = 100.0


@pytest.fixture(scope="module")
def made() -> Simulation:
    """Twenty-five seconds: start pose from 0.5 to 4.5 s, then the arms move."""
    return simulate(simulate_person(1).lengths, seed=1, clasp_s=5.0, circles=1)


def with_sensor(recording: Recording, name: str, **changes: object) -> Recording:
    return replace(recording, sensors={**recording.sensors, name: replace(recording.sensors[name], **changes)})


def stopped(recording: Recording, signals: str, first: float, last: float = np.inf, value: float | None = None):
    """The recording with a sensor that stays at its value, or at this one, in these seconds."""
    sensor, stands = recording.sensors[BROKEN], (recording.time >= first) & (recording.time <= last)
    changes = {}
    for name in signals.split():
        values = getattr(sensor, f"{name}_S").copy()
        values[stands] = values[int(np.argmax(stands))] if value is None else value
        changes[f"{name}_S"] = values
    return with_sensor(recording, BROKEN, **changes)


def written(folder: Path, recording: Recording) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_session(folder, recording)
    return folder


def off_by(recording: Recording, made: Simulation, method: str) -> np.ndarray:
    """Angle to the truth of the broken sensor's segment over its standard deviation, for each sample."""
    pose, truth = track(recording, method=method).pose, made.truth()
    off = Rotation.from_quat(truth.quat_WL[BROKEN]).inv() * Rotation.from_quat(pose.quat_WL[BROKEN])
    return off.magnitude() / np.sqrt(np.linalg.eigvalsh(pose.segment_cov[BROKEN])[:, -1])


@pytest.mark.parametrize(
    ("signals", "value"), [("gyro", 0.0), ("gyro", None), ("accel", None), ("gyro accel", None), ("gyro accel", 0.0)]
)
def test_a_sensor_that_never_measures_is_refused_by_name(
    signals: str, value: float | None, made: Simulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path / "in", stopped(made.recording("dead"), signals, 0.0, value=value))
    line = refused(["track", str(path), "-o", str(tmp_path / "out")], capsys)
    assert f"sensors.{BROKEN}: " in line
    assert all(name in line for name in signals.split())
    assert f"take [sensors.{BROKEN}] out" in line


@pytest.mark.parametrize(("signals", "since"), [("gyro accel", 16.3), ("gyro", 9.0), ("accel", 9.0)])
def test_a_sensor_that_freezes_is_lost_from_there(signals: str, since: float, made: Simulation, tmp_path: Path) -> None:
    whole = made.recording("frozen")
    path = written(tmp_path / "in", stopped(whole, signals, since))
    read = load_session(path)
    gap = read.sensors[BROKEN].gap
    assert gap is not None
    assert read.time[np.argmax(gap)] == pytest.approx(since + 0.01, abs=0.011)
    assert gap[read.time > since + 0.02].all()
    (frozen,) = (each for each in read.diagnostics if each.code == "sensor-frozen")
    assert (frozen.place, frozen.facts["signals"]) == (BROKEN, " and ".join(signals.split()))
    assert frozen.facts["start"] == pytest.approx(since, abs=0.011)
    assert frozen.value == pytest.approx(read.time[-1] - since, abs=0.011)
    assert all(sensor.gap is None for name, sensor in read.sensors.items() if name != BROKEN)


@pytest.mark.parametrize("dead", ["gyro y", "accel y", "gyro"])
def test_a_dead_axis_is_refused_by_name_of_files_and_of_arrays(dead: str, made: Simulation, tmp_path: Path) -> None:
    recording, pairs = made.recording("dead"), {}
    for name, sensor in recording.sensors.items():
        values = {"gyro": sensor.gyro_S.copy(), "accel": sensor.accel_S.copy()}
        if name == BROKEN:
            values[dead.split()[0]][:, 1 if dead.endswith("y") else slice(None)] = 0.0
        pairs[name] = tuple(values.values())
    files = with_sensor(recording, BROKEN, gyro_S=pairs[BROKEN][0], accel_S=pairs[BROKEN][1])
    if dead != "gyro":  # from a moment on it is lost
        key = f"{dead.split()[0]}_S"
        values = getattr(recording.sensors[BROKEN], key).copy()
        values[recording.time >= 9.0, 1] = 0.0
        later = load_session(written(tmp_path / "later", with_sensor(recording, BROKEN, **{key: values})))
        (frozen,) = (each for each in later.diagnostics if each.code == "sensor-frozen")
        assert (frozen.place, frozen.facts["signals"]) == (BROKEN, dead)
        assert frozen.facts["start"] == pytest.approx(9.0, abs=0.011)
    text = f"{dead} stands still at 0"
    with pytest.raises(WeposeError, match=f"sensors.{BROKEN}: {text}"):
        load_session(written(tmp_path / "in", files))
    with pytest.raises(WeposeError, match=f"sensors.{BROKEN}: {text}.*; leave this sensor out"):
        Recording.from_arrays(RATE, **pairs)


@pytest.mark.parametrize("digit", [0.0, 0.02])
def test_a_planar_motion_with_noise_below_its_digits_is_measured(digit: float) -> None:
    """One axis never changes; the other two move, and between two digits they change like noise."""
    swing = np.sin(2.0 * np.arange(1000) / RATE).clip(0.0)[:, None]
    gyro, accel = swing * [0.5, 0.0, 0.3], swing * [2.0, 1.0, 0.0] + [0.0, 0.0, 9.81]
    if digit:
        noise = 0.1 * np.random.default_rng(0).standard_normal((1000, 3)) + [0.5, 0.0, 0.5]
        gyro, accel = digit * np.round(gyro / digit + noise), digit * np.round(accel / digit + noise)
    assert len(Recording.from_arrays(RATE, torso=(gyro, accel))) == 1000
    estimate_orientation(gyro, accel, RATE, static=(1.6, 3.1))


def test_a_dead_accelerometer_of_arrays_is_refused_by_name(made: Simulation) -> None:
    recording = made.recording()
    dead = with_sensor(recording, BROKEN, accel_S=np.zeros((len(recording), 3)))
    with pytest.raises(WeposeError, match=f"sensors.{BROKEN}.accel_S is 0 in .* no gravity"):
        track(replace(dead, phases={}))


@pytest.mark.parametrize(
    ("since", "until", "method"), [(9.0, 99.0, "amekf"), (9.0, 99.0, "smekf"), (5.0, 7.4, "smoother")]
)
def test_an_arm_whose_sensor_froze_is_where_its_uncertainty_says(
    since: float, until: float, method: str, made: Simulation, tmp_path: Path
) -> None:
    read = load_session(written(tmp_path / "in", stopped(made.recording("frozen"), "gyro accel", since, until)))
    unmarked = with_sensor(read, BROKEN, gap=None)
    assert off_by(unmarked, made, method).max() > 6.0
    assert off_by(read, made, method).max() < 6.0


@pytest.mark.parametrize("unit", ["rad/s", "deg/s"])
@pytest.mark.parametrize("method", ["amekf", "smoother"])
def test_what_a_gyroscope_turned_beyond_its_range_is_uncertain(
    unit: str, method: str, made: Simulation, tmp_path: Path
) -> None:
    """A wide swing is cut off in the middle; whoever believes it is off by many standard deviations."""
    whole, level = made.recording("cut"), np.deg2rad(120.0)
    gyro_S = whole.sensors[BROKEN].gyro_S
    fast = 4.0 * (gyro_S - gyro_S[50:450].mean(axis=0))
    at = [Rotation.identity()]
    for turn in Rotation.from_rotvec(fast[1:] / RATE):
        at.append(at[-1] * turn)
    turned = Rotation.concatenate(at)
    accel = turned.inv().apply(whole.sensors[BROKEN].accel_S[0])
    accel += 0.01 * np.random.default_rng(0).standard_normal(accel.shape)
    path = written(tmp_path / "in", with_sensor(whole, BROKEN, gyro_S=np.clip(fast, -level, level), accel_S=accel))
    if unit == "deg/s":
        text, table = (path / "session.toml").read_text(), pl.read_parquet(path / "recording.parquet")
        (path / "session.toml").write_text(text.replace('"rad/s"', '"deg/s"'))
        rates = [name for name in table.columns if "gyr" in name]
        table.with_columns(pl.col(rates).degrees()).write_parquet(path / "recording.parquet")
    read = load_session(path)
    assert read.sensors[BROKEN].gyro_range == pytest.approx(level, rel=0.03)
    arrays = Recording.from_arrays(RATE, torso=(np.clip(fast, -level, level), accel))
    assert arrays.imus["torso"].gyro_range == pytest.approx(level, rel=0.03)
    (saturated,) = (each for each in read.diagnostics if each.code == "signal-saturated")
    assert (saturated.place, saturated.facts["variant"]) == (BROKEN, "gyro")
    assert saturated.facts["range"] == pytest.approx(level)
    assert all(np.isinf(sensor.gyro_range) for name, sensor in read.sensors.items() if name != BROKEN)

    def worst(recording: Recording) -> float:
        of = track(recording, method=method, open_loop=True).segments.orientation[BROKEN]
        R_VS = Rotation.from_quat(of.quat_VS)
        off = (turned[300].inv() * turned).inv() * (R_VS[300].inv() * R_VS)
        return float((off.magnitude() / np.sqrt(np.linalg.eigvalsh(of.attitude_cov)[:, -1]))[450:].max())

    assert worst(with_sensor(read, BROKEN, gyro_range=np.inf)) > 6.0
    assert worst(read) < 6.0


# What repeats and measures ----------------------------------------------------------------------------------------


def gated(recording: Recording, zone_deg_s: float, by_axis: bool) -> Recording:
    """Gyroscopes that take off their bias and have a dead zone: rates below it are zero."""
    sensors = {}
    for name, sensor in recording.imus.items():
        rate = sensor.gyro_S - sensor.gyro_S[recording.span((0.5, 4.5))].mean(axis=0)
        small = np.abs(rate) < np.deg2rad(zone_deg_s)
        sensors[name] = replace(sensor, gyro_S=np.where(small if by_axis else small.all(axis=1)[:, None], 0.0, rate))
    return replace(recording, sensors={**recording.sensors, **sensors})


@pytest.mark.parametrize("by_axis", [False, True])
@pytest.mark.parametrize("zone_deg_s", [0.3, 1.0])
def test_a_dead_zone_is_no_fault(zone_deg_s: float, by_axis: bool, made: Simulation, tmp_path: Path) -> None:
    """Zeros at rest, for seconds, from a gyroscope that shows noise as soon as it moves."""
    recording = gated(made.recording(), zone_deg_s, by_axis)
    assert any((np.diff(imu.gyro_S[50:450], axis=0) == 0.0).all(axis=1).mean() > 0.1 for imu in recording.imus.values())
    read = load_session(written(tmp_path / "gated", recording))
    assert "sensor-frozen" not in {each.code for each in read.diagnostics}


def test_coarse_digits_and_zeros_at_rest_are_no_fault(tmp_path: Path) -> None:
    """Force in steps of ten times its noise, in poses that are held, and gyroscopes with a dead zone on a table."""
    rng, time = np.random.default_rng(0), np.arange(6000) / 50.0
    phase, held = np.minimum(1.0, time % 5.0 / 3.0), (time // 5.0).astype(int)
    poses = np.repeat(rng.uniform(-1.0, 1.0, (13, 3)), 2, axis=0)[:25]
    angle = poses[held] + (phase**2 * (3.0 - 2.0 * phase))[:, None] * (poses[held + 1] - poses[held])
    R = Rotation.from_rotvec(angle)
    gyro_S = np.concatenate([np.zeros((1, 3)), (R[:-1].inv() * R[1:]).as_rotvec() * 50.0])
    gyro_S, force = gyro_S + rng.normal(0.0, 0.003, (6000, 3)), R.inv().apply([0.0, 0.0, 9.81])
    coarse = ImuSensor(gyro_S, np.round(10.0 * (force + rng.normal(0.0, 0.01, (6000, 3)))) / 10.0)
    lying = ImuSensor(np.zeros((6000, 3)), [0.0, 0.0, 9.81] + rng.normal(0.0, 0.05, (6000, 3)))
    worn_later = ImuSensor(np.where(time[:, None] < 4.0, 0.0, gyro_S), force + rng.normal(0.0, 0.05, (6000, 3)))
    for name, sensor in (("coarse", coarse), ("lying", lying), ("worn later", worn_later)):
        read = load_session(written(tmp_path / name, Recording(name, time, 50.0, {"torso": sensor})))
        assert "sensor-frozen" not in {each.code for each in read.diagnostics}


def test_fast_motion_without_noise_between_held_poses_is_measured_at_a_low_rate() -> None:
    """At 8 Hz the swings reverse as often as noise, and the poses repeat exactly."""
    time = np.arange(480) / 8.0
    swing = np.sin(np.pi * (time % 5.0 / 3.0).clip(0.0, 1.0)) ** 2 * np.sin(6.0 * np.pi * time)
    R = Rotation.from_rotvec(swing[:, None] * [0.3, 0.2, 0.1])
    gyro_S = np.concatenate([np.zeros((1, 3)), (R[:-1].inv() * R[1:]).as_rotvec() * 8.0])
    assert len(Recording.from_arrays(8.0, torso=(gyro_S, R.inv().apply([3.0, 3.0, 9.0]))))


def test_a_start_pose_that_turns_from_its_first_sample_on_is_refused() -> None:
    rng, time = np.random.default_rng(0), np.arange(2000) / RATE
    rate = np.where(time % 2.0 < 1.0, 0.2, -0.2)
    angle = np.cumsum(rate) / RATE
    gyro_S = np.stack([0.0 * rate, rate, 0.0 * rate], axis=1) + rng.normal(0.0, 0.002, (2000, 3))
    accel_S = 9.81 * np.stack([-np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1) + rng.normal(0.0, 0.02, (2000, 3))
    phases, mounts = {"start": [(0.0, 4.0)]}, {"torso": ("+z", "+x")}
    recording = Recording.from_arrays(RATE, torso=(gyro_S, accel_S), phases=phases, mounts=mounts)
    with pytest.raises(WeposeError, match="less than 1 s of it is static"):
        track(recording, open_loop=True)


# Arrays ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("signals", "since", "step"), [("gyro", 0.0, 1), ("gyro accel", 9.0, 10), ("accel", 9.0, 1)])
def test_arrays_of_a_dead_or_frozen_sensor_are_refused(signals: str, since: float, step: int, made: Simulation) -> None:
    sensor = stopped(made.recording("stopped"), signals, since).sensors[BROKEN].part(slice(None, None, step))
    with pytest.raises(WeposeError, match=rf"^{signals.split()[0]}.* stands? still.* from {since:g} to .* leave"):
        estimate_orientation(sensor.gyro_S, sensor.accel_S, RATE / step, static=(0.5, 4.5))


# Lost samples are not measured ones --------------------------------------------------------------------------------


@pytest.mark.parametrize("frozen", [False, True])
def test_a_sensor_that_is_lost_in_the_start_pose_is_not_aligned_by_invention(
    frozen: bool, made: Simulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = made.recording("lost")
    if frozen:
        whole = stopped(whole, "gyro accel", 0.3, 4.8)
    path = written(tmp_path / "in", whole)
    if not frozen:
        table = pl.read_parquet(path / "recording.parquet")
        cells = [name for name in table.columns if name.startswith(BROKEN)]
        keep = ~table["time"].is_between(0.3, 4.8)
        table.with_columns(pl.when(keep).then(pl.col(cells)).name.keep()).write_parquet(path / "recording.parquet")
    line = refused(["track", str(path), "--gaps", "-o", str(tmp_path / "out")], capsys)
    assert f"sensors.{BROKEN}" in line
    assert f"take [sensors.{BROKEN}] out" in line


# Right, and once refused -------------------------------------------------------------------------------------------


def swing(hertz: float, peak_deg_s: float, radius: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], gyro and accel of a wrist on an arm that swings about the shoulder, after five seconds of standing."""
    time = np.arange(2500) / RATE
    on = np.clip(time - 5.0, 0.0, 1.0)
    angle = on * np.deg2rad(peak_deg_s) / (2.0 * np.pi * hertz) * np.sin(2.0 * np.pi * hertz * time)
    R = Rotation.from_rotvec(angle[:, None] * [0.1, 0.99, 0.1])
    place = R.apply([0.0, 0.0, -radius])
    force = R.inv().apply(np.gradient(np.gradient(place, time, axis=0), time, axis=0) + [0.0, 0.0, 9.81])
    rate = np.concatenate([np.zeros((1, 3)), (R[:-1].inv() * R[1:]).as_rotvec() * RATE])
    noise = np.random.default_rng(0).standard_normal((2, len(time), 3))
    return time, rate + 0.002 * noise[0], force + 0.02 * noise[1]


@pytest.mark.parametrize(("hertz", "peak"), [(1.5, 800.0), (1.0, 500.0), (2.5, 900.0), (0.8, 1200.0)])
def test_arms_that_swing_fast_are_measured_in_the_unit_that_is_stated(
    hertz: float, peak: float, tmp_path: Path
) -> None:
    time, gyro, accel = swing(hertz, peak)

    def checked(scale: float) -> None:
        sensors = {"torso": ImuSensor(scale * gyro, accel)}
        recording = Recording("swing", time, RATE, sensors, {"start": ((0.5, 4.5),)})
        load_session(written(tmp_path / f"{scale:.3g}", recording))

    checked(1.0)
    if peak > 1000.0:  # speeds that two seconds do not average out: either unit may be
        return
    with pytest.raises(WeposeError, match="gyro"):
        checked(180.0 / np.pi)
    with pytest.raises(WeposeError, match='"rad/s" would fit'):
        checked(np.pi / 180.0)


def test_arms_that_move_are_not_said_to_be_in_another_unit_live(data: Path) -> None:
    for imu in load_session(data / "upper_body").imus.values():
        for rows in np.arange(len(imu.gyro_S) - len(imu.gyro_S) % 400).reshape(-1, 400):
            assert np.isnan(find_unseen_rate(imu.gyro_S[rows], imu.accel_S[rows], RATE))


@pytest.mark.parametrize(
    ("change", "rates"),
    [
        (np.pi / 180.0, None),
        (0.5, []),
        (1.0, []),
        (2.0, ["0.5 x, 0.5 y, 0.5 z"]),
        (-1.0, ["-x, -y, -z"]),
        (np.eye(3)[[1, 0, 2]], ["+y, +x, +z"]),
    ],
)
def test_a_gyroscope_that_contradicts_slow_tilts_is_refused_or_named(
    change: float | np.ndarray, rates: list[str] | None
) -> None:
    """A third of a turn in six seconds and back, with forces near gravity throughout."""
    time, M = np.arange(6000) / RATE, np.eye(3) * change if np.ndim(change) == 0 else change
    R = Rotation.from_rotvec(np.pi / 3.0 * (1.0 - np.cos(np.pi / 6.0 * time))[:, None] * [0.0, 0.8, 0.6])
    rate = np.concatenate([np.zeros((1, 3)), (R[:-1].inv() * R[1:]).as_rotvec() * RATE]) @ M
    noise = np.random.default_rng(0).standard_normal((2, len(time), 3))
    torso = rate + 0.002 * noise[0], R.inv().apply([0.0, 0.0, 9.81]) + 0.02 * noise[1]
    if rates is None:
        with pytest.raises(WeposeError, match=r"turns too little .* rad/s"):
            Recording.from_arrays(RATE, torso=torso)
        return
    named = Recording.from_arrays(RATE, torso=torso).diagnostics
    assert [each.facts["rates"] for each in named if each.code == "gyro-contradicted"] == rates


@pytest.mark.parametrize("within", [0.0, 1e-4, 2e-3])
@pytest.mark.parametrize("packet", [2, 4, 10])
def test_time_stamps_of_packets_are_spread_over_their_samples(packet: int, within: float, tmp_path: Path) -> None:
    true = 1.7e9 + np.arange(2000) / RATE
    stamps = true[packet - 1 :: packet].repeat(packet)
    stamps += np.tile(np.arange(packet) - packet + 1, 2000 // packet) * within
    gyro, accel = np.random.default_rng(0).normal(0.0, [[0.01], [0.05]], (2000, 2, 3)).transpose(1, 0, 2)
    sensors = {"torso": ImuSensor(gyro, accel + [0.0, 0.0, 9.81])}
    path = written(tmp_path, Recording("packets", true, RATE, sensors))
    table = pl.read_parquet(path / "recording.parquet").with_columns(time=stamps)
    for rows in (np.arange(2000), np.r_[0:1000, 1000 + packet : 2000]):  # all, and one packet is lost
        table[rows].write_parquet(path / "recording.parquet")
        read = load_session(path, gaps=True)
        np.testing.assert_allclose(read.time, true, atol=1e-4 + 0.02 * within)
        lost = read.sensors["torso"].gap
        assert (0 if lost is None else np.count_nonzero(lost)) in (0, 2000 - len(rows))


@pytest.mark.parametrize("options", [[], ["--causal"]])
def test_a_mount_off_gravity_may_be_a_start_pose_that_is_another(
    options: list[str], made: Simulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a start pose that is stated, and of one that is guessed."""
    path = written(tmp_path / "in", made.recording("guessed"))
    text = (path / "session.toml").read_text()
    mount, phases = text.index("mount = {"), text.index("[phases]")
    wrong = text[:mount] + 'mount = { up = "+y", forward = "+x" }' + text[text.index("}", mount) + 1 :]
    for session in (wrong, wrong[:phases] + wrong[wrong.index("[sensors") :]):
        (path / "session.toml").write_text(session)
        line = refused(["track", str(path), "-o", str(tmp_path / "out"), *options], capsys)
        assert "the seconds of the start pose in [phases]" in line


@pytest.mark.parametrize("is_imu", [True, False])
def test_a_sensor_that_is_a_copy_of_another_is_refused(is_imu: bool) -> None:
    values = np.random.default_rng(1).normal(0.0, 1.0, (100, 3 if is_imu else 4))
    samples = (np.arange(100) / RATE, *(values,) * (1 + is_imu))
    with pytest.raises(
        WeposeError, match=r"^here: sensors\.head and sensors\.torso hold the same values in 100 rows: "
    ):
        check_sensors("here", {"head": samples, "torso": samples}, None)
