"""`wepose reproduce`: make a result again from its provenance, and compare."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from ..diagnostics import INFO, WARNING, Diagnostic
from ..errors import BadData, BadOption, MissingFile, WeposeError
from ..jobs import Progress, no_progress
from ..jobs.angles import AnglesJob, run_angles
from ..jobs.calibrate import CalibrateJob, run_calibrate
from ..jobs.demo import DemoJob, run_demo
from ..jobs.export import ExportJob, run_export
from ..jobs.fields import build_job, field_types
from ..jobs.reproduce import ReproduceJob
from ..jobs.retarget import RetargetJob, run_retarget
from ..jobs.simulate import SimulateJob, run_simulate
from ..jobs.track import TrackJob, run_track
from ..readers.tables import read_table
from ..writers.provenance import CALL, code, file_hash, machine, read_provenance
from ..writers.result import versions
from .comparison import find_differences
from .items import COMMAND, FAILED, read_item, run_steps
from .storage import DONE_FILE, fetch
from .study import ITEMS, RESULTS, STUDY

# Commands that a provenance, which may be a stranger's, can run: they make a result and use no network.
REPRODUCIBLE: dict[str, tuple[type, Callable[[Any], Any]]] = {
    "track": (TrackJob, run_track),
    "calibrate": (CalibrateJob, run_calibrate),
    "simulate": (SimulateJob, run_simulate),
    "retarget": (RetargetJob, run_retarget),
    "demo": (DemoJob, run_demo),
    "export": (ExportJob, run_export),
    "angles": (AnglesJob, run_angles),
}
_PAGES = ("report", "view")  # options that write pages, which are not compared


class Reproduction(NamedTuple):
    """Outcome of a reproduction."""

    command: str
    differences: list[str]  # a line each; empty: the results are equal
    diagnostics: list[Diagnostic]  # changes of code, packages and machine


def run_reproduce(job: ReproduceJob, progress: Progress = no_progress) -> Reproduction:
    """Make a result, or each item of a study, again in a temporary folder, and compare.

    Raises
    ------
    MissingFile
        The result, or an input, is not there.
    BadData
        Its provenance is missing or damaged, an input has changed, or the command now refuses.
    """
    if (job.result / STUDY).is_file():
        return _reproduce_study(job.result, progress)
    progress(f"making {job.result.name} again", 0.0)
    return _reproduce(job.result)


def _reproduce(result: Path) -> Reproduction:
    item = next((folder for folder in (result, *result.parents[:2]) if (folder / DONE_FILE).is_file()), None)
    provenance = _read_item_provenance(item) if item is not None else read_provenance(result)
    command = str(provenance.get("command"))
    with tempfile.TemporaryDirectory(prefix="wepose-") as place:
        out = Path(place) / "made" / result.name
        out.parent.mkdir()
        if command == COMMAND:
            if item is None:
                raise BadData(f"{result}: is of an item of wepose batch, whose {DONE_FILE} is missing; name its folder")
            _check_inputs(item, provenance, Path(place))
            out = Path(place) / "item"
            out.mkdir()
            run_steps(out, read_item(provenance))
            out /= result.relative_to(item)
        elif command in REPRODUCIBLE:
            _check_inputs(result, provenance, Path(place))
            kind, run = REPRODUCIBLE[command]
            run(_build_job(result, kind, provenance, out))
        elif command == CALL:
            raise BadData(
                f"{result}: saved from Python, whose code is not known; what `wepose track` writes is made again"
            )
        else:
            raise BadData(f"{result}: made by '{command}', which cannot be made again one by one")
        return Reproduction(command, find_differences(result, out), _diagnose_changes(provenance))


def _build_job(result: Path, kind: type, provenance: Mapping[str, Any], out: Path) -> Any:
    """The job that made a result, with output `out` and without pages."""
    inputs: dict[str, Any] = {}
    for name, entry in provenance["inputs"].items():
        field, dot, _ = name.partition(".")  # several of a field are numbered
        inputs[field] = [*inputs.get(field, []), entry["path"]] if dot else entry["path"]
    values = {**provenance["options"], **inputs, "out": out}
    values |= {name: False for name in _PAGES if name in field_types(kind)}
    try:
        return build_job(kind, values)
    except BadOption as error:
        raise BadData(f"{result}: provenance: wepose {provenance['command']} of this version: {error}") from None


def _reproduce_study(study: Path, progress: Progress) -> Reproduction:
    """All items of a study that were done; one that cannot be made again is a difference."""
    names, failed = _list_done_items(study)
    lines, diagnostics = list[str](), list[Diagnostic]()
    for k, name in enumerate(names):
        progress(f"making {name} again", k / len(names))
        try:
            again = _reproduce(study / ITEMS / name)
        except WeposeError as error:
            again = Reproduction(COMMAND, [f"cannot be made again: {error}"], [])
        lines += [f"{name}: {line}" for line in again.differences]
        diagnostics += [each for each in again.diagnostics if each not in diagnostics]
    if failed:
        diagnostics.append(Diagnostic("reproduce-items-skipped", INFO, value=failed))
    return Reproduction("batch", lines, diagnostics)


def _list_done_items(study: Path) -> tuple[list[str], int]:
    """Names of the items of a study that were done, and the number of the others."""
    try:
        table = read_table(study / RESULTS).select("item", "status")
    except (WeposeError, pl.exceptions.PolarsError):
        raise MissingFile(f"{study}: no {RESULTS} in it to go by; wepose batch goes on where it was stopped") from None
    names = table.filter(pl.col("status") != FAILED)["item"].to_list()
    return names, table.height - len(names)


def _read_item_provenance(folder: Path) -> dict[str, Any]:
    try:
        provenance = json.loads((folder / DONE_FILE).read_text(encoding="utf-8"))["provenance"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadData(f"{folder / DONE_FILE}: is damaged: {error}") from None
    if not isinstance(provenance, dict) or not isinstance(provenance.get("inputs"), dict):
        raise BadData(f"{folder / DONE_FILE}: provenance is damaged: a table with inputs is needed")
    return provenance


def _check_inputs(result: Path, provenance: Mapping[str, Any], place: Path) -> None:
    """Raise `WeposeError` where inputs are gone or have changed."""
    for name, entry in provenance["inputs"].items():
        try:
            url, before = str(entry["path"]), dict(entry["files"])
        except (KeyError, TypeError, ValueError):
            raise BadData(f"{result}: provenance is damaged: inputs.{name} needs path and files") from None
        truth = name == "session" and "evaluate" in provenance["options"].get("steps", ())
        path = fetch(url, place, truth)
        if not path.exists():
            raise MissingFile(f"{result}: its {name} is gone: {url}")
        top = path if path.is_dir() else path.parent
        for file, digest in before.items():
            if not (top / file).exists():
                raise MissingFile(f"{result}: of its {name}, {file} is gone: {top / file}")
            now = file_hash(top / file)
            if now != digest:
                raise BadData(
                    f"{result}: of its {name}, {top / file} has changed: SHA-256 was {digest[:12]}…, is {now[:12]}…"
                )


def _diagnose_changes(provenance: Mapping[str, Any]) -> list[Diagnostic]:
    """Changes of code, machine and packages."""
    now, diagnostics = code(), []
    if provenance.get("code") != now["code"]:
        codes = {
            "before": f"{provenance.get('version')} ({provenance.get('commit') or 'commit not known'})",
            "now": f"{now['version']} ({now['commit'] or 'commit not known'})",
        }
        diagnostics.append(Diagnostic("reproduce-version-differs", WARNING, facts=codes))
    if provenance.get("machine") not in (None, machine()):
        machines = {"before": str(provenance["machine"]), "now": machine()}
        diagnostics.append(Diagnostic("reproduce-machine-differs", INFO, facts=machines))
    packages = provenance.get("packages")
    packages = packages if isinstance(packages, dict) else versions()
    changed = [f"{name} {version}" for name, version in versions().items() if packages.get(name) != version]
    if changed:
        installed = {"packages": ", ".join(changed)}
        diagnostics.append(Diagnostic("reproduce-packages-differ", WARNING, facts=installed))
    return diagnostics
