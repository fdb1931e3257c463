"""Checks where a public function is called: each argument is what the function's annotation says.

``check_arguments(track, locals())`` is the first line of such a function. Annotations say it all: a `Positive` number,
a bool, a path, names → lengths. The method `check` of an object, if it has one, is called; of other dataclasses each
field is checked as an argument is. Inside, everything is trusted.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from .errors import BadData, BadOption, one_of

_LONGEST = 60  # letters of a value in a message


@dataclass(frozen=True)
class Range:
    """Numbers above `low`, or from it on where `closed`, up to `high`, that are finite."""

    low: float
    closed: bool
    high: float = math.inf

    def __str__(self) -> str:
        up_to = "" if math.isinf(self.high) else f", up to {self.high:g}"
        return f"a finite number {'at least' if self.closed else 'above'} {self.low:g}{up_to}"

    def __contains__(self, value: float) -> bool:
        return (self.low <= value if self.closed else self.low < value) and value <= self.high and value < math.inf


Positive = Annotated[float, Range(0.0, closed=False)]
NonNegative = Annotated[float, Range(0.0, closed=True)]
Count = Annotated[int, Range(0.0, closed=True)]


def check_arguments(function: Any, arguments: Mapping[str, Any]) -> None:
    """Every argument, by its name, is what the annotation of that name says of a function, or of a class' making.

    Raises
    ------
    BadOption
        One that is not, named with its value and what is needed.
    WeposeError
        What the `check` of an argument that has one raises.
    """
    made_by = getattr(function, "__init__") if isinstance(function, type) else function  # noqa: B009
    for name, hint in _hints(made_by).items():
        if name not in arguments:
            continue
        value = arguments[name]
        nan = isinstance(value, float) and math.isnan(value)
        if not (nan and float in _options(hint)):  # which the function's own range refuses
            check_value(name, value, hint)


def check_fields(value: Any, place: str, kind: type | None = None) -> None:
    """Every field of a dataclass or named tuple is what its annotation says; those of the base `kind` where given."""
    for name, hint in _hints(kind or type(value)).items():
        check_value(f"{place}{name}", getattr(value, name), hint)


def check_value(place: str, value: Any, hint: Any) -> None:
    """A value is what an annotation says, and so is what it holds; `place` begins the error's text."""
    if not _fits(value, hint):
        raise BadOption(f"{place} = {_shown(value)}: {_needed(hint)} is needed")
    hint = next((option for option in _options(hint) if _fits(value, option)), hint)
    parts = get_args(hint)
    if get_origin(hint) is Annotated:
        if value not in parts[1]:
            raise BadOption(f"{place} = {_shown(value)}: {parts[1]} is needed")
    elif get_origin(hint) is Literal:
        if value not in parts:
            raise BadOption(f"{place} = {_shown(value)} is not known; {one_of(parts, value)}")
    elif isinstance(value, Mapping):
        for name, entry in value.items() if parts else ():
            check_value(f"{place}: name", name, parts[0])
            check_value(f"{place}.{name}", entry, parts[1])
    elif get_origin(hint) in (tuple, Sequence):
        each = [parts[0]] * len(value) if parts[-1] is ... or len(parts) == 1 else list(parts)
        if len(value) != len(each):
            raise BadOption(f"{place} = {_shown(value)}: {len(each)} values are needed, not {len(value)}")
        for k, (entry, of) in enumerate(zip(value, each, strict=True)):
            check_value(f"{place}[{k}]", entry, of)
    elif hint is not Any and (is_dataclass(value) or hasattr(value, "_fields")):
        value.check() if hasattr(value, "check") else check_fields(value, f"{place}.")


def check_array(place: str, values: Any, shape: tuple[int, ...], kinds: str = "fiu", rows: str = "") -> None:
    """`values` is an array of that shape, whose type is of NumPy's `kinds`; `rows` says what a row is for.

    Raises
    ------
    BadData
        It is not.
    """
    if not isinstance(values, np.ndarray) or values.dtype.kind not in kinds:
        of = "bool" if kinds == "b" else "real numbers"
        raise BadData(f"{place} = {_shown(values)}: a NumPy array of {of}, {shape}, is needed")
    if values.shape != shape:
        raise BadData(f"{place} has the shape {values.shape}; {shape} is needed{rows}")


