"""``wepose reproduce``: the options; `batch.run_reproduce` does the job."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ReproduceJob:
    """Make a result again from its provenance and compare: tables must be bit-identical.

    Nothing is changed: the result is made again in a folder that is removed afterwards.

    Parameters
    ----------
    result : RESULT
        Folder of `wepose track`, calibrate, simulate, retarget or demo, a study of `wepose batch` or an item of it, or
        a file of `wepose export`.
    """

    result: Path
