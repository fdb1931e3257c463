"""The checker of values against annotations: arguments of public functions, fields, and what stands in a TOML file.

``check_arguments(track, locals())`` is the first line of a public function. The annotation defines the check: a
`Positive` number, a choice of a `Literal`, a class. An object with a method `check` is checked by it. Inner functions
do no checks.
"""

import math
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from .errors import BadData, BadOption, one_of


@dataclass(frozen=True)
class Range:
    """Numbers above `low`, or at least `low` where `closed`, and at most `high`: finite unless that is infinite."""

    low: float
    closed: bool
    high: float = sys.float_info.max
    unit: str = ""

    def __str__(self) -> str:
        unit = f" [{self.unit}]" if self.unit else ""
        if self.low <= -1e300:
            return f"a finite number{unit}"
        if self.closed and self.high < sys.float_info.max:
            return f"a number{unit} from {self.low:g} to {self.high:g}"
        kind, up_to = "finite " * (self.high < math.inf), f", up to {self.high:g}" * (self.high < sys.float_info.max)
        return f"a {kind}number{unit} {'at least' if self.closed else 'above'} {self.low:g}{up_to}"

    def __contains__(self, value: float) -> bool:
        return (self.low <= value if self.closed else self.low < value) and value <= self.high


Positive = Annotated[float, Range(0.0, closed=False)]
NonNegative = Annotated[float, Range(0.0, closed=True)]
PositiveOrInfinite = Annotated[float, Range(0.0, closed=False, high=math.inf)]
Count = Annotated[int, Range(0.0, closed=True)]
EACH_TIME = ", a row for each time"  # part of an error's text on an array's shape


# Annotation → class of the values that it takes, and what it takes in words.
_KINDS: dict[Any, tuple[Any, str]] = {
    float: (Real, "a number"),
    int: (Integral, "a whole number"),
    bool: (bool | np.bool_, "true or false"),
    str: (str, "a text"),
    Path: (os.PathLike, "a path"),
    Any: (object, "a value"),
    NoneType: (NoneType, "None"),
    np.ndarray: (np.ndarray | list | tuple, "an array"),
    Mapping: (Mapping, "a mapping of names to values"),
    Callable: (Callable, "a function"),
}


@cache
def _split(hint: Any) -> tuple[tuple[Any, Range | None], ...]:
    """Split an annotation into those of a union, each with its range."""
    if get_origin(hint) in (Union, UnionType):
        return tuple(each for part in get_args(hint) for each in _split(part))
    if get_origin(hint) is Annotated:
        base, *notes = get_args(hint)
        limits = next((note for note in notes if isinstance(note, Range)), None)
        if limits is not None and get_origin(base) is tuple:  # of its numbers
            items = (each if each is ... else Annotated[each, limits] for each in get_args(base))
            return _split(tuple.__class_getitem__(tuple(items)))
        return tuple((part, limits or own) for part, own in _split(base))
    return ((hint, None),)


def _takes(hint: Any, value: Any) -> bool:
    origin = get_origin(hint) or hint
    kind = str if origin is Literal else tuple if origin is Sequence else _KINDS.get(origin, (origin,))[0]
    is_no_number = kind in (Real, Integral) and (isinstance(value, bool) or value != value)
    return isinstance(value, tuple | list if kind is tuple else kind) and not is_no_number


def _describe_part(hint: Any, limits: Range | None) -> str:
    origin, parts = get_origin(hint) or hint, get_args(hint)
    if origin is Literal:
        return f"one of {', '.join(filter(None, parts))}"
    if origin in (tuple, Sequence):
        count = f"{len(parts)} " if origin is tuple and parts and ... not in parts else ""
        item = describe(parts[0]) if parts else "a value"
        return f"a list of {count}" + re.sub(r"^an? ((whole |finite )?\w+)", r"\1s", item)
    text = str(limits or _KINDS.get(origin, (origin, f"an object of class {origin.__name__}"))[1])
    return re.sub("^a (finite )?number", "a whole number", text) if origin is int else text


