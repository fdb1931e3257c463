"""``wepose batch``: the options; `batch.run_batch` does the job."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import BadOption


@dataclass(frozen=True)
class BatchJob:
    """Work through many recordings by a plan, on all processors or on a Dask cluster.

    An item that fails leaves its error in the table, and the others continue. The same command continues a run that was
    stopped and repeats nothing that is done. Sessions and DIR may lie on s3:// (docs/batch.md).

    Parameters
    ----------
    plan : PLAN.toml
        The plan: which sessions, whose, and the steps calibrate, track, retarget, export, evaluate with their options.
    out : DIR|URL
        Write items/, one folder per item, results.parquet and report.html to this folder or below this URL.
    scheduler : ADDRESS
        Use the workers of a running Dask scheduler, tcp://HOST:8786. Without it workers are started here.
    workers : NUMBER
        Start this number of workers here. Without it one per processor.
    force
        Make those items again whose inputs, options or version have changed since they were made.
    """

    plan: Path
    out: str
    scheduler: str | None = None
    workers: int | None = None
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where the workers cannot be started."""
        if self.workers is not None and (self.workers < 1 or self.scheduler is not None):
            why = "they run at the scheduler, which knows how many" if self.scheduler else "at least 1"
            raise BadOption(f"--workers {self.workers}: {why}")
