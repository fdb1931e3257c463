"""Bodies that are no upper body, by the commands: lengths, orientations and points beside what is known of them."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.trials import RING_SEGMENTS, find_ring
from benchmarks.validation import real
from benchmarks.validation.experiment import align_rotation
from wepose_pin import rotations
from wepose_pin.body import load_model
from wepose_pin.body.subject import load_subject, population_subject, subject_toml
from wepose_pin.commands import main
from wepose_pin.commands.evaluate import evaluate
from wepose_pin.errors import BadData, BadOption
from wepose_pin.evaluation import attitude_error
from wepose_pin.readers import load_session
from wepose_pin.readers.mvnx import SEGMENT_OF, read_frames
from wepose_pin.simulation import NOISE_FREE
from wepose_pin.tracking import track
from wepose_pin.writers import write_session

from .four_bar import PROTOCOL, STD_PERCENT, move_four_bar, write_four_bar
from .ring_chain import RingSession, write_ring_session
from .tables import Column, Section, Table
from .ur5_arm import RUNS, move_arm, write_table, write_ur5_session, write_urdf

MOUNTS = ("rigid", "loose")
MODELS = ("upper_body", "humanSubject01_66dof")
MVNX = Path("mvnx") / "test_mocap.mvnx"
# An Xsens segment's position is that of the joint at which it begins.
XSENS_JOINTS = {
    f"{side}_{point}": f"{side.capitalize()}{segment}"
    for side in ("left", "right")
    for point, segment in (("shoulder", "UpperArm"), ("elbow", "ForeArm"), ("wrist", "Hand"))
}
MVNX_START = (0.0, 0.4)  # [s]; the orientations are the segments' own, so that it sets the heading of x alone
LEG_JOINTS = ("hip", "knee", "ankle")


def sections(quick: bool, data: Path | None) -> dict[str, Section]:
    """Name → a function that measures it."""
    if data is None or not find_ring(data) or not (data / MVNX).is_file():
        raise BadOption(f"--data {data}: bodies are measured on ring/, ur5/ and {MVNX}, which are not all there")
    measured: dict[str, Callable[[Path], Table]] = {
        "ring links": partial(measure_ring_links, data, MOUNTS[: 1 if quick else None]),
        "ring orientations": partial(measure_ring_orientations, data, MOUNTS[: 1 if quick else None]),
        "ur5 links": partial(measure_ur5_links, (0,) if quick else (0, 1, 2)),
        "four-bar linkage": partial(measure_four_bar, range(3 if quick else 12)),
        "ur5 encoders": partial(measure_ur5, data, ("amekf",) if quick else ("smekf", "amekf")),
        "mvnx": partial(measure_mvnx, data),
        "legs": partial(measure_legs, ("walk",) if quick else ("walk", "sit")),
    }
    return {name: partial(_measure_in_a_folder, measure) for name, measure in measured.items()}


def _measure_in_a_folder(measure: Callable[[Path], Table]) -> Table:
    with tempfile.TemporaryDirectory() as folder:
        return measure(Path(folder))


def run(*words: object, codes: Sequence[int] = (0,)) -> None:
    """Run a command of `wepose` without what it prints.

    Raises
    ------
    BadData
        It ends with another exit code than `codes`.
    """
    printed = io.StringIO()
    code: object = None
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main([str(word) for word in words])
        except SystemExit as stopped:
            code = stopped.code or 0
    if code not in codes:
        raise BadData(f"wepose {' '.join(map(str, words))}: {printed.getvalue().strip()}")


# RING ---------------------------------------------------------------------------------------------------------------


def calibrate_ring(data: Path, mount: str, folder: Path) -> RingSession:
    """Write the trial's session and calibrate its lengths, into `folder`/cal."""
    ring = write_ring_session(find_ring(data)[0], mount, folder)
    run(
        *("calibrate", ring.session, "--model", ring.model, "--protocol", ring.protocol),
        *("-o", folder / "cal", "--no-report", "--force"),
    )
    return ring


def measure_ring_links(data: Path, mounts: Sequence[str], folder: Path) -> Table:
    """Measure the lengths of RING trial 1 by `wepose calibrate`, with a table, beside the validation's script."""
    table = Table(
        "RING trial 1: lengths of links by wepose calibrate with a table",
        (
            Column("calibrated_mm", "calibrated [mm]", 1),
            Column("std_mm", "± [mm]", 1),
            Column("script_mm", "validation's script [mm]", 1),
            Column("optical_mm", "optical [mm]", 1),
        ),
        notes=["seg2 and seg3 lie in one line: the motion shows the sum of their lengths."],
    )
    for mount in mounts:
        ring = calibrate_ring(data, mount, folder)
        subject = load_subject(folder / "cal")
        by_script = {each.method: each.figures for each in real.compare_links(find_ring(data)[0], mount)}["amekf"]
        for names in (["seg2", "seg3"], ["seg4"]):
            name = " and ".join(names)
            table.rows[f"{mount} {name}"] = {
                "calibrated_mm": 1e3 * sum(subject.lengths[each] for each in names),
                "std_mm": 1e3 * float(np.sqrt(subject.lengths_covariance(names).sum())),
                "script_mm": by_script[f"{name} [mm]"],
                "optical_mm": 1e3 * sum(ring.true_lengths[each] for each in names),
            }
    return table


