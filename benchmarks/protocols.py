"""What each calibration protocol is worth on simulated people: errors, stated standard deviations and seconds.

Each person of the preset `people` does each protocol with arbitrary mounts, a measured shoulder width and trunk, and
then draws a circle with the right hand, on which the palm is compared. Clocks are exact, which makes the simulation
twice as fast and changes no angle by more than 0.2 deg. Results are appended to a file, so that a run goes on where it
was stopped.
"""

from __future__ import annotations

import json
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wepose_pin.errors import BadOption
from wepose_pin.simulation import (
    PEOPLE_MEASURED_STD,
    PRESETS,
    Imperfections,
    Person,
    Simulation,
    simulate,
    simulate_activity,
    simulate_person,
)

from .consistency import measure_simulation, summarize
from .tables import Column, Section, Table

FIRST_SEED = 300  # of persons; none of them was looked at while sizes were chosen
CIRCLES = 1
SCATTER = 0.6  # of the ratio of one person, whose lengths and headings are far from independent
CLOCKS: dict[str, Any] = {"clock_jitter": 0.0, "clock_offset": 0.0, "clock_drift_ppm": 0.0}
# Quantity of `consistency` → key, name, factor, unit
QUANTITIES = {
    "lengths": ("length", "lengths", 1e3, "mm"),
    "whole arms": ("arm", "whole arms", 1e3, "mm"),
    "mounts, tilt": ("tilt", "tilt", float(np.degrees(1.0)), "deg"),
    "mounts, heading": ("heading", "heading", float(np.degrees(1.0)), "deg"),
    "point right_palm": ("palm", "palm", 1e3, "mm"),
    "palm from shoulders": ("palm_from_shoulders", "palm from the shoulders", 1e3, "mm"),
}


class Cell(NamedTuple):
    """A row of the table."""

    protocol: str
    seconds: float  # of the session after the start pose


# `free` is the activity "tasks": reaches, rests and typing.
CELLS = (
    Cell("clasp", 30.0),
    Cell("clasp+t_pose", 30.0),
    Cell("clasp", 60.0),
    Cell("clasp+t_pose", 60.0),
    Cell("clasp+bow", 60.0),
    Cell("t_pose+bow", 14.5),
    Cell("free", 60.0),
)
Results = dict[tuple[Cell, int], dict[str, Any]]


def _people() -> Imperfections:
    return replace(PRESETS["people"], mount="any", **CLOCKS)


def measure(cell: Cell, seed: int) -> dict[str, Any]:
    """Errors and standard deviations of a person, as `consistency.measure_person`."""
    person = simulate_person(seed, PEOPLE_MEASURED_STD)
    try:
        simulation = _simulate(cell, seed, person)
    except BadOption:
        return {"seed": seed, "out_of_reach": True}
    return {"seed": seed, **measure_simulation(person, simulation, cell.protocol)}


def _simulate(cell: Cell, seed: int, person: Person) -> Simulation:
    """A person's session.

    Raises
    ------
    BadOption
        The arms do not reach through the motion that was drawn.
    """
    if cell.protocol == "free":
        return simulate_activity(
            "tasks", seed=seed, imperfections=_people(), seconds=cell.seconds, lengths=person.lengths
        )
    return simulate(
        person.lengths,
        seed=seed,
        imperfections=_people(),
        clasp_s=cell.seconds,
        protocol=cell.protocol,
        circles=CIRCLES,
    )


def read_results(file: Path) -> Results:
    """The results of an earlier run, (cell, seed) → result."""
    if not file.exists():
        return {}
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return {(Cell(row["protocol"], row["seconds"]), row["result"]["seed"]): row["result"] for row in rows}


def run(persons: int, file: Path, workers: int = 2) -> Results:
    """Measure what the file does not hold yet, and append it."""
    results = read_results(file)

    def add(cell: Cell, seed: int, result: dict[str, Any]) -> None:
        results[cell, seed] = result
        row = {"protocol": cell.protocol, "seconds": cell.seconds, "result": result}
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(row, default=float) + "\n")

    cells = [(cell, seed) for cell in CELLS for seed in range(FIRST_SEED, FIRST_SEED + persons)]
    with ProcessPoolExecutor(workers) as pool:
        pending = {pool.submit(measure, *key): key for key in cells if key not in results}
        for future in as_completed(pending):
            add(*pending[future], future.result())
    return results


