"""``wepose simulate``."""

from __future__ import annotations

from ..jobs.simulate import SimulateJob, run_simulate
from .output import progress_bar, say
from .parser import Command


def run(job: SimulateJob) -> int:
    """Simulate; print the files, and the lengths that a user would measure."""
    with progress_bar() as progress:
        person = run_simulate(job, progress).person
    measured = " ".join(f"{name}={value:.4f}" for name, value in person.measured.items())
    about = f"measured: {measured}, stature {person.stature:.2f} m, sex {person.sex}"
    say(f"Session: {job.out / 'session.toml'}  ({about})")
    say(f"Truth: {job.out / 'truth.parquet'}  {job.out / 'subject.toml'}")
    return 0


COMMAND = Command(
    SimulateJob,
    run,
    example="simulate -o made --seed 7 --preset mild --imperfection palm_slip=0 --imperfection mount=any",
)