def measure_ring_orientations(data: Path, mounts: Sequence[str], folder: Path) -> Table:
    """Measure the orientations of RING trial 1 by `wepose track`, beside those of each sensor alone in the script."""
    table = Table(
        "RING trial 1: orientations by wepose track of the calibrated chain, root mean square error",
        (Column("command_deg", "wepose track [deg]", 2), Column("script_deg", "validation's script [deg]", 2)),
        notes=["After the first 10 s, on which the heading is aligned. The script has its biases and mounts from the"]
        + ["optical system, the command from its own calibration."],
    )
    for mount in mounts:
        ring = calibrate_ring(data, mount, folder)
        run(
            *("track", ring.session, "--model", ring.model, "--subject", folder / "cal", "-o", folder / "result"),
            *("--no-report", "--no-view", "--force"),
        )
        pose = pl.read_parquet(folder / "result" / "pose.parquet")
        time = pose["time"].to_numpy()
        inside = ring.known & (ring.time >= time[0]) & (ring.time <= time[-1])
        scored_time = ring.time[inside]
        early = scored_time <= real.UNSCORED_S
        chain, registered = real.register_ring(find_ring(data)[0].folder)
        for segment in RING_SEGMENTS:
            quat = pose.select([f"{segment}_{c}" for c in ("qx", "qy", "qz", "qw")]).to_numpy()
            tracked, true = Slerp(time, Rotation.from_quat(quat))(scored_time), ring.true[segment][inside]
            tracked = align_rotation(tracked, true, early)
            sensor, registration = chain.sensors[mount, segment], registered[mount, segment]
            noise = real.assume_noise(sensor.rate_hz, registration.gyro_bias)
            alone = dict(real.run_orientations(sensor, registration, noise))["amekf"]
            scored = alone.scored
            by_script = attitude_error(alone.estimated[scored], alone.true[scored], sensor.time[scored])
            table.rows[f"{mount} {segment}"] = {
                "command_deg": attitude_error(tracked[~early], true[~early], scored_time[~early]).total_rmse,
                "script_deg": by_script.total_rmse,
            }
    return table


# UR5 ----------------------------------------------------------------------------------------------------------------


def measure_ur5_links(seeds: Sequence[int], folder: Path) -> Table:
    """Measure two lengths of a simulated UR5 by `wepose calibrate`, its tip on a fixed point that is not known."""
    table = Table(
        "UR5, simulated, a sensor on each link, the tip on a fixed point: two lengths by wepose calibrate",
        (
            Column("before_mm", "before [mm]", 1),
            Column("before_std_mm", "± [mm]", 1),
            Column("calibrated_mm", "calibrated [mm]", 1),
            Column("std_mm", "± [mm]", 1),
            Column("true_mm", "true [mm]", 1),
            Column("z", "error / ±", 2),
        ),
    )
    model = write_table(write_urdf(folder))
    body = load_model(model)
    for seed in seeds:
        moved, session = move_arm(body, seed), folder / f"session{seed}"
        session.mkdir()
        write_session(session, moved.recording)
        run(
            *("calibrate", session, "--model", model, "--protocol", "tip", "-o", folder / f"cal{seed}"),
            *("--no-report",),
            codes=(0, 3),  # poor: the first link turns about the vertical alone
        )
        subject = load_subject(folder / f"cal{seed}")
        for name, true in moved.lengths.items():
            value, std = subject.lengths[name], subject.std(name)
            before = body.lengths[name]
            table.rows[f"seed {seed} {name}"] = {
                "before_mm": 1e3 * before,
                "before_std_mm": 10.0 * body.table.lengths[name].std_percent * before,
                "calibrated_mm": 1e3 * value,
                "std_mm": 1e3 * std,
                "true_mm": 1e3 * true,
                "z": (value - true) / std,
            }
    return table