def check_finite(place: str, values: np.ndarray, *, missing: bool = False) -> None:
    """Numbers are finite; where they may be `missing`, NaN is passed over."""
    wrong = np.isinf(values) if missing else ~np.isfinite(values)
    if wrong.any():
        k = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise BadData(f"{place}[{', '.join(map(str, k))}] = {values[k]:g}: a finite number is needed")


def check_unit(place: str, quat: np.ndarray, tolerance: float) -> None:
    """Quaternions (…, 4) are of length 1; those that are missing, NaN, are passed over."""
    length = np.linalg.norm(quat, axis=-1)
    off = np.abs(np.nan_to_num(length, nan=1.0) - 1.0)
    if np.max(off, initial=0.0) > tolerance:
        raise BadData(f"{place}: no unit quaternion x, y, z, w: length {length.flat[int(np.argmax(off))]:.6g}")


def check_covariance(place: str, matrices: np.ndarray) -> None:
    """Matrices (…, k, k) are symmetric and positive semidefinite; those with NaN are passed over."""
    known = matrices[np.isfinite(matrices).all(axis=(-2, -1))]
    scale = np.max(np.abs(known), axis=(-2, -1), initial=0.0)
    skew = np.max(np.abs(known - np.swapaxes(known, -2, -1)), axis=(-2, -1), initial=0.0)
    if (skew > 1e-6 * scale).any() or (np.linalg.eigvalsh(known)[..., 0] < -1e-6 * scale).any():
        raise BadData(f"{place} is not symmetric and positive semidefinite")


def check_names(place: str, names: Collection[str], known: Collection[str], otherwise: str = "") -> None:
    """Each name is one of those that are known; `otherwise` says what else it may need.

    Raises
    ------
    BadOption
        One is not.
    """
    for name in names:
        if name not in known:
            raise BadOption(f"{place}: '{name}' is not known; {one_of(known, name)}{otherwise}")


@cache
def _hints(of: Any) -> dict[str, Any]:
    hints = get_type_hints(of, include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return" and not name.startswith("_")}


def _options(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of the kind that an annotation says; what it holds is not looked at."""
    origin = get_origin(hint)
    if len(_options(hint)) > 1:
        return any(_fits(value, option) for option in _options(hint))
    if origin is Annotated:
        return _fits(value, get_args(hint)[0])
    if hint is Any:
        return True
    if hint in (float, int):
        number = isinstance(value, Integral if hint is int else Real) and not isinstance(value, bool | np.bool_)
        return number and value == value
    if hint is np.ndarray:
        return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.dtype.kind in "biuf")
    kind: dict[Any, Any] = {bool: (bool, np.bool_), Path: os.PathLike, Literal: str, tuple: (tuple, list)}
    return isinstance(value, kind.get(origin or hint, origin or hint))


def _needed(hint: Any) -> str:
    """What an annotation asks for, in words."""
    if len(_options(hint)) > 1:
        return ", or ".join(dict.fromkeys(_needed(option) for option in _options(hint)))
    if get_origin(hint) is Annotated:
        return str(get_args(hint)[1])
    words = {
        bool: "True or False",
        float: "a number",
        int: "a whole number",
        str: "a text",
        Path: "a path",
        tuple: "a tuple",
        Mapping: "a mapping of names to values",
        Callable: "a function",
        NoneType: "None",
        np.ndarray: "an array of real numbers",
        Literal: f"one of {', '.join(map(str, get_args(hint)))}",
    }
    kind = get_origin(hint) or hint
    return words.get(kind) or f"an object of class {kind.__name__}"


def _shown(value: Any) -> str:
    text = f"array {value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else " ".join(repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} …"
