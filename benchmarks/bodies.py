"""Bodies that are no upper body, by the commands: lengths, orientations and points beside what is known of them."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.trials import RING, RING_MOUNTS, RING_SEGMENTS
from benchmarks.validation import real
from benchmarks.validation.experiment import align_rotation
from wepose_pin import rotations
from wepose_pin.body.subject import load_subject, population_subject, subject_toml
from wepose_pin.commands import main
from wepose_pin.errors import BadData, BadOption
from wepose_pin.evaluation import attitude_error
from wepose_pin.readers import load_session
from wepose_pin.readers.mvnx import SEGMENT_OF, read_frames
from wepose_pin.tracking import track

from .ring_chain import RingSession, write_ring_session
from .tables import Column, Section, Table, rms
from .ur5_arm import RUNS, write_ur5_session, write_urdf

MODELS = ("upper_body", "humanSubject01_66dof")
MVNX = Path("mvnx") / "test_mocap.mvnx"
# An Xsens segment's position is that of the joint at which it begins.
XSENS_JOINTS = {
    f"{side}_{point}": f"{side.capitalize()}{segment}"
    for side in ("left", "right")
    for point, segment in (("shoulder", "UpperArm"), ("elbow", "ForeArm"), ("wrist", "Hand"))
}
MVNX_START = (0.0, 0.4)  # [s]; the orientations are the segments' own, so that it sets the heading of x alone


def sections(quick: bool, data: Path | None) -> list[Section]:
    """List the functions that measure."""
    if data is None or not (data / RING).is_dir() or not (data / MVNX).is_file():
        raise BadOption(f"--data {data}: bodies are measured on {RING}, ur5/ and {MVNX}, which are not all there")
    mounts = RING_MOUNTS[: 1 if quick else None]
    measured: list[Callable[[Path], Table]] = [
        partial(measure_ring_links, data, mounts),
        partial(measure_ring_orientations, data, mounts),
        partial(measure_ur5, data, ("amekf",) if quick else ("smekf", "amekf")),
        partial(measure_mvnx, data),
    ]
    return [partial(_measure_in_a_folder, measure) for measure in measured]


def _measure_in_a_folder(measure: Callable[[Path], Table]) -> Table:
    with tempfile.TemporaryDirectory() as folder:
        return measure(Path(folder))


def run(*words: object) -> None:
    """Run a command of `wepose` without what it prints; `BadData`: its exit code is not 0."""
    printed, code = io.StringIO(), None
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main([str(word) for word in words])
        except SystemExit as stopped:
            code = stopped.code
    if code:
        raise BadData(f"wepose {' '.join(map(str, words))}: {printed.getvalue().strip()}")


# RING ---------------------------------------------------------------------------------------------------------------


def calibrate_ring(data: Path, mount: str, folder: Path) -> RingSession:
    """Write the trial's session and calibrate its lengths, into `folder`/cal."""
    ring = write_ring_session(data / RING, mount, folder)
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
        by_script = {each.method: each.figures for each in real.compare_links(data / RING, mount)}["amekf"]
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
        chain, registered = real.register_ring(data / RING)
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
                errors.append([float(np.degrees(rms(angle))) for angle in off])
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
