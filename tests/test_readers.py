"""Reading sessions: tables, clocks, gaps, resampling, plausibility, pieces."""

import json
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from wepose_pin import BadData, BadPhase, ImuSensor, Recording, load_session, rotations
from wepose_pin.data_tables import read_table
from wepose_pin.recording.faults import find_saturation
from wepose_pin.writers import write_session

SIGNALS = {"gyro": ["gx", "gy", "gz"], "accel": ["ax", "ay", "az"], "orientation": ["qx", "qy", "qz", "qw"]}
RAW = [*SIGNALS["gyro"], *SIGNALS["accel"]]


def true_orientation(time: np.ndarray) -> Rotation:
    """A hand that turns about changing axes, at up to 300 deg/s."""
    angles = np.column_stack([1.2 * np.sin(2.1 * time), 0.9 * np.sin(3.3 * time + 0.4), 1.5 * np.sin(1.3 * time)])
    return Rotation.from_euler("ZYX", angles * np.sin(0.5 * np.pi * np.clip(time - 2.0, 0.0, 1.0))[:, None] ** 2)


def table_at(time: np.ndarray, noise: float = 0.0) -> pl.DataFrame:
    """The table of a perfect sensor (no speed, so that accel is gravity) sampled at these times."""
    R = true_orientation(time)
    rate = (R[:-1].inv() * R[1:]).as_rotvec() / np.diff(time)[:, None]
    gyro = np.concatenate([rate[:1], rate])
    accel = R.inv().apply([0.0, 0.0, 9.81])
    values = np.column_stack([gyro, accel]) + noise * np.random.default_rng(0).standard_normal((len(time), 6))
    names = ["time", *RAW, *SIGNALS["orientation"]]
    return pl.DataFrame(np.column_stack([time, values, R.as_quat()]), schema=names)


def write(
    folder: Path,
    table: pl.DataFrame,
    *,
    file: str = "hand.csv",
    sensor: str = "",
    ready: bool = False,
    data: str = 'time = "time"',
    **other: pl.DataFrame,
) -> Path:
    """A session with the torso in `file`, and one sensor more for each of `other`, in a CSV of its own."""

    def columns(ready: bool) -> str:
        return "\n".join(f"{k} = {json.dumps(v)}" for k, v in SIGNALS.items() if ready == (k == "orientation"))

    table.write_parquet(folder / file) if file.endswith("parquet") else table.write_csv(folder / file)
    text = (
        f'[data]\nfile = "{file}"\n{data}\ngyro_unit = "rad/s"\naccel_unit = "m/s^2"\n[phases]\nstart = [[0.5, 1.9]]\n'
    )
    text += f'[sensors.torso]\n{columns(ready)}\nmount = {{ up = "+z", forward = "+x" }}\n'
    for name, its_own in other.items():
        its_own.write_csv(folder / f"{name}.csv")
        own_time = "" if "rate_hz" in sensor else 'time = "time"\n'
        text += f'[sensors.{name}]\nfile = "{name}.csv"\n{own_time}{sensor}\n{columns(False)}\n'
    (folder / "session.toml").write_text(text, encoding="utf-8")
    return folder / "session.toml"


def rotation_error_deg(sensor: ImuSensor, time: np.ndarray) -> np.ndarray:
    """Angle between the integrated gyroscope and the truth, at each time."""
    turned = Rotation.from_quat(rotations.integrate(sensor.gyro_S[1:] * np.diff(time)[:, None]))
    truth = true_orientation(time)
    return np.degrees(((truth[0] * turned).inv() * truth).magnitude())


def where(mask: np.ndarray) -> pl.Expr:
    return pl.lit(pl.Series(mask))


def same(a: Recording, b: Recording) -> bool:
    return np.array_equal(a.time, b.time) and all(
        np.array_equal(values, getattr(b.sensors[s], name))
        for s in a.sensors
        for name, values in vars(a.sensors[s]).items()
        if name in ("gyro_S", "accel_S", "quat_VS")
    )


# Tables ------------------------------------------------------------------------------------------------------------