def measure_four_bar(seeds: Sequence[int], folder: Path) -> Table:
    """Measure the lengths of a simulated four-bar linkage by `wepose calibrate`, and what their errors come from."""
    table = Table(
        "Four-bar linkage, simulated, the tip on its pivot on the ground: three lengths by wepose calibrate",
        (
            Column("mean_mm", "mean error [mm]", 1),
            Column("spread_mm", "its spread [mm]", 1),
            Column("std_mm", "± [mm]", 1),
            Column("z", "error / ±, rms", 2),
        ),
        notes=[f"{len(seeds)} seeds. Lengths are known to {STD_PERCENT:g} % before."],
    )
    exact: dict[str, Any] = {"start_std": 0.0}
    noise_free: dict[str, Any] = {"noise": NOISE_FREE}
    cases: dict[str, tuple[float, dict[str, Any]]] = {
        "all errors": (STD_PERCENT, {}),
        "lengths unknown before": (10.0 * STD_PERCENT, {}),
        "exact start pose": (STD_PERCENT, exact),
        "sensors without noise": (STD_PERCENT, noise_free),
        "neither of these": (STD_PERCENT, exact | noise_free),
    }
    for case, (std_percent, options) in cases.items():
        model = write_four_bar(folder, std_percent)
        body = load_model(model)
        errors: dict[str, list[tuple[float, float]]] = {name: [] for name in body.lengths}
        for seed in seeds:
            moved, session = move_four_bar(body, seed, **options), folder / f"{len(table.rows)}-{seed}"
            session.mkdir()
            write_session(session, moved.recording)
            (folder / "pivot.toml").write_text(PROTOCOL.format(at=moved.tip[0].tolist()), encoding="utf-8")
            run(
                *("calibrate", session, "--model", model, "--protocol", folder / "pivot.toml"),
                *("-o", folder / "cal", "--no-report", "--force"),
                codes=(0, 3, 4),
            )
            subject = load_subject(folder / "cal")
            for name, true in moved.lengths.items():
                errors[name].append((subject.lengths[name] - true, subject.std(name)))
        for name, pairs in errors.items():
            error, std = np.transpose(pairs)
            table.rows[f"{case}: {name}"] = {
                "mean_mm": 1e3 * float(error.mean()),
                "spread_mm": 1e3 * float(error.std()),
                "std_mm": 1e3 * float(std.mean()),
                "z": float(np.sqrt(np.mean((error / std) ** 2))),
            }
    return table


def measure_ur5(data: Path, methods: Sequence[str], folder: Path) -> Table:
    """Measure the recordings of a UR5 as a chain beside its encoders, to which nothing is fitted."""
    table = Table(
        "UR5, recorded: orientations of its links beside the encoders, root mean square error",
        (Column("alone_deg", "sensor alone [deg]", 2), Column("chain_deg", "chain [deg]", 2)),
        notes=["From 10 s on. Nothing is fitted to the encoders: neither clock, frames nor heading."],
    )
    urdf = write_urdf(folder)
    for method in methods:
        errors = []
        for name in RUNS:
            truth = write_ur5_session(data, name, folder)
            recording = load_session(folder)
            tracked = track(recording, method=method, model=urdf)
            scored = recording.time - recording.time[0] > real.UNSCORED_S
            for link, true in truth.items():
                off = [
                    (Rotation.from_quat(quat[link]) * true.inv()).magnitude()[scored]
                    for quat in (tracked.segments.quat_WL, tracked.quat_WL)
                ]
                errors.append([float(np.degrees(np.sqrt(np.mean(angle**2)))) for angle in off])
                table.rows[f"{method} {name} {link}"] = dict(zip(("alone_deg", "chain_deg"), errors[-1], strict=True))
        table.rows[f"{method} mean"] = dict(zip(("alone_deg", "chain_deg"), np.mean(errors, axis=0), strict=True))
    return table


# MVNX ---------------------------------------------------------------------------------------------------------------


class XsensMotion(NamedTuple):
    """An MVNX file's own positions, and lengths from them."""

    time: np.ndarray  # (n,) [s]
    places: dict[str, np.ndarray]  # Xsens segment → (n, 3) [m] from the middle of the hips, in the file's world
    torso: Rotation  # (n,) T8 to the file's world
    lengths: dict[str, float]  # [m]


def read_positions(file: Path) -> XsensMotion:
    """Read the positions of an MVNX file, and the person's lengths from them."""
    frames = read_frames(file)
    at = {name: k for k, name in enumerate(frames.segments)}
    positions = frames.values["position"]
    hips = 0.5 * (positions[:, at["LeftUpperLeg"]] + positions[:, at["RightUpperLeg"]])
    places = {name: positions[:, k] - hips for name, k in at.items()}
    torso = Rotation.from_quat(rotations.xyzw_from_wxyz(frames.values["orientation"][:, at["T8"]]))

    def length(first: np.ndarray, last: np.ndarray) -> float:
        return float(np.linalg.norm(last - first, axis=1).mean())

    left, right = places["LeftUpperArm"], places["RightUpperArm"]
    lengths = {"trunk": length(np.zeros((1, 3)), 0.5 * (left + right)), "shoulder_width": length(right, left)}
    for side in ("Left", "Right"):
        shoulder, elbow, wrist = (places[f"{side}{part}"] for part in ("UpperArm", "ForeArm", "Hand"))
        lengths[f"{side.lower()}_upper_arm"] = length(shoulder, elbow)
        lengths[f"{side.lower()}_forearm"] = length(elbow, wrist)
    return XsensMotion(frames.time, places, torso, lengths)


