"""Arrays of numbers made of files and values: key → array of float64 (or bool and integers as such)."""

from __future__ import annotations

import fnmatch
import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from . import adapter

Arrays = dict[str, np.ndarray]
_NUMBER = re.compile(r"(?<![\w.+-])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])|\bnan\b", re.IGNORECASE)


def values_of(value: Any, key: str = "") -> Arrays:
    """Every number in mappings, dataclasses, lists and arrays; null is NaN; texts are left out."""
    if re.search(adapter.VOLATILE, key) or isinstance(value, str | bytes | Path):
        return {}
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {k: v for name, each in value.items() for k, v in values_of(each, _join(key, str(name))).items()}
    if value is None:
        return {key: np.array(np.nan)}
    if (
        isinstance(value, list)
        and value
        and all(isinstance(each, Mapping) and each.keys() == value[0].keys() for each in value)
    ):
        return values_of({name: [each[name] for each in value] for name in value[0]}, key)  # rows as columns
    array = _array(value)
    if array is not None:
        return {key: array}
    if isinstance(value, list | tuple):
        return {k: v for n, each in enumerate(value) for k, v in values_of(each, _join(key, str(n))).items()}
    return {}


def _join(key: str, name: str) -> str:
    return f"{key}/{name}" if key else name


def _array(value: Any) -> np.ndarray | None:
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        return None
    if array.dtype.kind not in "fiub":
        return None
    array = array.astype(float)
    array[np.isnan(array)] = np.nan  # one NaN, whatever its bits
    return array


def folder_values(folder: Path, key: str) -> Arrays:
    """The numbers of all files of a result that are compared."""
    found: Arrays = {}
    for path in sorted(path for path in folder.rglob("[!.]*") if path.is_file()):
        if any(fnmatch.fnmatch(path.name, pattern) for pattern in adapter.NOT_COMPARED):
            continue
        name = path.relative_to(folder).with_suffix("").as_posix()
        same_stem = [
            other for other in path.parent.glob(f"{path.stem}.*") if other.suffix not in (path.suffix, ".html")
        ]
        name += path.suffix if same_stem else ""
        found |= file_values(path, key if name in adapter.MAIN_TABLES else f"{key}/{name}")
    return found


def file_values(path: Path, key: str) -> Arrays:
    """The numbers of one file.

    Columns of a table, keys of JSON and TOML; of text the numbers in their order, without comments; of C3D its points.
    """
    suffix = path.suffix.lower()
    if suffix in (".parquet", ".csv"):
        return _table_values(path, key)
    if suffix == ".json":
        return values_of(json.loads(path.read_text(encoding="utf-8")), key)
    if suffix == ".toml":
        return values_of(tomllib.loads(path.read_text(encoding="utf-8")), key)
    if suffix == ".c3d":
        return _c3d_values(path, key)
    if suffix in (".yaml", ".urdf", ".mot", ".sto", ".trc", ".bvh", ".xml", ".txt", ".jsonl"):
        text = re.sub(r"<!--.*?-->", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        lines = [line for line in text.splitlines() if not line.lstrip().startswith(("#", "//"))]
        return {key: np.array([float(number) for number in _NUMBER.findall("\n".join(lines))])}
    raise ValueError(f"{path}: how are its numbers read?")


def _table_values(path: Path, key: str) -> Arrays:
    if path.suffix == ".csv":
        frame = pl.read_csv(path, infer_schema_length=None, comment_prefix="#")
    else:
        frame = pl.read_parquet(path)
    found: Arrays = {}
    for name in frame.columns:
        column = frame[name]
        if column.dtype.is_numeric() or column.dtype == pl.Boolean:
            found |= values_of(column.cast(pl.Float64).fill_null(float("nan")).to_numpy(), f"{key}/{name}")
        elif column.dtype.is_nested():
            found |= values_of(column.to_list(), f"{key}/{name}")
    return found


def _c3d_values(path: Path, key: str) -> Arrays:
    import ezc3d

    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    names, values = point["LABELS"]["value"], np.asarray(file["data"]["points"])
    found = {f"{key}/{name}": np.ascontiguousarray(values[:3, k].T) for k, name in enumerate(names)}
    return found | {f"{key}/rate": np.asarray(point["RATE"]["value"], float)}