def test_values_come_through_untouched_and_in_si(tmp_path: Path) -> None:
    table = table_at(np.arange(800) / 100.0, 0.01)
    path = write(tmp_path, table.with_columns(pl.col("gx", "gy", "gz").degrees(), pl.col("ax", "ay", "az") / 9.80665))
    path.write_text(path.read_text().replace("rad/s", "deg/s").replace("m/s^2", "g"))
    recording = load_session(path)
    np.testing.assert_array_equal(recording.time, table["time"])
    np.testing.assert_allclose(recording.sensors["torso"].gyro_S, table[SIGNALS["gyro"]], atol=1e-13)
    np.testing.assert_allclose(recording.sensors["torso"].accel_S, table[SIGNALS["accel"]], atol=1e-13)
    assert recording.rate_hz == pytest.approx(100.0)
    assert recording.diagnostics == ()
    assert recording.name == tmp_path.name
    assert same(load_session(tmp_path), recording)


@pytest.mark.parametrize("file", ["hand.csv", "hand.parquet"])
def test_several_sensors_in_one_file_keep_every_bit(file: str, tmp_path: Path) -> None:
    time = np.arange(800) / 100.0
    own = {"torso": table_at(time, 0.01), "head": table_at(time, 0.02).rename({name: f"h{name}" for name in RAW})}
    path = write(tmp_path, own["torso"].hstack(own["head"].select(pl.col("^h.*$"))), file=file)
    sensor = path.read_text()[path.read_text().index("[sensors") :].replace("torso", "head")
    path.write_text(path.read_text() + sensor.replace('["', '["h').replace(', "', ', "h') + "offset_s = 0.0\n")
    path.write_text(path.read_text().replace('forward = "h', 'forward = "'))
    recording = load_session(path)
    for segment, table in own.items():
        names = [name if segment == "torso" else f"h{name}" for name in SIGNALS["gyro"]]
        np.testing.assert_array_equal(recording.sensors[segment].gyro_S, table[names])


def test_float32_integer_and_nullable_columns_load(tmp_path: Path) -> None:
    table = table_at(np.arange(800) / 100.0).with_columns(
        pl.col("gx", "gy").cast(pl.Float32),
        pl.when(pl.col("time") == 4.0).then(None).otherwise(pl.col("gz")).alias("gz"),
        pl.lit(0).cast(pl.Int16).alias("ay"),
        pl.lit(10).cast(pl.UInt8).alias("az"),
        pl.lit(0.0).cast(pl.Decimal(10, 2)).alias("ax"),
    )
    table = table.with_columns(pl.col("gx", "gy", "gz") * 0.05)
    expected = table["gx"].cast(pl.Float64).to_numpy().copy()
    expected[400] = (expected[399] + expected[401]) / 2.0  # gz is missing there, and all three are bridged
    torso = load_session(write(tmp_path, table, file="hand.parquet")).sensors["torso"]
    assert torso.gyro_S.dtype == np.float64
    np.testing.assert_allclose(torso.gyro_S[:, 0], expected, rtol=1e-12)
    np.testing.assert_array_equal(torso.accel_S, np.tile([0.0, 0.0, 10.0], (800, 1)))
    assert np.isfinite(torso.gyro_S).all()


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text,
        lambda text: "# made by a logger\n" + 200 * "# rate: 100\n" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text + "\n\n",
        lambda text: text + ",,,,,,,,,,\n",
        lambda text: text.replace(",", ", ").replace(", ", ",", 10),
    ],
    ids=["BOM", "comments", "CRLF", "empty lines at the end", "empty cells at the end", "blanks before numbers"],
)
def test_csv_as_programs_write_it(change, tmp_path: Path) -> None:
    table = table_at(np.arange(800) / 100.0)
    path = write(tmp_path, table)
    (tmp_path / "hand.csv").write_bytes(change(table.write_csv()).encode())
    assert same(load_session(path), load_session(write(tmp_path, table, file="hand.parquet")))


