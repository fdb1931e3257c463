"""Common parts of the readers of device files: a table in SI with a clock, and text with lines before its table."""

from __future__ import annotations

import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
import polars as pl

from ..diagnostics import INFO, Diagnostic
from ..errors import BadData, MissingFile, one_of
from ..recording.limits import LARGEST_NUMBER, STANDARD_GRAVITY
from .guess import guess_unit
from .tables import NO_VALUE, read_columns

# A table begins within this many lines of a file; the lines before it describe the device.
PREAMBLE_LINES = 100
SEPARATORS = "\t,; "
AXES = {"gyro": "xyz", "accel": "xyz", "orientation": "xyzw"}
GYRO_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
ACCEL_UNITS = {"m/s^2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY}
# A zip may unpack to so many bytes, or to so many times its own size: sensor noise packs to a tenth.
MOST_BYTES, MOST_GROWTH = 1 << 28, 50
# Where the gyroscope's clock is not the accelerometer's, a sample is between two that are at most so many steps apart.
LONGEST_STEPS = 2.5


@dataclass(frozen=True)
class Device:
    """The contents of a device's file, in SI.

    Parameters
    ----------
    format : its name, a key of `wepose_pin.readers.formats.FORMATS`
    table : `time` [s] on the device's clock, and the columns of `name_columns`
    own_tables : label → such a table, of the sensors that have clocks of their own; these all begin at one moment
    labels : the file's name of each sensor or segment → our segment, None where the name is not clear
    kind : "raw" for gyro and accel, "orientation"
    since_power_on : the clock starts at power-on, or at another arbitrary moment
    wraps_s : [s] after which such a clock wraps; None: it does not
    aligned : the orientations are the segments' own, in one world
    mounts : label → (4,) xyzw, sensor to segment, where the file states it
    diagnostics : assumptions, and missing data
    """

    format: str
    table: pl.DataFrame
    labels: Mapping[str, str | None]
    kind: str
    since_power_on: bool = False
    wraps_s: float | None = None
    aligned: bool = False
    mounts: Mapping[str, np.ndarray] = field(default_factory=dict)
    diagnostics: tuple[Diagnostic, ...] = ()
    own_tables: Mapping[str, pl.DataFrame] = field(default_factory=dict)

    def find_table(self, label: str) -> pl.DataFrame:
        """Return the table with the columns of a sensor, and its clock."""
        return self.own_tables.get(label, self.table)

    def signals(self, label: str) -> dict[str, list[str]]:
        """Return signal → columns."""
        return {
            name: name_columns(label, name) for name in (("gyro", "accel") if self.kind == "raw" else ("orientation",))
        }


def name_columns(label: str, signal: str) -> list[str]:
    """Name the columns of a sensor's signal, one an axis."""
    return [f"{label} {signal} {axis}" for axis in AXES[signal]]


def make_table(time: np.ndarray, values: Mapping[str, Mapping[str, np.ndarray]]) -> pl.DataFrame:
    """Make the table of a `Device` from times (n,) [s] and label → signal → (n, 3 or 4)."""
    columns = {"time": time}
    for label, signals in values.items():
        for signal, array in signals.items():
            columns |= dict(zip(name_columns(label, signal), array.T, strict=True))
    return pl.DataFrame(columns)


def make_device(
    format: str,
    kind: str,
    clocks: Mapping[str, np.ndarray],
    values: Mapping[str, Mapping[str, np.ndarray]],
    labels: Mapping[str, str | None],
    diagnostics: Sequence[Diagnostic] = (),
) -> Device:
    """Make a `Device` whose sensors may have clocks of their own: label → times (n,) [s], and as for `make_table`."""
    tables = {label: make_table(clocks[label], {label: signals}) for label, signals in values.items()}
    first, *others = tables.values()
    if all(table["time"].equals(first["time"]) for table in others):
        first, tables = pl.concat([first, *(table.drop("time") for table in others)], how="horizontal"), {}
    return Device(format, first, labels, kind, True, diagnostics=tuple(diagnostics), own_tables=tables)


def convert(path: Path, signal: str, values: np.ndarray, unit: str, column: str) -> np.ndarray:
    """Convert values of gyro or accel to SI by what the file calls their unit.

    Raises
    ------
    BadData
        The unit is none that is known.
    """
    known = GYRO_UNITS if signal == "gyro" else ACCEL_UNITS
    guess = guess_unit(signal, unit)
    if guess is None:
        stated = f"'{unit}'" if unit else "no unit that it states"
        raise BadData(f"{path}: '{column}' is in {stated}; {one_of(known, unit)}")
    return known[guess] * values


def read_converted(path: Path, table: pl.DataFrame, signal: str, columns: Sequence[str], unit: str) -> np.ndarray:
    """Read the columns of a signal in SI, orientations (w, x, y, z in the file) as xyzw."""
    values = read_columns(table, columns, str(path), str(path))
    check_measured(path, values, ", ".join(columns))
    return values[:, [1, 2, 3, 0]] if signal == "orientation" else convert(path, signal, values, unit, columns[0])


def spread_equal_times(time: np.ndarray) -> np.ndarray:
    """Spread equal stamps (n,) evenly up to the next one: samples that one packet brought."""
    new = np.flatnonzero(np.diff(time, prepend=-np.inf) != 0.0)
    if len(new) < 2 or len(new) == len(time):
        return time
    step = (time[new[-1]] - time[new[0]]) / max(new[-1] - new[0], 1)
    last = time[new[-1]] + step * (len(time) - new[-1])
    return np.asarray(np.interp(np.arange(len(time)), [*new, len(time)], [*time[new], last]))


def join_signals(
    place: str, gyro: tuple[np.ndarray, np.ndarray], accel: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray], tuple[Diagnostic, ...]]:
    """Join rates and specific forces of different clocks on that of the rates: times, values, and what was done.

    Each is times (n,) [s] and values (n, 3). Specific force between two samples is interpolated, NaN where these are
    further apart than `LONGEST_STEPS`.

    Raises
    ------
    BadData
        They have no time in common.
    """
    (time, rates), (own, forces) = (_drop_missing(*each) for each in (gyro, accel))
    if len(time) < 2 or len(own) < 2 or min(time[-1], own[-1]) <= max(time[0], own[0]):
        raise BadData(
            f"{place}: gyroscope and accelerometer have no time in common, of {len(time)} and {len(own)} rows"
        )
    if len(time) == len(own) and np.array_equal(time, own):
        return time, {"gyro": rates, "accel": forces}, ()
    inside = (time >= own[0]) & (time <= own[-1])
    time, rates = time[inside], rates[inside]
    after = np.clip(np.searchsorted(own, time), 1, len(own) - 1)
    steps = own[after] - own[after - 1]
    joined = np.column_stack([np.interp(time, own, axis) for axis in forces.T])
    off = np.minimum(time - own[after - 1], own[after] - time)
    joined[(steps > LONGEST_STEPS * np.median(np.diff(own))) & (off > 0.0)] = np.nan
    facts = {"off": float(np.max(off, initial=0.0))}
    return time, {"gyro": rates, "accel": joined}, (Diagnostic("signals-joined", INFO, place, facts=facts),)


