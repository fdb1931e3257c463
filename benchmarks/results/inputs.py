"""The recordings that `save` works on: simulated, with what goes wrong in ordinary use, and one real one.

Each is a folder ``inputs/NAME`` with ``session.toml``, its data, its truth where it is known, and ``known.json``: what
a user with a tape knows of the person, and the protocol of the calibration.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from . import adapter
from .adapter import Session, Signals, Simulated, Table

REAL = "upper_body"  # in the folder of real recordings
LEFT_ARM = ("left_upper_arm", "left_forearm")

_simulated = lru_cache(maxsize=None)(adapter.simulated)


def makers() -> dict[str, Callable[[], tuple[Session, dict[str, Any]]]]:
    """Name → a function that makes the session and what is known of the person."""

    def simulated(seed: int, preset: str, protocol: str = "clasp", mount: str = "stated") -> Callable[[], Any]:
        return lambda: _with_known(_simulated(seed, preset, protocol=protocol, mount=mount), protocol)

    return {
        "ideal": _ideal,
        "mild": simulated(2, "mild"),
        "unknown_mounts": simulated(3, "mild", mount="any"),
        "right_arm_only": _right_arm_only,
        "gaps": _gaps,
        "two_rates": _two_rates,
        "measured_orientations": _measured_orientations,
        "no_phases": lambda: _changed(lambda session: replace(session, phases={})),
        "remounted": lambda: _changed(lambda session: replace(session, remounted=True)),
        "chain": lambda: (_chain(), {}),
    }


def write_inputs(folder: Path, data: Path | None) -> None:
    """All recordings, into a new folder."""
    folder.mkdir(parents=True)
    for name, make in makers().items():
        session, known = make()
        adapter.write_session(folder / name, session)
        (folder / name / "known.json").write_text(json.dumps(known) + "\n", encoding="utf-8")
    (folder / "chain" / "arm.urdf").write_text(_arm_urdf(), encoding="utf-8")
    if data is not None and (data / REAL).is_dir():
        (folder / REAL).mkdir()
        for path in (data / REAL).iterdir():
            shutil.copyfile(path, folder / REAL / path.name)


def read_known(folder: Path) -> Mapping[str, Any]:
    """What is known of the person of an input."""
    path = folder / "known.json"
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return found


def _with_known(made: Simulated, protocol: str = "clasp") -> tuple[Session, dict[str, Any]]:
    known = {"measured": dict(made.measured), "stature": made.stature, "sex": made.sex, "protocol": protocol}
    return made.session, known


def _changed(change: Callable[[Session], Session]) -> tuple[Session, dict[str, Any]]:
    session, known = _with_known(_simulated(2, "mild"))
    return change(session), known


def _ideal() -> tuple[Session, dict[str, Any]]:
    """No imperfection but noise; the first half of the start counts as sensors on a table."""
    session, known = _with_known(_simulated(1, "ideal"))
    return replace(session, phases={**session.phases, "static": [(0.5, 2.5)], "start": [(2.5, 4.5)]}), known


def _right_arm_only() -> tuple[Session, dict[str, Any]]:
    def change(session: Session) -> Session:
        (table,) = session.tables
        left = {name: signals for name, signals in table.signals.items() if name not in LEFT_ARM}
        return replace(session, tables=(replace(table, signals=left),))

    return _changed(change)


def _gaps() -> tuple[Session, dict[str, Any]]:
    """The left forearm gives nothing for 30 ms and for 0.3 s; all sensors give nothing for 0.12 s. As CSV."""

    def change(session: Session) -> Session:
        (table,) = session.tables
        signals = dict(table.signals)
        forearm = signals["left_forearm"]
        assert forearm.gyro is not None
        assert forearm.accel is not None
        gyro, accel = forearm.gyro.copy(), forearm.accel.copy()
        for first, last in ((12.0, 12.03), (20.0, 20.3)):
            rows = (table.time >= first) & (table.time < last)
            gyro[rows] = accel[rows] = np.nan
        signals["left_forearm"] = replace(forearm, gyro=gyro, accel=accel)
        rows = (table.time < 15.0) | (table.time >= 15.12)
        kept = {name: replace(s, gyro=s.gyro[rows], accel=s.accel[rows]) for name, s in signals.items()}  # type: ignore[index]
        return replace(session, tables=(Table(table.time[rows], kept, ".csv"),))

    return _changed(change)


def _two_rates() -> tuple[Session, dict[str, Any]]:
    """Two devices, each with a file, a rate and a clock of its own, in deg/s and g."""
    fast, slow = _simulated(7, "mild"), _simulated(7, "mild", rate_hz=60.0)
    tables = []
    for made, forearms, offset in ((fast, False, 0.0), (slow, True, -2.5)):
        (table,) = made.session.tables
        signals = {name: s for name, s in table.signals.items() if name.endswith("forearm") == forearms}
        tables.append(Table(table.time - offset, signals, ".csv", in_degrees=True, offset_s=offset))
    session, known = _with_known(fast)
    return replace(session, tables=tuple(tables)), known


def _measured_orientations() -> tuple[Session, dict[str, Any]]:
    """The forearms' sensors fuse by themselves, each in a world of its own heading."""
    made = _simulated(2, "mild")
    session, known = _with_known(made)
    (table,) = session.tables
    signals = dict(table.signals)
    for name, heading in (("left_forearm", 0.7), ("right_forearm", -2.0)):
        quat = (Rotation.from_euler("z", heading) * Rotation.from_quat(made.quat_WS[name])).as_quat()
        signals[name] = Signals(quat=quat, mount=signals[name].mount)
    return replace(session, tables=(replace(table, signals=signals),)), known


