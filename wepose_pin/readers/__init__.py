"""Readers: a session, the file in which the user describes a recording (TOML), and the data files that it names.

`formats/` describes tables of devices; `registry` has the formats, and `describe` says what a file is.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
import polars as pl

from ..arguments import check_arguments
from ..body.table import NEUTRAL_POSE
from ..data_tables import read_columns, read_table, read_times
from ..diagnostics import INFO, WARNING, Diagnostic, render
from ..documents import Finite, Key, TomlTable, format_value, is_number, read_record, read_toml, toml_key
from ..errors import BadData, BadPhase, BadSession, MissingFile, one_of, printable
from ..recording import CONFIGURATION, ImuSensor, OrientationSensor, Recording, Sensor, clocks, compute_mount, read_axes
from ..recording.clocks import TIME_UNITS, Clock
from ..recording.faults import Fault, check_sensors
from ..recording.intervals import Intervals, check_phases, find_runs, format_span
from .arrays import ArrayFile, is_array_file
from .device import ACCEL_UNITS, GYRO_UNITS, NEEDED, Device
from .live_log import is_live_log as is_live_log
from .live_log import read_live_log as read_live_log
from .registry import detect_format, find_format, read_device

T = TypeVar("T")

SESSION_KEYS = ("name", "model", "start_pose", "remounted", "data", "phases", "sensors", "joints")
# Keys of a sensor that have an effect only where a format reads the file, or only where the session names columns.
OF_FORMATS = ("format", "label", "use")
OF_COLUMNS = ("gyro_unit", "accel_unit", "time", "time_unit")
WIDTHS = {"gyro": 3, "accel": 3, "orientation": 4}
NORM_ERROR = 1e-2  # of a quaternion, from rounded decimals
MOST_LOST = 0.01  # share of samples lost in short gaps, above which it is a diagnostic
_UNITS = {"time_unit": TIME_UNITS, "gyro_unit": GYRO_UNITS, "accel_unit": ACCEL_UNITS}
_CHOICES: dict[str, Collection[str]] = {"use": NEEDED, **_UNITS}
_NO_TABLE = TomlTable({}, "")


class SensorKeys(NamedTuple):
    """The keys of a sensor's table, or of [data], which hold for every sensor that does not state them."""

    table: Annotated[TomlTable, None] = _NO_TABLE  # the sensor's own
    data: Annotated[TomlTable, None] = _NO_TABLE
    file: str = ""
    format: str = ""
    use: Annotated[str, Key(of="use")] = ""
    time: str = ""
    time_unit: Annotated[str, Key(of="time_unit")] = "s"
    rate_hz: Annotated[float | None, Key(least=1e-3)] = None
    offset_s: Annotated[float, Key(least=-1e12, most=1e12)] = 0.0  # between a clock since 1970 and one since power-on
    gyro_unit: Annotated[str, Key(of="gyro_unit")] = ""
    accel_unit: Annotated[str, Key(of="accel_unit")] = ""
    label: str = ""
    aligned: bool | None = None
    ignore: bool = False
    # Signal → columns, or one array; empty where the file's format defines them.
    signals: Annotated[Mapping[str, list[str]], None] = MappingProxyType({})
    mount: Annotated[np.ndarray | None, None] = None  # (4,) xyzw

    @property
    def path(self) -> Path:
        """The sensor's file; `BadSession`: none is named."""
        if not self.file:
            raise BadSession(f"{self.data.at('file')} is missing; the .csv or .parquet file beside {self.data.file}")
        return Path(self.data.file).parent / self.file

    def at(self, key: str) -> str:
        """Return the place of a key, which may stand in [data]."""
        return (self.table if key in self.table else self.data).at(key)


def read_session_file(path: Path, values: Mapping[str, Any] | None = None) -> TomlTable:
    """Read a session file, or the one in a folder; `values` are its contents where it does not exist yet."""
    path = path / "session.toml" if path.is_dir() else path
    if path.suffix.lower() != ".toml" and path.is_file():
        written = f"which `wepose info {path.name} --write` writes"
        raise BadSession(f"{path}: is not a TOML file by its name; a session is needed here, {written}")
    top = TomlTable(read_toml(path, "a session file") if values is None else values, str(path))
    top.allow(*SESSION_KEYS)
    return top