def _drop_missing(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out rows without a time, spread equal stamps, and sort."""
    known = np.isfinite(time)
    order = np.argsort(time[known], kind="stable")
    return spread_equal_times(time[known][order]), values[known][order]


@contextmanager
def open_folder(path: Path, what: str) -> Iterator[dict[str, Path]]:
    """Open a folder, or a zip of one, as name → file; of a file of neither kind, what lies beside it.

    Raises
    ------
    BadData
        The zip is damaged, or holds far more than its size.
    """
    if not (path.is_file() and zipfile.is_zipfile(path)):
        folder = path if path.is_dir() else path.parent
        yield {file.name: file for file in sorted(folder.iterdir()) if file.is_file()}
        return
    with tempfile.TemporaryDirectory() as unpacked:
        try:
            with zipfile.ZipFile(path) as archive:
                members = [each for each in archive.infolist() if each.filename.lower().endswith((".csv", ".json"))]
                if sum(each.file_size for each in members) > max(MOST_BYTES, MOST_GROWTH * path.stat().st_size):
                    raise BadData(f"{path}: holds far more than its size; no {what} packs so well")
                for k, member in enumerate(members):  # a name may lead out of the folder
                    name = PurePosixPath(member.filename).name
                    (Path(unpacked) / str(k)).mkdir()
                    (Path(unpacked) / str(k) / name).write_bytes(archive.read(member))
        except (
            zipfile.BadZipFile,
            zlib.error,
            NotImplementedError,
            RuntimeError,
            OSError,
            EOFError,
            ValueError,
        ) as error:
            raise BadData(f"{path}: is a damaged zip: {error}") from error
        yield {file.name: file for file in sorted(Path(unpacked).glob("*/*"))}


def check_measured(path: Path, values: np.ndarray, what: str) -> None:
    """Raise an error on numbers (n, k) beyond `LARGEST_NUMBER`."""
    too_large = np.flatnonzero((np.abs(values) > LARGEST_NUMBER).any(axis=1))
    if too_large.size:
        largest = np.nanmax(np.abs(values[too_large[0]]))
        raise BadData(f"{path}: {what} holds {largest:.3g} in row {too_large[0] + 1}; no device measures as much")


def read_first_lines(path: Path, most: int = PREAMBLE_LINES) -> list[str]:
    """Read the first lines of a text file; bytes that are not UTF-8 are replaced.

    Raises
    ------
    MissingFile
        The file is missing or not readable.
    """
    try:
        with path.open("rb") as file:
            # The limit bounds the memory for a file without line ends.
            return [file.readline(2**16).decode("utf-8-sig", errors="replace").rstrip("\r\n") for _ in range(most)]
    except FileNotFoundError:
        raise MissingFile(f"{path}: no such file") from None
    except OSError as error:
        raise MissingFile(f"{path}: cannot be read: {error.strerror}") from error


@dataclass(frozen=True)
class Text:
    """A text file of a device: the lines before its table, and the table, all cells text.

    Parameters
    ----------
    path : the file
    about : name → value of the lines `name: value` before the table
    cells : the table, without an incomplete last line
    """

    path: Path
    about: Mapping[str, str]
    cells: pl.DataFrame

    def __contains__(self, names: Sequence[str]) -> bool:
        return all(name in self.cells.columns and self.cells[name].is_not_null().any() for name in names)

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """Return columns (n, k); empty cells are NaN."""
        values = read_columns(self.cells, names, str(self.path), str(self.path))
        check_measured(self.path, values, ", ".join(names))
        return values


def read_text(path: Path, first: str, what: str) -> Text:
    """Read the table whose header has the column `first`, separated by tabs, commas, semicolons or single spaces.

    Raises
    ------
    MissingFile, BadData
        The file is missing, or has no such header, or no line of numbers after it.
    """
    lines = read_first_lines(path)
    head, separator = _find_header(lines, first)
    if head is None:
        raise BadData(f"{path}: no line of names with '{first}' in its first {PREAMBLE_LINES} lines; {what} has one")
    about = {}
    for line in lines[:head]:
        name, colon, value = line.strip("/ ").partition(":")
        if colon:
            about[name.strip()] = value.strip(f" {SEPARATORS}")
    with path.open("rb") as file:
        for _ in range(head):
            file.readline()
        rest = file.read()
    rest = rest.removeprefix(b"\xef\xbb\xbf")
    header, _, body = rest.partition(b"\n")
    names = [cell.strip(' "\r') for cell in header.decode("utf-8", errors="replace").split(separator)]
    while names and not names[-1]:
        names.pop()
    return Text(path, about, parse_rows(path, body, names, separator, head + 1, what))


def parse_rows(
    path: Path, body: bytes, names: Sequence[str], separator: str, names_line: int, what: str
) -> pl.DataFrame:
    """Parse the rows after the header in line `names_line` of the file: cells are text, null without a value.

    Raises
    ------
    BadData
        Two columns of one name; zero bytes; no rows.
    """
    if len(set(names)) < len([name for name in names if name]) or b"\0" in body:
        reason = "zero bytes in it" if b"\0" in body else "two columns of one name"
        raise BadData(f"{path}: is no {what}: there are {reason}")
    if not body.strip():
        raise BadData(
            f"{path}: has no line of numbers after its names in line {names_line}; the export is empty or cut off"
        )
    schema = {name or f"column {k}": pl.String for k, name in enumerate(names)}
    try:
        cells = pl.read_csv(
            body,
            has_header=False,
            separator=separator,
            schema=schema,
            truncate_ragged_lines=True,
            encoding="utf8-lossy",
            quote_char=None,
        )
    except pl.exceptions.PolarsError as error:
        raise BadData(f"{path}: cannot be read as {what}: {' '.join(str(error).split())[:120]}") from error
    cells = cells.with_columns(pl.all().str.strip_chars(' "\r'))
    cells = cells.with_columns(pl.when(~pl.all().is_in(NO_VALUE)).then(pl.all()).name.keep())
    if separator != ",":
        cells = cells.with_columns(pl.all().str.replace(",", ".", literal=True))
    filled = cells.select(pl.any_horizontal(pl.all().is_not_null()))[:, 0]
    cells = cells.filter(filled)
    if cells.height and not body.endswith(b"\n") and cells[-1, cells.width - 1] is None:
        cells = cells.head(-1)  # the last line is incomplete
    return cells


def _find_header(lines: Sequence[str], first: str) -> tuple[int | None, str]:
    """Find the line of column names that has `first`, and its separator."""
    for k, line in enumerate(lines):
        if line.startswith("//"):
            continue
        for separator in SEPARATORS:
            if first in (cell.strip(' "') for cell in line.split(separator)):
                return k, separator
    return None, ""


def compute_counted_time(counter: np.ndarray, rate_hz: float, wraps: float) -> tuple[np.ndarray, float]:
    """Compute times (n,) [s] from a packet counter, and the time [s] after which the counter wraps."""
    packets = unwrap_counter(counter, wraps)
    usual = max(1.0, float(np.median(np.diff(packets)))) if len(packets) > 1 else 1.0
    return packets / (usual * rate_hz), wraps / (usual * rate_hz)


def unwrap_counter(counter: np.ndarray, wraps: float) -> np.ndarray:
    """Unwrap a counter (n,) that starts again at `wraps`; NaN stay."""
    filled = np.where(np.isfinite(counter), counter, 0.0)
    good = np.isfinite(counter)
    steps = np.diff(filled[good])
    count = np.cumsum(np.concatenate([[0], np.where(steps < -wraps / 2, 1, 0)]))
    result = np.full(len(counter), np.nan)
    result[good] = filled[good] + wraps * count
    return result
