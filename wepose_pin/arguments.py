"""Checks of the arguments of public functions against their annotations.

``check_arguments(track, locals())`` is the first line of such a function. The annotation defines the check: a
`Positive` number, a bool, a path, names → lengths. An object with a method `check` is checked by it; of other
dataclasses each field is checked like an argument. Inner functions do no checks.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from .errors import BadData, BadOption, one_of

_LONGEST = 60  # letters of a value in a message
_PLAIN = (float, bool, int, str)


@dataclass(frozen=True)
class Range:
    """Finite numbers above `low`, or at least `low` where `closed`, and at most `high`."""

    low: float
    closed: bool
    high: float = math.inf

    def __str__(self) -> str:
        up_to = "" if math.isinf(self.high) else f", up to {self.high:g}"
        return f"{'at least' if self.closed else 'above'} {self.low:g}{up_to}"

    def __contains__(self, value: float) -> bool:
        return (self.low <= value if self.closed else self.low < value) and value <= self.high and value < math.inf


Positive = Annotated[float, Range(0.0, closed=False)]
NonNegative = Annotated[float, Range(0.0, closed=True)]
Count = Annotated[int, Range(0.0, closed=True)]


def check_arguments(function: Any, arguments: Mapping[str, Any]) -> None:
    """Check every argument against the annotation of its name in a function, or in the constructor of a class.

    Raises
    ------
    BadOption
        An argument does not fit; the text has its name, its value and what is needed.
    WeposeError
        An argument's own `check` fails.
    """
    signature = getattr(function, "__init__") if isinstance(function, type) else function  # noqa: B009
    for name, hint in _read_hints(signature).items():
        if name not in arguments:
            continue
        value = arguments[name]
        nan = isinstance(value, float) and math.isnan(value)
        if not (nan and float in _list_options(hint)):  # the function's own range refuses NaN
            check_value(name, value, hint)


def check_fields(value: Any, place: str, kind: type | None = None) -> None:
    """Check every field of a dataclass or named tuple against its annotation, or those of its base class `kind`."""
    for name, hint in _read_hints(kind or type(value)).items():
        check_value(f"{place}{name}", getattr(value, name), hint)


def check_value(place: str, value: Any, hint: Any) -> None:
    """Check a value and its contents against an annotation; `place` begins the error's text."""
    if _origin(hint) is Annotated and not isinstance(_parts(hint)[1], Range):  # it says how a file has the value
        hint = _parts(hint)[0]
    if type(value) is hint and hint in _PLAIN and value == value:  # the usual case, ten times as fast
        return
    if not _fits(value, hint):
        raise BadOption(f"{place} = {_format_value(value)}: {_describe_hint(hint)} is needed")
    hint = next((option for option in _list_options(hint) if _fits(value, option)), hint)
    parts = _parts(hint)
    if _origin(hint) is Annotated:
        if value not in parts[1]:
            raise BadOption(f"{place} = {_format_value(value)}: {_describe_hint(hint)} is needed")
    elif _origin(hint) is Literal:
        if value not in parts:
            raise BadOption(f"{place} = {_format_value(value)} is not known; {one_of(parts, value)}")
    elif isinstance(value, Mapping):
        for name, entry in value.items() if parts else ():
            check_value(f"{place}: name", name, parts[0])
            check_value(f"{place}.{name}", entry, parts[1])
    elif _origin(hint) in (tuple, Sequence):
        each = [parts[0]] * len(value) if parts[-1] is ... or len(parts) == 1 else list(parts)
        if len(value) != len(each):
            raise BadOption(f"{place} = {_format_value(value)}: {len(each)} values are needed, not {len(value)}")
        for k, (entry, entry_hint) in enumerate(zip(value, each, strict=True)):
            check_value(f"{place}[{k}]", entry, entry_hint)
    elif hint is not Any and (is_dataclass(value) or hasattr(value, "_fields")):
        value.check() if hasattr(value, "check") else check_fields(value, f"{place}.")


def check_array(place: str, values: Any, shape: tuple[int, ...], kinds: str = "fiu", rows: str = "") -> None:
    """Check that `values` is an array of that shape with a type of NumPy's `kinds`; `rows` ends the error's text.

    Raises
    ------
    BadData
        It is not.
    """
    if not isinstance(values, np.ndarray) or values.dtype.kind not in kinds:
        kind = "bool" if kinds == "b" else "real numbers"
        raise BadData(f"{place} = {_format_value(values)}: a NumPy array of {kind}, {shape}, is needed")
    if values.shape != shape:
        raise BadData(f"{place} has the shape {values.shape}; {shape} is needed{rows}")