def read_head(top: TomlTable) -> Recording:
    """Read what a session file states besides its data: a recording without sensors and samples."""
    path, name = Path(top.file), top.text("name", None)
    start_pose = top.text("start_pose", NEUTRAL_POSE) or NEUTRAL_POSE
    joints, truth = top.table("joints", {}), top.table("data", {}).text("truth", None)
    if joints.values and start_pose != CONFIGURATION:
        raise BadSession(f'{top.at("joints")} needs start_pose = "{CONFIGURATION}", and it is "{start_pose}"')
    return Recording(
        name=printable(name or path.absolute().parent.name or path.stem),
        time=np.empty(0),
        rate_hz=0.0,
        sensors={},
        phases=_read_phases(top.table("phases", {})),
        start_pose=start_pose,
        joints={joint: float(joints.get(joint, 0.0, Finite)) for joint in joints.values},
        model=_find_model(path, top),
        remounted=top.get("remounted", False, bool),
        source=path,
        truth=None if truth is None else path.parent / truth,
    )


def _find_model(path: Path, top: TomlTable) -> str:
    """Find the body that the session names: a file beside it, or the name of a body of the package; empty: none."""
    name = top.text("model", None) or ""
    file = path.parent / name
    if name and not file.is_file() and (Path(name).suffix or len(Path(name).parts) > 1):
        needed = "a URDF, its table, or the name of a body of the package is needed"
        raise MissingFile(f"{top.at('model')}: no such file '{name}' beside {path.name}; {needed}")
    return str(file) if file.is_file() else name


def _read_phases(keys: TomlTable) -> dict[str, Intervals]:
    if "still" in keys:  # of an earlier version
        needed = "write static = [[from, to]], seconds in which the sensors lie on a table"
        raise BadSession(f"{keys.at('still')} is called static now: {needed}")
    phases: dict[str, Intervals] = {}
    for name, value in keys.values.items():
        pairs: list[Any] = value if isinstance(value, list) else [None]
        if not all(isinstance(pair, list) and len(pair) == 2 and all(map(is_number, pair)) for pair in pairs):
            raise BadSession(f"{keys.at(name)} = {value!r} is not a list of intervals; write [[from, to]] in seconds")
        phases[name] = tuple((float(a), float(b)) for a, b in pairs)
    return phases


def read_sensor_keys(table: TomlTable, data: SensorKeys) -> SensorKeys:
    """Read the keys of a sensor; those that its table lacks are those of [data]."""
    keys = read_record(SensorKeys, table, _CHOICES, data, others=(*WIDTHS, "mount"))._replace(table=table)
    if "time" in table or "rate_hz" in table:  # one replaces the other
        cleared = {key: SensorKeys._field_defaults[key] for key in ("time", "rate_hz") if key not in table}
        keys = keys._replace(**cleared)
    if "mount" in table:
        axes = table.table("mount")
        axes.allow("up", "forward")
        keys = keys._replace(mount=compute_mount(*read_axes(axes)))
    if not any(signal in table for signal in WIDTHS):
        return keys
    needed = NEEDED["orientation"] if "orientation" in table else NEEDED["raw"]
    if other := next((signal for signal in WIDTHS if signal in table and signal not in needed), None):
        raise BadSession(f"{table.at('orientation')} stands beside {other}; a sensor has one or the other")
    signals = {}
    for signal in needed:
        value = table.values.get(signal)
        signals[signal] = [value] if isinstance(value, str) and value else table.names(signal, WIDTHS[signal])
    return keys._replace(signals=signals)


def _check_columns(keys: Mapping[str, SensorKeys]) -> None:
    owners: dict[tuple[str, str], str] = {}
    for name, each in keys.items():
        for signal, column in ((signal, column) for signal, own in each.signals.items() for column in own):
            place = f"sensors.{name}.{signal}"
            if (owner := owners.setdefault((each.file, column), place)) != place:
                raise BadSession(f"{each.table.at(signal)}: '{column}' of {each.file} is a column of {owner} too")