# Lost samples ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", ["cells", "rows"])
@pytest.mark.parametrize("count", [1, 3, 5])
def test_short_gaps_are_bridged_on_the_rotation(lost: str, count: int, tmp_path: Path) -> None:
    time = np.arange(1000) / 100.0
    table = table_at(time)
    holes = [(k, k + count) for k in range(300, 900, 60)]
    gone = np.zeros(1000, dtype=bool)
    for first, last in holes:
        gone[first:last] = True
    if lost == "rows":
        path = write(tmp_path, table.filter(~gone))
    else:
        path = write(tmp_path, table.with_columns(pl.when(where(~gone)).then(pl.col(RAW)).name.keep()))
    recording = load_session(path)
    np.testing.assert_allclose(recording.time, time, atol=1e-9)
    error = rotation_error_deg(recording.sensors["torso"], time)
    assert error[:300].max() < 1e-6
    assert error.max() < {1: 0.01, 3: 0.07, 5: 0.13}[count] * len(holes)  # [deg], at up to 260 deg/s
    accel = recording.sensors["torso"].accel_S
    assert np.abs(accel - table[SIGNALS["accel"]].to_numpy()).max() < 0.02 * count**2
    share = count * len(holes) / 1000
    told = [(each.code, each.place, each.value) for each in recording.diagnostics]
    assert told == ([("samples-lost", "torso", pytest.approx(share))] if share > 0.01 else [])
    assert recording.sensors["torso"].gap is None


def test_ready_orientations_are_bridged_along_the_rotation(tmp_path: Path) -> None:
    time = np.arange(1000) / 100.0
    table = table_at(time)
    zeros = (pl.col("time") >= 5.0) & (pl.col("time") < 5.05)
    table = table.with_columns(pl.when(zeros).then(0.0).otherwise(pl.col(SIGNALS["orientation"])).name.keep())
    quat = load_session(write(tmp_path, table, ready=True)).sensors["torso"].quat_VS
    assert quat is not None
    np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0, atol=1e-12)
    assert np.degrees((Rotation.from_quat(quat).inv() * true_orientation(time)).magnitude()).max() < 0.3


def still(time: np.ndarray, gyro: np.ndarray, accel: np.ndarray | float = 0.0) -> pl.DataFrame:
    """The table of a sensor that turns about the vertical alone."""
    values = np.broadcast_to([0.0, 0.0, 9.81] + np.asarray(accel), (len(time), 3))
    return pl.DataFrame(np.column_stack([time, gyro, values]), schema=["time", *RAW])


def test_accepted_gaps_are_marked_and_counted_in_the_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = table_at(np.arange(1000) / 100.0, 0.005)
    gone = (pl.col("time") > 5.0) & (pl.col("time") < 5.5)
    rows = (pl.col("time") < 7.0) | (pl.col("time") > 7.205)
    table = table.with_columns(pl.when(~gone).then(pl.col("gy"))).filter(rows)
    (tmp_path / "in").mkdir()
    path = write(tmp_path / "in", table)
    with pytest.raises(
        BadData, match=r"gyro: samples are missing for 0.490 s from 5.010 s, after row 501; up to 50 ms"
    ):
        load_session(path)
    half = [
        pl.when((pl.col("time") < 3.0) == early).then(pl.col(name)) for name, early in (("gx", True), ("ax", False))
    ]
    with pytest.raises(BadData, match=r"accel: no numbers where the other signal has them, from 0 to 9.99 s"):
        load_session(write(tmp_path, table.with_columns(half)), gaps=True)
    recording = load_session(path, gaps=True)
    gap = recording.sensors["torso"].gap
    assert len(recording) == 1000
    assert np.flatnonzero(gap).tolist() == [*range(501, 550), *range(700, 721)]
    assert run("track", path, "--gaps", "-o", tmp_path / "out", "--no-view", "--no-report") == 0
    (gaps,) = (each for each in recording.diagnostics if each.code == "samples-lost")
    assert (gaps.place, gaps.facts["gaps"], gaps.facts["samples"]) == ("torso", 2, 70)
    assert str(gaps) in capsys.readouterr().err
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert "samples-lost" in [each["code"] for each in summary["diagnostics"]]
    np.testing.assert_array_equal(pl.read_parquet(tmp_path / "out" / "pose.parquet")["torso_gap"], gap)
    torso = summary["sensors"]["torso"]
    assert (torso["gaps"], torso["gap_s"]) == (2, 0.7)