def check_finite(place: str, values: np.ndarray, *, missing: bool = False) -> None:
    """Check that numbers are finite; NaN is accepted where they may be `missing`."""
    wrong = np.isinf(values) if missing else ~np.isfinite(values)
    if wrong.any():
        k = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise BadData(f"{place}[{', '.join(map(str, k))}] = {values[k]:g}: a finite number is needed")


def check_unit(place: str, quat: np.ndarray, tolerance: float) -> None:
    """Check that quaternions (…, 4) have length 1; NaN, a missing one, is accepted."""
    length = np.linalg.norm(quat, axis=-1)
    off = np.abs(np.nan_to_num(length, nan=1.0) - 1.0)
    if np.max(off, initial=0.0) > tolerance:
        raise BadData(f"{place}: no unit quaternion x, y, z, w: length {length.flat[int(np.argmax(off))]:.6g}")


def check_covariance(place: str, matrices: np.ndarray) -> None:
    """Check that matrices (…, k, k) are symmetric and positive semidefinite; those with NaN are accepted."""
    known = matrices[np.isfinite(matrices).all(axis=(-2, -1))]
    scale = np.max(np.abs(known), axis=(-2, -1), initial=0.0)
    skew = np.max(np.abs(known - np.swapaxes(known, -2, -1)), axis=(-2, -1), initial=0.0)
    wrong = bool((skew > 1e-6 * scale).any())
    try:  # faster than eigenvalues
        np.linalg.cholesky(known + (1e-6 * scale + 1e-300)[..., None, None] * np.eye(known.shape[-1]))
    except np.linalg.LinAlgError:
        wrong = True
    if wrong:
        raise BadData(f"{place} is not symmetric and positive semidefinite")


def check_names(place: str, names: Collection[str], known: Collection[str], otherwise: str = "") -> None:
    """Check that each name is known; `otherwise` ends the error's text.

    Raises
    ------
    BadOption
        A name is not known.
    """
    for name in names:
        if name not in known:
            raise BadOption(f"{place}: '{name}' is not known; {one_of(known, name)}{otherwise}")


def format_object(value: object, describe: Callable[[], str]) -> str:
    """``Class(description)`` in one line, for `__repr__`; an object with invalid fields says that it is invalid."""
    name = type(value).__name__
    try:
        return f"{name}({describe()})"
    except Exception:
        return f"{name}(invalid: its check() says why)"


def format_settings(value: Any) -> str:
    """``Class(name=value)`` in one line, for `__repr__`: the fields of a dataclass that differ from their defaults."""
    chosen = {each.name: getattr(value, each.name) for each in fields(value)}
    changed = [f"{each.name}={chosen[each.name]!r}" for each in fields(value) if chosen[each.name] != each.default]
    return f"{type(value).__name__}({', '.join(changed)})"


@cache
def _read_hints(function: Any) -> dict[str, Any]:
    hints = get_type_hints(function, include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return" and not name.startswith("_")}


@cache  # asked again for the same few annotations at each call
def _origin(hint: Any) -> Any:
    return get_origin(hint)


@cache
def _parts(hint: Any) -> tuple[Any, ...]:
    return get_args(hint)


@cache
def _list_options(hint: Any) -> tuple[Any, ...]:
    return _parts(hint) if _origin(hint) in (Union, UnionType) else (hint,)


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value has the kind of an annotation; its contents are not checked."""
    origin = _origin(hint)
    if len(_list_options(hint)) > 1:
        return any(_fits(value, option) for option in _list_options(hint))
    if origin is Annotated:
        return _fits(value, _parts(hint)[0])
    if hint is Any:
        return True
    if hint in (float, int):
        number = isinstance(value, Integral if hint is int else Real) and not isinstance(value, bool | np.bool_)
        return number and value == value
    if hint is np.ndarray:
        return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.dtype.kind in "biuf")
    kind: dict[Any, Any] = {bool: (bool, np.bool_), Path: os.PathLike, Literal: str, tuple: (tuple, list)}
    return isinstance(value, kind.get(origin or hint, origin or hint))


def _describe_hint(hint: Any) -> str:
    """Describe an annotation in words."""
    if len(_list_options(hint)) > 1:
        return ", or ".join(dict.fromkeys(_describe_hint(option) for option in _list_options(hint)))
    if _origin(hint) is Annotated:
        kind, limits = _parts(hint)[:2]
        return f"a {'whole' if kind is int else 'finite'} number {limits}"
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
        Literal: f"one of {', '.join(map(str, _parts(hint)))}",
    }
    kind = _origin(hint) or hint
    return words.get(kind) or f"an object of class {kind.__name__}"


def _format_value(value: Any) -> str:
    text = f"array {value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else " ".join(repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} …"
