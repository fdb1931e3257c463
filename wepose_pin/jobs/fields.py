"""The fields of a job as data: their types and defaults, and a job built from values that a file holds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from ..errors import BadOption, one_of

Job = TypeVar("Job")
REQUIRED = object()


@cache
def field_types(kind: type) -> dict[str, Any]:
    """Field → its annotation, in the order of the fields."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in _fields(kind)}


def field_defaults(kind: type) -> dict[str, Any]:
    """Field → its default; `REQUIRED` where it has none."""
    return {field.name: _default(field) for field in _fields(kind)}


def field_values(job: Any) -> dict[str, Any]:
    """Field → its value in a job."""
    return {field.name: getattr(job, field.name) for field in fields(job)}


def build_job(kind: type[Job], values: Mapping[str, Any]) -> Job:
    """The job of these values, as JSON or TOML hold them: a path as text, a tuple as a list.

    Raises
    ------
    BadOption
        An option that the job does not have, one that it needs, or a value of another type.
    """
    from ..arguments import check_value

    types, converted = field_types(cast(type, kind)), {}
    for name, value in values.items():
        if name not in types:
            raise BadOption(f"{name} is not an option; {one_of(types, name)}")
        converted[name] = convert_value(value, types[name])
        check_value(name, converted[name], types[name])
    for name, default in field_defaults(kind).items():
        if default is REQUIRED and name not in converted:
            raise BadOption(f"{name} is missing")
    return kind(**converted)


def convert_value(value: Any, hint: Any) -> Any:
    """A value of JSON or TOML as its field has it; one of another type stays as it is."""
    kinds = choices_of(hint)
    if isinstance(value, str) and Path in kinds:
        return Path(value)
    if isinstance(value, list):
        return tuple(convert_value(entry, get_args(kinds[0])[0]) if get_args(kinds[0]) else entry for entry in value)
    if isinstance(value, int) and not isinstance(value, bool) and float in kinds:
        try:
            return float(value)
        except OverflowError:
            return math.inf
    return value


def choices_of(hint: Any) -> tuple[Any, ...]:
    """The types that an annotation allows, None left out."""
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return tuple(kind for kind in kinds if kind is not type(None))


def _fields(kind: Any) -> tuple[Field[Any], ...]:
    return fields(kind)


def _default(field: Field[Any]) -> Any:
    if field.default is not MISSING:
        return field.default
    return REQUIRED if field.default_factory is MISSING else field.default_factory()
