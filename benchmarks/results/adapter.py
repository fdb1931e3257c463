"""The one file that knows the project: its commands, options, exit codes, files, columns, keys and functions.

Where a name of the project changes, it changes here and nowhere else in this folder. The keys under which numbers are
stored hold names of the project too (columns, keys of TOML and JSON): those go into a table of renames.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import traceback
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

METHODS = ("amekf", "smoother", "smekf", "smekf_published", "ncf", "gdc")
OFFLINE = ("smoother",)  # methods that cannot run causally
EXPORTS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("out.csv", ()),
    ("out.parquet", ()),
    ("out.mot", ()),
    ("isb.mot", ("--names", "isb")),
    ("out.sto", ()),
    ("placement.sto", ("--format", "placement")),
    ("out.trc", ()),
    ("out.bvh", ()),
    ("out.c3d", ()),
    ("out.urdf", ()),
    ("thirty.parquet", ("--rate-hz", "30")),
)
ACCEPTED = {"calibrate": (0, 3, 4), "retarget": (0, 3)}  # exit codes beside 0 with which files are written

# Files of a result whose numbers are not compared: pages, and what tells where, when and by what it was made.
NOT_COMPARED = ("*.html", "*.md", "*.svg", "provenance.json", "*.provenance.json", "done.json", "study.json")
# Keys, of JSON or of ours, whose numbers differ from run to run: times, versions, dates.
VOLATILE = r"(^|/)(provenance|versions|packages|machine|date|solve_ms)(/|$)|/results/(seconds|memory_mb|\w+_s)$"
MAIN_TABLES = ("pose",)  # files whose columns stand under the result's own key

# Where the inputs of an older version are read: what has another name now, line by line of its TOML files.
SESSION_KEYS: dict[str, str] = {r"^still = ": "static = ", "^strapping = .new.": "remounted = true"}


# Sessions ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Signals:
    """One sensor's: rates and forces, or orientations in place of both. `mount`: its axes that point up and forward."""

    gyro: np.ndarray | None = None  # (n, 3) [rad/s]
    accel: np.ndarray | None = None  # (n, 3) [m/s²]
    quat: np.ndarray | None = None  # (n, 4) xyzw, sensor to its world
    mount: tuple[str, str] | None = None


@dataclass(frozen=True)
class Table:
    """One file: what one device wrote."""

    time: np.ndarray  # (n,) [s]
    signals: Mapping[str, Signals]
    suffix: str = ".parquet"
    in_degrees: bool = False  # deg/s and g in place of SI units
    offset_s: float = 0.0


@dataclass(frozen=True)
class Session:
    """A recording as a user states it. `truth`: column → values, as in the result of `track`."""

    name: str
    tables: tuple[Table, ...]
    phases: Mapping[str, list[tuple[float, float]]]
    start_pose: str = "n_pose"
    remounted: bool = False
    joints: Mapping[str, float] = field(default_factory=dict)  # [rad] in the start phase, of a chain
    truth: Mapping[str, np.ndarray] | None = None


@dataclass(frozen=True)
class Simulated:
    """A simulated session, and what a user with a tape knows of the person."""

    session: Session
    quat_WS: Mapping[str, np.ndarray]  # sensor → (n, 4) xyzw, true
    measured: Mapping[str, float]  # [m]
    stature: float  # [m]
    sex: str


def simulated(
    seed: int, preset: str, *, rate_hz: float = 100.0, protocol: str = "clasp", mount: Any = "stated"
) -> Simulated:
    """A short simulated session: 20 s of the protocol, one circle."""
    from dataclasses import replace

    from wepose_pin.simulation import IDEAL_PRESET, MILD_PRESET, simulate, simulate_person

    person = simulate_person(seed)
    made = simulate(
        person.lengths,
        seed=seed,
        rate_hz=rate_hz,
        protocol=protocol,
        clasp_s=20.0,
        circles=1,
        imperfections=replace({"ideal": IDEAL_PRESET, "mild": MILD_PRESET}[preset], mount=mount),
    )
    signals = {name: Signals(gyro, made.accel_S[name], mount=made.stated_mount) for name, gyro in made.gyro_S.items()}
    truth = {"time": made.time}
    for name, quat in made.quat_WL.items():
        truth |= {f"{name}_q{axis}": quat[:, k] for k, axis in enumerate("xyzw")}
    for name, point in made.points.items():
        truth |= {f"{name}_{axis}": point[:, k] for k, axis in enumerate("xyz")}
    phases = {name: spans for name, spans in made.phases.items() if spans}
    session = Session(f"{preset}-{seed}", (Table(made.time, signals),), phases, truth=truth)
    measured = {"shoulder_width": person.measured["shoulder_width"]}
    return Simulated(session, made.quat_WS, measured, round(person.stature, 2), person.sex)


