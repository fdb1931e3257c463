"""``wepose batch``: the options; `batch.run_batch` does the job."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import BadOption


@dataclass(frozen=True)
class BatchJob:
    """Run the same steps on many recordings, on all processors of this machine or on a Dask cluster.

    An item is one session of the plan with its steps. If it fails, the table has its error, and the others continue.
    The same command continues a run that was stopped and repeats nothing that is done. Sessions and DIR may
    lie on s3:// (docs/batch.md).

    Parameters
    ----------
    plan : PLAN.toml
        The plan: the sessions, their subjects, and the steps calibrate, track, retarget, export, evaluate with options.
    out : DIR|URL
        Write items/, one folder per item, results.parquet and report.html to this folder or below this URL.
    scheduler : ADDRESS
        Use the workers of a running Dask scheduler, tcp://HOST:8786. Without it workers are started here.
    workers : NUMBER
        Start this number of workers here. Without it one per processor.
    force
        Run those items again whose inputs, options or package version have changed. Without it they are kept, with the
        status "changed".
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
