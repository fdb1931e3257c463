"""The one file that knows the project: its commands, options, exit codes, files, columns, keys and codes.

Where a name of the project changes, it changes here and nowhere else in this folder.
"""

import contextlib
import io
import json
import re
import traceback
import warnings as python_warnings
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import polars as pl

from .cases import Case, Layout
from .people import SEGMENTS
from .recordings import Recorded, Table
from .sensors import DEG, GRAVITY

# Exit codes that a command may end with.
CODES = {"calibrate": {0, 2, 3, 4}, "batch": {0, 2, 3}}
USUAL_CODES = {0, 2}
ACCEPTED = {"calibrate": {0, 3, 4}}
EXPORTS = ("out.mot", "out.sto", "out.trc", "out.bvh", "out.csv", "out.parquet", "out.urdf")

# Codes of diagnostics that say why a segment is not to be believed, by cause; each counts for the segment that it is
# about, or for all where it is about none. Causes of ALWAYS may be there in any recording, the others only where the
# case has them.
CAUSES = {
    "range": {"signal-saturated"},
    "fault": {"sensor-frozen", "samples-lost"},
    "identical": set(),
    "swapped": {"sensors-exchanged"},
    "gap": {"samples-lost"},
    "start": {"start-pose-guessed", "start-pose-motion", "static-phase-trimmed", "mount-contradicted"},
}
ALWAYS = ("start",)


@dataclass
class Outcome:
    """How a command ended. `traceback`: the error that left it, which it never may."""

    argv: list[str]
    code: int
    out: str
    err: str
    traceback: str = ""


@dataclass(frozen=True)
class Diagnosed:
    """What a result says of itself; `places`: segments that it is about, none where it is about all."""

    code: str
    places: tuple[str, ...]


@dataclass
class Result:
    """What `track` wrote: rotations as xyzw, deviations of one axis; `calibrated`: segments whose mount has a ±."""

    time: np.ndarray
    quat: dict[str, np.ndarray]
    quat_std: dict[str, np.ndarray]
    points: dict[str, np.ndarray]
    points_std: dict[str, np.ndarray]
    gap: dict[str, np.ndarray]
    table: pl.DataFrame
    lengths: dict[str, float]
    girdles: dict[str, np.ndarray]  # shoulder → (7,) what the subject differs by from the law of the shoulders
    start: tuple[float, float]
    diagnostics: list[Diagnosed]
    calibrated: set[str]


# Session -----------------------------------------------------------------------------------------------------------