def write_session(folder: Path, session: Session) -> None:
    """The session file with its tables beside it."""
    folder.mkdir(parents=True)
    lines = [f'name = "{session.name}"', f'start_pose = "{session.start_pose}"']
    lines += ["remounted = true"] * session.remounted
    first = session.tables[0]
    lines += ["[data]", f'gyro_unit = "{"deg/s" if first.in_degrees else "rad/s"}"']
    lines += [f'accel_unit = "{"g" if first.in_degrees else "m/s^2"}"']
    if len(session.tables) == 1:
        lines += [f'file = "data_0{first.suffix}"', 'time = "time"']
    if session.truth is not None:
        lines.append('truth = "truth.parquet"')
        pl.DataFrame(dict(session.truth)).write_parquet(folder / "truth.parquet")
    if session.phases:
        lines.append("[phases]")
        lines += [f"{name} = {[list(span) for span in s]}" for name, s in session.phases.items()]
    if session.joints:
        lines += ["[joints]", *(f"{name} = {value!r}" for name, value in session.joints.items())]
    for k, table in enumerate(session.tables):
        columns = {"time": table.time}
        for segment, s in table.signals.items():
            lines.append(f"[sensors.{segment}]")
            if len(session.tables) > 1:
                lines += [f'file = "data_{k}{table.suffix}"', 'time = "time"', f"offset_s = {table.offset_s!r}"]
            units = (np.deg2rad(1.0), 9.80665, 1.0) if table.in_degrees else (1.0, 1.0, 1.0)
            for key, values, unit in zip(
                ("gyro", "accel", "orientation"), (s.gyro, s.accel, s.quat), units, strict=True
            ):
                if values is not None:
                    names = [f"{segment}_{key}_{axis}" for axis in "xyzw"[: values.shape[1]]]
                    columns |= {name: values[:, c] / unit for c, name in enumerate(names)}
                    lines.append(f"{key} = {json.dumps(names)}")
            if s.mount is not None:
                lines.append(f'mount = {{ up = "{s.mount[0]}", forward = "{s.mount[1]}" }}')
        frame = pl.DataFrame(columns).with_columns(pl.all().fill_nan(None))
        if table.suffix == ".csv":
            frame.write_csv(folder / f"data_{k}.csv")
        else:
            frame.write_parquet(folder / f"data_{k}.parquet")
    (folder / "session.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def copy_inputs(source: Path, target: Path) -> None:
    """The inputs of another version, in the words of this one."""
    shutil.copytree(source, target)
    for path in target.rglob("*.toml"):
        text = path.read_text(encoding="utf-8")
        for pattern, replacement in SESSION_KEYS.items():
            text = re.sub(pattern, replacement, text, flags=re.MULTILINE)
        path.write_text(text, encoding="utf-8")


# Commands ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """How a command ended; `error`: what it said, or the traceback that left it."""

    code: int
    error: str


def run(argv: list[str]) -> Outcome:
    """Run a command in this process."""
    from wepose_pin.commands import main

    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(list(argv))
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        except Exception:
            return Outcome(1, traceback.format_exc())
    return Outcome(code, err.getvalue().strip())


def calibrate(session: Path, out: Path, *, method: str, protocol: str, known: Mapping[str, Any]) -> list[str]:
    argv = ["calibrate", str(session), "-o", str(out), "--method", method, "--protocol", protocol]
    argv += [part for name, value in known.get("measured", {}).items() for part in ("--measured", f"{name}={value!r}")]
    argv += ["--stature", str(known["stature"]), "--sex", known["sex"]] if "stature" in known else []
    return argv


def track(
    session: Path,
    out: Path,
    *,
    method: str,
    subject: Path | None = None,
    model: Path | None = None,
    options: Iterable[str] = (),
) -> list[str]:
    """`options`: of causal, gaps, covariance, torques."""
    argv = ["track", str(session), "-o", str(out), "--method", method, "--no-report"]
    argv += ["--subject", str(subject), "--accept-failed"] if subject else []
    argv += ["--model", str(model)] if model else []
    return argv + [f"--{name}" for name in options]


def track_live_recording(file: Path, out: Path) -> list[str]:
    """The poses that were shown live."""
    return ["track", str(file), "-o", str(out), "--no-report"]


def live(session: Path, record: Path, *, method: str, subject: Path | None) -> list[str]:
    argv = ["live", "--source", f"replay:{session}", "--speed", "max", "--no-page", "--record", str(record)]
    return [*argv, "--method", method, *(["--subject", str(subject)] if subject else [])]


def export(result: Path, out: Path, options: Iterable[str]) -> list[str]:
    return ["export", str(result), "-o", str(out), *options]


def retarget(result: Path, out: Path, *, robot: str, options: Iterable[str] = ()) -> list[str]:
    return ["retarget", str(result), "--robot", robot, "-o", str(out), "--no-view", *options]


def simulate(out: Path, *, seed: int, preset: str, protocol: str, changes: Iterable[str] = ()) -> list[str]:
    argv = ["simulate", "-o", str(out), "--seed", str(seed), "--preset", preset, "--protocol", protocol]
    return argv + [part for change in changes for part in ("--imperfection", change)]


def info(file: Path, session: Path) -> list[str]:
    return ["info", str(file), "-o", str(session)]


def name_sensors(session: Path, segments: Iterable[str]) -> None:
    """Put sensors whose place `info` could not know, and left open in the session, on segments."""
    text = session.read_text(encoding="utf-8")
    for segment in segments:
        text = text.replace("# [sensors.SEGMENT]\n# file", f"[sensors.{segment}]\nfile", 1)
    session.write_text(text, encoding="utf-8")


def demo(out: Path) -> list[str]:
    return ["demo", "-o", str(out)]


def batch(plan: Path, out: Path) -> list[str]:
    return ["batch", str(plan), "-o", str(out), "--workers", "1"]


def write_plan(file: Path, recording: Path, known: Mapping[str, Any]) -> None:
    """A plan of `batch`: a subject calibrated by a recording, which is tracked, exported and evaluated with it."""
    measured = ", ".join(f"{name} = {value!r}" for name, value in known["measured"].items())
    person = f'stature = {known["stature"]}\nsex = "{known["sex"]}"'
    file.write_text(
        f"""[sessions]
files = ["{recording}/session.toml"]
subject = "person"
[subjects.person]
calibration = "{recording}/session.toml"
measured = {{ {measured} }}
{person}
[steps.calibrate]
report = false
[steps.track]
view = false
report = false
[steps.export]
formats = ["trc"]
[steps.evaluate]
""",
        encoding="utf-8",
    )


# Functions ---------------------------------------------------------------------------------------------------------


def recording_values(session: Path) -> dict[str, Any]:
    """What a session is read as."""
    import wepose_pin as wp

    recording = wp.load_session(session)
    values: dict[str, Any] = {"time": recording.time, "rate_hz": recording.rate_hz, "phases": recording.phases}
    for name, sensor in recording.sensors.items():
        fields = {"gyro": "gyro_S", "accel": "accel_S", "quat_WS": "quat_VS", "stated_quat_LS": "stated_quat_LS"}
        values[name] = {key: getattr(sensor, field, None) for key, field in fields.items()}
    return values


def tracked_values(session: Path, subject: Path | None, method: str) -> dict[str, Any]:
    """What the function `track` gives, in full precision."""
    import wepose_pin as wp

    pose = wp.track(wp.load_session(session), wp.load_subject(subject) if subject else None, method=method)
    return {
        "quat_WL": pose.quat_WL,
        "points": pose.points,
        "q": pose.q,
        "segment_cov": pose.pose.segment_cov,
        "point_cov": pose.pose.point_cov,
    }


def calibration_values(session: Path, measured: Mapping[str, float]) -> dict[str, Any]:
    """What the function `calibrate` gives, in full precision."""
    import wepose_pin as wp

    subject = wp.calibrate(wp.load_session(session), measured=dict(measured)).subject
    return {"lengths": subject.lengths, "mounts": subject.mounts, "covariance": subject.covariance}


def errors_of(result: Path, truth: Path) -> object:
    """What `evaluate` gives."""
    import wepose_pin as wp
    from wepose_pin.body.kinematics import parse_pose_table

    return wp.evaluate(wp.load_result(result).pose, parse_pose_table(pl.read_parquet(truth), str(truth)))


def orientation_values(
    gyro: np.ndarray, accel: np.ndarray, rate_hz: float, method: str, static: tuple[float, float] | None
) -> dict[str, Any]:
    """What `estimate_orientation` gives."""
    import wepose_pin as wp

    with warnings.catch_warnings(action="ignore"):
        found = wp.estimate_orientation(gyro, accel, rate_hz, method=method, static=static)
    return {"quat_WS": found.quat_VS, "gyro_bias": found.gyro_bias, "static": found.static}


def has_robot(name: str) -> bool:
    """Whether a robot's model is installed."""
    from wepose_pin.retargeting import find_map, load_robot

    with contextlib.suppress(Exception):
        load_robot(find_map(name))
        return True
    return False
