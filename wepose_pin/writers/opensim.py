"""OpenSim's files: joint angles (.mot), orientations for OpenSense (.sto), points (.trc), the set-ups of its tools.

In OpenSim's ground G (x forward, y up, z right). Coordinates and bodies are those of Rajagopal's full-body model, whose
frames are parallel to G in the anatomical position, where all coordinates are zero; bodies and lengths stand in
``rajagopal.toml``, axes and their order are those of Rajagopal_2015.osim.

Sources: Rajagopal et al. 2016, IEEE Trans. Biomed. Eng. 63:2068, doi 10.1109/TBME.2016.2586891; opensim-core,
OpenSim/Common: DelimFileAdapter.h (.mot, .sto: ``endheader`` alone in a line, tabs, no empty line), Storage.cpp (.mot:
the name first, ``nRows`` and ``nColumns``), TRCFileAdapter.cpp (.trc: eight keys, a tab ends each row, a marker with an
empty cell is missing).
"""

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ..angles import NEAR_LOCK, diagnose_lock, euler, joint_angles
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from ..readers.registry import OWN_STO
from ..rotations import conjugate, multiply, rotation_about
from ..tracking import TrackResult
from .motion import check_complete, diagnose_gaps, find_measured_points, resample_evenly

SETUPS = Path(__file__).parent / "opensim_setups"
GENERIC_MODEL = "Rajagopal_2015.osim"  # of OpenSense's example
# [rad] rms by which the model may miss a body. Its elbow turns about an axis that is 13 deg oblique: arms of simulated
# people, whose orientations are exact, are missed by 3 to 7 deg, of a real recording by up to 9.
MOST_MISSED = np.deg2rad(12.0)
# OpenSim's ground G: x forward, y up, z right.
QUAT_GW = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).as_quat()
_MODEL = tomllib.loads(Path(__file__).with_name("rajagopal.toml").read_text(encoding="utf-8"))
BODIES: Mapping[str, str] = _MODEL["bodies"]
LENGTHS: Mapping[str, Mapping[str, Any]] = _MODEL["lengths"]
# Axes of a right arm's elbow and wrist in the body above; a left arm's are mirrored on the sagittal plane.
_AXES = [
    np.array(axis) / np.linalg.norm(axis)
    for axis in [(0.22604696, 0.022269, 0.97386183), (0.05639803, 0.99840646, 0.001952), (0, 0, 1), (1, 0, 0)]
]
# Their coordinates, and the middle of each range [rad]: angles are given within half a turn of it. Followed over time,
# an elbow that was once bent as none can be might keep a full turn too much.
_MIDDLE = {"elbow_flex": np.radians(75.0), "pro_sup": np.radians(90.0), "wrist_flex": 0.0, "wrist_dev": 0.0}
_MIRRORED = np.array([-1.0, -1.0, 1.0, 1.0])  # xyzw, z → −z
_ROUNDS = 200  # of the fit of an arm
_CLOSE = 1e-9  # [rad] of the last step


def write_mot(path: Path, motion: TrackResult, names: str | None = None) -> list[Diagnostic]:
    """Write joint angles in degrees: the ISB's, of `wepose_pin.angles`, then the coordinates of Rajagopal's model.

    ``<joint>_near_lock`` is 1 where the first and the third angle of a joint are not to be read. `names`: only "isb" or
    "opensim".
    """
    check_complete(motion, "a .mot")
    if motion.model.table.is_mechanism:
        raise BadData(f"{motion.where}: is of a mechanism, for which OpenSim has no joints; csv and rosbag hold them")
    diagnostics, angles, others = diagnose_gaps(motion), dict[str, np.ndarray](), dict[str, np.ndarray]()
    if names != "opensim":
        isb = joint_angles(motion.pose)
        diagnostics += diagnose_lock(isb)
        for name, joint in isb.joints.items():
            angles |= {f"{name}_{angle}": joint[angle] for angle in joint}
            others[f"{name}_near_lock"] = joint.near_lock.astype(int)
    if names != "isb":
        opensim, residuals = coordinates(orientations(motion.pose.quat_WL))
        angles |= opensim
        missed = {body: angle for body, angle in residuals.items() if angle > MOST_MISSED}
        facts: dict[str, float | str] = {"variant": "opensim"}
        for body, angle in missed.items():
            diagnostics.append(Diagnostic("orientation-residual", WARNING, body, angle, MOST_MISSED, facts))
    if not angles:
        raise BadData(f"{motion.where}: no joint has both of its segments in pose.parquet; there are no angles")
    rows = pl.DataFrame({"time": motion.pose.time, **{k: np.degrees(v) for k, v in angles.items()}, **others})
    name = " ".join(motion.name.split()).replace("=", "-") or "motion"  # a line that is no key and no other's
    header = [name, "version=1", f"nRows={rows.height}", f"nColumns={rows.width}", "inDegrees=yes", "endheader"]
    _write_rows(path, header, rows)
    return diagnostics


