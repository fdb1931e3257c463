"""``wepose reproduce``: the options; `batch.run_reproduce` does the job."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ReproduceJob:
    """Run a result again from its recorded provenance and check that its tables are bit-identical.

    RESULT is not changed: the new one is written to a temporary folder, which is removed afterwards.

    Parameters
    ----------
    result : RESULT
        Folder of `wepose track`, calibrate, simulate, retarget, angles or demo, a study of `wepose batch` or an item of
        it, or a file of `wepose export`.
    """

    result: Path
