"""``wepose angles``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..jobs.angles import PAGE, AnglesJob, run_angles
from .output import print_diagnostics, print_table, progress_bar, say, say_pages
from .parser import Command

if TYPE_CHECKING:
    from ..angles.movement import Movement


def run(job: AnglesJob) -> int:
    """Write the folder; print what was repeated, and the ranges."""
    from ..angles import diagnose_lock

    with progress_bar() as progress:
        outcome = run_angles(job, progress)
    lock = {each.place: each for movement in outcome.movements for each in diagnose_lock(movement.angles)}
    print_diagnostics([*lock.values(), *outcome.page_failures])
    for movement in outcome.movements:
        _print_repetitions(movement)
    _print_ranges(outcome.movements)
    filtered = "not low-passed" if job.low_pass_hz is None else f"low-passed at {job.low_pass_hz:g} Hz (half amplitude)"
    say(f"Orientations {filtered}; shoulder {'-'.join(job.shoulder)}; ± between repetitions: one standard deviation")
    say_pages(job.out, {"Page": PAGE})
    say(f"Tables and figures: {job.out}")
    return 0


def _print_repetitions(movement: Movement) -> None:
    repetitions = movement.repetitions
    by = f" by {repetitions.source}" if repetitions.source else ""
    if not len(repetitions.spans):
        other = "take another angle with --main-angle, or mark them as a phase and name it with --repetitions"
        say(f"{movement.name}: no repetitions{by}: {repetitions.reason}; {other}")
        return
    text = f"{movement.name}: {len(repetitions.spans)} repetitions{by}"
    if repetitions.rising is not None:
        text += f", {'rising' if repetitions.rising else 'falling'} first; CMC {repetitions.cmc:.2f}"
    say(text + (f"; {repetitions.left_out} left out as unlike them, or in gaps" if repetitions.left_out else ""))


def _print_ranges(movements: Sequence[Movement]) -> None:
    import numpy as np

    from ..angles.movement import compute_statistics

    repeated = [movement for movement in movements if movement.curves]
    rows = []
    for joint in dict.fromkeys(joint for movement in repeated for joint in movement.curves):
        for k in range(3):
            cells, name = [], ""
            for movement in repeated:
                if joint not in movement.curves:
                    cells.append("")
                    continue
                name = movement.angles[joint].names[k]
                each = compute_statistics(
                    movement.measures[joint].values[:, k, 2], movement.measures[joint].std[:, k, 2]
                )
                mean, sd = np.degrees(each.mean), np.degrees(each.sd)
                cells.append(f"{mean:.1f} ± {sd:.1f}" if np.isfinite(sd) else "")
            rows.append((f"{joint} {name}", *cells))
    if rows:
        names = [f"{movement.name}, n = {len(movement.repetitions.spans)}" for movement in repeated]
        print_table("Range in a repetition [deg]: mean ± std", ("angle", *names), rows)


COMMAND = Command(
    AnglesJob,
    run,
    example="angles before after -o angles --low-pass-hz 6",
    arguments=("result", "further"),
)
