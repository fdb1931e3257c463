"""Real recordings with optical truth: BROAD, the paper authors' own trial.

Heading aligned once, on a stretch that is not scored, and never fitted to the truth afterwards; optical gaps left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import MissingFile
from ..evaluation import attitude_error
from ..noise import noise_of
from ..readers.trials import Trial, read_authors_trial, read_broad
from .contenders import contenders
from .jobs import Job, Result
from .series import aligned, over_time


def experiments(data: Path, quick: bool = False) -> dict[str, list[Job]]:
    """Name → jobs, for what of the real recordings lies in `data`.

    Raises
    ------
    MissingFile
        Nothing of them does.
    """
    found = {}
    paths = sorted((data / "broad").glob("*.mat"))
    authors = data / "wepose_hr" / "prova_HR.txt"
    if paths:
        found["BROAD"] = [
            Job("BROAD", path.stem, _broad, (path, n == 0)) for n, path in enumerate(paths[: 2 if quick else None])
        ]
    if authors.is_file():
        found["the authors' trial"] = [Job("the authors' trial", authors.stem, _authors, (authors,))]
    if not found:
        raise MissingFile(f"{data}: neither broad/*.mat nor wepose_hr/prova_HR.txt in it; see the data's README")
    return found


def _broad(experiment: str, name: str, path: Path, first: bool) -> list[Result]:
    """Errors over the marked motion, the heading aligned in the still phase."""
    trial = read_broad(path)
    seen = np.isfinite(trial.quat_true).all(axis=1)
    at_rest = np.zeros(len(seen), dtype=bool)
    at_rest[trial.still] = seen[trial.still]
    true = Rotation.from_quat(np.where(seen[:, None], trial.quat_true, [0.0, 0.0, 0.0, 1.0]))
    return [
        Result(experiment, name, label, *_scored(aligned(R_VS, true, at_rest), true, trial, first))
        for label, R_VS in _filtered(trial)
    ]


def _authors(experiment: str, name: str, path: Path) -> list[Result]:
    """Vicon's world is not level to a degree: aligned in full, on the world's side, at the first Vicon sample."""
    trial = read_authors_trial(path)
    first = int(np.argmax(trial.scored))
    true = Rotation.from_quat(np.where(trial.scored[:, None], trial.quat_true, [0.0, 0.0, 0.0, 1.0]))
    return [
        Result(experiment, name, label, *_scored((true[first] * R_VS[first].inv()) * R_VS, true, trial, True))
        for label, R_VS in _filtered(trial)
    ]


def _filtered(trial: Trial) -> Iterator[tuple[str, Rotation]]:
    noise = noise_of(trial.gyro_S[trial.still], trial.accel_S[trial.still], trial.rate_hz)
    for contender in contenders("real"):
        yield contender.label, Rotation.from_quat(contender.orient(trial.gyro_S, trial.accel_S, trial.rate_hz, noise))


def _scored(R_WS: Rotation, true: Rotation, trial: Trial, keep: bool) -> tuple[dict[str, Any], dict[str, list[float]]]:
    time = np.arange(len(trial.scored))[trial.scored] / trial.rate_hz
    error = R_WS[trial.scored] * true[trial.scored].inv()
    figures = attitude_error(R_WS[trial.scored], true[trial.scored], time)._asdict()
    figures["mean_angle"] = float(np.degrees(error.magnitude()).mean())
    return figures, over_time(time, total_deg=np.degrees(error.magnitude())) if keep else {}
