"""Both solvers on random recordings: ``python tests/random_recordings/solvers.py --seeds 0:640 --jobs 2``.

Each seed that calibrates does so by `nlpsol` and by the Gauss-Newton loop of `benchmarks.calibration`. Each least
squares on the way is solved by both from the same start.
Exit code 1: one of them fails where the other does not, or they end elsewhere.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [path for path in (str(ROOT), str(ROOT / "tests")) if path not in sys.path]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np  # noqa: E402

EQUAL = 1e-3  # standard deviations between solutions
MOST = 0.01  # the same, above which they differ: each stops where 1e-4 are left, or after its last step


class Compared(NamedTuple):
    """A seed's calibration by both solvers, `nlpsol` first."""

    seed: int
    codes: tuple[int, ...]  # exit codes
    solved: int  # number of least squares
    seconds: tuple[float, float]  # processor time of all least squares
    command_s: float  # processor time of the command by the loop
    difference: float  # of the last least squares' solutions [standard deviations]; NaN: there is none
    length: float  # largest difference of the subjects' lengths [standard deviations]; NaN: there is none


def compare_solvers(seed: int) -> Compared | None:
    """Calibrate the recording of a seed by both solvers; None: the seed does not calibrate."""
    from benchmarks.calibration import LOOP, NLPSOL, SOLVERS, exchange_solver
    from random_recordings import adapter
    from random_recordings.cases import draw_case
    from random_recordings.recordings import record
    from wepose_pin import load_subject
    from wepose_pin.calibration.least_squares import STEPS
    from wepose_pin.errors import NoSolution

    case = draw_case(seed)
    if "calibrate" not in case.steps:
        return None
    seconds: dict[str, list[float]] = {name: [] for name in SOLVERS}
    difference = np.nan

    def solve_by_both(problem: Any, start: Any, steps: int = STEPS, *, strict: bool = True) -> Any:
        nonlocal difference
        fits: dict[str, Any] = {}
        for name, run in SOLVERS.items():
            begin = time.process_time()
            try:
                fits[name] = run(problem, start, steps, strict=strict)
            except NoSolution as error:  # the command by the loop shows which of them it is
                fits[name] = error
            seconds[name].append(time.process_time() - begin)
        if isinstance(fits[NLPSOL], NoSolution):
            raise fits[NLPSOL]
        if strict and not isinstance(fits[LOOP], NoSolution):  # the last one
            std = np.sqrt(np.diag(fits[LOOP].covariance))
            difference = float(np.abs((fits[NLPSOL].x - fits[LOOP].x) / std).max())
        return fits[NLPSOL]

    codes, subjects = [], []
    with tempfile.TemporaryDirectory(prefix="random-recording-") as name:
        folder = Path(name)
        session = adapter.write_session(folder, record(case), case.layout, case.clock.unit)
        for run in (solve_by_both, SOLVERS[LOOP]):
            exchange_solver(run)
            begin, out = time.process_time(), folder / f"subject{len(codes)}"
            codes.append(adapter.run(adapter.calibrate(session, out, case)).code)
            command_s = time.process_time() - begin
            if out.exists():
                subjects.append(load_subject(out))
    length = np.nan
    if len(subjects) == 2:
        a, b = subjects
        length = max(abs(metres - b.lengths[name]) / a.std(name) for name, metres in a.lengths.items())
    total = (sum(seconds[NLPSOL]), sum(seconds[LOOP]))
    return Compared(seed, tuple(codes), len(seconds[LOOP]), total, command_s, difference, length)


def report(compared: list[Compared]) -> bool:
    """Print what came of all seeds; return whether the solvers agree."""
    solved = [each for each in compared if each.solved]
    nlpsol, loop = np.sum([each.seconds for each in solved], axis=0)
    command_s = sum(each.command_s for each in solved)
    differences = np.array([each.difference for each in solved])
    lengths = np.array([each.length for each in solved])
    apart = [each.seed for each in compared if len(set(each.codes)) > 1]
    differ = [e.seed for e in solved if max(e.difference, e.length) > MOST]
    print(f"{len(compared)} calibrations, {len(compared) - len(solved)} of them refused before a least squares")
    print(f"another exit code by the other solver: seeds {apart or 'none'}")
    print(
        f"last least squares: {np.sum(differences < EQUAL)} of {np.sum(np.isfinite(differences))} solutions equal to "
        f"{EQUAL:g} standard deviations, the largest difference {np.nanmax(differences):.2g}"
    )
    print(
        f"lengths of the subjects: {np.sum(lengths == 0.0)} of {np.sum(np.isfinite(lengths))} equal as written, the "
        f"largest difference {np.nanmax(lengths):.2g} standard deviations"
    )
    print(f"solutions or lengths that differ: seeds {differ or 'none'}")
    print(
        f"processor time of {sum(each.solved for each in solved)} least squares: nlpsol {nlpsol:.1f} s, loop "
        f"{loop:.1f} s, ratio {nlpsol / loop:.2f}; of the commands: {(command_s + nlpsol - loop) / command_s:.2f}"
    )
    return not apart and not differ


def main() -> int:
    """Compare; exit code 1 where the solvers do not agree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:640", help="FROM:TO; about one in three calibrates")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    options = parser.parse_args()
    first, _, last = options.seeds.partition(":")
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        every = pool.imap_unordered(compare_solvers, range(int(first), int(last)))
        compared = [each for each in every if each is not None]
    return 0 if report(compared) else 1


if __name__ == "__main__":
    sys.exit(main())
