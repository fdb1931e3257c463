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
    format : its name, as `wepose_pin.readers.registry` knows it
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


def read_first_lines(path: Path, most: int = 100) -> list[str]:
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
