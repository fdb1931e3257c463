"""The plan (``PLAN.toml``): sessions, their subjects, the steps with their options. Places are paths or URLs."""

import contextlib
import glob
import inspect
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..body import list_breadths, load_table
from ..commands.options import APP, parse
from ..data_tables import read_table
from ..documents import TomlTable, read_toml
from ..errors import BadOption, BadPlan, MissingFile, WeposeError, one_of, reason

# Step → what its command takes by position; in the order in which they run.
STEPS = {
    "calibrate": ("session",),
    "track": ("session",),
    "retarget": ("result",),
    "export": ("result",),
    "evaluate": ("result", "truth"),
}
_LONGEST_NAME = 100  # letters of an item's folder
PERSON = ("stature", "sex", "measured")  # options of `calibrate` that belong to a person
# Follow from an item's session and subject, or are not of one session.
_ITEM_OPTIONS = ("out", "subject", "format", "episodes", "instruction", "force", *PERSON)


@dataclass(frozen=True)
class Item:
    """One session and its steps."""

    name: str  # of its folder, unique in the plan
    session: str  # path or URL
    steps: Mapping[str, Mapping[str, Any]]  # step → the options that the plan gives
    subject: str | None = None  # a name of the plan
    subject_file: str = ""  # path or URL
    person: Mapping[str, Any] = field(default_factory=dict)  # options of `calibrate`


def read_plan(path: Path, items_folder: str) -> tuple[list[Item], list[Item]]:
    """Calibrations of subjects and the items that need them, in the order of the plan; find its sessions.

    `items_folder` will hold the items' folders. A mistake is a `WeposeError`.
    """
    top = TomlTable(read_toml(path, "a plan", BadPlan), str(path), error=BadPlan)
    top.allow("sessions", "subjects", "steps")
    steps = _read_steps(top.table("steps"), path)
    tables = top.table("subjects", {})
    subjects = {name: _read_subject(tables.table(name), path, steps) for name in tables.values}
    calibrations: dict[str, Item] = {}
    items: dict[str, Item] = {}
    for keys in _list_sessions(top.table("sessions"), path):
        session, name = keys.values["session"], keys.text("subject", None)
        if name and name not in subjects and (subjects or "calibrate" not in steps):
            raise BadPlan(f"{keys.where}: subject '{name}' is not in the plan; {one_of(subjects, name)}")
        person, file, calibration = subjects.get(name or "", ({}, "", ""))
        person = _read_person(keys, "session", "name", "subject") or person
        if calibration:
            folder = f"subject-{_sanitize(name or '')}"
            calibrations[folder] = Item(folder, calibration, {"calibrate": steps["calibrate"]}, name, person=person)
            file = f"{items_folder}/{folder}/calibrate/subject.toml"
        own = {step: options for step, options in steps.items() if not (file and step == "calibrate")}
        if not own:
            raise BadPlan(f"{keys.where}: nothing to do: its subject is calibrated elsewhere; it needs another step")
        folder = _sanitize(keys.text("name", None) or "") or _derive_name(session, path)
        if folder in items or folder in calibrations:
            raise BadPlan(f"{keys.where}: '{folder}' names two items; the column 'name' of a table can name them")
        items[folder] = Item(folder, session, own, name, file, person)
    return list(calibrations.values()), list(items.values())


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

    table.allow(*STEPS)
    steps: dict[str, dict[str, Any]] = {}
    for step in [step for step in STEPS if step in table]:
        keys = table.table(step)
        steps[step] = options = dict(keys.values)
        command = APP[step].default_command
        assert command is not None
        known = [name for name in inspect.signature(command).parameters if name not in (*STEPS[step], *_ITEM_OPTIONS)]
        keys.allow(*known, *(["formats"] * (step == "export")))
        for name, value in options.items():
            if isinstance(value, str) and (path.parent / value).is_file():  # beside the plan, such as a protocol
                options[name] = str((path.parent / value).absolute())
        if step not in ("calibrate", "track") and "track" not in steps:
            raise BadPlan(f"{keys.where}: needs the step [steps.track], which is missing")
        if step == "export":
            options["formats"] = list(keys.texts("formats"))
            formats = [name for name, format in list_formats().items() if format.of != ROBOTS]
            for each in options["formats"] or [""]:
                if each not in formats:
                    place = keys.at("formats")
                    raise BadPlan(f"{place}: '{each}' is no format of a person's motion; {one_of(formats, each)}")
        _check_options(keys, step, {name: value for name, value in options.items() if name != "formats"})
    if not steps:
        raise BadPlan(f"{table.where}: no step; {one_of(STEPS)}")
    return steps


def _check_options(keys: TomlTable, step: str, options: Mapping[str, Any]) -> None:
    """Raise `BadPlan` where the command of a step refuses its options."""
    try:
        parse(write_words(step, STEPS[step], {**options, **({} if step == "evaluate" else {"out": "OUT"})}))
    except WeposeError as error:
        raise BadPlan(f"{keys.where}: {error}") from None


