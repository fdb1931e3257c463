"""What a user's files can be wrong in: told in one line that names the place, what is there and what would be right.

All of it runs through the command line: exit code 2, one line on stderr, nothing written.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run

RATE = 100.0
SESSION = """
[data]
file = "arm.csv"
time = "time"
gyro_unit = "rad/s"
accel_unit = "m/s^2"
[phases]
start = [[0.5, 2.5]]
[sensors.torso]
gyro = ["gx", "gy", "gz"]
accel = ["ax", "ay", "az"]
mount = { up = "+z", forward = "+x" }
"""
QUATS = SESSION.replace(
    'gyro = ["gx", "gy", "gz"]\naccel = ["ax", "ay", "az"]', 'orientation = ["qx", "qy", "qz", "qw"]'
)


def good_table() -> pl.DataFrame:
    """Three seconds of standing, then a turn by 90 deg about y and back, with a little noise."""
    rng = np.random.default_rng(0)
    time = np.arange(900) / RATE
    angle = np.deg2rad(90.0) * np.sin(np.pi * np.clip((time - 3.0) / 5.0, 0.0, 1.0)) ** 2
    rate = np.diff(angle, prepend=0.0) * RATE
    noise = 0.002 * rng.standard_normal((900, 6))
    return pl.DataFrame(
        {
            "time": time,
            "gx": noise[:, 0],
            "gy": rate + noise[:, 1],
            "gz": noise[:, 2],
            "ax": -9.81 * np.sin(angle) + noise[:, 3],
            "ay": noise[:, 4],
            "az": 9.81 * np.cos(angle) + noise[:, 5],
            "qx": np.zeros(900),
            "qy": np.sin(angle / 2.0),
            "qz": np.zeros(900),
            "qw": np.cos(angle / 2.0),
        }
    )


@dataclass
class Files:
    """A session that is well, for each case to spoil."""

    folder: Path
    table: pl.DataFrame
    session: str = SESSION

    def write(self) -> Path:
        path = self.folder / "session.toml"
        path.write_text(self.session, encoding="utf-8")
        if not (self.folder / "arm.csv").exists():
            self.table.write_csv(self.folder / "arm.csv")
        return path

    def say(self, old: str, new: str) -> None:
        assert old in self.session
        self.session = self.session.replace(old, new)

    def raw(self, change: Callable[[str], str | bytes]) -> None:
        text = change(self.table.write_csv())
        (self.folder / "arm.csv").write_bytes(text if isinstance(text, bytes) else text.encode())

    def put(self, column: str, rows: slice, value: object) -> None:
        values = self.table[column].to_list()
        values[rows] = [value] * len(values[rows])
        self.table = self.table.with_columns(pl.Series(column, values, strict=False))

    def scale(self, names: str, factor: float) -> None:
        self.table = self.table.with_columns(pl.col(names.split()) * factor)

    def parquet(self) -> None:
        self.say("arm.csv", "arm.parquet")
        self.table.write_parquet(self.folder / "arm.parquet")


# What of the session is exchanged for what, and what is said.
SAYS = [
    ("[phases]", "[phases", "session.toml: not valid TOML: Expected"),
    ("arm.csv", "x", "x: no such file; there is: arm.csv"),
    ("\n[data]", "\nnme = 'x'\n[data]", "session.toml: nme is not a known"),
    ("start = [[0.5, 2.5]]", "still = [[0.5, 2.5]]", "phases.still is called static now: write static = [[from, to]]"),
    ("gyro_unit", "gyr_unit", "session.toml: data.gyr_unit is not a known key; did you mean 'gyro_unit'?"),
    ('gyro_unit = "rad/s"\n', "", "session.toml: data.gyro_unit is missing; there is: rad/s, deg/s"),
    ('"m/s^2"', '"m/s2"', "data.accel_unit = 'm/s2' is not known; did you mean 'm/s^2'?"),
    ("sensors.torso", "sensors.torsoo", "sensors.torsoo is no segment of upper_body; did you mean 'torso'?"),
    ("[data]", "[sensors.head]", "session.toml: data is missing; a table [data]"),
    ('file = "arm.csv"\n', "", "session.toml: data.file is missing"),
    ('accel = ["ax", "ay", "az"]\n', "", "sensors.torso.accel is missing"),
    ('["gx", "gy", "gz"]', '["gx", "gy"]', "gyro = ['gx', 'gy']; a list of 3 different column names is needed"),
    ('time = "time"', "rate_hz = -100.0", "data.rate_hz = -100.0; a number from"),
    ('time = "time"', 'time = "time"\nrate_hz = 100', "one of the two, and both are"),
    ('time = "time"\n', "", "one of the two, and neither is there"),
    (
        'time = "time"',
        'time = "time"\noffset_s = -2e12',
        "data.offset_s = -2000000000000.0; a number from -1e+12 to 1e+12 is needed",
    ),
    ("\ntime =", "\nuse = 'raw'\ntime =", "data.use has no effect, as the columns are named here; remove it"),
    ("accel =", "format = 'dot'\naccel =", "format has no effect, as the columns are named here; remove it"),
    ('forward = "+x"', 'forward = "-z"', "mount.forward = '-z' is parallel to up = '+z'"),
    ("accel =", 'orientation = ["qx", "qy", "qz", "qw"]\naccel =', "orientation stands beside gyro; a sensor has one"),
    ("\n[data]", "\nstart_pose = 'npose'\n[data]", "start_pose = 'npose' is not known; did you mean 'n_pose'?"),
    (
        "[[0.5, 2.5]]",
        "[[0.5, 25.0]]",
        "session.toml: phases.start: [0.5, 25] is outside the recording, which runs from 0.000 to 8.990 s",
    ),
    ("[[0.5, 2.5]]", "[[2.5, 0.5]]", "phases.start: [2.5, 0.5] is empty"),
    ("[[0.5, 2.5]]", '"begin"', "phases.start = 'begin' is not a list of interv"),
    ("[[0.5, 2.5]]", "[[0.5, 0.55]]", "phases.start: [0.5, 0.55] holds 6 samples"),
    (
        "[[0.5, 2.5]]",
        "[[4.0, 6.0]]",
        "session.toml: phases.start: sensors.torso turns at up to 61 deg/s in 4 to 6 s, and less than 1 s of it is",
    ),
    ("arm.csv", "amr.csv", "amr.csv: no such file; did you mean 'arm.csv'?"),
    ('"gz"', '"gyr_z"', "session.toml: sensors.torso.gyro: no column 'gyr_z' in arm.csv; there is: time, gx"),
    ('"gz"', '"ax"', "sensors.torso.accel: 'ax' of arm.csv is a column of sensors.torso.gyro too"),
    ('time = "time"', 'time = "Time"', "session.toml: data.time: no column 'Time' in arm.csv; did you mean 'time'?"),
    ('"m/s^2"', '"g"', "norm 96.2 m/s^2 in phases.start (0.5 to 2.5 s), where grav"),
    ('"rad/s"', '"deg/s"', 'data.gyro_unit = "rad/s" would fit, or the time or rate_hz is wrong'),
    ('mount = { up = "+z", forward = "+x" }', "", "sensors.torso.mount is not known"),
]
# Column, rows, the value put there, and what is said.
PUTS = [
    ("gy", slice(40, 41), "0,125", "column 'gy' holds text in row 41: '0,125'; write decimals with a point: 0.125"),
    ("ax", slice(6, 7), "n.v.", "arm.csv: column 'ax' holds text in row 7: 'n.v.'; it must be a number"),
    ("az", slice(70, 71), float("inf"), "arm.csv: column 'az' holds inf in row 71; no device measures as much"),
    ("gx", slice(None), None, "sensors.torso.gyro: no numbers from 0 to"),
    (
        "time",
        slice(100, 101),
        0.99,
        "arm.csv: time stands still in row 101: 0.99 s after 0.99 s; it must grow in every row: delete one of",
    ),
    ("time", slice(100, 101), 0.5, "arm.csv: time goes back in row 101: 0.5 s"),
    ("time", slice(3, 4), None, "arm.csv: time: not a finite number in row 4"),
    ("gy", slice(400, 406), None, "gyro: samples are missing for 0.060 s from 4.000 s, after row 400; up to 50 ms"),
    ("gz", slice(50, 51), -9999.0, "sensors.torso.gyro: -9999 rad/s on z at 0.500 s, no sensor measures above 80"),
    ("ax", slice(700, 701), 2**63, "sensors.torso.accel: 9.22337e+18 m/s^2 on x at 7."),
]
# Columns, the factor on them, and what is said.
SCALES = [
    ("time", 1000.0, 'time grows by 10 s from row to row, slower than any body sensor; time_unit = "ms" would fit'),
    ("ax ay az", 1 / 9.81, """where gravity's 9.81 is expected; data.accel_unit = "g" would fit"""),
    ("ax ay az", 1000 / 9.81, 'data.accel_unit = "mg" would fit'),
    ("ax ay az", 0.001, "gravity seems to have been taken out"),
    ("gx gy gz", 57.29578, 'data.gyro_unit = "deg/s" would fit'),
]
CASES: list[tuple[Callable[[Files], object], str]] = [
    *((lambda f, old=old, new=new: f.say(old, new), says) for old, new, says in SAYS),
    *((lambda f, put=put: f.put(*put), says) for *put, says in PUTS),
    *((lambda f, n=names, by=by: f.scale(n, by), says) for names, by, says in SCALES),
    (lambda f: setattr(f, "session", f.session.split("[sensors")[0]), "session.toml: no sensors; one"),
    (
        lambda f: setattr(f, "session", f.session.split("[sensors")[0] + "[sensors]\ntorso = 3"),
        "sensors.torso = 3 is not a table; a table [sensors.torso] is needed",
    ),
    (
        lambda f: setattr(f, "session", f.session + f.session[f.session.index("[sensors") :].replace("torso", "head")),
        "session.toml: sensors.head.gyro: 'gx' of arm.csv is a column of sensors.torso.gyro too",
    ),
    (lambda f: (f.folder / "arm.csv").mkdir(), "arm.csv: is a folder; a table is needed here"),
    (
        lambda f: (f.say("arm.csv", "arm.xlsx"), (f.folder / "arm.xlsx").write_bytes(b"PK")),
        "'.xlsx' is not a known format; there is: .csv, .tsv, .txt, .parquet",
    ),
    (
        lambda f: (f.say("arm.csv", "arm.parquet"), (f.folder / "arm.parquet").write_bytes(b"no parquet at all")),
        "arm.parquet: cannot be read as a Parquet file",
    ),
    (lambda f: f.raw(lambda _: ""), "arm.csv: is empty"),
    (lambda f: setattr(f, "table", f.table.head(1)), "arm.csv: 1 samples; a recording has at least"),
    (lambda f: f.raw(lambda t: t.replace("gz", "gy", 1)), "arm.csv: column 'gy' stands there more than once"),
    (lambda f: f.raw(lambda t: t[: t.rindex(",")]), "arm.csv: row 900 has 10 fields, the line of names has 11"),
    (lambda f: f.raw(lambda t: t.encode("utf-16")), "arm.csv: is not a CSV in UTF-8"),
    (
        lambda f: (setattr(f, "table", f.table.with_columns(time=pl.col("time") > 1.0)), f.parquet()),
        "arm.parquet: column 'time' holds values of type Boolean",
    ),
    (
        lambda f: setattr(f, "table", f.table.with_columns(time=pl.col("time") + 1e6 * (pl.col("time") > 5))),
        "arm.csv: time jumps from 5 to 1000005.01 s in row 502",
    ),
    (
        lambda f: setattr(f, "table", pl.concat([f.table.head(300), f.table.slice(307)])),
        "arm.csv: sensors.torso.gyro: samples are missing for 0.070 s from 3.000 s, after row 300; up to 50 ms",
    ),
    (
        lambda f: setattr(
            f, "session", f.session + QUATS[QUATS.index("[sensors") :].replace("torso", "head") + "offset_s = 99"
        ),
        "session.toml: the sensors' clocks do not overlap (torso 0 to 8.99 s, head 99 to 107.99 s)",
    ),
    (
        lambda f: (setattr(f, "session", QUATS), f.put("qw", slice(4, 5), 0.5)),
        "arm.csv: sensors.torso.orientation has length 0.5 in row 5; a unit quaternion x, y, z, w is needed",
    ),
]


