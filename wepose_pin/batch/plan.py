"""The plan (``PLAN.toml``): sessions, their subjects, and the steps with their options."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..arguments import check_value
from ..documents import TomlTable, read_toml
from ..errors import BadData, BadOption, BadPlan, BadSession, WeposeError, WrongOption, one_of
from ..jobs.calibrate import CalibrateJob
from ..jobs.evaluate import EvaluateJob
from ..jobs.export import ExportJob
from ..jobs.fields import REQUIRED, build_job, convert_value, field_defaults, field_types
from ..jobs.retarget import RetargetJob
from ..jobs.track import TrackJob
from ..model import load_table
from ..readers.tables import read_table
from ..subject import population_subject
from .storage import find_urls, is_remote

SESSION = "session.toml"
# Step → the job of the command of the same name, whose options it has; in the order in which they run.
STEPS: dict[str, type] = {
    "calibrate": CalibrateJob,
    "track": TrackJob,
    "retarget": RetargetJob,
    "export": ExportJob,
    "evaluate": EvaluateJob,
}
_PATHS = ("session", "out", "result", "truth")
# Follow from an item's session and subject, or are not of one session.
_ITEM_OPTIONS = (
    *_PATHS,
    "subject",
    "further",
    "episodes",
    "instruction",
    "measured",
    "stature",
    "sex",
    "force",
)
_NAMES_OR_FILES = ("protocol", "robot")
_FORMATS = "formats"  # of export: a list, in place of --format
_COLUMNS = ("session", "name", "subject", "truth", "stature", "sex")
_MEASURED = "measured."
MAX_NAME = 100  # letters of an item's folder


@dataclass(frozen=True)
class Anthropometrics:
    """What is known of a person before calibration: stature and lengths [m], sex "f" or "m"."""

    stature: float | None = None
    sex: str | None = None
    measured: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Item:
    """One session and its steps.

    Parameters
    ----------
    name : of its folder, unique in the plan
    session, subject_file, truth : paths or URLs
    subject : a name of the plan
    steps : step → all of its options
    """

    name: str
    session: str
    steps: Mapping[str, Mapping[str, Any]]
    subject: str | None = None
    subject_file: str | None = None
    truth: str | None = None
    anthropometrics: Anthropometrics = Anthropometrics()


@dataclass(frozen=True)
class Plan:
    """The items of a study, in the order of the file; `calibrations` of subjects run before `items`."""

    name: str
    calibrations: tuple[Item, ...]
    items: tuple[Item, ...]

    @property
    def all_items(self) -> tuple[Item, ...]:
        return (*self.calibrations, *self.items)


@dataclass(frozen=True)
class _Subject:
    calibration: str | None
    file: str | None
    anthropometrics: Anthropometrics


def read_plan(path: Path, items_folder: str) -> Plan:
    """Read a plan and find its sessions; `items_folder` will hold the items' folders.

    Raises
    ------
    MissingFile, BadPlan
        With one line that names the file, the key, the value found and what would be right.
    """
    try:
        return _read_plan(path, items_folder)
    except (BadSession, BadData) as error:  # of readers that are shared with sessions
        raise BadPlan(str(error)) from None


def _read_plan(path: Path, items_folder: str) -> Plan:
    top = TomlTable(read_toml(path, "a plan"), str(path))
    top.allow("name", "sessions", "subjects", "steps")
    steps = _read_steps(top, path.parent)
    lengths = tuple(load_table().lengths)
    tables = top.table("subjects", {})
    subjects = {name: _read_subject(tables.table(name), path, lengths) for name in tables.values}
    named = [
        (entry, _build_item(path, entry, steps, subjects, items_folder))
        for place, keys in _list_session_tables(top, path)
        for entry in _read_sessions(place, keys, path, lengths)
    ]
    if not named:
        raise BadPlan(f"{path}: sessions: no session at all; files or table are needed")
    items = _make_names_unique(path, named)
    calibrations = []
    for name, subject in subjects.items():
        if subject.calibration is None or not any(item.subject == name for item in items):
            continue
        if "calibrate" not in steps:
            raise BadPlan(
                f"{top.at(f'subjects.{name}')}.calibration: needs the step [steps.calibrate], which is missing"
            )
        only = {"calibrate": steps["calibrate"]}
        calibrations.append(
            Item(_subject_item_name(name), subject.calibration, only, name, anthropometrics=subject.anthropometrics)
        )
    if taken := {item.name for item in items} & {item.name for item in calibrations}:
        raise BadPlan(f"{path}: '{min(taken)}' is both a session's and a subject's item; give the session a name")
    return Plan(top.text("name", None) or path.stem, tuple(calibrations), tuple(items))


# Steps ---------------------------------------------------------------------------------------------------------------


def step_options(step: str) -> dict[str, Any]:
    """Option → default of a step in a plan; `REQUIRED` where there is none."""
    defaults = field_defaults(STEPS[step])
    named = {_FORMATS: REQUIRED} if "format" in defaults else {}
    return named | {name: value for name, value in defaults.items() if name not in (*_ITEM_OPTIONS, "format")}


def _read_steps(top: TomlTable, folder: Path) -> dict[str, dict[str, Any]]:
    table = top.table("steps")
    table.allow(*STEPS)
    if not table.values:
        raise BadPlan(f"{top.at('steps')}: no step; {one_of(STEPS)}")
    steps: dict[str, dict[str, Any]] = {}
    for step in [step for step in STEPS if step in table]:  # in the order in which they run
        keys, options = table.table(step), step_options(step)
        keys.allow(*options)
        steps[step] = {name: _read_option(keys, step, name, default, folder) for name, default in options.items()}
        _check_step(step, steps[step], keys)
    for step in ("retarget", "export", "evaluate"):
        if step in steps and "track" not in steps:
            raise BadPlan(f"{top.at('steps')}.{step}: needs the step [steps.track], which is missing")
    return steps


def _read_option(keys: TomlTable, step: str, name: str, default: Any, folder: Path) -> Any:
    """The value of an option as JSON holds it."""
    if name not in keys:
        if default is REQUIRED:
            raise BadPlan(f"{keys.at(name)} is missing")
        return default
    value = keys.values[name]
    if name == _FORMATS:
        return _read_formats(keys, value)
    hint = field_types(STEPS[step])[name]
    try:
        value = convert_value(value, hint)
        check_value(keys.at(name), value, hint)
    except BadOption as error:
        raise BadPlan(str(error)) from None
    if isinstance(value, Path) or name in _NAMES_OR_FILES:
        file = folder / value
        return str(file.absolute()) if file.is_file() else str(value)
    return value


def _read_formats(keys: TomlTable, value: Any) -> tuple[str, ...]:
    from ..writers.export import FORMATS, LEROBOT, REMOVED

    if not isinstance(value, list) or not value:
        raise BadPlan(f'{keys.at(_FORMATS)} = {value!r} is not a list of formats, such as ["trc", "mot"]')
    for each in value:
        if each in REMOVED:
            raise BadPlan(f"{keys.at(_FORMATS)}: '{each}' is no longer written; {REMOVED[each]}")
        if each not in FORMATS:
            raise BadPlan(f"{keys.at(_FORMATS)}: '{each}' is no format; {one_of(FORMATS, str(each))}")
        if each == LEROBOT:
            raise BadPlan(f"{keys.at(_FORMATS)}: '{each}' is of robots, and this step writes the person's motion")
    return tuple(dict.fromkeys(value))


def _check_step(step: str, options: Mapping[str, Any], keys: TomlTable) -> None:
    """Raise `BadPlan` for what would fail at every item, before any work."""
    values = {name: value for name, value in options.items() if name != _FORMATS}
    values |= {name: Path(name) for name in _PATHS if name in field_types(STEPS[step])}
    job: Any = build_job(STEPS[step], values)
    try:
        job.check()
    except BadSession:
        raise
    except WrongOption as error:
        key = error.name.replace("-", "_")
        raise BadPlan(f"{keys.file}: {keys.place}{key} = {error.value}: {error.needed}") from None
    except WeposeError as error:
        raise BadPlan(f"{keys.file}: {keys.place.rstrip('.')}: {error}") from None


# Subjects ------------------------------------------------------------------------------------------------------------


def _read_subject(keys: TomlTable, path: Path, lengths: Sequence[str]) -> _Subject:
    keys.allow("calibration", "file", "stature", "sex", "measured")
    calibration, file = keys.text("calibration", None), keys.text("file", None)
    if calibration is not None and file is not None:
        raise BadPlan(f"{keys.at('file')}: a subject has a file or a calibration, not both")
    for key in ("calibration", "file"):
        place = _resolve(keys.text(key, None), path)
        if place is not None and not is_remote(place) and not Path(place).exists():
            raise BadPlan(f"{keys.at(key)} = '{keys.values[key]}': no such file; a path from the plan's folder, or URL")
    table = keys.table("measured", {})
    table.allow(*lengths)
    measured = {name: table.number(name, None, positive=True) for name in table.values}
    sex = keys.choice("sex", ("f", "m")) if "sex" in keys else None
    stature = keys.number("stature", None, True)
    _check_stature(stature, keys.at("stature"))
    person = Anthropometrics(stature, sex, {name: value for name, value in measured.items() if value is not None})
    return _Subject(_resolve(calibration, path), _resolve(file, path), person)


# Sessions ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Entry:
    """A session of the plan; `place` in the plan is for errors."""

    session: str
    place: str
    name: str | None = None
    subject: str | None = None
    truth: str | None = None
    anthropometrics: Anthropometrics | None = None


def _list_session_tables(top: TomlTable, path: Path) -> list[tuple[str, TomlTable]]:
    """Place and table of [sessions], or of several [[sessions]]."""
    value = top.values.get("sessions")
    if isinstance(value, dict):
        value = [value]
    if not isinstance(value, list) or not value or not all(isinstance(entry, dict) for entry in value):
        raise BadPlan(
            f"{top.at('sessions')}: a table [sessions], or several [[sessions]], with files or table is needed"
        )
    places = [f"sessions[{k}]" if len(value) > 1 else "sessions" for k in range(len(value))]
    return [(place, TomlTable(entry, str(path), f"{place}.")) for place, entry in zip(places, value, strict=True)]


def _read_sessions(place: str, keys: TomlTable, path: Path, lengths: Sequence[str]) -> list[_Entry]:
    keys.allow("files", "table", "subject")
    if ("files" in keys) == ("table" in keys):
        raise BadPlan(f"{path}: {place}: either files (globs) or table is needed")
    subject = keys.text("subject", None)
    if "table" in keys:
        if subject is not None:
            raise BadPlan(f"{keys.at('subject')}: a table has a column for it")
        return _read_table(str(keys.text("table", None)), path, lengths)
    patterns = keys.values["files"]
    patterns = [patterns] if isinstance(patterns, str) else patterns
    if not isinstance(patterns, list) or not all(isinstance(pattern, str) and pattern for pattern in patterns):
        raise BadPlan(f'{keys.at("files")} = {patterns!r} is not a list of globs, such as ["data/*/session.toml"]')
    urls: dict[str, None] = {}
    for pattern in patterns:
        matches = find_urls(str(_resolve(pattern, path)))
        if not matches:
            raise BadPlan(f"{keys.at('files')}: '{pattern}' finds nothing; it is a path or glob from the plan's folder")
        urls |= dict.fromkeys(matches)
    return [_Entry(url, f"{path}: {place}: {url}", subject=subject) for url in urls]


def _read_table(name: str, path: Path, lengths: Sequence[str]) -> list[_Entry]:
    file = path.parent / name
    table = read_table(file)
    if "session" not in table.columns:
        raise BadPlan(f"{file}: no column 'session'; {one_of(table.columns, 'session')}")
    for column in table.columns:
        if column not in _COLUMNS and not (column.startswith(_MEASURED) and column.removeprefix(_MEASURED) in lengths):
            known = (*_COLUMNS, *(f"{_MEASURED}{length}" for length in lengths))
            raise BadPlan(f"{file}: column '{column}' is not known; {one_of(known, column, len(known))}")
    entries = []
    for k, row in enumerate(table.iter_rows(named=True), 1):
        where = f"{file}: row {k}"
        cells = {column: value for column, value in row.items() if value is not None and value != ""}
        if "session" not in cells:
            raise BadPlan(f"{where}: session is empty")
        metres = {c: _read_length(where, c, v) for c, v in cells.items() if c == "stature" or c.startswith(_MEASURED)}
        sex = cells.get("sex")
        if sex not in (None, "f", "m"):
            raise BadPlan(f"{where}: sex = '{sex}'; f, m or nothing")
        measured = {c.removeprefix(_MEASURED): value for c, value in metres.items() if c != "stature"}
        person = Anthropometrics(metres.get("stature"), sex, measured) if metres or sex else None
        _check_stature(metres.get("stature"), where)
        text = {key: str(cells[key]) for key in ("name", "subject") if key in cells}
        session, truth = (_resolve(str(cells[key]), file) if key in cells else None for key in ("session", "truth"))
        entries.append(_Entry(str(session), where, truth=truth, anthropometrics=person, **text))
    return entries


def _check_stature(stature: float | None, where: str) -> None:
    if problem := _find_stature_problem(stature):
        raise BadPlan(f"{where}: {problem}")


@lru_cache
def _find_stature_problem(stature: float | None) -> str | None:
    try:
        population_subject(stature)
    except WeposeError as error:
        return str(error)
    return None


def _read_length(where: str, column: str, value: Any) -> float:
    try:
        metres = float(value)
    except (TypeError, ValueError):
        metres = -1.0
    if not 0.0 < metres < 3.0:
        raise BadPlan(f"{where}: {column} = '{value}' is not a length in metres")
    return metres


def _build_item(
    path: Path, entry: _Entry, steps: dict[str, dict[str, Any]], subjects: Mapping[str, _Subject], items_folder: str
) -> Item:
    """The item of a session: calibrated by itself, or tracked with the calibration of its subject."""
    own, person, file = dict(steps), entry.anthropometrics or Anthropometrics(), None
    if entry.subject is not None and (subjects or "calibrate" not in steps):
        if entry.subject not in subjects:
            raise BadPlan(
                f"{entry.place}: subject '{entry.subject}' is not in the plan; {one_of(subjects, entry.subject)}"
            )
        subject = subjects[entry.subject]
        if entry.anthropometrics is None:
            person = subject.anthropometrics
        file = subject.file
        if subject.calibration is not None:
            file = f"{items_folder}/{_subject_item_name(entry.subject)}/calibrate/subject.toml"
        if file is not None:
            own.pop("calibrate", None)
    if not own:
        raise BadPlan(
            f"{entry.place}: nothing to do: its subject is calibrated elsewhere, and there is no step but that"
        )
    name = _sanitize(entry.name) if entry.name else _derive_name(entry.session, path)
    if not name:
        raise BadPlan(f"{entry.place}: name '{entry.name}' has no letter or digit; an item's folder has that name")
    return Item(name, entry.session, own, entry.subject, file, entry.truth, person)


def _subject_item_name(subject: str) -> str:
    return f"subject-{_sanitize(subject)}"


def _make_names_unique(path: Path, named: Sequence[tuple[_Entry, Item]]) -> list[Item]:
    """The items; those of equal name get the hash of their session, which does not depend on other items."""
    by_name: dict[str, list[str]] = {}
    for _, item in named:
        by_name.setdefault(item.name, []).append(item.session)
    items = []
    for entry, item in named:
        if len(by_name[item.name]) > 1:
            if entry.name or by_name[item.name].count(item.session) > 1:
                source = f"name '{entry.name}'" if entry.name else f"session {item.session}"
                raise BadPlan(f"{entry.place}: {source} is there twice in {path.name}; each item needs one of its own")
            item = replace(item, name=f"{item.name}-{hashlib.sha256(item.session.encode()).hexdigest()[:6]}")
        items.append(item)
    return items


def _derive_name(session: str, path: Path) -> str:
    """A name from the path of a session: its folders below the plan's, or below the bucket."""
    if is_remote(session):
        parts = session.partition("://")[2].split("/")[1:]
    else:
        place, base = Path(session).absolute(), path.parent.absolute()
        while base not in place.parents:
            base = base.parent
        parts = list(place.relative_to(base).parts)
    if parts and parts[-1] == SESSION:
        parts = parts[:-1]
    elif parts and parts[-1].endswith(".toml"):
        parts = [*parts[:-1], parts[-1].removesuffix(".toml")]
    return _sanitize("-".join(parts)) or "session"


def _sanitize(text: str) -> str:
    """A text as the name of a folder."""
    return re.sub(r"[^\w.-]+", "_", text, flags=re.ASCII).lstrip(".")[:MAX_NAME]


def _resolve(text: str | None, path: Path) -> str | None:
    """A path from the folder of the file that names it; URLs stay."""
    if text is None or is_remote(text):
        return text
    return str((path.parent / text).absolute())
