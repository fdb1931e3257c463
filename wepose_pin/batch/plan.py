"""The plan (``PLAN.toml``): sessions, their subjects, and the steps with their options."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from ..body import load_table
from ..commands.command_line import APP, parse
from ..data_tables import read_table
from ..documents import Key, TomlTable, read_record, read_toml
from ..errors import BadPlan, WeposeError, one_of
from .storage import find_urls, is_remote

# Step → what its command takes by position; in the order in which they run.
STEPS = {
    "calibrate": ("session",),
    "track": ("session",),
    "retarget": ("result",),
    "export": ("result",),
    "evaluate": ("result", "truth"),
}
_PERSON = ("stature", "sex", "measured")  # options of `calibrate` that belong to a person
# Follow from an item's session and subject, or are not of one session.
_ITEM_OPTIONS = ("out", "subject", "further", "format", "episodes", "instruction", *_PERSON, "force")
_MEASURED = "measured."  # begins the columns of a table that are measured lengths
_LONGEST_NAME = 100  # letters of an item's folder
_Stature = Annotated[float | None, Key(least=1.0, most=2.5)]


class Sessions(NamedTuple):
    """``[sessions]``: globs, or a table with a row for each session."""

    files: tuple[str, ...] = ()
    table: str = ""
    subject: str = ""


class Session(NamedTuple):
    """A session, as a row of a table names it."""

    session: str  # resolved path or URL
    name: str = ""
    subject: str = ""
    stature: _Stature = None
    sex: Literal["", "f", "m"] = ""
    measured: Mapping[str, float] = {}


class Subject(NamedTuple):
    """``[subjects.NAME]``."""

    calibration: str = ""
    file: str = ""
    stature: _Stature = None
    sex: Literal["", "f", "m"] = ""
    measured: Mapping[str, float] = {}


K = TypeVar("K", Session, Subject)


@dataclass(frozen=True)
class Item:
    """One session and its steps.

    Parameters
    ----------
    name : of its folder, unique in the plan
    session, subject_file : paths or URLs
    subject : a name of the plan
    steps : step → the options that the plan gives
    person : the options of `calibrate` that are known of the person: "stature", "sex", "measured"
    """

    name: str
    session: str
    steps: Mapping[str, Mapping[str, Any]]
    subject: str | None = None
    subject_file: str | None = None
    person: Mapping[str, Any] = field(default_factory=dict)


class Plan(NamedTuple):
    """The items of a study, in the order of the file; `calibrations` of subjects run before `items`."""

    calibrations: tuple[Item, ...]
    items: tuple[Item, ...]

    @property
    def all_items(self) -> tuple[Item, ...]:
        return (*self.calibrations, *self.items)


def read_plan(path: Path, items_folder: str) -> Plan:
    """Read a plan and find its sessions; `items_folder` will hold the items' folders.

    Raises
    ------
    WeposeError
        With one line that names the file, the key, the value found and what would be right.
    """
    top = TomlTable(read_toml(path, "a plan", BadPlan), str(path), error=BadPlan)
    top.allow("sessions", "subjects", "steps")
    steps = _read_steps(top.table("steps"), path)
    tables = top.table("subjects", {})
    subjects = {name: _read_subject(tables.table(name), path) for name in tables.values}
    calibrations: dict[str, Item] = {}
    items: dict[str, Item] = {}
    for keys in _list_sessions(top.table("sessions"), path):
        session = _read_keys(Session, keys)
        person, own, subject = _find_person(session), steps, Subject()
        if session.subject and (subjects or "calibrate" not in steps):
            if session.subject not in subjects:
                raise BadPlan(
                    f"{keys.where}: subject '{session.subject}' is not in the plan; {one_of(subjects, session.subject)}"
                )
            subject = subjects[session.subject]
            person = person or _find_person(subject)
        file = subject.file
        if subject.calibration:
            if "calibrate" not in steps:
                raise BadPlan(f"{tables.at(session.subject)}.calibration: needs the step [steps.calibrate]")
            name, only = f"subject-{_sanitize(session.subject)}", {"calibrate": steps["calibrate"]}
            calibrations[name] = Item(name, subject.calibration, only, session.subject, person=person)
            file = f"{items_folder}/{name}/calibrate/subject.toml"
        if file:
            own = {step: options for step, options in steps.items() if step != "calibrate"}
        if not own:
            raise BadPlan(f"{keys.where}: nothing to do: its subject is calibrated elsewhere; it needs another step")
        name = _sanitize(session.name) or _derive_name(session.session, path)
        if name in items or name in calibrations:
            raise BadPlan(f"{keys.where}: '{name}' names two items; the column 'name' of a table can name them")
        items[name] = Item(name, session.session, own, session.subject or None, file or None, person)
    return Plan(tuple(calibrations.values()), tuple(items.values()))


def write_words(step: str, places: Sequence[str], options: Mapping[str, Any]) -> list[str]:
    """The command line of a step: places by position, options as TOML or JSON have them."""
    words = [step, *places]
    for name, value in options.items():
        switch = f"--{name.replace('_', '-')}"
        if isinstance(value, bool):
            words.append(switch if value else f"--no-{switch[2:]}")
        elif isinstance(value, Mapping):
            words += [f"{switch}={key}={entry}" for key, entry in value.items()]
        elif isinstance(value, list):
            words += [switch, *map(str, value)]
        else:
            words.append(f"{switch}={value}")
    return words


def _read_steps(table: TomlTable, path: Path) -> dict[str, dict[str, Any]]:
    """Step → the options that are given, in the order in which the steps run; each is checked before any work."""
    from ..writers.export import ROBOTS, list_formats

    formats = [name for name, format in list_formats().items() if format.of != ROBOTS]
    table.allow(*STEPS)
    steps: dict[str, dict[str, Any]] = {}
    for step in [step for step in STEPS if step in table]:
        keys = table.table(step)
        steps[step] = options = dict(keys.values)
        for name, value in options.items():  # a file beside the plan, such as a protocol
            if isinstance(value, str) and (path.parent / value).is_file():
                options[name] = str((path.parent / value).absolute())
        if step not in ("calibrate", "track") and "track" not in steps:
            raise BadPlan(f"{keys.where}: needs the step [steps.track], which is missing")
        command = APP[step].default_command
        assert command is not None
        known = [name for name in inspect.signature(command).parameters if name not in (*STEPS[step], *_ITEM_OPTIONS)]
        keys.allow(*known, *(["formats"] * (step == "export")))
        if step == "export":
            for each in keys.texts("formats") or ("",):
                if each not in formats:
                    raise BadPlan(
                        f"{keys.at('formats')}: '{each}' is no format of a person's motion; {one_of(formats, each)}"
                    )
        given = {name: value for name, value in options.items() if name != "formats"}
        try:
            parse(write_words(step, STEPS[step], given | ({} if step == "evaluate" else {"out": "OUT"})))
        except WeposeError as error:
            raise BadPlan(f"{keys.where}: {error}") from None
    if not steps:
        raise BadPlan(f"{table.where}: no step; {one_of(STEPS)}")
    return steps


def _read_subject(keys: TomlTable, path: Path) -> Subject:
    subject = _read_keys(Subject, keys)
    if subject.calibration and subject.file:
        raise BadPlan(f"{keys.at('file')}: a subject has a file or a calibration, not both")
    calibration, file = (place and _resolve(place, path) for place in subject[:2])
    for place in (calibration, file):
        if place and not is_remote(place) and not Path(place).exists():
            raise BadPlan(f"{keys.where}: {place}: no such file; a path from the plan's folder, or a URL, is needed")
    return subject._replace(calibration=calibration, file=file)


def _read_keys(kind: type[K], keys: TomlTable) -> K:
    keys.table("measured", {}).allow(*load_table().lengths)
    return read_record(kind, keys)


def _find_person(record: Session | Subject) -> dict[str, Any]:
    """The options of `calibrate` that are given of a person."""
    return {name: value for name in _PERSON if (value := getattr(record, name))}


def _list_sessions(keys: TomlTable, path: Path) -> list[TomlTable]:
    """A table a session, with the keys of `Session`."""
    sessions = read_record(Sessions, keys)
    if bool(sessions.files) == bool(sessions.table):
        raise BadPlan(f"{keys.where}: either files (globs) or table is needed")
    if "" in sessions.files:
        raise BadPlan(f"{keys.at('files')}: '' is no glob; one from the plan's folder is needed, such as \"data/*\"")
    found: list[TomlTable] = []
    if sessions.files:
        urls: dict[str, None] = {}
        for pattern in sessions.files:
            matches = find_urls(_resolve(pattern, path))
            if not matches:
                raise BadPlan(f"{keys.at('files')}: '{pattern}' finds nothing; a glob from the plan's folder is needed")
            urls |= dict.fromkeys(matches)
        own = {"subject": sessions.subject} if sessions.subject else {}
        return [TomlTable({"session": url, **own}, str(path), f"sessions: {url}.", BadPlan) for url in urls]
    file = path.parent / sessions.table
    for k, cells in enumerate(read_table(file).iter_rows(named=True), 1):
        row = {name: value for name, value in cells.items() if value is not None and value != ""}
        row |= {name: str(row[name]) for name in ("session", "name", "subject") if name in row}
        if "session" not in row:
            raise BadPlan(f"{file}: row {k}: session is empty; the columns are {', '.join(cells)}")
        row["session"] = _resolve(row["session"], file)
        measured = {name.removeprefix(_MEASURED): row.pop(name) for name in list(row) if name.startswith(_MEASURED)}
        found.append(TomlTable(row | ({"measured": measured} if measured else {}), str(file), f"row {k}.", BadPlan))
    return found


def _derive_name(session: str, path: Path) -> str:
    """A name from the path of a session: its folders below the plan's, or below the bucket."""
    place = (
        session.partition("://")[2].partition("/")[2] if is_remote(session) else os.path.relpath(session, path.parent)
    )
    return _sanitize(re.sub(r"/?session\.toml$|\.toml$", "", place).replace("/", "-").lstrip(".-")) or "session"


def _sanitize(text: str) -> str:
    """A text as the name of a folder."""
    return re.sub(r"[^\w.-]+", "_", text, flags=re.ASCII).lstrip(".")[:_LONGEST_NAME]


def _resolve(text: str, path: Path) -> str:
    """A path from the folder of the file that names it; URLs stay."""
    return text if is_remote(text) else str((path.parent / text).absolute())
