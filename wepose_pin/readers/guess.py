"""Guesses from the column names of an unknown table: a proposal that the user checks, never applied by itself.

``guess.toml`` has the words.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ..body import BodyTable, load_table
from ..documents import read_toml

HOLE = "\0"  # the place of the axis in a name without it
_WORDS = read_toml(Path(__file__).with_suffix(".toml"), "words")
SIGNALS = {name: text.replace("{alone}", rf"(?=[^a-z]*({HOLE}|$))") for name, text in _WORDS["signals"].items()}
UNITS: Mapping[str, Mapping[str, str]] = _WORDS["units"]
TIME, BESIDE_TIME = set(_WORDS["time"]["names"]), set(_WORDS["time"]["beside"])
TIME_UNIT = {word: unit for unit, words in _WORDS["time"]["units"].items() for word in words}
NOT = r"mag|free|linear|lin[ _]?acc|user|earth|std|cov"  # no raw data, whatever else the name says
ORDER = {"gyro": "xyz", "accel": "xyz", "orientation": "xyzw"}
_BEFORE_AXIS = re.compile(r"(acc|accel|gyr|gyro|omega|vel|rate|quat|(^|[^a-z])[agwq])$")
_NUMBERED = re.compile(r"(.*?)[ _.\-\[(]*([0-3])[\])]?\s*")
_BRACKETS = re.compile(r"(.*?)\s*[\[({]\s*([^\[\]{}]*?)\s*[\])}]\s*")


class Guess(NamedTuple):
    """The guess from the names of columns."""

    times: Sequence[str]  # columns that may be the time, the likeliest first
    sensors: Mapping[str, Mapping[str, list[str]]]  # segment, or ?name where it is not known → signal → columns
    units: Mapping[str, str]  # "gyro", "accel" or a column of times → unit, where the names say it


def guess_columns(
    names: Iterable[str], table: BodyTable | None = None, units: Mapping[str, str] | None = None
) -> Guess:
    """Guess signals from groups of three or four columns that differ only in the axis, wherever it stands in the name.

    Parameters
    ----------
    table : of the body whose segments carry the sensors; None: the upper body
    units : of the columns, where a line after the names has them
    """
    names = list(names)
    own_units = {name: (units or {}).get(name, "") or split_unit(name)[1] for name in names}
    return _make_guess({name: name for name in names}, group_columns(names, table), own_units)


def guess_arrays(shapes: Mapping[str, tuple[int, ...]], table: BodyTable | None = None) -> Guess:
    """Guess signals from the paths of arrays (n, 3) and (n, 4); `table` as for `guess_columns`."""
    by_sensor: dict[str, dict[str, list[str]]] = {}
    for path, shape in shapes.items():
        signal = guess_signal(path)
        if signal and len(shape) == 2 and len(ORDER[signal]) in shape:
            by_sensor.setdefault(_find_owner(path, table or load_table()), {}).setdefault(signal, [path])
    vectors = (path for path, shape in shapes.items() if max(shape, default=0) == math.prod(shape))
    return _make_guess({path.rpartition("/")[2]: path for path in vectors}, by_sensor, {})


def _make_guess(
    columns: Mapping[str, str], by_sensor: Mapping[str, Mapping[str, list[str]]], own_units: Mapping[str, str]
) -> Guess:
    """Make the guess; `columns`: name → column or array of those that may be times."""
    sensors: dict[str, Mapping[str, list[str]]] = {}
    units: dict[str, str | None] = {}
    for owner, signals in by_sensor.items():
        needed = ("gyro", "accel") if {"gyro", "accel"} <= set(signals) else ("orientation",)
        if set(needed) <= set(signals):
            sensors[owner] = {signal: signals[signal] for signal in signals if signal in needed}
            units |= {signal: guess_unit(signal, own_units.get(signals[signal][0], "")) for signal in needed}
    times = {name: each for name, each in columns.items() if _is_time(split_unit(name)[0]) or _is_time(name)}
    for name, each in times.items():
        words = [own_units.get(name, "").lower(), *_split_words(name)]
        units[each] = next((TIME_UNIT[word] for word in words if word in TIME_UNIT), None)
    return Guess(list(times.values()), sensors, {name: unit for name, unit in units.items() if unit})


def group_columns(names: Sequence[str], table: BodyTable | None = None) -> dict[str, dict[str, list[str]]]:
    """Group columns: segment, or ?name where it is not known → signal → the columns of its axes; `table` as above."""
    table = table or load_table()
    # ROS calls the specific force of sensor_msgs/Imu linear_acceleration; elsewhere this is without gravity.
    ros = any("angular_velocity" in name for name in names)
    groups: dict[tuple[str, str], dict[str, str]] = {}
    by_sensor: dict[str, dict[str, list[str]]] = {}
    for find_axes in (_find_letters, _find_number):  # numbers may be those of sensors
        owned = {name for axes in groups.values() if len(axes) > 2 for name in axes.values()}
        for name in names:
            for stem, axis in find_axes(split_unit(name)[0]) if name not in owned else ():
                if signal := guess_signal(stem.replace("linear_acc", "acc") if ros else stem):
                    groups.setdefault((stem, signal), {})[axis] = name
    for (stem, signal), axes in groups.items():
        order = ORDER[signal]
        if set("0123") <= set(axes) and signal == "orientation":
            order = "1230"  # numbered quaternions begin with w
        elif not set(order) <= set(axes) and signal != "orientation":
            order = "012"
        if set(order) <= set(axes):
            by_sensor.setdefault(_find_owner(stem, table), {}).setdefault(signal, [axes[axis] for axis in order])
    return by_sensor


def split_unit(name: str) -> tuple[str, str]:
    """Split a column's name into what stands before its unit, and the unit; an axis in brackets is none."""
    match = _BRACKETS.fullmatch(name)
    if match and match[1] and not re.fullmatch("[xyzw0-3]", match[2], re.IGNORECASE):
        return match[1], match[2]
    for pattern in (pattern for patterns in UNITS.values() for pattern in patterns.values()):
        if match := re.fullmatch(rf"(.*[xyz].*)[ _,]+({pattern})", name, re.IGNORECASE):
            return match[1], match[2]
    return name, ""


