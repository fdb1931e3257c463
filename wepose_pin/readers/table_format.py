"""Tables of devices: a TOML describes how a vendor writes them, and one engine reads them all.

A description (`formats/*.toml`, or a user's own, docs/formats.md) says how a file is recognised, which lines
belong to the names of its columns, which columns are whose gyroscope, accelerometer or orientation, their units, and
the clock.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ..data_tables import parse_rows, read_body, read_columns
from ..diagnostics import WARNING, Diagnostic
from ..documents import TomlTable, read_toml
from ..errors import BadData, BadSession, MissingFile, MissingRate
from .device import (
    NEEDED,
    Device,
    Signal,
    check_measured,
    convert,
    make_device,
    open_folder,
    read_first_lines,
    spread_equal_times,
)

FOLDER = Path(__file__).parent / "formats"
SEPARATORS = "\t,; "
MOST_LINES = 2000  # before the names; some exports have a line for each channel
MOST_AFTER = 4  # lines of text between the names and the numbers
AXES = {"gyro": "xyz", "accel": "xyz", "orientation": "wxyz"}
_NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)(e[-+]?\d+)?|\d{4}[/-]\d.*", re.IGNORECASE)
_STATED_RATE = re.compile(r"\d+(\.\d*)?(?![\d.])")


# What a TOML says --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Columns:
    """Columns of a signal.

    Parameters
    ----------
    names : of the columns in their order, of a file with one sensor; x, y, z of vectors. An orientation has w, x, y, z,
        or the nine cells of a matrix by rows, or roll, pitch and yaw [deg]
    pattern : of such names instead, with a group `axis`, and `sensor`, `side` (a further part of its name), `unit`
    unit : where neither the name nor a line of units has it
    limit : [SI] where a value is beyond, the next columns of the format are taken if they are there
    increments : the values are increments over a sample: a quaternion of the rotation, m/s
    """

    names: tuple[str, ...] = ()
    pattern: re.Pattern[str] | None = None
    unit: str = ""
    limit: float = np.inf
    increments: bool = False

    def match(self, name: str, axes: str) -> tuple[str, int, str] | None:
        """Return sensor, index among the columns, and unit of a column; None: it is none of these."""
        if self.pattern is None:
            return ("", self.names.index(name), "") if name in self.names else None
        match = self.pattern.fullmatch(name)
        if match is None:
            return None
        groups = match.groupdict()
        sensor = f"{(groups.get('sensor') or '').strip()} {(groups.get('side') or '').strip()}".strip()
        axis = match["axis"][:1].lower().replace("s", "w")  # APDM calls the w of a quaternion its scalar
        return (sensor, axes.index(axis), groups.get("unit") or "") if axis in axes else None


@dataclass(frozen=True)
class ClockColumn:
    """A column that gives the time.

    Parameters
    ----------
    column : pattern of its name; a group `sensor` says whose it is
    unit_s : [s]
    wraps : value at which it begins again at 0
    rate : pattern of the line before the table that states the rate of which the column counts the samples
    date : how it is written where it is no number
    spread : equal times are those of a packet, and are spread up to the next
    """

    column: re.Pattern[str]
    unit_s: float
    wraps: float | None
    rate: re.Pattern[str] | None
    date: str | None
    spread: bool


@dataclass(frozen=True)
class TableFormat:
    """A description of tables; keys as in docs/formats.md."""

    name: str
    title: str
    needs: str
    detect: tuple[re.Pattern[str], ...]
    suffixes: tuple[str, ...]
    whole: bool
    files: Mapping[str, str]
    clocks: tuple[ClockColumn, ...]
    signals: Mapping[str, tuple[Columns, ...]]
    times_before: bool
    sensors_line: int
    sensor_begins: re.Pattern[str] | None
    axes_line: int
    units_line: int
    units_before: re.Pattern[str] | None
    label_line: str | None
    label_in_name: re.Pattern[str] | None
    sync_line: str | None

    def is_time(self, name: str) -> bool:
        """Return whether a column of this name gives the time."""
        return any(clock.column.fullmatch(name) for clock in self.clocks)

    def is_signal(self, name: str) -> bool:
        """Return whether a column of this name is one of a signal."""
        return any(columns.match(name, AXES[signal]) for signal, each in self.signals.items() for columns in each)


def load_format(path: Path) -> TableFormat:
    """Load a description.

    Raises
    ------
    WeposeError
        The file is missing or no description: an unknown or wrong key, a pattern that is none.
    """
    keys = TomlTable(read_toml(path, "a description of tables"), str(path))
    keys.allow(
        *("title", "needs", "detect", "suffixes", "whole", "files", "clock", *AXES, "times_before"),
        *("sensors_line", "sensor_begins", "axes_line", "units_line", "units_before", "label_line"),
        *("label_in_name", "sync_line"),
    )
    signals = {signal: tuple(_read_signal(table, signal) for table in keys.entries(signal)) for signal in AXES}
    clocks = tuple(_read_clock(table) for table in keys.entries("clock"))
    lacking = next((signal for signal in NEEDED["raw"] if not signals[signal]), None)
    if lacking and (any(signals[signal] for signal in NEEDED["raw"]) or not signals["orientation"]):
        raise BadSession(f"{keys.at(lacking)} is missing; [[gyro]] and [[accel]], or [[orientation]] alone are needed")
    if not clocks:
        raise BadSession(f"{keys.at('clock')} is missing; a table [[clock]] with its column is needed")
    files = keys.table("files", {})
    files.allow(*NEEDED)
    return TableFormat(
        name=path.stem,
        title=keys.text("title", path.stem) or path.stem,
        needs=keys.text("needs", " and ".join(signal for signal in AXES if signals[signal])) or "",
        detect=tuple(_compile(keys.at("detect"), text, flags=re.S | re.M) for text in keys.texts("detect")),
        suffixes=keys.texts("suffixes"),
        whole=keys.flag("whole"),
        files={kind: files.text(kind, None) or "" for kind in files.values},
        clocks=clocks,
        signals=signals,
        times_before=keys.flag("times_before"),
        sensors_line=_read_line(keys, "sensors_line"),
        sensor_begins=_pattern(keys, "sensor_begins"),
        axes_line=_read_line(keys, "axes_line"),
        units_line=_read_line(keys, "units_line"),
        units_before=_pattern(keys, "units_before", "name", "unit"),
        label_line=keys.text("label_line", None),
        label_in_name=_pattern(keys, "label_in_name", "label"),
        sync_line=keys.text("sync_line", None),
    )


@cache
def load_formats() -> Mapping[str, TableFormat]:
    """Load the descriptions in the package: name → description."""
    return {path.stem: load_format(path) for path in sorted(FOLDER.glob("*.toml"))}


def _read_line(keys: TomlTable, key: str) -> int:
    """Read the place of a line, counted from the line of names; 0: there is none."""
    line = keys.number(key, 0.0) or 0.0
    if line != round(line) or abs(line) > MOST_AFTER:
        raise BadSession(f"{keys.at(key)} = {line:g}; a number of lines from that of the names is needed, such as -1")
    return int(line)


def _compile(place: str, text: str, *groups: str, flags: int = re.IGNORECASE) -> re.Pattern[str]:
    """Compile a regular expression that has these groups."""
    try:
        pattern = re.compile(text, flags)
    except (re.error, RecursionError, OverflowError) as error:
        raise BadSession(f"{place} = '{text}' is no regular expression: {error}") from None
    if lacking := [group for group in groups if group not in pattern.groupindex]:
        raise BadSession(f"{place} = '{text}' has no group (?P<{lacking[0]}>…)")
    return pattern


def _pattern(keys: TomlTable, key: str, *groups: str) -> re.Pattern[str] | None:
    text = keys.text(key, None)
    return None if text is None else _compile(keys.at(key), text, *groups)


def _read_signal(keys: TomlTable, signal: str) -> Columns:
    keys.allow("columns", "unit", "limit", "increments")
    increments, names = keys.flag("increments"), keys.values.get("columns")
    pattern, listed = None, tuple[str, ...]()
    if isinstance(names, str):
        pattern = _compile(keys.at("columns"), names, "axis")
    else:
        counts = {"gyro": (4,) if increments else (3,), "accel": (3,), "orientation": (3, 4, 9)}[signal]
        count = len(names) if isinstance(names, list) and len(names) in counts else counts[0]
        listed = tuple(keys.names("columns", count))
    limit = keys.number("limit", None, positive=True) or np.inf
    return Columns(listed, pattern, keys.text("unit", None) or "", limit, increments)


def _read_clock(keys: TomlTable) -> ClockColumn:
    keys.allow("column", "unit_s", "wraps", "rate", "date", "spread")
    column = _pattern(keys, "column")
    if column is None:
        raise BadSession(f"{keys.at('column')} is missing; a pattern of the name of the column is needed")
    unit_s = keys.number("unit_s", 1.0, positive=True) or 1.0
    wraps, date = keys.number("wraps", None, positive=True), keys.text("date", None)
    return ClockColumn(column, unit_s, wraps, _pattern(keys, "rate"), date, keys.flag("spread"))


# Detection ---------------------------------------------------------------------------------------------------------


def detects(format: TableFormat, path: Path, start: str) -> bool:
    """Return whether a file that starts with this text, a folder, or a zip is of the format."""
    if path.is_file() and path.suffix.lower() != ".zip":
        if format.suffixes and path.suffix.lower() not in format.suffixes:
            return False
        matches = [bool(pattern.search(start)) for pattern in format.detect]
        # A table with all signals is one that needs no folder.
        return any(matches) and (len(matches) == 1 or (not all(matches) and detects(format, path.parent, "")))
    if not format.files:
        return False
    with open_folder(path) as files:
        named = {file for pattern in format.files.values() for file in _select(files, pattern)}
        starts = ["\n".join(read_first_lines(file, 3)) for file in named]
    matches = [any(pattern.search(text) for text in starts) for pattern in format.detect]
    return bool(matches) and all(matches)


def _select(files: Mapping[str, Path], pattern: str) -> list[Path]:
    return [file for name, file in files.items() if fnmatch.fnmatch(name, pattern)]


# Tables ------------------------------------------------------------------------------------------------------------


class Header(NamedTuple):
    """The names of the columns, and where they stand."""

    line: int
    separator: str
    names: list[str]
    units: list[str]
    first_row: int  # line of the first row


@dataclass(frozen=True)
class DeviceTable:
    """A table.

    Parameters
    ----------
    path : the file
    names, units : of the columns
    about : name → value of the lines `name: value` before the names
    cells : columns "0", "1", … that the description names, without rows that have no values in them
    times : column → times (n,) [s] that were read from it; None: of a rate
    """

    path: Path
    names: Sequence[str]
    units: Sequence[str]
    about: Mapping[str, str]
    cells: pl.DataFrame
    times: dict[int | None, np.ndarray] = field(default_factory=dict)

    def has_values(self, column: int) -> bool:
        """Whether any cell of a column has a value."""
        return bool(self.cells[str(column)].is_not_null().any())

    def numbers(self, columns: Sequence[int]) -> np.ndarray:
        """Return columns (n, k); empty cells are NaN."""
        names = [self.names[k] for k in columns]
        table = self.cells.select(pl.col(str(k)).alias(self.names[k]) for k in columns)
        values = read_columns(table, names, str(self.path), str(self.path))
        check_measured(self.path, values, ", ".join(names))
        return values


def _split(line: str, separator: str) -> list[str]:
    return [cell.strip(' "\r') for cell in line.split(separator)]


def _find_header(format: TableFormat, lines: Sequence[str]) -> Header | None:
    """Find the first line with a column of time and one of a signal."""
    for k, line in enumerate(lines):
        for separator in () if line.startswith(("//", "#")) else SEPARATORS:
            if line.count(separator) < 3:
                continue
            names, units = _name_columns(format, lines, k, separator)
            if any(map(format.is_time, names)) and any(map(format.is_signal, names)):
                first = k + 1 + max(format.axes_line, format.units_line, 0)
                for cells in (_split(row, separator) for row in lines[first : first + MOST_AFTER]):
                    if any(map(_NUMBER.fullmatch, cells)) and (cells[0] or not format.times_before):
                        break
                    first += 1
                return Header(k, separator, names, units, first)
    return None


def _name_columns(format: TableFormat, lines: Sequence[str], k: int, separator: str) -> tuple[list[str], list[str]]:
    """Name the columns of line k, as ``sensor/name/axis`` where these stand in lines of their own; and their units."""

    def read(offset: int) -> list[str]:
        return _split(lines[k + offset], separator) if offset and 0 <= k + offset < len(lines) else []

    own = _split(lines[k], separator)
    rows = [own, read(format.sensors_line), read(format.axes_line), read(format.units_line)]
    width = max(len(rows[0]), len(rows[2]))
    own, owners, axes, units = ([*row, *[""] * width][:width] for row in rows)
    if format.sensor_begins is None:
        begins = [column for column, owner in enumerate(owners) if owner]
    else:
        begins = [column for column, name in enumerate(own) if name and format.sensor_begins.fullmatch(name)]
    full, short, name = [""] * width, [""] * width, ""
    for count, (first, last) in enumerate(zip(begins, [*begins, width][1:], strict=True), 1):
        *numbers, title = [cell for cell in owners[first:last] if cell] or [f"sensor {count}"]
        full[first:last] = [" ".join([title, *numbers])] * (last - first)
        short[first:last] = [re.sub(r" *\(\d+\)$", "", title)] * (last - first)
    titles = [title for _, title in set(zip(full, short, strict=True))]  # of different sensors
    names = []
    for column in range(width):
        name = own[column] or (name if format.axes_line and axes[column] else "")
        owner = short[column] if titles.count(short[column]) == 1 else full[column]
        names.append("/".join(filter(None, (owner, name, axes[column]))))
    if format.units_before:
        stated = {match["name"]: match["unit"] for match in map(format.units_before.match, lines[:k]) if match}
        units = [stated.get(name, "") for name in own]
    return names, units


def parse_table(format: TableFormat, path: Path) -> DeviceTable | None:
    """Parse a table; None: it has no line of names as described.

    Raises
    ------
    MissingFile, BadData
        The file is not readable; no rows; zero bytes in it.
    """
    lines = read_first_lines(path, MOST_LINES)
    header = _find_header(format, lines)
    if header is None:
        return None
    about = {}
    for line in lines[: header.line]:
        name, colon, value = line.strip("/ ").partition(":")
        if colon:
            about[name.strip()] = value.strip(f" {SEPARATORS}")
    body = read_body(path, header.first_row)
    if b"\0" in body or not body.strip():
        found = "zero bytes" if body.strip() else f"no line of numbers after the names in line {header.line + 1}"
        raise BadData(f"{path}: there is {found} in it; the export is damaged, empty or cut off")
    width = max(len(header.names), body.partition(b"\n")[0].count(header.separator.encode()) + 1)
    last = max(k for k, name in enumerate(header.names) if name)
    columns = [str(k) for k, name in enumerate(header.names) if format.is_time(name) or format.is_signal(name)]
    cells = parse_rows(path, body, [str(k) for k in range(width)], header.separator, lenient=True)
    if cells.height and not body.endswith(b"\n") and cells[str(last)][-1] is None:
        cells = cells.head(-1)  # the last line is incomplete
    cells = cells.select(columns).filter(pl.any_horizontal(pl.all().is_not_null()))
    return DeviceTable(path, header.names, header.units, about, cells)


# Sensors -----------------------------------------------------------------------------------------------------------


@dataclass
class _Source:
    """Columns of a sensor's signal in a table, by index among those of `columns`."""

    table: DeviceTable
    columns: Columns
    places: dict[int, int] = field(default_factory=dict)
    unit: str = ""

    def is_complete(self, axes: str) -> bool:
        """Whether each column is there, with values."""
        count = len(self.columns.names) or len(axes)
        return len(self.places) == count and all(map(self.table.has_values, self.places.values()))

    def list_columns(self) -> list[int]:
        """List the columns in their order."""
        return [self.places[k] for k in sorted(self.places)]


