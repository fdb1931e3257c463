"""One seed: its recording is written, its commands are run, and every oracle is asked."""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from . import adapter
from .adapter import Outcome, Result
from .cases import Case, draw_case
from .invariances import choose, compare, list_fitting
from .oracles import Failure, of_acceptance, of_errors, of_outcome, of_result, of_same_table
from .recordings import Recorded, record

CLIPPED = 0.999  # share of the range from which a sensor is saturated


@dataclass
class Report:
    """What came of a seed."""

    seed: int
    about: str
    failures: list[Failure] = field(default_factory=list)
    commands: list[tuple[str, int]] = field(default_factory=list)  # command, exit code
    method: str = ""  # of the filter, where a result was scored
    z: float = 0.0  # its largest error over the stated one that no diagnostic explains
    recorded_s: float = 0.0

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


class Trial:
    """The commands of a case in a folder, and what came of them."""

    def __init__(self, case: Case, folder: Path) -> None:
        self.case, self.folder = case, folder
        self.report = Report(case.seed, case.describe())
        self.recorded: Recorded = record(case)
        self.report.recorded_s = case.duration
        # Only a sensor that does reach its range is one.
        for name, share in self.recorded.share_of_range.items():
            if case.suspects.get(name) == "range" and share < CLIPPED:
                del case.suspects[name]
        self.session = adapter.write_session(folder, self.recorded, case.layout, case.clock.unit)
        self.subject: Path | None = None
        self.subject_failed = False
        self.result_folder = folder / "result"
        self.result: Result | None = None

    def run(self, invariances_alone: bool = False) -> Report:
        """Run the steps and one invariance, or all invariances that can be tried and no step."""
        (self.folder / "about.txt").write_text(self.case.describe() + "\n", encoding="utf-8")
        for step in [] if invariances_alone else self.case.steps:
            if step in ("calibrate", "track", "info") or self.result is not None:
                STEPS[step](self)
        for invariance in list_fitting(self.case) if invariances_alone else choose(self.case):
            failures, outcomes = compare(self.case, invariance, self.folder / invariance)
            self.report.failures += failures
            for outcome in outcomes:
                self._count(outcome)
        return self.report

    def command(self, argv: list[str], out: Path | None = None, acceptance: str | None = None) -> Outcome:
        """Run one, with the oracles of every command; `acceptance`: why it may be refused, None: as the case says."""
        outcome = adapter.run(argv)
        self._count(outcome)
        failures = of_outcome(outcome, out)
        if not failures:
            failures = of_acceptance(outcome, self.case, self.case.refusal if acceptance is None else acceptance)
        self.report.failures += failures
        return outcome

    def _count(self, outcome: Outcome) -> None:
        self.report.commands.append((outcome.argv[0], outcome.code))

    # Steps --------------------------------------------------------------------------------------------------------

    def calibrate(self) -> None:
        out, case = self.folder / "subject", self.case
        swapped = "swapped" in case.suspects.values()
        outcome = self.command(
            adapter.calibrate(self.session, out, case), out, "" if case.refusal.startswith("must: no mount") else None
        )
        if outcome.code == 2 or outcome.traceback:
            return
        if swapped and outcome.code == 0:
            self.report.failures.append(Failure("swapped sensors do not pass", " ".join(outcome.argv), case.refusal))
        self.subject, self.subject_failed = out, outcome.code == 4

    def track(self) -> None:
        case, out = self.case, self.result_folder
        known = all(sensor.axes is not None for sensor in case.worn.values())
        acceptance = case.refusal
        beyond = [name for name, sensor in case.worn.items() if sensor.axes is None and name in ("pelvis", "head")]
        if not known and (self.subject is None or beyond) and not acceptance:
            acceptance = "may: no mount is known"
        if self.subject_failed and not acceptance:
            acceptance = "may: the calibration failed"
        argv = adapter.track(self.session, out, case.method, case.options, self.subject)
        outcome = self.command(argv, out, acceptance)
        shown = " ".join(argv)
        if outcome.code == 2 and self.subject is not None and beyond and adapter.advises_calibration(outcome):
            self.report.failures.append(Failure("advice that helps", shown, adapter.refusal(outcome)))
        if outcome.code or outcome.traceback:
            return
        self.result = adapter.read_result(out)
        broken = of_result(self.result, shown)
        self.report.failures += broken
        if broken:
            return
        if self.subject_failed or "swapped" in case.suspects.values():
            return
        failures, z, truth = of_errors(self.result, case, self.recorded, shown)
        self.report.failures += failures
        self.report.method, self.report.z = case.method, round(z, 3)
        worn = {name: R.as_quat() for name, R in truth.R_WL.items() if name in case.worn}
        adapter.write_truth(self.folder / "truth.parquet", self.result.time, worn, truth.points)

    def evaluate(self) -> None:
        if (self.folder / "truth.parquet").exists():
            self.command(adapter.evaluate(self.result_folder, self.folder / "truth.parquet"), acceptance="")

    def view(self) -> None:
        self.command(adapter.view(self.result_folder, self.folder / "view.html"), acceptance="")

    def export(self) -> None:
        rng = self.case.stream("export")
        for name in rng.choice(adapter.EXPORTS, size=2, replace=False):
            points = bool(self.result and self.result.points)
            self.command(
                adapter.export(self.result_folder, self.folder / str(name)),
                acceptance="" if points else "may: no points",
            )

    def info(self) -> None:
        self.command(adapter.info(self.session), acceptance="may: a damaged recording" if self.case.refusal else "")
        path, written, out = adapter.data_files(self.folder)[0], self.folder / "proposed.toml", self.folder / "proposed"
        outcome = self.command(adapter.info(path, written), acceptance="may: the file alone does not say")
        if outcome.code == 0:  # what is proposed may lack a mount, and says so in a line
            argv = adapter.track(written, out, "amekf", self.case.options & {"gaps"})
            self.command(argv, out, "may: a proposal is to be completed")

    def again(self) -> None:
        self._compared("again", "the same bits again")

    def chunks(self) -> None:
        rng = self.case.stream("chunks")
        seconds = float(rng.choice([7.0, 15.0, 40.0, rng.uniform(5.0, 60.0)]))
        with adapter.tracking_in_chunks(round(seconds, 2)):
            self._compared("chunks", "chunks equal the whole")

    def _compared(self, name: str, oracle: str) -> None:
        out, case = self.folder / name, self.case
        argv = adapter.track(self.session, out, case.method, case.options - {"report"}, self.subject)
        outcome = self.command(argv, out)
        if outcome.code or outcome.traceback:
            return
        self.report.failures += of_same_table(
            adapter.table_bytes(self.result_folder), adapter.table_bytes(out), oracle, " ".join(argv)
        )

    def retarget(self) -> None:
        arms = {"right_palm", "right_elbow"}
        points = self.result is not None and arms <= set(self.result.points)
        out = self.folder / "robot"
        self.command(adapter.retarget(self.result_folder, out), out, "" if points else "may: an arm is not known")


STEPS: dict[str, Callable[[Trial], None]] = {
    name: getattr(Trial, name)
    for name in ("calibrate", "track", "evaluate", "view", "export", "info", "again", "chunks", "retarget")
}


def try_seed(seed: int, keep: Path | None = None, invariances_alone: bool = False) -> Report:
    """Everything of one seed, in a folder that is removed, or kept under `keep`."""
    case = draw_case(seed)
    if keep is not None:
        shutil.rmtree(keep, ignore_errors=True)
        keep.mkdir(parents=True)
        return Trial(case, keep).run(invariances_alone)
    with tempfile.TemporaryDirectory(prefix="random-recording-") as folder:
        report = Trial(case, Path(folder)).run(invariances_alone)
        for failure in report.failures:
            failure.command = failure.command.replace(folder, "DIR")
            failure.message = failure.message.replace(folder, "DIR")
        return report