# Orientations -----------------------------------------------------------------------------------------------------


def write_sto(path: Path, motion: TrackResult) -> list[Diagnostic]:
    """Write orientations of the model's bodies in G, as sensors of OpenSense: ``<body>_imu``, cells ``w,x,y,z``."""
    check_complete(motion, "a .sto")
    _write_quaternions(path, motion, motion.pose.time, orientations(motion.pose.quat_WL))
    return diagnose_gaps(motion)


def write_placement(path: Path, motion: TrackResult) -> None:
    """Write one sample for OpenSense's IMU Placer: the same sensors while all coordinates of the model are zero."""
    upright = np.array([[0.0, 0.0, 0.0, 1.0]])
    _write_quaternions(path, motion, np.zeros(1), dict.fromkeys(orientations(motion.pose.quat_WL), upright))


def _write_quaternions(path: Path, motion: TrackResult, time: np.ndarray, quat_GB: Mapping[str, np.ndarray]) -> None:
    if not quat_GB:
        raise BadData(f"{motion.where}: no segment in pose.parquet is a body of the model; there is none to write")
    cells = {
        f"{body}_imu": [f"{w:.9f},{x:.9f},{y:.9f},{z:.9f}" for x, y, z, w in quat.tolist()]
        for body, quat in quat_GB.items()
    }
    header = [f"DataRate={motion.rate_hz:f}", "DataType=Quaternion", "version=3", "=".join(OWN_STO), "endheader"]
    _write_rows(path, header, pl.DataFrame({"time": time, **cells}))


def write_setups(sto: Path, motion: TrackResult, model: str, open_file: Callable[[Path], Path]) -> None:
    """Write what OpenSense needs beside a .sto: the placement, and the set-ups of IMU Placer and IK.

    `model`: the subject's. `open_file`: the path of a file → that to which it is written.
    """
    endings = ("_placement.sto", "_placer.xml", "_ik.xml")
    placement, placer, ik = (open_file(sto.with_name(f"{sto.stem}{ending}")) for ending in endings)
    write_placement(placement, motion)
    placer.write_bytes(_fill("placer", model=model, stem=sto.stem))
    step = 0.5 / motion.rate_hz  # past the last sample, whose time is rounded in the file
    begin, end = (f"{time:.6f}" for time in (motion.pose.time[0] - step, motion.pose.time[-1] + step))
    ik.write_bytes(_fill("ik", stem=sto.stem, orientations=sto.name, begin=begin, end=end))


def _fill(setup: str, *, scales: str = "", **values: str) -> bytes:
    """Fill a set-up in ``opensim_setups/``; `scales` are XML already."""
    template = Template((SETUPS / f"{setup}.xml").read_text(encoding="utf-8"))
    return template.substitute({name: escape(value) for name, value in values.items()}, scales=scales).encode()


# The model --------------------------------------------------------------------------------------------------------


def write_scale(path: Path, motion: TrackResult, osim_model: str | Path = GENERIC_MODEL) -> None:
    """Write the set-up of OpenSim's Scale Tool that gives a generic model the subject's lengths; masses stay.

    The factors are over the lengths of Rajagopal's model.
    """
    factors: dict[str, dict[str, float]] = {}
    for length, place in LENGTHS.items():
        for body in place["bodies"] if length in motion.model.lengths else ():
            scaled = dict.fromkeys(place.get("axes", "xyz"), motion.model.lengths[length] / place["generic"])
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


def write_trc(path: Path, motion: TrackResult) -> None:
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
        for axis, p_G in zip("XYZ", (p_W[:, [0, 2, 1]] * [1.0, 1.0, -1.0]).T, strict=True)
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


# Rajagopal's model ---------------------------------------------------------------------------------------------------