def describe(hint: Any) -> str:
    """Return what an annotation takes in words, such as "a number [deg] from 0 to 90"."""
    return ", or ".join(dict.fromkeys(_describe_part(*each) for each in _split(hint)))


@cache
def _read_hints(function: Any) -> dict[str, Any]:
    hints = get_type_hints(function, include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return" and not name.startswith("_")}


def check_arguments(function: Any, arguments: Mapping[str, Any]) -> None:
    """Check the arguments of a function against its annotations; raise `BadOption`, or what a `check` raises."""
    for name, hint in _read_hints(function).items():
        if name in arguments:
            check_value(name, arguments[name], hint)


def check_fields(value: Any, place: str) -> None:
    """Check every field of a dataclass against its annotation."""
    for name, hint in _read_hints(value.__class__).items():
        check_value(f"{place}{name}", getattr(value, name), hint)


def check_value(place: str, value: Any, hint: Any, error: type[Exception] = BadOption) -> None:
    """Check a value and its contents against an annotation; `place` begins the text of the `error` that is raised."""
    part, limits = next((each for each in _split(hint) if _takes(each[0], value)), (None, None))
    parts = get_args(part)
    if part is None or (limits is not None and value not in limits):
        needed = describe(hint) if part is None else _describe_part(part, limits)
        raise error(f"{place} = {_show(value)}; {needed} is needed")
    if get_origin(part) is Literal:
        if value not in parts:
            raise error(f"{place} = {_show(value)} is not known; {one_of(filter(None, parts), value)}")
    elif isinstance(value, Mapping):
        for name, entry in value.items() if parts else ():
            check_value(f"{place}: name", name, parts[0], error)
            check_value(f"{place}.{name}", entry, parts[1], error)
    elif parts and isinstance(value, tuple | list):
        each = [parts[0]] * len(value) if len(parts) == 1 or ... in parts else parts
        if len(value) != len(each):
            raise error(f"{place} = {_show(value)}; {_describe_part(part, None)} is needed")
        for k, (entry, own) in enumerate(zip(value, each, strict=True)):
            check_value(f"{place}[{k}]", entry, own, error)
    elif part is not Any and (is_dataclass(value) or hasattr(value, "_fields")):
        value.check() if hasattr(value, "check") else check_fields(value, f"{place}.")


def _show(value: Any) -> str:
    return f"array {value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else repr(value)[:60]


def check_array(
    place: str, values: Any, shape: tuple[int, ...], rows: str = "", *, kind: str = "number", unit: float = np.inf
) -> None:
    """Raise `BadData` where `values` is no array of that shape of finite numbers; `rows` ends the text on a shape.

    `kind`: also "missing", numbers or NaN, and "flag", bool; `unit`: by how much the length of quaternions (…, 4) or
    directions (…, 3) may differ from 1
    """
    if not isinstance(values, np.ndarray) or values.dtype.kind not in ("b" if kind == "flag" else "fiu"):
        needed = "bool" if kind == "flag" else "real numbers"
        raise BadData(f"{place} = {_show(values)}: a NumPy array of {needed}, {shape}, is needed")
    if values.shape != shape:
        raise BadData(f"{place} has the shape {values.shape}; {shape} is needed{rows}")
    wrong = np.isinf(values) if kind == "missing" else ~np.isfinite(values)
    if wrong.any():
        k = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise BadData(f"{place}[{', '.join(map(str, k))}] = {values[k]:g}: a finite number is needed")
    if np.isfinite(unit):
        length = np.linalg.norm(values, axis=-1)
        off = np.abs(np.nan_to_num(length, nan=1.0) - 1.0)
        if np.max(off, initial=0.0) > unit:
            what = "unit quaternion x, y, z, w" if shape[-1] == 4 else "unit vector"
            raise BadData(f"{place}: no {what}: length {length.flat[int(np.argmax(off))]:.6g}")


def check_names(place: str, names: Iterable[str], known: Collection[str], error: type[Exception] = BadOption) -> None:
    """Raise an `error` where a name is not known."""
    for name in names:
        if name not in known:
            raise error(f"{place}: '{name}' is not known; {one_of(known, name)}")
