"""The plan (``PLAN.toml``): sessions, their subjects, and the steps with their options."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from ..body import load_table
from ..body.anthropometry import check_stature
from ..commands.command_line import APP, parse
from ..data_tables import read_table
from ..documents import TomlTable, read_toml
from ..errors import BadData, BadPlan, BadSession, WeposeError, WrongOption, one_of
from .storage import find_urls, is_remote

# Step → what its command takes by position; in the order in which they run.
STEPS = {
    "calibrate": ("session",),
    "track": ("session",),
    "retarget": ("result",),
    "export": ("result",),
    "evaluate": ("result", "truth"),
}
_PERSON = ("stature", "sex", "measured")
# Follow from an item's session and subject, or are not of one session.
_ITEM_OPTIONS = ("out", "subject", "further", "format", "episodes", "instruction", *_PERSON, "force")
_REMOVED = {"name": "was for the page of a study, which is gone; remove it"}
_MEASURED = "measured."  # begins the columns of a table that are measured lengths
_LONGEST_NAME = 100  # letters of an item's folder


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


@dataclass(frozen=True)
class Plan:
    """The items of a study, in the order of the file; `calibrations` of subjects run before `items`."""

    calibrations: tuple[Item, ...]
    items: tuple[Item, ...]

    @property
    def all_items(self) -> tuple[Item, ...]:
        return (*self.calibrations, *self.items)


class _Subject(NamedTuple):
    calibration: str | None
    file: str | None
    person: dict[str, Any]


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
    top = TomlTable(read_toml(path, "a plan"), str(path), error=BadPlan)
    top.allow("sessions", "subjects", "steps", renamed=_REMOVED)
    steps = _read_steps(top.table("steps"), path)
    lengths = tuple(load_table().lengths)
    tables = top.table("subjects", {})
    subjects = {name: _read_subject(tables.table(name), path, lengths) for name in tables.values}
    calibrations: dict[str, Item] = {}
    items: dict[str, Item] = {}
    for keys in _list_sessions(top, path):
        item, subject = _build_item(keys, path, steps, subjects, lengths)
        if subject is not None and subject.calibration is not None:
            if "calibrate" not in steps:
                raise BadPlan(f"{tables.at(str(item.subject))}.calibration: needs the step [steps.calibrate]")
            name, only = f"subject-{_sanitize(str(item.subject))}", {"calibrate": steps["calibrate"]}
            calibrations[name] = Item(name, subject.calibration, only, item.subject, person=subject.person)
            item = replace(item, subject_file=f"{items_folder}/{name}/calibrate/subject.toml")
        if item.name in items:
            raise BadPlan(f"{keys.where}: '{item.name}' names two items; the column 'name' of a table can name them")
        items[item.name] = item
    if both := items.keys() & calibrations.keys():
        raise BadPlan(f"{path}: '{min(both)}' is both a session's and a subject's item; give the session a name")
    return Plan(tuple(calibrations.values()), tuple(items.values()))


# Steps ---------------------------------------------------------------------------------------------------------------


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
    table.allow(*STEPS)
    steps: dict[str, dict[str, Any]] = {}
    for step in [step for step in STEPS if step in table]:
        keys = table.table(step)
        steps[step] = {name: _resolve_option(value, path) for name, value in keys.values.items()}
        if step not in ("calibrate", "track") and "track" not in steps:
            raise BadPlan(f"{keys.where}: needs the step [steps.track], which is missing")
        command = APP[step].default_command
        assert command is not None
        known = inspect.signature(command).parameters
        keys.allow(*(name for name in known if name not in (*STEPS[step], *_ITEM_OPTIONS)), "formats")
        if step == "export":
            _check_formats(keys)
        options = {name: value for name, value in steps[step].items() if name != "formats"}
        options |= {} if step == "evaluate" else {"out": "OUT"}
        try:
            parse(write_words(step, STEPS[step], options))
        except BadSession:
            raise
        except WrongOption as error:
            raise BadPlan(f"{keys.at(error.name.replace('-', '_'))} = {error.value}: {error.needed}") from None
        except WeposeError as error:
            raise BadPlan(f"{keys.where}: {error}") from None
    if not steps:
        raise BadPlan(f"{table.where}: no step; {one_of(STEPS)}")
    return steps


def _resolve_option(value: Any, path: Path) -> Any:
    """An option; a text that names a file beside the plan, such as a protocol, as its path."""
    file = path.parent / value if isinstance(value, str) else path
    return str(file.absolute()) if isinstance(value, str) and file.is_file() else value


def _check_formats(keys: TomlTable) -> None:
    from ..writers.export import LEROBOT, REMOVED, list_formats

    formats = keys.values.get("formats")
    if not isinstance(formats, list) or not formats:
        raise BadPlan(f'{keys.at("formats")} = {formats!r} is not a list of formats, such as ["trc", "mot"]')
    persons = [name for name in list_formats() if name != LEROBOT]  # a robot's alone
    for each in formats:
        if each in REMOVED:
            raise BadPlan(f"{keys.at('formats')}: '{each}' is no longer written; {REMOVED[each]}")
        if each not in persons:
            raise BadPlan(
                f"{keys.at('formats')}: '{each}' is no format of a person's motion; {one_of(persons, str(each))}"
            )


# Subjects and sessions -----------------------------------------------------------------------------------------------


def _read_subject(keys: TomlTable, path: Path, lengths: Sequence[str]) -> _Subject:
    keys.allow("calibration", "file", *_PERSON)
    calibration, file = (_resolve(keys.text(key, None), path) for key in ("calibration", "file"))
    if calibration is not None and file is not None:
        raise BadPlan(f"{keys.at('file')}: a subject has a file or a calibration, not both")
    for key, place in (("calibration", calibration), ("file", file)):
        if place is not None and not is_remote(place) and not Path(place).exists():
            raise BadPlan(f"{keys.at(key)} = '{keys.values[key]}': no such file; a path from the plan's folder, or URL")
    return _Subject(calibration, file, _read_person(keys, lengths))


def _read_person(keys: TomlTable, lengths: Sequence[str]) -> dict[str, Any]:
    """The options of `calibrate` that are given of a person."""
    table = keys.table("measured", {})
    table.allow(*lengths)
    stature = keys.number("stature", None, positive=True)
    try:
        check_stature(stature)
    except WeposeError as error:
        raise BadPlan(f"{keys.where}: {error}") from None
    sex = {"sex": keys.choice("sex", ("f", "m"))} if "sex" in keys else {}
    measured = {name: table.number(name, None, positive=True) for name in table.values}
    return sex | ({"stature": stature} if stature else {}) | ({"measured": measured} if measured else {})


def _list_sessions(top: TomlTable, path: Path) -> list[TomlTable]:
    """A table a session: `session` (a resolved path or URL), and what a table's row has besides."""
    if isinstance(top.values.get("sessions"), list):
        raise BadPlan(f"{top.at('sessions')}: several [[sessions]] are one [sessions] with a table of them now")
    keys = top.table("sessions")
    keys.allow("files", "table", "subject")
    if ("files" in keys) == ("table" in keys):
        raise BadPlan(f"{keys.where}: either files (globs) or table is needed")
    if "table" in keys:
        if "subject" in keys:
            raise BadPlan(f"{keys.at('subject')}: a table has a column for it")
        return _read_table(path.parent / str(keys.text("table", None)))
    patterns = keys.values["files"]
    patterns = [patterns] if isinstance(patterns, str) else patterns
    if not isinstance(patterns, list) or not patterns or not all(isinstance(each, str) and each for each in patterns):
        raise BadPlan(f'{keys.at("files")} = {patterns!r} is not a list of globs, such as ["data/*/session.toml"]')
    urls: dict[str, None] = {}
    for pattern in patterns:
        matches = find_urls(str(_resolve(pattern, path)))
        if not matches:
            raise BadPlan(f"{keys.at('files')}: '{pattern}' finds nothing; it is a path or glob from the plan's folder")
        urls |= dict.fromkeys(matches)
    own = {"subject": keys.values["subject"]} if "subject" in keys else {}
    return [TomlTable({"session": url, **own}, str(path), f"sessions: {url}.", BadPlan) for url in urls]