_Sensors = dict[str, dict[str, list[_Source]]]  # sensor → signal → its complete columns, those to prefer first


def read_table_format(format: TableFormat, path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensors' raw data where they are there, else their orientations; `use` selects one of the two.

    `rate_hz` replaces the file's own times, or is the rate of its counter.

    Raises
    ------
    MissingFile, BadData
        Not there; no such table; no times; an unknown unit; not what `use` asks for.
    """
    tables = _open_tables(format, path, use)
    sensors = _find_sensors(format, tables)
    kind = use or next((kind for kind in NEEDED if _has(sensors, kind)), "raw")
    joins = format.times_before or len(tables) > 1  # a rate is that of the joined signals
    alone = tables[0].about.get(format.label_line or "") or _name_alone(format, path)
    found: dict[str, dict[str, Signal]] = {}
    wraps_s = None
    for sensor, signals in sensors.items():
        own = found.setdefault(sensor or alone, {})
        for name in NEEDED[kind] if set(NEEDED[kind]) <= set(signals) else ():
            first, *others = signals[name]
            time, wraps_s = _read_time(format, first, sensor, None if joins else rate_hz)
            values = _read_values(name, first, time)
            if others and (np.abs(values) > first.columns.limit).any():
                values = _read_values(name, others[0], time)
            own[name] = Signal(time, values)
    diagnostics = []
    # Clocks of devices that were not synchronized start at power-on.
    if format.sync_line and not tables[0].about.get(format.sync_line, "synced").lower().startswith("synced"):
        diagnostics.append(Diagnostic("device-not-synchronized", WARNING, path.name))
    needs = f"{format.needs}; it has: {', '.join(filter(None, tables[0].names[:12]))}"
    device = make_device(path, found, needs, use, rate_hz if joins else None, diagnostics)
    return replace(device, wraps_s=None if joins else wraps_s)


def _open_tables(format: TableFormat, path: Path, use: str | None) -> list[DeviceTable]:
    """Parse the file, or those of a folder or zip that hold what is wanted."""
    kinds = [use] if use else list(NEEDED)
    alone = path.is_file() and path.suffix.lower() != ".zip"
    table = parse_table(format, path) if alone else None
    if table and (not format.files or any(_has(_find_sensors(format, [table]), kind) for kind in kinds)):
        return [table]
    clock = " or ".join(f"'{clock.column.pattern}'" for clock in format.clocks)
    named = f"line of names with {clock} and columns of a signal in its first {MOST_LINES} lines"
    if not format.files:
        raise BadData(f"{path}: no {named}, which a {format.title} has; {format.needs} are needed")
    patterns = [format.files[kind] for kind in kinds if kind in format.files]
    with open_folder(path) as files:
        for selected in filter(None, (_select(files, pattern) for pattern in patterns)):
            tables = [table for file in selected if (table := parse_table(format, file)) is not None]
            if not tables:
                raise BadData(f"{path}: {selected[0].name} has no {named}; {format.needs} are needed")
            return tables
    raise MissingFile(f"{path}: no {' or '.join(dict.fromkeys(patterns))} in it with {format.needs}")


def _has(sensors: _Sensors, kind: str) -> bool:
    return any(set(NEEDED[kind]) <= set(signals) for signals in sensors.values())


def _find_sensors(format: TableFormat, tables: Sequence[DeviceTable]) -> _Sensors:
    sensors: _Sensors = {}
    entries = [(name, columns, table) for name, each in format.signals.items() for columns in each for table in tables]
    for signal, columns, table in entries:
        own: dict[str, _Source] = {}
        for k, name in enumerate(table.names):
            match = columns.match(name, AXES[signal])
            if match is None:
                continue
            sensor, axis, unit = match
            source = own.setdefault(sensor, _Source(table, columns))
            if axis in source.places:
                raise BadData(f"{table.path}: '{name}' and '{table.names[source.places[axis]]}' are one axis")
            source.places[axis] = k
            source.unit = source.unit or unit or (table.units[k] if k < len(table.units) else "") or columns.unit
        for sensor, source in own.items():
            signals = sensors.setdefault(sensor, {})
            if source.is_complete(AXES[signal]):
                signals.setdefault(signal, []).append(source)
    return sensors


def _name_alone(format: TableFormat, path: Path) -> str:
    """Name the only sensor of a file or folder."""
    path = path.absolute()
    if path.is_dir() or any(fnmatch.fnmatch(path.name, pattern) for pattern in format.files.values()):
        return path.name if path.is_dir() else path.parent.name
    match = format.label_in_name.fullmatch(path.stem) if format.label_in_name else None
    return match["label"] if match else path.stem


def _read_values(signal: str, source: _Source, time: np.ndarray) -> np.ndarray:
    """Read values in SI, quaternions as xyzw."""
    table, columns = source.table, source.list_columns()
    values = table.numbers(columns)
    if signal == "orientation":
        return _read_quat(table, values)
    if source.columns.increments:
        steps = np.diff(time)
        step = float(np.median(steps[np.isfinite(steps)])) if np.isfinite(steps).any() else 0.0
        if not step > 0.0:
            raise BadData(f"{table.path}: its time does not grow from row to row, so that increments give no rate")
        return (_read_turns(values) if signal == "gyro" else values) / step
    return convert(table.path, signal, values, source.unit, table.names[columns[0]])


def _read_turns(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return rotation vectors (n, 3) of quaternions (n, 4); NaN where there is none."""
    turns = np.full((len(quat_wxyz), 3), np.nan)
    good = np.isfinite(quat_wxyz).all(axis=1) & (np.linalg.norm(quat_wxyz, axis=1) > 0.5)
    turns[good] = Rotation.from_quat(quat_wxyz[good][:, [1, 2, 3, 0]]).as_rotvec()
    return turns


def _read_quat(table: DeviceTable, values: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4) xyzw of wxyz, matrices by rows, or roll, pitch, yaw [deg]; NaN where there is none."""
    if values.shape[1] == 4:
        return values[:, [1, 2, 3, 0]]
    quat = np.full((len(values), 4), np.nan)
    good = np.isfinite(values).all(axis=1)
    if values.shape[1] == 3:
        quat[good] = Rotation.from_euler("ZYX", values[good][:, ::-1], degrees=True).as_quat()
        return quat
    matrices = values[good].reshape(-1, 3, 3)
    off = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(3)).max(initial=0.0)
    if off > 1e-2:
        raise BadData(f"{table.path}: its matrices are no rotations, off by {off:.2g}; export them again")
    quat[good] = Rotation.from_matrix(matrices).as_quat()
    return quat


def _read_time(
    format: TableFormat, source: _Source, sensor: str, rate_hz: float | None
) -> tuple[np.ndarray, float | None]:
    """Read times (n,) [s] on the device's clock, and the time [s] after which it wraps."""
    table = source.table
    for clock in format.clocks:
        column = _find_time(format, clock, source, sensor)
        if column is None or not table.has_values(column):
            continue
        if clock.rate:
            stated = next((value for name, value in table.about.items() if clock.rate.fullmatch(name)), "")
            number = _STATED_RATE.match(stated)
            rate = rate_hz or (float(number[0]) if number else 0.0)
            counter = table.numbers([column])[:, 0]
            if rate > 0.0 and np.isfinite(counter).all() and len(counter) > 1:
                packets = unwrap_counter(counter, clock.wraps)
                a_second = max(1.0, float(np.median(np.diff(packets)))) * rate
                time = table.times.setdefault(column, packets / a_second)
                return time, clock.wraps / a_second if clock.wraps else None
        elif not rate_hz:
            if column not in table.times:
                time = _read_stamps(clock, table, column)
                table.times[column] = spread_equal_times(time) if clock.spread else time
            return table.times[column], clock.unit_s * clock.wraps if clock.wraps else None
    if rate_hz:
        return table.times.setdefault(None, np.arange(table.cells.height) / rate_hz), None
    names = " or ".join(f"'{clock.column.pattern}'" for clock in format.clocks)
    raise MissingRate(
        f"{table.path}: no times are known from {names}, or a rate in a line before the table; state the update "
        f"rate as rate_hz in [data], or export one of them"
    )


def _find_time(format: TableFormat, clock: ClockColumn, source: _Source, sensor: str) -> int | None:
    """Find the column of a signal's times."""
    table, first = source.table, source.list_columns()[0]
    if format.times_before:
        if first == 0 or not clock.column.fullmatch(table.names[first - 1]):
            raise BadData(f"{table.path}: no column of times right before '{table.names[first]}'; export them too")
        return first - 1
    matches = [(k, match) for k, name in enumerate(table.names) if (match := clock.column.fullmatch(name))]
    own = [k for k, match in matches if match.groupdict().get("sensor") == sensor]  # else the times may be shared
    return next(iter([*own, *(k for k, _ in matches)]), None)


def _read_stamps(clock: ClockColumn, table: DeviceTable, column: int) -> np.ndarray:
    """Read a column of times [s], of numbers or dates."""
    if clock.date and table.cells[str(column)].dtype == pl.String:
        dates = table.cells[str(column)].str.to_datetime(clock.date, time_unit="us", strict=False)
        if dates.null_count() < len(dates):
            return 1e-6 * dates.to_physical().cast(pl.Float64).fill_null(np.nan).to_numpy()
    return clock.unit_s * unwrap_counter(table.numbers([column])[:, 0], clock.wraps)


def unwrap_counter(counter: np.ndarray, wraps: float | None) -> np.ndarray:
    """Unwrap a counter (n,) that starts again at `wraps`; NaN stay."""
    if wraps is None:
        return counter
    good = np.isfinite(counter)
    count = np.cumsum(np.diff(counter[good], prepend=counter[good][:1]) < -wraps / 2)
    result = np.full(len(counter), np.nan)
    result[good] = counter[good] + wraps * count
    return result