def format_keys(keys: Mapping[str, Any], checks: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Format the keys of a table, one a line; `checks`: key → what the user has to check there."""
    return [
        f"{toml_key(key)} = {format_value(value)}" + (f"   # CHECK: {checks[key]}" if key in checks else "")
        for key, value in keys.items()
    ]


# The recording -----------------------------------------------------------------------------------------------------


def load_session(path: str | Path, gaps: bool = False) -> Recording:
    """Read ``session.toml`` and the data it names, or a recording of `wepose live`.

    Parameters
    ----------
    path : str or Path
        The session file, or its folder; a file of `wepose live --record`.
    gaps : bool
        Accept gaps of more than 50 ms: interpolate them, and mark them as `gap` in the recording and the pose. Without
        it such a gap is an error, except in a live recording.

    Returns
    -------
    Recording
        `time` (n,) [s], evenly spaced, and `sensors`, segment → samples in SI units.

    Raises
    ------
    WeposeError
        With one line that names the file, the key or column, the value found and what would be right.

    Examples
    --------
    >>> recording = wp.load_session("session.toml")
    >>> recording
    Recording('simulated': 22.5 s at 100 Hz, 5 sensors, phases start, clasp, rest)
    >>> recording.sensors["torso"].gyro_S.shape == (len(recording.time), 3)  # [rad/s]
    True
    """
    check_arguments(load_session, locals())
    if is_live_log(Path(path)):
        return read_live_log(Path(path)).recording
    return read_session(Path(path), gaps)


def read_session(path: Path, gaps: bool = False, values: Mapping[str, Any] | None = None) -> Recording:
    """Read a session file and the data it names.

    Parameters
    ----------
    path : the session file, or its folder
    gaps : accept gaps longer than 50 ms: they are bridged, and marked in the sensor's `gap`
    values : the contents of the session file, where it does not exist yet

    Raises
    ------
    WeposeError
        One line that names the file, the key or column, its value and what would be right.
    """
    top = read_session_file(path, values)
    path = Path(top.file)
    stated, data = top.table("sensors", {}), top.table("data")
    common = read_record(SensorKeys, data, _CHOICES, others=("truth",))._replace(data=data)
    # Whether the names are segments, and the start pose one of theirs, is checked where the body is known.
    keys = {name: read_sensor_keys(stated.table(name), common) for name in stated.values}
    keys = {name: each for name, each in keys.items() if not each.ignore}
    _check_columns(keys)
    if not keys:
        raise BadSession(f"{path}: no sensors; one [sensors.<segment>] table each, without # before its lines")
    head = read_head(top)
    contents: dict[Any, Any] = {}  # of the files, each read once, and their clocks
    devices = {name: _open_device(each, contents) for name, each in keys.items() if not each.signals}
    # Clocks that start at power-on are shifted together, so that the earliest begins at zero.
    power_on_s = min((each.begin for each in devices.values() if each.since_power_on), default=0.0)
    alike = len({bool(each.signals) for each in keys.values()}) == 1
    own_clocks: dict[str, Clock] = {}  # of each sensor, with lost rows filled in
    rows: dict[str, Mapping[str, np.ndarray]] = {}  # its signals in SI, as its file has them, without lost rows
    for name, each in keys.items():
        unused = OF_FORMATS if each.signals else OF_COLUMNS
        for key, own in ((key, own) for own in (each.table, *[data] * alike) for key in unused if key in own):
            why = "the columns are named here" if each.signals else "the format of the file defines it"
            raise BadSession(f"{own.at(key)} has no effect, as {why}; remove it")
        if each.signals:
            own_clocks[name], rows[name] = _read_columns(each, contents)
        else:
            keys[name], own_clocks[name], rows[name] = _take_sensor(name, each, devices[name], power_on_s, contents)
        if keys[name].aligned and ("mount" in each.table or "orientation" not in rows[name]):
            raise BadSession(f"{each.table.where}: aligned orientations are the segment's own: no mount, no raw data")
    diagnostics = [own for content in contents.values() for own in getattr(content, "diagnostics", ())]
    packets = {id(each): (keys[name].path.name, each.packet) for name, each in own_clocks.items() if each.packet > 1}
    for file, size in packets.values():
        facts: dict[str, float | str] = {"variant": "packets", "packet": size}
        diagnostics.append(Diagnostic("time-stamps-uneven", INFO, file, facts=facts))
    del contents  # of a day its tables are gigabytes
    time, resampled = clocks.find_common_time(str(path), own_clocks)
    try:
        check_phases(str(path), time, head.phases)
    except BadPhase as error:
        short = [render(each)["what"] for each in resampled if each.code == "sensor-short"]
        raise BadPhase(" ".join((f"{error}{'.' * bool(short)}", *short))) from None
    start = next(iter(head.phases.get("start", ())), None)
    samples = {name: (clock.time[clock.row >= 0], *rows[name].values()) for name, clock in own_clocks.items()}
    faults, gyro_range, frozen = check_sensors(str(path), samples, start)
    sensors: dict[str, Sensor] = {}
    diagnostics = [*resampled, *diagnostics, *frozen]
    for segment, clock in own_clocks.items():
        each = keys[segment]
        place, own_faults = f"{each.path}: {each.table.place}", faults.get(segment, [])
        signals, missing, long_gap = _bridge_gaps(place, rows[segment], clock, own_faults, gaps)
        gap = long_gap if gaps or own_faults else None
        if "orientation" in signals:
            sensor: Sensor = OrientationSensor(signals["orientation"], each.mount, gap, bool(each.aligned))
        else:
            sensor = ImuSensor(signals["gyro"], signals["accel"], each.mount, gap, gyro_range[segment])
        sensors[segment] = clocks.resample(sensor, clock.time, time) if resampled else sensor
        diagnostics += _report_bridged_gaps(segment, missing, long_gap, clock.step)
    rate_hz = round((len(time) - 1) / float(time[-1] - time[0]), 4)  # seconds since 1970 are off by 1e-6 Hz
    recording = replace(head, time=time, rate_hz=rate_hz, sensors=sensors, diagnostics=tuple(diagnostics))
    recording.check()
    return replace(recording, diagnostics=(*recording.diagnostics, *recording.check_signals()))


def _once(contents: dict[Any, Any], key: Any, read: Callable[..., T], *arguments: Any) -> T:
    """Return what `read` returns of the arguments; for each key it is called once."""
    if key not in contents:
        contents[key] = read(*arguments)
    content: T = contents[key]
    return content


def _open_device(keys: SensorKeys, contents: dict[Any, Any]) -> Device:
    """Read the file of a sensor without columns, whose format defines them."""
    path = keys.path
    if not keys.format and not path.exists():
        raise MissingFile(f"{path}: no such file or folder")
    folder, place = Path(keys.data.file).parent, keys.at("format")
    format = find_format(keys.format, folder, place) if keys.format else detect_format(path)
    if format is None:
        if not is_array_file(path):
            read_table(path)  # an error where it is none
        keys.table.names("gyro", WIDTHS["gyro"])  # an error: the session must name the columns of a table
    arguments = path, str(format), keys.use or None, keys.rate_hz
    return _once(contents, arguments, read_device, *arguments)


def _take_sensor(
    segment: str, keys: SensorKeys, device: Device, power_on_s: float, contents: dict[Any, Any]
) -> tuple[SensorKeys, Clock, Mapping[str, np.ndarray]]:
    """Take a sensor of a device's file: the stated label, the one with the segment's name, or the only sensor.

    Returns its keys, with the device's mount and `aligned` where these are not stated, its clock and its signals.
    """
    path, table = keys.path, keys.table
    labels = [label for label, each in device.sensors.items() if each.segment == segment] or list(device.sensors)
    if keys.label:
        labels = [table.choice("label", device.sensors, keys.label)]
    if len(labels) != 1:
        raise BadSession(f"{table.at('label')} is missing; which of {path.name} is it? {one_of(device.sensors)}")
    sensor = device.sensors[labels[0]]
    offset_s = keys.offset_s - (power_on_s if device.since_power_on else 0.0)
    key, time = (path, id(sensor.time), offset_s), sensor.time + offset_s
    clock = _once(contents, key, clocks.build_clock, time, str(path), True)
    mount = sensor.mount if keys.mount is None else keys.mount
    aligned = device.aligned if keys.aligned is None else keys.aligned
    return keys._replace(mount=mount, aligned=aligned), clock, sensor.signals


def _read_columns(keys: SensorKeys, contents: dict[Any, Any]) -> tuple[Clock, Mapping[str, np.ndarray]]:
    """Read the columns or arrays of a sensor, which the session names."""
    path, table = keys.path, keys.table
    if bool(keys.time) == (keys.rate_hz is not None):
        stated = "both are" if keys.time else "neither is"
        raise BadSession(f"{keys.at('time')} or rate_hz is needed, one of the two, and {stated} there")
    units = {"orientation": 1.0}
    for signal, unit, known in (("gyro", keys.gyro_unit, GYRO_UNITS), ("accel", keys.accel_unit, ACCEL_UNITS)):
        if signal in keys.signals and not unit:
            raise BadSession(f"{keys.at(f'{signal}_unit')} is missing; {one_of(known)}")
        units[signal] = known.get(unit, 1.0)
    columns, is_table = dict(keys.signals), not is_array_file(path)
    content: Any = _once(contents, path, read_table if is_table else ArrayFile, path)
    for signal, names in keys.signals.items():
        if len(names) == 1 and is_table:
            table.names(signal, WIDTHS[signal])  # an error: one array, but the file is a table of columns
        elif len(names) == 1:
            columns[signal] = content.expand(names[0], WIDTHS[signal], table.at(signal))
    if not is_table:
        places = {name: table.at(signal) for signal, names in columns.items() for name in names}
        content = content.table(places | ({keys.time: keys.at("time")} if keys.time else {}))
    if keys.rate_hz is not None:
        time, source = np.arange(content.height) / keys.rate_hz, keys.at("rate_hz")
    else:
        time, source = read_times(content, keys.time, str(path), keys.at("time")), str(path)
        time = TIME_UNITS[keys.time_unit] * time
    key = (path, len(time), keys.time, keys.time_unit, keys.rate_hz, keys.offset_s)
    clock = _once(contents, key, clocks.build_clock, time + keys.offset_s, source)
    signals = {}
    for signal, names in columns.items():
        signals[signal] = units[signal] * read_columns(content, names, str(path), table.at(signal))
        if is_table:  # columns that have been read make room: of a day the table is gigabytes
            contents[path] = contents[path].with_columns(pl.lit(None).alias(name) for name in names)
    return clock, signals


# Gaps --------------------------------------------------------------------------------------------------------------


def _bridge_gaps(
    place: str, rows: Mapping[str, np.ndarray], clock: Clock, faults: Sequence[Fault], gaps: bool
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Put rows on the clock and bridge gaps, long ones where `gaps` are accepted.

    Returns the signals, which samples (n,) are missing, and which are in a long gap; those of `faults` are in gaps too.
    """
    frozen = np.zeros(len(clock.time), dtype=bool)
    for fault in faults:
        frozen |= (clock.time > fault.first) & (clock.time <= fault.last)
    signals, lost = {}, frozen.copy()
    for signal, values in rows.items():
        signals[signal], good = _place_on_clock(values, clock, f"{place}{signal}", signal == "orientation")
        lost |= ~good
        if lost.all():
            when = "where the other signal has them, " if good.any() else ""
            raise BadData(f"{place}{signal}: no numbers {when}from {format_span(clock.time[[0, -1]])}")
        if not gaps and (long := find_runs(clocks.find_long_gaps(~good, clock.step))):
            first, last = long[0]
            lost_s, row = (last - first) * clock.step, clock.row[:first].max(initial=-1) + 1
            raise BadData(
                f"{place}{signal}: samples are missing for {lost_s:.3f} s from {clock.time[first]:.3f} s, after row "
                f"{row}; up to 50 ms are bridged; cut the recording there, or accept gaps by `gaps=True`"
            )
    long_gap = clocks.find_long_gaps(lost, clock.step)
    signals = {signal: clocks.bridge(values, lost, clock.time) for signal, values in signals.items()}
    return signals, lost & ~frozen, long_gap  # frozen samples have a diagnostic of their own


def _place_on_clock(rows: np.ndarray, clock: Clock, place: str, is_quat: bool) -> tuple[np.ndarray, np.ndarray]:
    """Put the values (n, k) of a signal on the clock, with a mask (n,) of the samples that exist."""
    exists, values = clock.row >= 0, rows
    if not exists.all():
        values = np.full((len(clock.row), rows.shape[1]), np.nan)
        values[exists] = rows[clock.row[exists]]
    good = np.isfinite(values).all(axis=1)
    if not is_quat:
        return values, good
    norm = np.linalg.norm(values, axis=1)
    good &= norm > 0.0  # many exports write zeros for a lost sample
    not_unit = np.flatnonzero(good & (np.abs(norm - 1.0) > NORM_ERROR))
    if not_unit.size:
        length, row = norm[not_unit[0]], clock.row[not_unit[0]] + 1
        raise BadData(f"{place} has length {length:.3g} in row {row}; a unit quaternion x, y, z, w is needed")
    return values / np.where(good, norm, np.nan)[:, None], good


def _report_bridged_gaps(segment: str, missing: np.ndarray, long_gap: np.ndarray, step: float) -> Iterator[Diagnostic]:
    """Report bridged gaps, short ones where they are many, of the samples (n,) with a step [s]."""
    long, short = ([last - first for first, last in find_runs(missing & own)] for own in (long_gap, ~long_gap))
    if long:
        facts: dict[str, float | str] = {"samples": sum(long), "gaps": len(long)}
        yield Diagnostic("samples-lost", WARNING, segment, max(long) * step, max(clocks.LONGEST_GAP_S, step), facts)
    elif sum(short) > MOST_LOST * len(missing):
        facts = {"variant": "short", "longest": max(short) * step}
        yield Diagnostic("samples-lost", WARNING, segment, sum(short) / len(missing), MOST_LOST, facts)
