"""OpenSim's files: joint angles (.mot), orientations for OpenSense (.sto), points (.trc), the set-ups of its tools.

In OpenSim's ground G (x forward, y up, z right), the angles and the bodies those of Rajagopal's model (`rajagopal`).

Sources: opensim-core, OpenSim/Common: DelimFileAdapter.h (.mot, .sto: ``endheader`` alone in a line, tabs, no empty
line), Storage.cpp (.mot: the name first, ``nRows`` and ``nColumns``), TRCFileAdapter.cpp (.trc: eight keys, a tab ends
each row, a marker with an empty cell is missing).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from xml.sax.saxutils import escape

import numpy as np
import polars as pl

from ..angles import diagnose_lock, joint_angles
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, BadOption
from ..readers.opensim import OWN
from .motion import Motion, check_complete, diagnose_gaps, find_measured_points, resample_evenly
from .rajagopal import LENGTHS, coordinates, in_ground, orientations

SETUPS = Path(__file__).parent / "opensim_setups"
GENERIC_MODEL = "Rajagopal_2015.osim"  # of OpenSense's example
# [rad] rms by which the model may miss a body. Its elbow turns about an axis that is 13 deg oblique: arms of simulated
# people, whose orientations are exact, are missed by 3 to 7 deg, of a real recording by up to 9.
MOST_MISSED = np.deg2rad(12.0)


def write_mot(path: Path, motion: Motion, names: str | None = None) -> list[Diagnostic]:
    """Write joint angles in degrees: the ISB's, of `wepose_pin.angles`, then the coordinates of Rajagopal's model.

    Beside the three angles of a joint ``<joint>_near_lock`` is 1 where the first and the third are not to be read. Of a
    mechanism it has the joints of its URDF by their names, in degrees, and in m those that slide.

    Parameters
    ----------
    names : only these: "isb" or "opensim"
    """
    check_complete(motion, "a .mot")
    diagnostics, angles, others = diagnose_gaps(motion), dict[str, np.ndarray](), dict[str, np.ndarray]()
    if motion.pose.joints:
        if names is not None:
            raise BadOption(f"--names {names}: {motion.where} is of a mechanism, whose joints have their own names")
        slides = {joint.name for joint in motion.model.robot.joints if joint.type == "prismatic"}
        others = {name: each if name in slides else np.degrees(each) for name, each in motion.pose.joints.items()}
    else:
        if names != "opensim":
            isb = joint_angles(motion.pose)
            diagnostics += diagnose_lock(isb)
            for name, joint in isb.joints.items():
                angles |= {f"{name}_{angle}": joint[angle] for angle in joint}
                others[f"{name}_near_lock"] = joint.near_lock.astype(int)
        if names != "isb":
            opensim, residuals = coordinates(orientations(motion.pose.quat_WL))
            angles |= opensim
            diagnostics += [
                Diagnostic("orientation-residual", WARNING, body, angle, MOST_MISSED, {"variant": "opensim"})
                for body, angle in residuals.items()
                if angle > MOST_MISSED
            ]
        if not angles:
            raise BadData(f"{motion.where}: no joint has both of its segments in pose.parquet; there are no angles")
    rows = pl.DataFrame({"time": motion.pose.time, **{k: np.degrees(v) for k, v in angles.items()}, **others})
    name = " ".join(motion.name.split()).replace("=", "-") or "motion"  # a line that is no key and no other's
    header = [name, "version=1", f"nRows={rows.height}", f"nColumns={rows.width}", "inDegrees=yes", "endheader"]
    _write_rows(path, header, rows)
    return diagnostics


# Orientations -----------------------------------------------------------------------------------------------------


def write_sto(path: Path, motion: Motion) -> list[Diagnostic]:
    """Write orientations of the model's bodies in G, as sensors of OpenSense: ``<body>_imu``, cells ``w,x,y,z``."""
    check_complete(motion, "a .sto")
    _write_quaternions(path, motion, motion.pose.time, _find_bodies(motion))
    return diagnose_gaps(motion)


def write_placement(path: Path, motion: Motion) -> None:
    """Write one sample for OpenSense's IMU Placer: the same sensors while all coordinates of the model are zero."""
    upright = np.array([[0.0, 0.0, 0.0, 1.0]])
    _write_quaternions(path, motion, np.zeros(1), dict.fromkeys(_find_bodies(motion), upright))


def _find_bodies(motion: Motion) -> dict[str, np.ndarray]:
    bodies = orientations(motion.pose.quat_WL)
    if not bodies:
        raise BadData(f"{motion.where}: no segment in pose.parquet is a body of the model; there is none to write")
    return bodies