def _find_letters(name: str) -> Iterator[tuple[str, str]]:
    """Find the letters of a name that may be its axis: x, y, z and w on their own, or after a signal's word."""
    for k, letter in enumerate(name):
        before, after = name[:k], name[k + 1 : k + 2]
        begins = not before[-1:].isalpha() or (letter.isupper() and before[-1:].islower())
        ends = not after.isalpha() or (after.isupper() and not letter.isupper())
        if letter.lower() in "xyzw" and ends and (begins or _BEFORE_AXIS.search(before.lower())):
            yield before + HOLE + name[k + 1 :], letter.lower()


def _find_number(name: str) -> Iterator[tuple[str, str]]:
    if match := _NUMBERED.fullmatch(name):
        yield match[1] + HOLE, match[2]


def guess_unit(signal: str, text: str) -> str | None:
    """Guess the unit of a signal, as a session states it, from what a file calls it."""
    matches = (unit for unit, pattern in UNITS.get(signal, {}).items() if re.fullmatch(pattern, text, re.IGNORECASE))
    return next(matches, None)


def guess_signal(stem: str) -> str | None:
    """Guess the signal from a column's name without its axis."""
    text = stem.lower()
    if re.search(NOT, text):
        return None
    return next((signal for signal, pattern in SIGNALS.items() if re.search(pattern, text)), None)


def _is_time(name: str) -> bool:
    words = _split_words(name)
    rest = [word for word in words if word not in TIME and word not in TIME_UNIT]
    named = any(word in TIME for word in words) or (len(words) == 1 and words[0] in TIME_UNIT and words[0] != "s")
    return named and all(word in BESIDE_TIME or word.isdigit() for word in rest)


def _split_words(name: str) -> list[str]:
    return re.sub(r"(?<=[a-z])(?=[A-Z])|[\W_]+", " ", name).lower().split()


def _find_owner(stem: str, table: BodyTable) -> str:
    """Return the segment, or the name without its signal, which one sensor's signals have in common."""
    if segment := table.guess_segment(stem.replace(HOLE, " ")):
        return segment
    text = stem.lower()
    for pattern in SIGNALS.values():
        text = re.sub(f"({pattern})[a-z]*", "", text)
    return f"?{re.sub(f'[ _./:{HOLE}-]+', ' ', text).strip()}"
