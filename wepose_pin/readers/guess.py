"""Guesses from the column names of an unknown table: a proposal that the user checks, never applied by itself."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from ..model import BodyTable, load_table

AXIS = re.compile(r"(?P<stem>.*?)[ _.\-\[(]*(?P<axis>[xyzw0-3])[\])]?\s*(?P<unit>[\[(].*[\])])?", re.IGNORECASE)
# Signals in the order of the search; (?![a-z]) for names such as gx, ax.
SIGNALS = (
    ("gyro", r"gyr|ang(ular)?[ _]?vel|omega|rot(ation)?[ _]?rate|(^|[^a-z])[gw]$"),
    ("accel", r"acc|(^|[^a-z])a$"),
    ("orientation", r"quat|ori(entation)?|rotation|(^|[^a-z])q$"),
)
NOT = r"mag|free|linear|lin[ _]?acc|earth|std|cov"  # no raw data, whatever else the name says
# Words of a name that make it a column of times, units of it, and words that may stand beside them.
TIME = {"time", "times", "timestamp", "timestamps", "t", "ts", "clock", "elapsed", "epoch"}
TIME_UNIT = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "milli", "millis", "millisec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "micro", "micros", "microsec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nano", "nanos", "nanosec", "nanosecond", "nanoseconds"), "ns"),
}
BESIDE_TIME = {"stamp", "unix", "utc", "since", "start", "sync", "system", "host", "device", "sensor", "shimmer", "cal"}
ORDER = {"gyro": "xyz", "accel": "xyz", "orientation": "xyzw"}


class Guess(NamedTuple):
    """The guess from the names of columns."""

    time: str | None
    time_unit: str | None  # "s", "ms", "us" or "ns", where the name has it
    sensors: Mapping[str, Mapping[str, list[str]]]  # segment, or ?name where it is not known → signal → columns
    degrees: bool  # a name has deg/s
    g: bool  # a name has g


def guess_columns(names: Iterable[str], table: BodyTable | None = None) -> Guess:
    """Guess signals from groups of three or four columns that differ only in the axis.

    `table` : of the body whose segments carry the sensors; None: the upper body
    """
    names = list(names)
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in names:
        match = AXIS.fullmatch(name)
        signal = guess_signal(match["stem"]) if match else None
        if match and signal:
            groups.setdefault((match["stem"], signal), {})[match["axis"].lower()] = name
    by_sensor: dict[str, dict[str, list[str]]] = {}
    for (stem, signal), axes in groups.items():
        order = ORDER[signal]
        if set("0123") <= set(axes) and signal == "orientation":
            order = "1230"  # numbered quaternions begin with w
        elif not set(order) <= set(axes) and set("012") <= set(axes) and signal != "orientation":
            order = "012"
        if set(order) <= set(axes):
            by_sensor.setdefault(_find_owner(stem, table or load_table()), {}).setdefault(
                signal, [axes[axis] for axis in order]
            )
    return _make_guess(names, by_sensor)


def guess_arrays(shapes: Mapping[str, tuple[int, ...]], table: BodyTable | None = None) -> Guess:
    """Guess signals from the paths of arrays (n, 3) and (n, 4); `table` as for `guess_columns`."""
    by_sensor: dict[str, dict[str, list[str]]] = {}
    for path, shape in shapes.items():
        signal = guess_signal(path)
        if signal and len(shape) == 2 and len(ORDER[signal]) in shape:
            by_sensor.setdefault(_find_owner(path, table or load_table()), {}).setdefault(signal, [path])
    times = {
        path.rpartition("/")[2]: path for path, shape in shapes.items() if max(shape, default=0) == _compute_size(shape)
    }
    guess = _make_guess(list(times), by_sensor)
    return guess._replace(time=times.get(guess.time or ""))


def guess_signal(stem: str) -> str | None:
    """Guess the signal from a column's name without its axis."""
    text = stem.lower()
    if re.search(NOT, text):
        return None
    return next((signal for signal, pattern in SIGNALS if re.search(pattern, text)), None)


def _is_time(name: str) -> bool:
    words = _split_words(name)
    rest = [word for word in words if word not in TIME and word not in TIME_UNIT]
    named = any(word in TIME for word in words) or (len(words) == 1 and words[0] in TIME_UNIT and words[0] != "s")
    return named and all(word in BESIDE_TIME or word.isdigit() for word in rest)


def _split_words(name: str) -> list[str]:
    return re.sub(r"(?<=[a-z])(?=[A-Z])|[\W_]+", " ", name).lower().split()


def _compute_size(shape: tuple[int, ...]) -> int:
    size = 1
    for k in shape:
        size *= k
    return size


def _find_owner(stem: str, table: BodyTable) -> str:
    """Return the segment, or the name without its signal, which one sensor's signals have in common."""
    segment = table.guess_segment(stem)
    if segment:
        return segment
    text = stem.lower()
    for _, pattern in SIGNALS:
        text = re.sub(pattern + r"[a-z]*", "", text)
    return f"?{text.strip(' _./-')}"


def _make_guess(names: list[str], by_sensor: dict[str, dict[str, list[str]]]) -> Guess:
    time = next((name for name in names if _is_time(name)), None)
    complete = {name: signals for name, signals in by_sensor.items() if "orientation" in signals or len(signals) == 2}
    sensors = {
        name: {
            k: v
            for k, v in signals.items()
            if (k == "orientation") == ("gyro" not in signals or "accel" not in signals)
        }
        for name, signals in complete.items()
    }
    text = " ".join(names).lower()
    return Guess(
        time,
        next((TIME_UNIT[word] for word in _split_words(time or "") if word in TIME_UNIT), None),
        sensors,
        bool(re.search(r"dps|deg ?/ ?s|deg_s|deg/s", text)),
        bool(re.search(r"[\[( ]g[\]) ]", f"{text} ")),
    )