# Clocks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread", [0.7, 0.45])
def test_an_uneven_rate_is_resampled_on_the_rotation(spread: float, tmp_path: Path) -> None:
    steps = 0.01 * (1.0 + spread * np.random.default_rng(1).uniform(-1.0, 1.0, 999))
    recording = load_session(write(tmp_path, table_at(np.concatenate([[0.0], np.cumsum(steps)]))))
    np.testing.assert_allclose(np.diff(recording.time), np.diff(recording.time)[0])
    error = rotation_error_deg(recording.sensors["torso"], recording.time)
    assert error.max() < 0.05
    (resampled,) = recording.diagnostics
    assert (resampled.code, resampled.facts["rate"]) == ("time-stamps-uneven", pytest.approx(recording.rate_hz))
    assert resampled.facts["variant"] == ("uneven" if spread > 0.5 else "changing")
    assert resampled.facts["shortest"] < 0.01 < resampled.facts["longest"]


@pytest.mark.parametrize(
    ("own_rate", "sensor"),
    [(100.0, "offset_s = 0.25"), (97.3, ""), (1000.0, ""), (400.0, "rate_hz = 400.0"), (100.0, 'time_unit = "ms"')],
)
def test_sensors_with_clocks_of_their_own_come_to_one_time(own_rate: float, sensor: str, tmp_path: Path) -> None:
    """The torso at 100 Hz from 0 s, the head at its own rate on a clock that runs behind by `offset_s`."""
    offset = 0.25 if "offset" in sensor else 0.0
    its_own = np.arange(0.0, 9.0, 1.0 / own_rate) + (0.003 if "rate_hz" not in sensor else 0.0)
    head = table_at(its_own).with_columns((pl.col("time") - offset) * (1e3 if "unit" in sensor else 1.0))
    path = write(tmp_path, table_at(np.arange(1000) / 100.0), sensor=sensor, head=head)
    recording = load_session(path)
    time = recording.time
    assert recording.rate_hz == pytest.approx(min(100.0, own_rate), rel=1e-5)
    assert time[0] >= its_own[0] - 1e-9
    assert time[-1] <= its_own[-1] + 1e-9
    for segment in ("torso", "head"):
        error = rotation_error_deg(recording.sensors[segment], time)
        assert error.max() < 0.02
        accel = recording.sensors[segment].accel_S
        assert np.abs(accel - true_orientation(time).inv().apply([0.0, 0.0, 9.81])).max() < 0.05
    (resampled,) = recording.diagnostics
    assert (resampled.code, resampled.facts["variant"]) == ("time-stamps-uneven", "clocks")
    assert "With `rate_hz`, the start of each sensor is lost" in str(resampled)


def test_a_sensor_that_ends_early_is_named(tmp_path: Path) -> None:
    """Two of three last for 20 s; that one of these began 30 s before the others makes none of them late."""
    path = write(
        tmp_path,
        table_at(np.arange(2000) / 100.0),
        head=table_at(np.arange(600) / 100.0),
        pelvis=table_at(np.arange(-3000, 2000) / 100.0),
    )
    recording = load_session(path)
    (short,) = (each for each in recording.diagnostics if each.severity == "warning")
    assert (short.code, short.place, short.value) == ("sensor-short", "head", pytest.approx(14.0))
    path.write_text(path.read_text(encoding="utf-8").replace("[[0.5, 1.9]]", "[[7, 9]]"), encoding="utf-8")
    with pytest.raises(BadPhase, match=r"outside the recording.* The head sensor measured only from 0 s to 5.99 s"):
        load_session(path)


