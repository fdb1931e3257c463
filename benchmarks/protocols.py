"""What each calibration protocol is worth on simulated people: errors, stated standard deviations and seconds.

Each person of the preset `people` does each protocol with arbitrary mounts, a measured shoulder width and trunk, and
then draws a circle with the right hand, on which the palm is compared. Clocks are exact, which makes the simulation
twice as fast and changes no angle by more than 0.2 deg. Results are appended to a file, so that a run goes on where it
was stopped.
"""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wepose_pin.simulation import PEOPLE_MEASURED_STD, PRESETS, simulate, simulate_activity, simulate_person

from .consistency import measure_simulation, summarize

FIRST_SEED = 300  # of persons; none of them was looked at while sizes were chosen
CIRCLES = 1
CLOCKS: dict[str, Any] = {"clock_jitter": 0.0, "clock_offset": 0.0, "clock_drift_ppm": 0.0}
QUANTITIES = {
    "lengths": ("lengths", 1e3, "mm"),
    "whole arms": ("whole arm", 1e3, "mm"),
    "mounts, tilt": ("tilt", float(np.degrees(1.0)), "deg"),
    "mounts, heading": ("heading", float(np.degrees(1.0)), "deg"),
    "point right_palm": ("palm", 1e3, "mm"),
}


class Cell(NamedTuple):
    """A row of the table."""

    protocol: str
    seconds: float  # of the session after the start pose


# In the order in which they are measured. `free` is the activity "tasks": reaches, rests and typing.
CELLS = (
    Cell("clasp", 60.0),
    Cell("clasp+t_pose", 60.0),
    Cell("free", 60.0),
    Cell("clasp+elbows", 60.0),
    Cell("clasp", 30.0),
    Cell("clasp+t_pose", 30.0),
    Cell("clasp+swing", 60.0),
    Cell("clasp+touch_body", 60.0),
    Cell("handle", 60.0),
    Cell("elbows+swing+t_pose", 60.0),
    Cell("poses", 14.5),
    Cell("touch_body", 60.0),
    Cell("handle", 30.0),
    Cell("clasp+elbows", 30.0),
    Cell("clasp+elbows+t_pose", 60.0),
)


def measure(cell: Cell, seed: int) -> dict[str, Any]:
    """Errors and standard deviations of a person, as `consistency.measure_person`."""
    person = simulate_person(seed, PEOPLE_MEASURED_STD)
    imperfections = replace(PRESETS["people"], mount="any", **CLOCKS)
    if cell.protocol == "free":
        simulation = simulate_activity(
            "tasks", seed=seed, imperfections=imperfections, seconds=cell.seconds, lengths=person.lengths
        )
    else:
        simulation = simulate(
            person.lengths,
            seed=seed,
            imperfections=imperfections,
            clasp_s=cell.seconds,
            protocol=cell.protocol,
            circles=0 if cell.protocol == "poses" else CIRCLES,
        )
    return {"seed": seed, **measure_simulation(person, simulation, cell.protocol)}


def read_results(file: Path | None) -> dict[tuple[Cell, int], dict[str, Any]]:
    """The results of an earlier run, (cell, seed) → result."""
    if file is None or not file.exists():
        return {}
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return {(Cell(row["protocol"], row["seconds"]), row["result"]["seed"]): row["result"] for row in rows}


def run(persons: int, file: Path | None = None, workers: int = 2) -> dict[tuple[Cell, int], dict[str, Any]]:
    """Measure what the file does not hold yet."""
    results = read_results(file)
    todo = [(cell, seed) for cell in CELLS for seed in range(FIRST_SEED, FIRST_SEED + persons)]
    with ProcessPoolExecutor(workers) as pool:
        pending = {pool.submit(measure, *key): key for key in todo if key not in results}
        for future in as_completed(pending):
            (cell, seed), result = pending[future], future.result()
            results[cell, seed] = result
            if file is not None:
                row = {"protocol": cell.protocol, "seconds": cell.seconds, "result": result}
                with file.open("a", encoding="utf-8") as lines:
                    lines.write(json.dumps(row, default=float) + "\n")
    return results


def make_table(results: dict[tuple[Cell, int], dict[str, Any]]) -> str:
    """The table in Markdown: of each quantity error rms, standard deviation rms, and error over standard deviation."""
    names = [f"{name} [{unit}]" for name, _, unit in QUANTITIES.values()]
    header = ["protocol", "s", "people", "pass / poor / fail", *names, "palm from shoulders [mm]"]
    lines = [f"| {' | '.join(header)} |", f"|{'---|' * len(header)}"]
    for cell in CELLS:
        own = [result for (other, _), result in sorted(results.items()) if other == cell]
        good = [result for result in own if "error" not in result]
        if not good:
            continue
        rows = summarize(good)
        grades = [sum(result["quality"] == grade for result in good) for grade in ("pass", "poor", "fail")]
        cells = [cell.protocol, f"{cell.seconds:g}", str(len(own)), " / ".join(map(str, grades))]
        for quantity, (_, factor, _) in QUANTITIES.items():
            row = rows.get(quantity)
            digits = ".0f" if quantity in ("whole arms", "point right_palm") else ".1f"
            values = [f"{factor * row[key]:{digits}}" for key in ("error", "std")] if row else []
            cells.append(f"{values[0]} (± {values[1]}, {row['by_std']:.2f})" if row else "–")
        palm = rows.get("palm from shoulders")
        cells.append(f"{1e3 * palm['error']:.0f}" if palm else "–")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
