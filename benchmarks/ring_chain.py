"""The RING chain as a body of its own, and its trial as a session: URDF, table, protocol, session and truth."""

from __future__ import annotations

import shutil
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from benchmarks.trials import RING_FILES, RING_SEGMENTS
from benchmarks.validation import real

START_S = 0.7  # until seg1 is taken up; nothing moves before
MOTION_S = (real.UNSCORED_S, 66.0)  # that on which the validation's own script fits its lengths
LINK = 0.2  # [m] of each link in arm.xml
END = np.array([LINK, 0.0, 0.0])  # [m] a point on seg5 from its marker; the marker is too near to the joint

# arm.xml: seg1 free, seg2 on a ball joint, then hinges about x, y and z. What is free to turn is three hinges here, and
# so is the first hinge: by the optical system seg3 leaves the axis that fits best by 2.9 deg rms, seg4 and seg5 by 0.3.
JOINTS = {"seg1": "zyx", "seg2": "zyx", "seg3": "zyx", "seg4": "y", "seg5": "z"}
AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


def ring_urdf() -> str:
    text, parent = '<link name="base"/>', "base"
    for segment, axes in JOINTS.items():
        for k, axis in enumerate(axes):
            child = segment if k == len(axes) - 1 else f"{segment}_{axis}_link"
            at = f"{LINK} 0 0" if k == 0 and segment != "seg1" else "0 0 0"
            text += (
                f'<link name="{child}"/><joint name="{segment}_{axis}" type="continuous"><parent link="{parent}"/>'
                f'<child link="{child}"/><origin xyz="{at}"/><axis xyz="{AXES[axis]}"/>'
                f'<limit lower="-6.3" upper="6.3" effort="1" velocity="100"/></joint>'
            )
            parent = child
    return f'<robot name="ring">{text}</robot>'


TABLE = """kind = "mechanism"
[segments]
{segments}
[points]
head = {{ link = "seg1", at = {head} }}
ball = "seg2"
middle = "seg3"
bend = "seg4"
tip = "seg5"
end = {{ link = "seg5", at = {end} }}
[lengths]
seg2 = {{ segment = "seg2", from = "ball", to = "middle", std_percent = 50 }}
seg3 = {{ segment = "seg3", from = "middle", to = "bend", std_percent = 50 }}
seg4 = {{ segment = "seg4", from = "bend", to = "tip", std_percent = 50 }}
"""

PROTOCOL = """name = "optical"
title = "points of the chain by an optical system"
[[step]]
phase = "motion"
seconds = 60
do = "Move the chain."
""" + "".join(
    f'[[closure]]\nphase = "motion"\nkind = "recorded"\npoints = ["{point}"]\norigin = "{origin}"\nslip = 0.001\n'
    for point, origin in (("tip", "ball"), ("ball", "head"), ("end", "tip"))
)


class RingSession(NamedTuple):
    """The files of a session, and the truth behind them."""

    session: Path
    model: Path
    protocol: Path
    true_lengths: dict[str, float]  # [m]
    time: np.ndarray  # (m,) [s] on the sensors' clock
    true: dict[str, Rotation]  # segment → (m,) to W; identity where lost
    known: np.ndarray  # (m,) bool


def write_ring_session(trial: Path, mount: str, folder: Path) -> RingSession:
    """Write the trial as a session with a table and a protocol, the optical system's places as its truth."""
    chain, registered = real.register_ring(trial)
    links = real.fit_optical_links(chain)
    registration = registered[mount, "seg1"]
    known = np.isfinite(chain.quat_VB["seg1"]).all(axis=1)
    R_WV, unit = Rotation.from_quat(registration.quat_WV), [0.0, 0.0, 0.0, 1.0]
    true = {s: R_WV * Rotation.from_quat(np.where(known[:, None], chain.quat_VB[s], unit)) for s in RING_SEGMENTS}
    time = chain.time + registration.offset_s

    centres = {}  # of the joints, in the frames of both segments
    for near, far in pairwise(RING_SEGMENTS):
        A = np.concatenate([true[near][known].as_matrix(), -true[far][known].as_matrix()], axis=2).reshape(-1, 6)
        b = R_WV.apply(chain.origin_V[far][known] - chain.origin_V[near][known]).ravel()
        centres[near, far] = np.linalg.lstsq(A, b, rcond=1e-6)[0]
    # Each link's own frame has its origin at its joint, seg1's before its end by `LINK`.
    head, end = [LINK, 0.0, 0.0] - centres["seg1", "seg2"][:3], END - centres["seg4", "seg5"][3:]
    ball = R_WV.apply(np.nan_to_num(chain.origin_V["seg2"])) + true["seg2"].apply(centres["seg1", "seg2"][3:])
    tip = ball + R_WV.apply(np.nan_to_num(links.tip_V))
    points = {
        "ball": ball,
        "tip": tip,
        "head": R_WV.apply(np.nan_to_num(chain.origin_V["seg1"])),
        "end": R_WV.apply(np.nan_to_num(chain.origin_V["seg5"])) + true["seg5"].apply(END),
    }
    columns = {"time": time}
    for name, place in points.items():
        columns |= {f"{name}_{axis}": np.where(known, place[:, k], np.nan) for k, axis in enumerate("xyz")}
    pl.DataFrame(columns).write_parquet(folder / "optical.parquet")

    start = known & (time < START_S)
    joints: dict[str, float] = {}
    above = Rotation.identity()
    for segment, axes in JOINTS.items():
        own = true[segment][start].mean()
        angles = (above.inv() * own).as_euler(axes.upper() if len(axes) > 1 else "XYZ")
        angles = angles if len(axes) > 1 else [angles["xyz".index(axes)]]
        joints |= {f"{segment}_{axis}": float(angle) for axis, angle in zip(axes, angles, strict=True)}
        above = own
    shutil.copyfile(trial / RING_FILES[mount], folder / "imu.csv")
    sensors = ""
    for segment in RING_SEGMENTS:
        sensors += f"[sensors.{segment}]\n"
        for key, column in (("gyro", "gyr"), ("accel", "acc")):
            names = [f"{segment}_{column}_{axis}" for axis in "xyz"]
            sensors += f"{key} = {names}\n"
    (folder / "session.toml").write_text(
        f'name = "ring"\nstart_pose = "configuration"\n[data]\nfile = "imu.csv"\nrate_hz = 40.0\ngyro_unit = "rad/s"\n'
        f'accel_unit = "m/s^2"\ntruth = "optical.parquet"\n[phases]\nstart = [[0.0, {START_S}]]\n'
        f"motion = [[{MOTION_S[0]}, {MOTION_S[1]}]]\n{sensors}[joints]\n"
        + "".join(f"{name} = {value!r}\n" for name, value in joints.items()),
        encoding="utf-8",
    )
    (folder / "ring.urdf").write_text(ring_urdf(), encoding="utf-8")
    foam = "{ foam_deg = [0.6, 0.6, 0.6] }"
    segments = "\n".join(f"{name} = {foam if mount == 'loose' else repr(name)}" for name in RING_SEGMENTS)
    table = TABLE.format(segments=segments, head=head.tolist(), end=end.tolist())
    (folder / "ring.toml").write_text(table, encoding="utf-8")
    (folder / "optical.toml").write_text(PROTOCOL, encoding="utf-8")
    return RingSession(
        folder / "session.toml", folder / "ring.toml", folder / "optical.toml", links.lengths, time, true, known
    )