def measure_mvnx(data: Path, folder: Path, models: Sequence[str] = MODELS) -> Table:
    """Measure the MVNX sample by `wepose track` on two bodies: their points beside Xsens's own."""
    table = Table(
        "MVNX sample: points beside Xsens's own positions of the same joints",
        (
            Column("mean_mm", "mean [mm]", 1),
            Column("max_mm", "largest [mm]", 1),
            Column("arm_mean_mm", "from the shoulder on: mean [mm]", 2),
            Column("arm_max_mm", "largest [mm]", 2),
        ),
        notes=["Lengths are Xsens's own. Both bodies have the root midway between the hips."],
    )
    motion = read_positions(data / MVNX)
    sensors = "".join(f'[sensors.{segment}]\nlabel = "{label}"\n' for label, segment in SEGMENT_OF.items())
    (folder / "session.toml").write_text(
        f'[data]\nfile = "{data / MVNX}"\n[phases]\nstart = [[{MVNX_START[0]}, {MVNX_START[1]}]]\n{sensors}',
        encoding="utf-8",
    )
    prior = population_subject()
    subject = replace(prior, name="xsens", lengths={**prior.lengths, **motion.lengths})
    (folder / "subject.toml").write_text(subject_toml(subject), encoding="utf-8")
    for model in models:
        body = model if model == "upper_body" else data / "human_urdf" / f"{model}.urdf"
        run(
            *("track", folder, "--model", body, "--subject", folder / "subject.toml", "-o", folder / model),
            *("--no-view", "--no-report"),
        )
        pose = pl.read_parquet(folder / model / "pose.parquet")
        if not np.allclose(pose["time"], motion.time, atol=1e-6):
            raise BadData(f"{MVNX}: the result has other times than the file")
        quat = pose.select([f"torso_{c}" for c in ("qx", "qy", "qz", "qw")]).to_numpy()
        to_W = (Rotation.from_quat(quat) * motion.torso.inv()).mean()  # the heading of x
        apart = {
            point: pose.select([f"{point}_{axis}" for axis in "xyz"]).to_numpy() - to_W.apply(motion.places[joint])
            for point, joint in XSENS_JOINTS.items()
        }
        for point, difference in apart.items():
            off = 1e3 * np.linalg.norm(difference, axis=1)
            arm = 1e3 * np.linalg.norm(difference - apart[f"{point.partition('_')[0]}_shoulder"], axis=1)
            table.rows[f"{model} {point}"] = {
                "mean_mm": float(off.mean()),
                "max_mm": float(off.max()),
                "arm_mean_mm": float(arm.mean()),
                "arm_max_mm": float(arm.max()),
            }
    return table


# Legs ---------------------------------------------------------------------------------------------------------------


def measure_legs(activities: Sequence[str], folder: Path) -> Table:
    """Measure the joint angles of simulated legs by `wepose track --model whole_body`, against the truth."""
    table = Table(
        "Legs: angles of hip (Wu 2002), knee (Grood and Suntay 1983) and ankle against the truth, rms of both sides",
        tuple(Column(f"angle{k}_deg", f"{word} angle [deg]", 2) for k, word in enumerate(("first", "second", "third"))),
        notes=["wepose simulate --seed 5 --activity A --preset P --seconds 15 --rate-hz 60, track --open-loop."],
    )
    for activity in activities:
        for preset in ("ideal", "mild"):
            made, result = folder / f"{activity}-{preset}", folder / f"{activity}-{preset}-result"
            run(
                *("simulate", "-o", made, "--seed", 5, "--activity", activity, "--preset", preset),
                *("--seconds", 15, "--rate-hz", 60),
            )
            run(
                *("track", made, "--model", "whole_body", "--open-loop", "-o", result, "--no-view", "--no-report"),
            )
            errors = evaluate(result, made).joints
            for joint in LEG_JOINTS:
                sides = [[error.rmse for error in errors[f"{side}_{joint}"].values()] for side in ("left", "right")]
                rms = np.sqrt(np.mean(np.square(sides), axis=0))
                table.rows[f"{activity}, {preset}: {joint}"] = {f"angle{k}_deg": float(v) for k, v in enumerate(rms)}
    return table
