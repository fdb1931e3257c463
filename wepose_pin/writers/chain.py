"""The result folder of a chain: ``joints.parquet``, ``pose.parquet``, ``summary.json``."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl

from ..angles.torques import Torques, torque_table
from ..kinematics import compute_axis_std
from ..tracking import TrackedChain
from .result import versions, write_table


def write_chain(folder: Path, chain: TrackedChain, torques: Torques | None = None) -> None:
    """Write what `track_chain` gave into an existing folder.

    ``joints.parquet``: ``time``, a column a joint [rad or m]. ``pose.parquet``: ``time``; of each link with a sensor
    ``<link>_qx,_qy,_qz,_qw`` as the model has it, ``<link>_measured_qx,…`` as it was measured, ``<link>_std`` [rad] of
    the measured one.
    """
    write_table(folder / "joints.parquet", pl.DataFrame({"time": chain.time, **chain.joints}))
    pose = {"time": chain.time}
    for link, quat in chain.orientations().items():
        pose |= {f"{link}_{c}": quat[:, k] for k, c in enumerate(("qx", "qy", "qz", "qw"))}
        pose |= {f"{link}_measured_{c}": chain.quat_WL[link][:, k] for k, c in enumerate(("qx", "qy", "qz", "qw"))}
        if link in chain.segment_cov:
            pose[f"{link}_std"] = compute_axis_std(chain.segment_cov[link])
    write_table(folder / "pose.parquet", pl.DataFrame(pose))
    summary = chain.summary() | {"versions": versions()}
    if torques is not None:
        write_table(folder / "torques.parquet", torque_table(torques))
        summary["torques"] = torques.summary()
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