def summarize_cells(results: Results) -> dict[Cell, dict[str, float]]:
    """Of each cell the persons, how many pass, and of each quantity error, standard deviation and their ratio."""
    rows = {}
    for cell in CELLS:
        own = [r for (other, _), r in sorted(results.items()) if other == cell and "out_of_reach" not in r]
        good = [result for result in own if "error" not in result]
        if not good:
            continue
        row = {"seconds": cell.seconds, "persons": float(len(own)), "without": float(len(own) - len(good))}
        if "quality" in good[0]:
            row["passed"] = float(sum(result["quality"] == "pass" for result in good))
        for quantity, summary in summarize(good).items():
            if quantity in QUANTITIES:
                key, _, factor, _ = QUANTITIES[quantity]
                row |= {key: factor * summary["error"], f"{key}_std": factor * summary["std"]}
                row[f"{key}_z"] = summary["by_std"]
        rows[cell] = row
    return rows


def write_page(results: Results) -> str:
    """The section of docs/validation.md with the results, in Markdown."""
    rows = summarize_cells(results)
    persons = max(round(row["persons"]) for row in rows.values())
    return _PAGE.format(persons=persons, scatter=SCATTER / np.sqrt(persons), closed=_format_table(rows))


def _format_table(rows: dict[Cell, dict[str, float]]) -> str:
    shown = list(QUANTITIES.values())
    header = ["protocol", "seconds", "people", "pass", *(f"{name} [{unit}]" for _, name, _, unit in shown)]
    lines = [f"|{'|'.join(header)}|", f"|{'---|' * len(header)}"]
    for cell, row in rows.items():
        entries = [cell.protocol, f"{cell.seconds:g}", f"{row['persons']:.0f}", f"{row['passed']:.0f}"]
        for key, _, _, unit in shown:
            digits = ".0f" if unit == "mm" and key != "length" else ".1f"
            std = (
                f" ± {row[f'{key}_std']:{digits}}, {row[f'{key}_z']:.2f}"
                if np.isfinite(row.get(f"{key}_z", np.nan))
                else ""
            )
            entries.append(f"{row[key]:{digits}}{std}" if key in row else "–")
        lines.append(f"|{'|'.join(entries)}|")
    return "\n".join(lines)


_PAGE = """## Calibration protocols

`python -m benchmarks protocols --persons {persons} --page benchmarks/validation/protocols.md` writes this section. The
people are simulated (`people`), with sensors mounted at any rotation; stature and sex are known, shoulder width and
trunk are measured to 12 mm. Seconds are those after the start pose. An entry is the rms of the error over people, ± the
stated standard deviation, and the rms of error over standard deviation: 1 is right, above it the ± is too small. That
last figure scatters by {scatter:.2f} with {persons} people. The row `free` shows what is known of the lengths without
any closure.

Headings are those of the mounts of all sensors. Most of their error is common to all, because the heading of the torso
defines which way is forward. The palm is the right one on a circle drawn after the calibration, from the root and from
the middle of the shoulders; in `free` it is that of the tasks themselves.

{closed}
"""


def sections(persons: int, file: Path | None, page: Path | None) -> dict[str, Section]:
    """Name → a function that measures it; the page is written as well."""

    def measure_all() -> Table:
        with tempfile.TemporaryDirectory() as folder:
            results = run(persons, file or Path(folder) / "results.jsonl")
        if page is not None:
            page.write_text(write_page(results), encoding="utf-8")
        columns = [Column("seconds", "s", 0), Column("persons", "people", 0), Column("passed", "pass", 0)]
        for key, name, _, unit in QUANTITIES.values():
            columns += [Column(key, f"{name} [{unit}]"), Column(f"{key}_std", "±"), Column(f"{key}_z", "error / ±", 2)]
        table = Table("Calibration protocols on simulated people", tuple(columns))
        for cell, row in summarize_cells(results).items():
            table.rows[f"{cell.protocol}, {cell.seconds:g} s"] = row
        return table

    return {"protocols": measure_all}