def _write_quaternions(path: Path, motion: Motion, time: np.ndarray, quat_GB: Mapping[str, np.ndarray]) -> None:
    cells = {
        f"{body}_imu": [f"{w:.9f},{x:.9f},{y:.9f},{z:.9f}" for x, y, z, w in quat.tolist()]
        for body, quat in quat_GB.items()
    }
    header = [f"DataRate={motion.rate_hz:f}", "DataType=Quaternion", "version=3", "=".join(OWN), "endheader"]
    _write_rows(path, header, pl.DataFrame({"time": time, **cells}))


def list_setups(sto: Path) -> list[Path]:
    """List what OpenSense needs beside a .sto: the placement, and the set-ups of IMU Placer and IK."""
    return [sto.with_name(f"{sto.stem}{ending}") for ending in ("_placement.sto", "_placer.xml", "_ik.xml")]


def write_setups(sto: Path, written: Sequence[Path], motion: Motion, model: str) -> None:
    """Write what OpenSense needs beside the .sto of a motion, to `written` in the order of `list_setups`.

    `model` is the name of the subject's model.
    """
    write_placement(written[0], motion)
    written[1].write_bytes(_fill("placer", model=model, stem=sto.stem))
    step = 0.5 / motion.rate_hz  # past the last sample, whose time is rounded in the file
    begin, end = (f"{time:.6f}" for time in (motion.pose.time[0] - step, motion.pose.time[-1] + step))
    written[2].write_bytes(_fill("ik", stem=sto.stem, orientations=sto.name, begin=begin, end=end))


def _fill(setup: str, *, scales: str = "", **values: str) -> bytes:
    """Fill a set-up in ``opensim_setups/``; `scales` are XML already."""
    template = Template((SETUPS / f"{setup}.xml").read_text(encoding="utf-8"))
    return template.substitute({name: escape(value) for name, value in values.items()}, scales=scales).encode()


# The model --------------------------------------------------------------------------------------------------------


def write_scale(path: Path, motion: Motion, osim_model: str | Path = GENERIC_MODEL) -> None:
    """Write the set-up of OpenSim's Scale Tool that gives the generic model the subject's lengths.

    The factors are over the lengths of Rajagopal's model. Masses stay. No markers are placed, so the tool's part for
    them is left out.

    Parameters
    ----------
    osim_model : name of the generic model
    """
    factors: dict[str, dict[str, float]] = {}
    for length, place in LENGTHS.items():
        if length in motion.model.lengths:
            factor = motion.model.lengths[length] / place["generic"]
            for body in place["bodies"]:
                scaled = dict.fromkeys(place.get("axes", "xyz"), factor)
                factors.setdefault(body, dict.fromkeys("xyz", 1.0)).update(scaled)
    if not factors:
        raise BadData(f"{motion.where}: the body has no length that OpenSim's model of a person has")
    scales = "".join(
        _fill("scale_body", body=body, **{axis: f"{value:.9f}" for axis, value in of.items()}).decode()
        for body, of in factors.items()
    )
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", motion.name) or "subject"
    stem = _final_name(path).removesuffix(".xml")
    path.write_bytes(_fill("scale", name=name, model=str(osim_model), stem=stem, scales=scales))


# Points -----------------------------------------------------------------------------------------------------------


def write_trc(path: Path, motion: Motion) -> None:
    """Write points in G, in mm; a point in a gap has empty cells."""
    motion = resample_evenly(motion)
    points = find_measured_points(motion)
    n, rate = len(motion.pose.time), f"{motion.rate_hz:g}"
    keys = {"DataRate": rate, "CameraRate": rate, "NumFrames": str(n), "NumMarkers": str(len(points)), "Units": "mm"}
    keys |= {"OrigDataRate": rate, "OrigDataStartFrame": "1", "OrigNumFrames": str(n)}
    header = [f"PathFileType\t4\t(X/Y/Z)\t{_final_name(path)}", "\t".join(keys), "\t".join(keys.values())]
    header.append("Frame#\tTime\t" + "\t\t\t".join(points) + "\t\t")
    header.append("\t\t" + "\t".join(f"{axis}{k}" for k in range(1, len(points) + 1) for axis in "XYZ"))
    columns = {
        f"{point}_{axis}": 1e3 * p_G
        for point, p_W in points.items()
        for axis, p_G in zip("XYZ", in_ground(p_W).T, strict=True)
    }
    rows = pl.DataFrame({"Frame#": np.arange(1, n + 1), "Time": motion.pose.time, **columns, "": [None] * n})
    _write_rows(path, [*header, ""], rows, labels=False)


def _final_name(path: Path) -> str:
    """Return the name that a file gets when it is complete (`whole_file`)."""
    return path.name.removeprefix(".").removesuffix(".partial")


def _write_rows(path: Path, header: Sequence[str], rows: pl.DataFrame, labels: bool = True) -> None:
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode())
        rows.fill_nan(None).write_csv(
            file, separator="\t", include_header=labels, float_precision=6, quote_style="never", line_terminator="\n"
        )