@pytest.mark.parametrize(("spoil", "message"), CASES)
def test_bad_input_is_told_in_one_line(
    spoil: Callable[[Files], object], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = Files(tmp_path / "in", good_table())
    files.folder.mkdir()
    spoil(files)
    line = refused(["track", str(files.write()), "-o", str(tmp_path / "out")], capsys)
    assert message in line
    assert str(files.folder) in line  # the file is named
    assert not (tmp_path / "out").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def refused(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    code, printed = run(*argv), capsys.readouterr()
    assert code == 2
    assert printed.out == ""
    lines = printed.err.splitlines()
    assert len(lines) == 1, printed.err
    return lines[0].removeprefix("wepose: ")


def test_the_unspoilt_files_pass(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = Files(tmp_path, good_table()).write()
    assert run("track", session, "-o", tmp_path / "out", "--no-view", "--no-report") == 0
    (printed,) = capsys.readouterr().err.splitlines()
    assert printed.startswith("info: There is no sensor on left upper arm")  # the files hold a torso alone
    assert (tmp_path / "out" / "pose.parquet").is_file()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("nothing.toml", None, "nothing.toml: no such file; a session file is needed here"),
        ("data.csv", b"time,gx\n", "data.csv: is not a TOML file by its name; a session is needed here"),
        ("bytes.toml", b"\xff\xfe\x00", "bytes.toml: not valid TOML"),
        ("empty.toml", b"", "empty.toml: data is missing; a table [data] is needed"),
        ("", None, "session.toml: no such file"),
    ],
)
def test_what_is_no_session(
    name: str, content: bytes | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert message in refused(["track", str(tmp_path / name), "-o", str(tmp_path / "out")], capsys)
