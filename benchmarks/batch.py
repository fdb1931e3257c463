"""What `wepose batch` costs: a study of simulated sessions on one process, on two, and once more."""

from __future__ import annotations

import tempfile
import time
from functools import partial
from pathlib import Path

from wepose_pin.batch.study import run_batch
from wepose_pin.simulation import simulate, simulate_person
from wepose_pin.writers import write_session

from .tables import Column, Section, Table

SESSIONS, FEW = 50, 8
CLASP_S, CIRCLES = 20.0, 2
_PLAN = """
[sessions]
files = ["data/*/session.toml"]
[steps.calibrate]
report = false
[steps.track]
view = false
report = false
[steps.evaluate]
"""


def sections(quick: bool, sessions: int | None = None) -> dict[str, Section]:
    """Name → a function that measures it; `sessions`: their number in the study, in place of `SESSIONS` or `FEW`."""
    return {"study": partial(_study, sessions or (FEW if quick else SESSIONS))}


def _study(sessions: int) -> Table:
    """Calibrate, track, evaluate; the same rows on one process and on two."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plan.toml").write_text(_PLAN, encoding="utf-8")
        for seed in range(1, sessions + 1):
            made = simulate(simulate_person(seed).lengths, seed=seed, clasp_s=CLASP_S, circles=CIRCLES)
            (folder / "data" / f"{seed:04d}").mkdir(parents=True)
            write_session(folder / "data" / f"{seed:04d}", made.recording(f"simulated-{seed}"), made.truth())
        table = Table(
            f"A study of {sessions} simulated sessions of {made.time[-1]:.0f} s: calibrate, track, evaluate",
            (
                Column("done", "done", 0),
                Column("same", "as on one process", 0),
                Column("whole", "whole run [s]", 1),
                Column("rate", "items a minute", 1),
            ),
            notes=["With the start of the processes. A rate means something where nothing else runs on the machine."],
        )
        first = None
        for case, workers, out in (("one process", 1, "one"), ("two processes", 2, "two"), ("all is done", 1, "one")):
            begin = time.perf_counter()
            rows = run_batch(folder / "plan.toml", str(folder / out), workers=workers).table.drop("seconds")
            seconds = time.perf_counter() - begin
            first = rows if first is None else first
            same = sum(a == b for a, b in zip(rows.iter_rows(), first.iter_rows(), strict=True))
            done = rows.filter(rows["status"] == "done").height
            table.rows[case] = {
                **{"done": float(done), "same": float(same), "whole": seconds},
                "rate": 60.0 * sessions / seconds,
            }
    return table