def _read_table(file: Path) -> list[TomlTable]:
    table = read_table(file)
    if "session" not in table.columns:
        raise BadPlan(f"{file}: no column 'session'; {one_of(table.columns, 'session')}")
    sessions = []
    for k, cells in enumerate(table.iter_rows(named=True), 1):
        row = {name: value for name, value in cells.items() if value is not None and value != ""}
        row |= {name: str(row[name]) for name in ("session", "name", "subject") if name in row}
        if "session" not in row:
            raise BadPlan(f"{file}: row {k}: session is empty")
        row["session"] = _resolve(row["session"], file)
        measured = {name.removeprefix(_MEASURED): row.pop(name) for name in list(row) if name.startswith(_MEASURED)}
        sessions.append(TomlTable(row | ({"measured": measured} if measured else {}), str(file), f"row {k}.", BadPlan))
    return sessions


def _build_item(
    keys: TomlTable,
    path: Path,
    steps: Mapping[str, Mapping[str, Any]],
    subjects: Mapping[str, _Subject],
    lengths: Sequence[str],
) -> tuple[Item, _Subject | None]:
    """The item of a session, calibrated by itself or tracked with the calibration of its subject; that subject."""
    keys.allow("session", "name", "subject", *_PERSON)
    person, subject, name = _read_person(keys, lengths), None, keys.text("subject", None)
    if name is not None and (subjects or "calibrate" not in steps):
        if name not in subjects:
            raise BadPlan(f"{keys.where}: subject '{name}' is not in the plan; {one_of(subjects, name)}")
        subject = subjects[name]
        person = person or subject.person
    elsewhere = subject is not None and (subject.file or subject.calibration)
    own = {step: options for step, options in steps.items() if not (step == "calibrate" and elsewhere)}
    if not own:
        raise BadPlan(f"{keys.where}: nothing to do: its subject is calibrated elsewhere, and there is no other step")
    session = str(keys.values["session"])
    item_name = _sanitize(given) if (given := keys.text("name", None)) else _derive_name(session, path)
    if not item_name:
        raise BadPlan(f"{keys.where}: name '{given}' has no letter or digit; an item's folder has that name")
    file = subject.file if subject is not None else None
    return Item(item_name, session, own, name, file, person), subject


def _derive_name(session: str, path: Path) -> str:
    """A name from the path of a session: its folders below the plan's, or below the bucket."""
    place = (
        session.partition("://")[2].partition("/")[2] if is_remote(session) else os.path.relpath(session, path.parent)
    )
    return _sanitize(re.sub(r"/?session\.toml$|\.toml$", "", place).replace("/", "-").lstrip(".-")) or "session"


def _sanitize(text: str) -> str:
    """A text as the name of a folder."""
    return re.sub(r"[^\w.-]+", "_", text, flags=re.ASCII).lstrip(".")[:_LONGEST_NAME]


def _resolve(text: str | None, path: Path) -> str | None:
    """A path from the folder of the file that names it; URLs stay."""
    if text is None or is_remote(text):
        return text
    return str((path.parent / text).absolute())