def _read_subject(keys: TomlTable, path: Path, steps: Collection[str]) -> tuple[Mapping[str, Any], str, str]:
    """What is known of a person, and the file or the session of the calibration, if any, else each session's own."""
    person = _read_person(keys, "file", "calibration")
    file, calibration = (_resolve(keys.text(name, None) or "", path) for name in ("file", "calibration"))
    if calibration and file:
        raise BadPlan(f"{keys.at('file')}: a subject has a file or a calibration, not both")
    if calibration and "calibrate" not in steps:
        raise BadPlan(f"{keys.at('calibration')}: needs the step [steps.calibrate]")
    place = calibration or file
    if place and not is_remote(place) and not Path(place).exists():
        raise BadPlan(f"{keys.where}: {place}: no such file; a path from the plan's folder, or a URL, is needed")
    return person, file, calibration


def _read_person(keys: TomlTable, *others: str) -> dict[str, Any]:
    """The options of `calibrate` that are given of a person, in a table with these other keys."""
    keys.allow(*PERSON, *others)
    body = load_table()
    keys.table("measured", {}).allow(*body.lengths, *list_breadths(body))
    person = {name: keys.values[name] for name in PERSON if keys.values.get(name) not in (None, "", {})}
    if person:
        _check_options(keys, "calibrate", person)
    return person


def _list_sessions(keys: TomlTable, path: Path) -> Iterator[TomlTable]:
    """A table a session, with the keys "session", "name", "subject" and those of a person."""
    keys.allow("files", "table", "subject")
    if bool(keys.texts("files")) == ("table" in keys):
        raise BadPlan(f"{keys.where}: either files (globs) or table is needed")
    own = {"subject": subject} if (subject := keys.text("subject", None)) else {}
    urls: dict[str, None] = {}
    for pattern in keys.texts("files"):
        matches = find_urls(_resolve(pattern, path))
        if not matches:
            raise BadPlan(f"{keys.at('files')}: '{pattern}' finds nothing; a glob from the plan's folder is needed")
        urls |= dict.fromkeys(matches)
    for url in urls:
        yield TomlTable({"session": url, **own}, str(path), f"sessions: {url}.", BadPlan)
    if "table" not in keys:
        return
    file = path.parent / (keys.text("table", None) or "")
    for k, cells in enumerate(read_table(file).iter_rows(named=True), 1):
        row = {name: value for name, value in cells.items() if value is not None and value != ""}
        row |= {name: str(row[name]) for name in ("session", "name", "subject") if name in row}
        if "session" not in row:
            raise BadPlan(f"{file}: row {k}: session is empty; the columns are {', '.join(cells)}")
        row["session"] = _resolve(row["session"], file)
        lengths = [name for name in row if name.startswith("measured.")]
        row |= {"measured": {name.removeprefix("measured."): row.pop(name) for name in lengths}}
        yield TomlTable(own | row, str(file), f"row {k}.", BadPlan)


def _derive_name(session: str, path: Path) -> str:
    """A name from the path of a session: its folders below the plan's, or below the bucket."""
    place = re.sub("^.*?://[^/]*/", "", session) if is_remote(session) else os.path.relpath(session, path.parent)
    return _sanitize(re.sub(r"/?session\.toml$|\.toml$", "", place).replace("/", "-").lstrip(".-")) or "session"


def _sanitize(text: str) -> str:
    return re.sub(r"[^\w.-]+", "_", text, flags=re.ASCII).lstrip(".")[:_LONGEST_NAME]


def _resolve(text: str, path: Path) -> str:
    """A path from the folder of the file that names it; URLs and an empty text stay."""
    return text if is_remote(text) or not text else str((path.parent / text).absolute())


# Places of files ------------------------------------------------------------------------------------------------------


def is_remote(url: str) -> bool:
    return "://" in url


@contextlib.contextmanager
def open_filesystem(url: str) -> Iterator[tuple[Any, str]]:
    """The file system of a URL and the path on it; errors of a store, which has many kinds of its own, as one line."""
    try:
        import fsspec
    except ImportError as error:
        raise BadOption(f"{url}: {error}: pip install fsspec") from None
    try:
        yield fsspec.core.url_to_fs(url, use_listings_cache=False)  # a worker lives longer than listings stay true
    except WeposeError:
        raise
    except Exception as error:
        raise MissingFile(f"{url}: cannot be reached: {reason(error)}") from error


def find_urls(pattern: str) -> list[str]:
    """Files or folders that match a path or glob, sorted."""
    if not is_remote(pattern):
        return sorted(glob.glob(pattern, recursive=True))
    with open_filesystem(pattern) as (system, path):
        return sorted(system.unstrip_protocol(match) for match in system.glob(path))
