"""Tables of devices: a TOML describes how a vendor writes them, and one engine reads them all.

A description (`formats/*.toml`, or a user's own; its keys: docs/formats.md) says how a file is recognised, which lines
belong to the names of its columns, which columns are whose gyroscope, accelerometer or orientation, their units, and
the clock.
"""

import fnmatch
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ..data_tables import NUMBER, parse_rows, read_body, read_columns, read_first_lines
from ..diagnostics import WARNING, Diagnostic
from ..documents import Key, TomlTable, read_record, read_toml
from ..errors import BadData, BadSession, MissingRate
from .device import NEEDED, Device, Signal, convert, make_device, open_folder

FOLDER = Path(__file__).parent / "formats"
SEPARATORS = "\t,; "
MOST_LINES = 200  # up to the names
MOST_AFTER = 4  # lines of text between the names and the numbers
AXES = {"gyro": "xyz", "accel": "xyz", "orientation": "wxyz"}
_COUNTS = {"gyro": (1, 3), "accel": (1, 3), "orientation": (1, 3, 4, 9)}  # of columns; 1 is a pattern
_STATED_RATE = re.compile(r"\d+(\.\d*)?(?![\d.])")
_Line = Annotated[float, Key(least=-MOST_AFTER, most=MOST_AFTER)]  # counted from the line of names; 0: there is none


# What a TOML says --------------------------------------------------------------------------------------------------


class Columns(NamedTuple):
    """Columns of a signal."""

    columns: tuple[str, ...]  # one pattern with groups axis, sensor, side, unit; or the names of a file with one sensor
    unit: str = ""  # where neither the name nor a line of units has it
    limit: float = np.inf  # [SI] where a value is beyond, the next columns of the format are taken if they are there

    def match(self, name: str, axes: str) -> tuple[str, int, str] | None:
        """Return sensor, index among the columns, and unit of a column; None: it is none of these."""
        if len(self.columns) > 1:
            return ("", self.columns.index(name), "") if name in self.columns else None
        match = _match(self.columns[0], name)
        groups = {key: (text or "").strip() for key, text in match.groupdict().items()} if match else {}
        axis = groups.get("axis", "")[:1].lower().replace("s", "w")  # APDM calls the w of a quaternion its scalar
        if not axis or axis not in axes:
            return None
        return f"{groups.get('sensor', '')} {groups.get('side', '')}".strip(), axes.index(axis), groups.get("unit", "")


class ClockColumn(NamedTuple):
    """A column that gives the time."""

    column: str  # pattern of its name; a group `sensor` says whose it is
    unit_s: Annotated[float, Key(name="unit_s")] = 1.0  # [s]
    wraps: Annotated[float | None, Key(most=1e12)] = None  # value at which it begins again at 0
    rate: str = ""  # pattern of the line before the table with the rate of which the column counts the samples
    date: str = ""  # how it is written where it is no number