def write_session(folder: Path, recorded: Recorded, layout: Layout, unit: str = "s") -> Path:
    """The recording as a user has it: tables and the session file that names them."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ['name = "random"', 'start_pose = "n_pose"', "[data]"]
    several = len(recorded.tables) > 1
    if not several:
        lines += [f'file = "recording{layout.suffix}"', _clock_line(recorded.tables[0])]
    lines += [f'gyro_unit = "{"deg/s" if layout.gyro_in_deg else "rad/s"}"']
    lines += [f'accel_unit = "{"g" if layout.accel_in_g else "m/s^2"}"', "[phases]"]
    for name, span in (("start", recorded.start), ("clasp", recorded.clasp)):
        if span is not None:
            lines.append(f"{name} = [[{span[0]:.6f}, {span[1]:.6f}]]")
    for k, table in enumerate(recorded.tables):
        file = f"sensor_{k}{layout.suffix}" if several else f"recording{layout.suffix}"
        _write_table(folder / file, table, layout, unit)
        for segment, signals in table.signals.items():
            lines.append(f"[sensors.{segment}]")
            if several:
                lines += [f'file = "{file}"', _clock_line(table), f"offset_s = {table.offset!r}"]
            kinds = ("gyro", "accel") if signals.quat is None else ("orientation",)
            lines += [f"{kind} = {json.dumps(_columns(segment, kind))}" for kind in kinds]
            axes = recorded.axes[segment]
            if axes is not None:
                lines.append(f'mount = {{ up = "{axes[0]}", forward = "{axes[1]}" }}')
    session = folder / "session.toml"
    session.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return session


def data_files(folder: Path) -> list[Path]:
    """What `write_session` wrote beside the session."""
    return sorted([*folder.glob("recording.*"), *folder.glob("sensor_*")])


def _clock_line(table: Table) -> str:
    return f"rate_hz = {table.rate_hz!r}" if table.stamps is None else 'time = "time"'


def _columns(segment: str, kind: str) -> list[str]:
    short = {"gyro": "gyr", "accel": "acc", "orientation": "q"}[kind]
    return [f"{segment}_{short}_{axis}" for axis in ("xyzw" if kind == "orientation" else "xyz")]


def _write_table(path: Path, table: Table, layout: Layout, unit: str) -> None:
    columns: dict[str, np.ndarray] = {}
    if table.stamps is not None:
        columns["time"] = table.stamps * {"s": 1.0, "ms": 1e3, "us": 1e6}[unit]
    for segment, s in table.signals.items():
        parts = (
            {"orientation": s.quat}
            if s.quat is not None
            else {
                "gyro": s.gyro / DEG if layout.gyro_in_deg else s.gyro,
                "accel": s.accel / GRAVITY if layout.accel_in_g else s.accel,
            }
        )
        for kind, values in parts.items():
            assert values is not None
            columns |= dict(zip(_columns(segment, kind), values.T, strict=True))
    if path.suffix == ".parquet":
        pl.DataFrame(columns).write_parquet(path)
        return
    shown = pl.DataFrame({n: v if n == "time" else rounded(v, layout.digits) for n, v in columns.items()})
    shown.with_columns(pl.all().fill_nan(None)).write_csv(path)


def rounded(values: np.ndarray, digits: int) -> np.ndarray:
    """To so many significant digits of the largest value."""
    size = np.nanmax(np.abs(values), initial=1e-12)
    return np.round(values, max(0, digits - 1 - int(np.floor(np.log10(size)))))


# Commands ----------------------------------------------------------------------------------------------------------


def calibrate(session: Path, out: Path, case: Case) -> list[str]:
    lengths = {name: value for name, value in case.measured.items() if name != "stature"}
    options = [part for name, value in lengths.items() for part in ("--measured", f"{name}={value}")]
    if "stature" in case.measured:
        options += ["--stature", str(case.measured["stature"]), "--sex", case.person.sex]
    method = [] if case.method == "amekf" else ["--method", case.method]
    return ["calibrate", str(session), "-o", str(out), *options, *method, *_gaps(case.options)]


def track(session: Path, out: Path, method: str, options: Iterable[str], subject: Path | None = None) -> list[str]:
    options = set(options)
    argv = ["track", str(session), "-o", str(out), *_gaps(options)]
    argv += [] if method == "amekf" else ["--method", method]
    argv += [f"--{name}" for name in ("covariance", "causal", "torques") if name in options]
    argv += [] if "report" in options else ["--no-report"]
    return argv + (["--subject", str(subject)] if subject else [])


def tracking_in_chunks(seconds: float) -> AbstractContextManager[object]:
    """Within it `run` tracks recordings in chunks that are so short; it holds in this process alone."""
    return mock.patch("wepose_pin.tracking.CHUNK_S", seconds)


def _gaps(options: Iterable[str]) -> list[str]:
    return ["--gaps"] if "gaps" in options else []


def evaluate(result: Path, truth: Path) -> list[str]:
    return ["evaluate", str(result), str(truth)]


def view(result: Path, out: Path) -> list[str]:
    return ["view", str(result), "-o", str(out), "--no-open"]


def export(result: Path, out: Path) -> list[str]:
    return ["export", str(result), "-o", str(out)]


def info(file: Path, session: Path | None = None) -> list[str]:
    return ["info", str(file), *(["-o", str(session)] if session else [])]


def retarget(result: Path, out: Path) -> list[str]:
    return ["retarget", str(result), "--robot", "panda", "-o", str(out)]


def codes(command: str) -> set[int]:
    """Exit codes that the documents promise."""
    return CODES.get(command, USUAL_CODES)


def accepted(command: str, code: int) -> bool:
    return code in ACCEPTED.get(command, {0})


def run(argv: list[str]) -> Outcome:
    """Run a command in this process."""
    from wepose_pin.commands import main

    out, err, code, failed = io.StringIO(), io.StringIO(), 0, ""
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), python_warnings.catch_warnings():
        python_warnings.simplefilter("error")  # a library's complaint would stand in the user's terminal
        python_warnings.filterwarnings("ignore", category=DeprecationWarning)
        python_warnings.filterwarnings("ignore", category=ResourceWarning)
        try:
            main(list(argv))
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            code, failed = 1, traceback.format_exc()
    return Outcome(argv, code, out.getvalue(), err.getvalue(), failed)


# Results -----------------------------------------------------------------------------------------------------------


def read_result(folder: Path) -> Result:
    """What `track` wrote."""
    table = pl.read_parquet(folder / "pose.parquet")
    values = {name: table[name].to_numpy() for name in table.columns}
    segments = [name[:-3] for name in values if name.endswith("_qx")]
    points = [name[:-2] for name in values if name.endswith("_x")]
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    subject = (folder / "subject.toml").read_text(encoding="utf-8")
    lengths = dict(re.findall(r"^(\w+) = ([-0-9.e]+)", subject.split("[lengths]")[1].split("\n[")[0], re.MULTILINE))
    std = {name: values.get(f"{name}_std") for name in segments}
    return Result(
        time=values["time"],
        quat={name: np.column_stack([values[f"{name}_q{c}"] for c in "xyzw"]) for name in segments},
        quat_std={name: v for name, v in std.items() if v is not None},
        points={name: np.column_stack([values[f"{name}_{c}"] for c in "xyz"]) for name in points},
        points_std={name: values[f"{name}_std"] for name in points if f"{name}_std" in values},
        gap={name[:-4]: values[name] for name in values if name.endswith("_gap")},
        table=table,
        lengths={name: float(value) for name, value in lengths.items()},
        girdles={
            point: np.array([float(value) for value in re.findall(r"= ([-0-9.e]+)$", rows, re.MULTILINE)])
            for point, rows in re.findall(r"^\[girdles\.(\w+)\][^\n]*\n([^\[]*)", subject, re.MULTILINE)
        },
        start=_first_span(summary["phases"]["start"]),
        diagnostics=diagnosed(summary),
        calibrated=set(re.findall(r"^\[mounts\.(\w+)\][^\[]*?^std_deg", subject, re.MULTILINE | re.DOTALL)),
    )


def diagnosed(content: Mapping[str, Any]) -> list[Diagnosed]:
    """The diagnostics of a summary or a calibration."""
    diagnostics = []
    for item in content["diagnostics"]:
        places = (item["place"], item["facts"].get("other"))  # of two sensors that are alike
        diagnostics.append(Diagnosed(item["code"], tuple(place for place in places if place)))
    return diagnostics


def _first_span(value: list) -> tuple[float, float]:
    first = value[0] if isinstance(value[0], list) else value
    return float(first[0]), float(first[1])


def table_bytes(folder: Path) -> pl.DataFrame:
    """All numbers of a result, for comparison to the bit."""
    return pl.read_parquet(folder / "pose.parquet")


def write_truth(
    path: Path, stamps: np.ndarray, quat: Mapping[str, np.ndarray], points: Mapping[str, np.ndarray]
) -> None:
    """A reference table for `evaluate`."""
    columns = {"time": stamps}
    for name, values in quat.items():
        columns |= {f"{name}_q{c}": values[:, k] for k, c in enumerate("xyzw")}
    for name, values in points.items():
        columns |= {f"{name}_{c}": values[:, k] for k, c in enumerate("xyz")}
    pl.DataFrame(columns).write_parquet(path)


# Words -------------------------------------------------------------------------------------------------------------


def named_cause(diagnostics: Iterable[Diagnosed], segments: Iterable[str], causes: Iterable[str]) -> str:
    """Code and places of the first diagnostic that says why these segments may be wrong; empty: none does."""
    segments, codes = set(segments), set().union(*(CAUSES[cause] for cause in {*causes, *ALWAYS}))
    for each in diagnostics:
        if each.code in codes and (not each.places or segments & set(each.places)):
            return " ".join((each.code, *each.places))
    return ""


def refusal(outcome: Outcome) -> str:
    """The one line by which a command refuses."""
    return outcome.err.strip().removeprefix("wepose: ")


def advises_calibration(outcome: Outcome) -> bool:
    """Whether a refusal says that a calibration will find what is not known."""
    return "calibrate` finds" in outcome.err


def is_one_line(outcome: Outcome) -> bool:
    """Whether a refusal is one line that begins with the program's name."""
    lines = [line for line in outcome.err.splitlines() if line.strip()]
    return len(lines) == 1 and lines[0].startswith("wepose: ")


def names_something(outcome: Outcome) -> bool:
    """Whether a refusal names what it refuses: a file, key, column, sensor, option or a time."""
    text = refusal(outcome)
    named = re.search(r"\.(toml|csv|parquet)|--\w|phases\.|\d+\.?\d* s\b", text)
    return named is not None or any(segment in text for segment in SEGMENTS)


def left_behind(out: Path) -> list[str]:
    """What a command that refused has left where its output would stand."""
    beside = [path.name for path in out.parent.glob(f".{out.name}*")]
    return [str(out)] * out.exists() + beside