def test_a_faster_sensor_is_averaged_so_that_its_noise_does_not_fold_down(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    fast, slow = (
        still(np.arange(20 * hz) / hz, 0.1 * rng.standard_normal((20 * hz, 3)), 0.3 * rng.standard_normal((20 * hz, 3)))
        for hz in (1000, 100)
    )
    head = load_session(write(tmp_path, slow, head=fast.with_columns(pl.col("time") + 0.0003))).sensors["head"]
    assert head.accel_S.std(axis=0) == pytest.approx(0.3 / np.sqrt(10.0), rel=0.05)
    assert head.gyro_S.std() == pytest.approx(0.1 / np.sqrt(10.0), rel=0.05)


def test_the_same_clock_in_two_files_is_not_resampled(tmp_path: Path) -> None:
    time = np.arange(1000) / 100.0
    head = table_at(time, 0.02)
    recording = load_session(write(tmp_path, table_at(time, 0.01), head=head.with_columns(pl.col("time") + 1e-7)))
    assert recording.diagnostics == ()
    np.testing.assert_array_equal(recording.sensors["head"].gyro_S, head[SIGNALS["gyro"]])


def test_a_gap_is_marked_on_the_common_time(tmp_path: Path) -> None:
    time = np.arange(1000) / 100.0
    head = table_at(time + 0.004).with_columns(
        pl.when(where((time < 5.0) | (time > 6.0))).then(pl.col(RAW)).name.keep()
    )
    recording = load_session(write(tmp_path, table_at(time), head=head), gaps=True)
    gap = recording.sensors["head"].gap
    assert gap is not None
    marked = recording.time[gap]
    assert marked.min() == pytest.approx(5.004, abs=0.011)
    assert marked.max() == pytest.approx(6.004, abs=0.011)
    assert 99 <= gap.sum() <= 103
    assert not recording.sensors["torso"].gap.any()


@pytest.mark.parametrize("file", ["hand.csv", "hand.parquet"])
def test_text_is_named_by_its_row(file: str, tmp_path: Path) -> None:
    table = table_at(np.arange(1000) / 100.0)
    text = table["gx"].cast(pl.String).to_list()
    text[900] = "x"
    path = write(tmp_path, table.with_columns(gx=pl.Series(text)), file=file)
    with pytest.raises(BadData, match="column 'gx' holds text in row 901: 'x'"):
        load_session(path)


# Plausibility ------------------------------------------------------------------------------------------------------


def test_saturation_is_counted(tmp_path: Path) -> None:
    table = table_at(np.arange(1000) / 100.0, 0.005).with_columns(pl.col("gx", "gy", "gz").clip(-2.5, 2.5))
    (saturated,) = load_session(write(tmp_path, table)).diagnostics
    assert (saturated.code, saturated.place) == ("signal-saturated", "torso")
    assert saturated.facts == {"variant": "gyro", "range": 2.5}
    count = int((np.abs(table[SIGNALS["gyro"]].to_numpy()).max(axis=1) >= 0.98 * 2.5).sum())
    assert saturated.value == pytest.approx(0.01 * count)


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 1.6, 3.0, 30.0])
def test_saturation_is_told_from_noise_of_any_size(noise: float) -> None:
    """Motion of up to 7 rad/s with noise of so many digits, whole and cut off at 0.9 of its largest rate."""
    rng, time, count = np.random.default_rng(1), np.arange(2000) / 100.0, 0
    for _ in range(20):
        fast, slow = (rng.uniform(0.2, highest) * 2.0 * np.pi for highest in (2.0, 3.0))
        motion = 5.0 * np.sin(fast * time + rng.uniform(0.0, 6.0)) + 2.0 * np.sin(slow * time)
        digit = 10.0 ** rng.uniform(-3.5, -2.0)
        measured = motion + noise * digit * rng.standard_normal(2000)
        whole, cut = (np.round(np.clip(measured, -m, m) / digit) * digit for m in (9.0, 0.9 * np.abs(motion).max()))
        zero = 0.0 * time
        assert not find_saturation(np.column_stack([whole, zero, zero]), 2.0).any()
        count += bool(find_saturation(np.column_stack([zero, cut, zero]), 2.0)[:, 1].any())
    assert count == 20