class TableFormat(NamedTuple):
    """A description of tables."""

    title: str = ""
    needs: str = ""
    detect: tuple[str, ...] = ()
    whole: bool = False
    times_before: bool = False
    sensors_line: _Line = 0.0
    sensor_begins: str = ""
    axes_line: _Line = 0.0
    units_line: _Line = 0.0
    label_line: str = ""
    sync_line: str = ""
    files: Annotated[Mapping[str, str], None] = MappingProxyType({})
    clocks: Annotated[tuple[ClockColumn, ...], None] = ()
    signals: Annotated[Mapping[str, tuple[Columns, ...]], None] = MappingProxyType({})

    @property
    def folder(self) -> bool:
        """Whether a recording may be a folder."""
        return bool(self.files)

    def detects(self, path: Path, start: str) -> bool:
        """Return whether a file that starts with this text, a folder, or a zip is of the format."""
        alone = path.is_file() and path.suffix.lower() != ".zip"
        starts = [start] if alone else []
        if self.files and not alone:
            with open_folder(path) as files:
                named = {file for pattern in self.files.values() for file in _select(files, pattern)}
                starts = ["\n".join(read_first_lines(file, 3)) for file in named]
        matches = [any(re.search(pattern, text, re.S | re.M) for text in starts) for pattern in self.detect]
        if alone and len(matches) > 1:  # a table with all signals is one that needs no folder
            return any(matches) and not all(matches) and self.detects(path.parent, "")
        return bool(matches) and all(matches)

    def read(self, path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
        """Read the tables, as `Format.read`; `rate_hz` may be the rate of a counter."""
        tables = _open_tables(self, path, use)
        sensors = _find_sensors(self, tables)
        kind = use or next((kind for kind in NEEDED if _has(sensors, kind)), "raw")
        joins = self.times_before or len(tables) > 1  # a rate is that of the joined signals
        alone = tables[0].about.get(self.label_line) or _name_alone(self, path)
        devices: dict[str, dict[str, Signal]] = {}
        for sensor, signals in sensors.items():
            own = devices.setdefault(sensor or alone, {})
            for name in NEEDED[kind] if set(NEEDED[kind]) <= set(signals) else ():
                first, *others = signals[name]
                time, values = _read_time(self, first, sensor, None if joins else rate_hz), _read_values(name, first)
                if others and (np.abs(values) > first.format.limit).any():
                    values = _read_values(name, others[0])
                own[name] = Signal(time, values)
        diagnostics = []
        # Clocks of devices that were not synchronized start at power-on.
        if self.sync_line and not tables[0].about.get(self.sync_line, "synced").lower().startswith("synced"):
            diagnostics.append(Diagnostic("device-not-synchronized", WARNING, path.name))
        needs = f"{self.needs}; it has: {', '.join(filter(None, tables[0].names[:12]))}"
        return make_device(path, devices, needs, use, rate_hz if joins else None, diagnostics)

    def is_time(self, name: str) -> bool:
        """Return whether a column of this name gives the time."""
        return any(_match(clock.column, name) for clock in self.clocks)

    def is_signal(self, name: str) -> bool:
        """Return whether a column of this name is one of a signal."""
        return any(columns.match(name, AXES[signal]) for signal, each in self.signals.items() for columns in each)


def _match(pattern: str, text: str) -> re.Match[str] | None:
    return re.fullmatch(pattern, text, re.IGNORECASE)


def load_format(path: Path) -> TableFormat:
    """Load a description; `WeposeError`: the file is missing, has a wrong key, or a pattern that is none."""
    table = TomlTable(read_toml(path, "a description of tables"), str(path))
    format = read_record(TableFormat, table, others=("files", "clock", *AXES))
    clocks = tuple(read_record(ClockColumn, each) for each in table.entries("clock"))
    patterns = [*format.detect, format.sensor_begins, *(text for each in clocks for text in (each.column, each.rate))]
    signals: dict[str, tuple[Columns, ...]] = {}
    for signal in AXES:
        for entry in table.entries(signal):
            columns = read_record(Columns, entry)
            signals[signal] = (*signals.get(signal, ()), columns)
            count, needed = len(columns.columns), ""
            if count not in _COUNTS[signal]:
                needed = " or ".join("one pattern" if n == 1 else f"{n} names" for n in _COUNTS[signal])
            elif count == 1 and "(?P<axis>" not in columns.columns[0]:
                needed = "a pattern with (?P<axis>...)"
            if needed:
                raise BadSession(f"{entry.at('columns')} = {list(columns.columns)}; needed: {needed}")
            patterns += columns.columns if count == 1 else ()
    if not clocks or not ("orientation" in signals or {"gyro", "accel"} <= set(signals)):
        raise BadSession(f"{path}: needs [[clock]], and [[gyro]] and [[accel]], or [[orientation]]")
    keys = table.table("files", {})
    keys.allow(*NEEDED)
    for text in patterns:
        try:
            re.compile(text)
        except (re.error, RecursionError, OverflowError) as error:
            raise BadSession(f"{path}: '{text}' is no regular expression: {error}") from None
    title, needs = format.title or path.stem, format.needs or " and ".join(signals)
    files = {kind: keys.text(kind, None) or "" for kind in keys.values}
    return format._replace(title=title, needs=needs, files=files, clocks=clocks, signals=signals)


@cache
def load_formats() -> Mapping[str, TableFormat]:
    """Load the descriptions in the package: name → description."""
    return {path.stem: load_format(path) for path in sorted(FOLDER.glob("*.toml"))}


def _select(files: Mapping[str, Path], pattern: str) -> list[Path]:
    return [file for name, file in files.items() if fnmatch.fnmatch(name, pattern)]


# Tables ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DeviceTable:
    """A table."""

    path: Path
    names: Sequence[str]  # of the columns
    units: Sequence[str]
    about: Mapping[str, str]  # name → value of the lines `name: value` before the names
    cells: pl.DataFrame  # columns "0", "1", … that the description names, without rows that have no values in them
    times: dict[int | None, np.ndarray] = field(default_factory=dict)  # [s] read from a column; None: of a rate

    def has_values(self, columns: Sequence[int]) -> bool:
        """Return whether each of some columns has a value in any cell."""
        return all(self.cells[str(column)].is_not_null().any() for column in columns)

    def numbers(self, columns: Sequence[int]) -> np.ndarray:
        """Return columns (n, k); empty cells are NaN."""
        names = [self.names[k] for k in columns]
        table = self.cells.select(pl.col(str(k)).alias(self.names[k]) for k in columns)
        return read_columns(table, names, str(self.path), str(self.path))


def parse_table(format: TableFormat, path: Path) -> DeviceTable | None:
    """Parse a table; None: it has no line of names, with a column of time and one of a signal."""
    lines = read_first_lines(path, MOST_LINES)
    tables = [(k, line) for k, line in enumerate(lines) if not line.startswith(("//", "#"))]
    for k, separator in ((k, sign) for k, line in tables for sign in SEPARATORS if line.count(sign) >= 3):
        names, units = _name_columns(format, lines, k, separator)
        if any(map(format.is_time, names)) and any(map(format.is_signal, names)):
            break
    else:
        return None
    lines_before = (text.strip("/ ").partition(":") for text in lines[:k])
    about = {name.strip(): value.strip(f" {SEPARATORS}") for name, colon, value in lines_before if colon}
    first = k + 1 + int(max(format.axes_line, format.units_line, 0.0))
    for cells in (_split(row, separator) for row in lines[first : first + MOST_AFTER]):
        if any(map(NUMBER.fullmatch, cells)) and (cells[0] or not format.times_before):
            break
        first += 1
    body = read_body(path, first)
    width = max(len(names), body.partition(b"\n")[0].count(separator.encode()) + 1)
    table = parse_rows(path, body, [str(column) for column in range(width)], separator, lenient=True)
    last = max(column for column, name in enumerate(names) if name)
    if table.height and not body.endswith(b"\n") and table[str(last)][-1] is None:
        table = table.head(-1)  # the last line is incomplete
    columns = [str(column) for column, name in enumerate(names) if format.is_time(name) or format.is_signal(name)]
    table = table.select(columns).filter(pl.any_horizontal(pl.all().is_not_null()))
    if table.is_empty() or b"\0" in body:
        raise BadData(f"{path}: no sound lines of numbers after the names in line {k + 1}; the export is damaged")
    return DeviceTable(path, names, units, about, table)


def _split(line: str, separator: str) -> list[str]:
    return [cell.strip(' "\r') for cell in line.split(separator)]


def _name_columns(format: TableFormat, lines: Sequence[str], k: int, separator: str) -> tuple[list[str], list[str]]:
    """Name the columns of line k, as ``sensor/name/axis`` where these stand in lines of their own; and their units."""
    offsets = (format.sensors_line, format.axes_line, format.units_line)
    places = [k, *(k + int(offset) if offset else -1 for offset in offsets)]
    rows = [_split(lines[n], separator) if 0 <= n < len(lines) else [] for n in places]
    width = max(len(rows[0]), len(rows[2]))
    own, owners, axes, units = ([*row, *[""] * width][:width] for row in rows)
    if format.sensor_begins:
        begins = [column for column, name in enumerate(own) if name and _match(format.sensor_begins, name)]
    else:
        begins = [column for column, owner in enumerate(owners) if owner]
    titles, sensors = list[str](), [""] * width
    for count, (first, last) in enumerate(zip(begins, [*begins, width][1:], strict=True), 1):
        title = next(filter(None, reversed(owners[first:last])), f"sensor {count}")
        title = re.sub(r" *\(\d+\)$", "", title)
        titles.append(f"{title} {count}" if title in titles else title)
        sensors[first:last] = titles[-1:] * (last - first)
    if format.axes_line:  # a name is that of the axes after it too
        for column in range(1, width):
            own[column] = own[column] or (own[column - 1] if axes[column] else "")
    return ["/".join(filter(None, parts)) for parts in zip(sensors, own, axes, strict=True)], units


def _open_tables(format: TableFormat, path: Path, use: str | None) -> list[DeviceTable]:
    """Parse the file, or those of a folder or zip that hold what is needed."""
    kinds = [use] if use else list(NEEDED)
    table = parse_table(format, path) if path.is_file() and path.suffix.lower() != ".zip" else None
    if table and (not format.files or any(_has(_find_sensors(format, [table]), kind) for kind in kinds)):
        return [table]
    if format.files:
        with open_folder(path) as files:
            patterns = [format.files[kind] for kind in kinds if kind in format.files]
            if not patterns:
                raise BadData(f"{path}: a {format.title} holds no {use}; leave out data.use")
            selected = next(filter(None, (_select(files, pattern) for pattern in patterns)), None)
            if not selected:
                raise BadData(f"{path}: no {' or '.join(dict.fromkeys(patterns))} in it with {format.needs}")
            if tables := [table for file in selected if (table := parse_table(format, file))]:
                return tables
            path = path / selected[0].name
    clock = " or ".join(f"'{clock.column}'" for clock in format.clocks)
    named = f"line of names with {clock} and columns of a signal in its first {MOST_LINES} lines"
    raise BadData(f"{path}: no {named}, which a {format.title} has; {format.needs} are needed")


# Sensors -----------------------------------------------------------------------------------------------------------


class _Source(NamedTuple):
    """Columns of a sensor's signal in a table, in their order."""

    table: DeviceTable
    format: Columns
    columns: list[int]
    unit: str


_Sensors = dict[str, dict[str, list[_Source]]]  # sensor → signal → its complete columns, those to prefer first


def _has(sensors: _Sensors, kind: str) -> bool:
    return any(set(NEEDED[kind]) <= set(signals) for signals in sensors.values())


def _find_sensors(format: TableFormat, tables: Sequence[DeviceTable]) -> _Sensors:
    sensors: _Sensors = {}
    entries = [(name, columns, table) for name, each in format.signals.items() for columns in each for table in tables]
    for signal, columns, table in entries:
        own: dict[str, dict[int, tuple[int, str]]] = {}  # sensor → axis → column, unit
        for k, name in enumerate(table.names):
            if (match := columns.match(name, AXES[signal])) is not None:
                sensor, axis, unit = match
                axes = own.setdefault(sensor, {})
                if axis in axes:
                    raise BadData(f"{table.path}: '{name}' and '{table.names[axes[axis][0]]}' are one axis")
                axes[axis] = k, unit or table.units[k]
        count = len(columns.columns) if len(columns.columns) > 1 else len(AXES[signal])
        for sensor, axes in own.items():
            places = [axes[axis][0] for axis in sorted(axes)]
            signals = sensors.setdefault(sensor, {})
            if len(places) == count and table.has_values(places):
                unit = next(filter(None, (unit for _, unit in axes.values())), columns.unit)
                signals.setdefault(signal, []).append(_Source(table, columns, places, unit))
    return sensors


def _name_alone(format: TableFormat, path: Path) -> str:
    path = path.absolute()
    if any(fnmatch.fnmatch(path.name, pattern) for pattern in format.files.values()) and not path.is_dir():
        path = path.parent
    return path.name if path.is_dir() else path.stem


def _read_values(signal: str, source: _Source) -> np.ndarray:
    """Read values in SI; an orientation as xyzw from wxyz, matrices by rows, or roll, pitch, yaw [deg]; NaN: none."""
    path, values = source.table.path, source.table.numbers(source.columns)
    if signal != "orientation":
        return convert(path, signal, values, source.unit, source.table.names[source.columns[0]])
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
        raise BadData(f"{path}: its matrices are no rotations, off by {off:.2g}; export them again")
    quat[good] = Rotation.from_matrix(matrices).as_quat()
    return quat


def _read_time(format: TableFormat, source: _Source, sensor: str, rate_hz: float | None) -> np.ndarray:
    """Read times (n,) [s] on the device's clock, one array for all signals that share them."""
    table = source.table
    for clock in format.clocks:
        column = _find_time(format, clock, source, sensor)
        if column is None or not table.has_values([column]):
            continue
        if not clock.rate and not rate_hz:
            if column not in table.times:
                table.times[column] = _read_clock(table, clock, column)
            return table.times[column]
        if clock.rate:
            stated = next((value for name, value in table.about.items() if _match(clock.rate, name)), "")
            number = _STATED_RATE.match(stated)
            rate = rate_hz or (float(number[0]) if number else 0.0)
            counter = table.numbers([column])[:, 0]
            if rate > 0.0 and np.isfinite(counter).all() and len(counter) > 1:
                packets = _unwrap(counter, clock.wraps)
                return table.times.setdefault(column, packets / (max(1.0, float(np.median(np.diff(packets)))) * rate))
    if rate_hz:
        return table.times.setdefault(None, np.arange(table.cells.height) / rate_hz)
    names = " or ".join(f"'{clock.column}'" for clock in format.clocks)
    raise MissingRate(f"{table.path}: no times are known from {names}; state the update rate as rate_hz in [data]")


def _find_time(format: TableFormat, clock: ClockColumn, source: _Source, sensor: str) -> int | None:
    table, first = source.table, source.columns[0]
    if format.times_before:
        if first == 0 or not _match(clock.column, table.names[first - 1]):
            raise BadData(f"{table.path}: no column of times right before '{table.names[first]}'; export them too")
        return first - 1
    matches = {k: match for k, name in enumerate(table.names) if (match := _match(clock.column, name))}
    own = (k for k, match in matches.items() if match.groupdict().get("sensor") == sensor)
    return next(own, next(iter(matches), None))  # else the times may be shared


def _read_clock(table: DeviceTable, clock: ClockColumn, column: int) -> np.ndarray:
    """Read a column of times (n,) [s], numbers or dates."""
    cells = table.cells[str(column)]
    if clock.date and cells.dtype == pl.String:
        dates = cells.str.to_datetime(clock.date, time_unit="us", strict=False)
        if dates.count():
            return 1e-6 * dates.cast(pl.Int64).cast(pl.Float64).fill_null(np.nan).to_numpy()
    return clock.unit_s * _unwrap(table.numbers([column])[:, 0], clock.wraps)


def _unwrap(counter: np.ndarray, wraps: float | None) -> np.ndarray:
    """Unwrap a counter (n,) that starts again at `wraps`; NaN stay."""
    if wraps is None:
        return counter
    good, unwrapped = np.isfinite(counter), counter.copy()
    unwrapped[good] += wraps * np.cumsum(np.diff(counter[good], prepend=counter[good][:1]) < -wraps / 2)
    return unwrapped