def orientations(quat_WL: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Compute body → `quat_GB` (n, 4) xyzw, of the segments that are bodies of the model.

    The N-pose, palms to the thighs, is the model with 90° of `pro_sup` and zero of all others.
    """
    bodies, pronated = {}, _AXES[1] * np.pi / 2.0
    for segment, body in BODIES.items():
        if segment in quat_WL:
            moved = multiply(multiply(QUAT_GW, quat_WL[segment]), conjugate(QUAT_GW))
            n_pose = pronated * float(body.startswith(("radius", "hand"))) * ([-1, -1, 1] if body.endswith("_l") else 1)
            bodies[body] = multiply(moved, Rotation.from_rotvec(n_pose).as_quat())
    return bodies


def coordinates(quat_GB: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Compute coordinate → (n,) [rad], and body → angle [rad], rms, by which the model misses it.

    Torso, pelvis and shoulders turn about z, x, y, reach every orientation and are followed over time. Elbow and wrist
    have two axes: of each arm the sum of the squared angles between the model's bodies and the measured ones is the
    least, as it is for OpenSense with equal weights. A pelvis without a sensor stands still and upright.
    """
    columns: dict[str, np.ndarray] = {}
    residuals: dict[str, float] = {}

    def add(quat: np.ndarray, names: Sequence[str]) -> None:
        angles = euler.follow(euler.decompose(quat, "ZXY"), "ZXY", NEAR_LOCK)
        columns.update(zip(names, angles.T, strict=True))

    pelvis = quat_GB.get("pelvis", np.array([0.0, 0.0, 0.0, 1.0]))
    if "pelvis" in quat_GB:
        add(pelvis, ("pelvis_tilt", "pelvis_list", "pelvis_rotation"))
    if "torso" in quat_GB:
        add(multiply(conjugate(pelvis), quat_GB["torso"]), ("lumbar_extension", "lumbar_bending", "lumbar_rotation"))
    for side in "rl":
        arm = [name for body in ("humerus", "radius", "hand") if (name := f"{body}_{side}") in quat_GB]
        if not arm or arm[0] != f"humerus_{side}":
            continue
        mirror = _MIRRORED if side == "l" else 1.0
        quat = [quat_GB[name] * mirror for name in arm]
        below: dict[str, np.ndarray] = {}
        if arm[1:2] == [f"radius_{side}"]:
            quat[0], angles, misses = _fit_arm(quat)
            below = {f"{name}_{side}": value for name, value in zip(_MIDDLE, angles, strict=False)}
            residuals |= {name: float(np.sqrt(np.mean(angle**2))) for name, angle in zip(arm, misses, strict=True)}
        if "torso" in quat_GB:
            shoulder = multiply(conjugate(quat_GB["torso"] * mirror), quat[0])
            add(shoulder, [f"{name}_{side}" for name in ("arm_flex", "arm_add", "arm_rot")])
        columns |= below
    return columns, residuals


def _fit_arm(quat: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Fit the humerus (n, 4) and the angles of elbow and wrist to `quat` (n, 4) of humerus, radius and perhaps hand.

    And how far each body is off; angles are (n,) [rad]. By turns the joints take the angles that are the best for the
    radius, and the radius the mean of where the measured bodies put it: each lessens the sum of the squared angles.
    """
    humerus, radius = quat[:2]
    pace = 1.5 if len(quat) > 2 else 1.0  # where joints follow the radius on both sides, its mean lags behind
    for _ in range(_ROUNDS):
        angles, elbow = _solve_two_axes(_AXES[:2], multiply(conjugate(humerus), radius))
        placed = [multiply(humerus, elbow), quat[1]]
        if len(quat) > 2:
            more, wrist = _solve_two_axes(_AXES[2:], multiply(conjugate(radius), quat[2]))
            angles += more
            placed.append(multiply(quat[2], conjugate(wrist)))
        off = [Rotation.from_quat(multiply(conjugate(radius), each)).as_rotvec() for each in placed]
        step = pace * np.mean(off, axis=0)
        radius = multiply(radius, Rotation.from_rotvec(step).as_quat())
        if np.abs(step).max() < _CLOSE:
            break
    middles = list(_MIDDLE.values())
    angles = [a - 2.0 * np.pi * np.round((a - m) / (2.0 * np.pi)) for a, m in zip(angles, middles, strict=False)]
    return multiply(radius, conjugate(elbow)), angles, [np.linalg.norm(each, axis=1) for each in off]


def _solve_two_axes(axes: Sequence[np.ndarray], quat: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Compute the angles (n,) [rad] about two axes, and their rotation (n, 4), that come nearest to rotations (n, 4).

    The scalar product of the two quaternions is a cosine of half their difference and one of half their sum, summed.
    """
    (a, b), v, w = axes, quat[:, :3], quat[:, 3]
    m = v @ np.cross(a, b) - w * (a @ b)
    difference, total = np.arctan2(v @ (a - b), w + m), np.arctan2(v @ (a + b), w - m)
    angles = [total + difference, total - difference]
    return angles, multiply(rotation_about(a, angles[0]), rotation_about(b, angles[1]))