def test_a_scale_that_is_off_is_noted(tmp_path: Path) -> None:
    table = table_at(np.arange(1000) / 100.0).with_columns(pl.col(SIGNALS["accel"]) * 1.1)
    (scale,) = load_session(write(tmp_path, table)).diagnostics
    assert (scale.code, scale.place) == ("accel-scale", "torso")
    assert scale.value == pytest.approx(0.1, abs=0.01)
    assert scale.facts == {"norm": pytest.approx(10.79, abs=0.01), "start": 0.5, "end": 1.9}


def real_sensors(data: Path) -> dict[str, tuple[float, np.ndarray, np.ndarray]]:
    """Every raw sensor of the real recordings: rate, gyro [rad/s], accel [m/s²]."""
    signals = {}
    for path in sorted((data / "broad").glob("*.mat")):
        trial = loadmat(path)
        signals[path.stem] = (2000.0 / 7.0, trial["imu_gyr"], trial["imu_acc"])
    for path in sorted((data / "ur5" / "imu").glob("*/*.csv")):
        table = read_table(path)
        signals[f"{path.parent.name} {path.stem}"] = (
            125.0,
            table.select(r"gyr_x", "gyr_y", "gyr_z").to_numpy(),
            table.select("acc_x", "acc_y", "acc_z").to_numpy(),
        )
    for path in sorted((data / "ring" / "trial1").glob("imu*.csv")):
        table = read_table(path)
        for k in range(1, 6):
            gyro, accel = ([f"seg{k}_{name}_{axis}" for axis in "xyz"] for name in ("gyr", "acc"))
            signals[f"{path.stem} {k}"] = (40.0, table[gyro].to_numpy(), table[accel].to_numpy())
    prova = np.loadtxt(data / "wepose_hr" / "prova_HR.txt", usecols=range(7), comments=";")
    signals["prova"] = (1000.0, prova[:, 1:4], prova[:, 4:7])
    upper = load_session(data / "upper_body")
    for segment, sensor in upper.sensors.items():
        signals[segment] = (upper.rate_hz, sensor.gyro_S, sensor.accel_S)
    return {name: value for name, value in signals.items() if all(np.isfinite(v).all() for v in value[1:])}


def test_real_recordings_raise_no_alarm_and_their_units_are_told_apart(data: Path, tmp_path: Path) -> None:
    sensors, caught = real_sensors(data), 0
    assert len(sensors) > 40
    for name, (rate_hz, gyro, accel) in sensors.items():
        time = np.arange(len(gyro)) / rate_hz

        def load(gyro: np.ndarray, accel: np.ndarray, time=time, rate_hz=rate_hz) -> Recording:
            write_session(tmp_path, Recording("r", time[: len(gyro)], rate_hz, {"torso": ImuSensor(gyro, accel)}))
            return load_session(tmp_path)

        assert {each.code for each in load(gyro, accel).diagnostics} <= {"sensor-frozen"}, name
        minute = slice(round(60.0 * rate_hz))  # shows this unit
        with pytest.raises(BadData, match='accel_unit = "g" would fit'):
            load(gyro[minute], accel[minute] / 9.81)
        try:
            load(np.degrees(gyro), accel)
        except BadData as error:
            caught += 'gyro_unit = "deg/s" would fit' in str(error)
    assert caught >= len(sensors) - 5  # the arm of the UR5 hardly turns about horizontal axes


def test_a_phase_may_exceed_the_file_by_a_few_samples(tmp_path: Path) -> None:
    """Who states 0 s means the beginning of a file whose clock shows 0.011 s there."""
    path = write(tmp_path, table_at(0.011 + 0.01 * np.arange(1000)))
    for begin, is_right in ((0.0, True), (-1.0, False)):
        text = re.sub(r"(?m)^start = .*$", f"start = [[{begin}, 3.0]]", path.read_text(encoding="utf-8"))
        path.write_text(text, encoding="utf-8")
        if is_right:
            assert load_session(path).phases["start"] == ((0.0, 3.0),)
        else:
            with pytest.raises(BadPhase, match=r"outside the recording, which runs from 0\.011"):
                load_session(path)