# A chain that is no person's arms: joint → its link, its axis while all joints are at zero, its place on the parent.
_ARM = {
    "pan": ("shoulder", "z", "0 0 0.089"),
    "lift": ("upper_arm", "y", "0 0.136 0"),
    "elbow": ("forearm", "y", "0.425 -0.12 0"),
    "wrist": ("tool", "y", "0.392 0 0"),
}
_START = {"lift": -np.pi / 2.0, "wrist": -np.pi / 2.0}  # [rad]


def _arm_urdf() -> str:
    inertia = '<inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0" iyz="0"/>'
    text, parent = '<link name="base"/>', "base"
    for joint, (link, axis, place) in _ARM.items():
        text += f'<link name="{link}"><inertial><mass value="1"/>{inertia}</inertial></link>'
        text += f'<joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{link}"/>'
        text += f'<origin xyz="{place}"/><axis xyz="{" ".join(str(int(axis == each)) for each in "xyz")}"/>'
        text += '<limit lower="-6.3" upper="6.3" effort="100" velocity="3"/></joint>'
        parent = link
    return f'<robot name="arm">{text}</robot>\n'


def _chain() -> Session:
    """Sensors without noise on three links of the arm, which measure no acceleration but gravity."""
    rate_hz = 100.0
    time = np.arange(2000) / rate_hz
    rise = np.clip((time - 4.0) / 2.0, 0.0, 1.0) ** 2
    rng = np.random.default_rng(0)
    mount = Rotation.from_matrix([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])  # -y_S up, -x_S forward
    R_WL, signals = Rotation.identity(), {}
    for joint, (link, axis, _) in _ARM.items():
        angle = _START.get(joint, 0.0) + rise * 0.5 * np.sin(rng.uniform(0.3, 1.0) * time + rng.uniform(0.0, 6.0))
        R_WL = R_WL * Rotation.from_euler(axis, angle[:, None])
        R_WS = R_WL * R_WL[0].inv() * mount
        gyro = np.zeros((len(time), 3))
        gyro[1:] = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * rate_hz
        if link != "shoulder":
            signals[link] = Signals(gyro, R_WS.inv().apply([0.0, 0.0, 9.81]), mount=("-y", "-x"))
    table = Table(time, signals)
    return Session("chain", (table,), {"start": [(0.5, 3.5)]}, start_pose="configuration", joints=_START)
