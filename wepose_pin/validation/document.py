"""``validation.json``: every trial of a run, and the run's settings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from ..errors import BadData, MissingFile
from ..simulation import MTI_3
from .contenders import DEFAULT_GAINS
from .gains import STATED
from .jobs import Result, Skipped
from .presets import PRESETS


class Document(NamedTuple):
    """The contents of a run's file."""

    results: list[Result]
    quick: bool
    versions: dict[str, str]
    presets: dict[str, dict[str, Any]]  # name → "imperfections" with their sizes, "measured_std" [m] of lengths
    noise: dict[str, float]  # of the simulated sensors, in `ImuNoise`'s units
    gains: dict[str, dict[str, Any]]  # setting → "ncf", "gdc" → gains as stated
    skipped: list[Skipped] = []  # trials that could not be scored  # noqa: RUF012
    planned: dict[str, int] = {}  # experiment → trials of a full run  # noqa: RUF012


def format_document(
    results: Sequence[Result],
    quick: bool,
    versions: Mapping[str, str],
    skipped: Sequence[Skipped] = (),
    planned: Mapping[str, int] = MappingProxyType({}),
) -> str:
    """Format the file's text, one line a result, without a time stamp: two runs give the same file.

    JSON has no infinity and no NaN: an unbounded range and a NaN are null.
    """
    head = {
        "versions": dict(versions),
        "quick": quick,
        "planned": dict(planned),
        **({"skipped": [each._asdict() for each in skipped]} if skipped else {}),
        "presets": {
            name: {"imperfections": asdict(preset.imperfections), "measured_std": preset.measured_std}
            for name, preset in PRESETS.items()
        },
        "noise": asdict(MTI_3),
        "gains": {
            setting: {name: asdict(params) for name, params in gains.items()}
            for setting, gains in {
                "default gains": DEFAULT_GAINS,
                **{s: g._asdict() for s, g in STATED.items()},
            }.items()
        },
    }
    text = json.dumps(_plain(head), indent=1, ensure_ascii=False, allow_nan=False).removesuffix("\n}")
    lines = ",\n".join(
        "  " + json.dumps(_plain(result._asdict()), ensure_ascii=False, allow_nan=False) for result in results
    )
    return f'{text},\n "results": [\n{lines}\n ]\n}}\n'


def join_results(
    kept: Document, results: Sequence[Result], skipped: Sequence[Skipped], chosen: Sequence[str], order: Sequence[str]
) -> tuple[list[Result], list[Skipped]]:
    """Join the results of the `chosen` experiments with those that an earlier run has of others, in that order."""
    place = {name: k for k, name in enumerate(order)}
    joined = [each for each in kept.results if each.experiment not in chosen] + list(results)
    missed = [each for each in kept.skipped if each.experiment not in chosen] + list(skipped)
    joined.sort(key=lambda result: place.get(result.experiment, len(place)))
    return joined, missed


def check_same_settings(kept: Document, now: Document, where: str) -> None:
    """Check that two runs have the same packages, noise, presets and gains, as far as both name them.

    Raises
    ------
    BadData
        They differ: their results are not to be compared.
    """
    for name in ("quick", "versions", "noise", "presets", "gains"):
        if _differ(getattr(kept, name), getattr(now, name)):
            raise BadData(f"{where}: {name}: made with others than this run's; run these experiments again as well")


def _differ(before: Any, after: Any) -> bool:
    """Tell whether two values differ, of dicts in the keys that both have."""
    if isinstance(before, dict) and isinstance(after, dict):
        return any(_differ(before[key], after[key]) for key in before.keys() & after.keys())
    return bool(before != after)


def read_document(path: Path) -> Document:
    """Read the run in `path`.

    Raises
    ------
    MissingFile
        It is not there.
    BadData
        It is no ``validation.json``.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; a validation.json that `wepose validate -o DIR` wrote is wanted here")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise BadData(f"{path}: is no JSON: {error}") from error
    return parse_document(content, str(path))


def parse_document(content: Any, where: str) -> Document:
    """Parse a run from decoded JSON.

    Raises
    ------
    BadData
        A key is missing or its value is of the wrong kind.
    """

    def read_value(table: Any, key: str, kind: type, place: str, default: Any = None) -> Any:
        value = table.get(key, default) if isinstance(table, dict) else None
        if not isinstance(value, kind):
            shown = "nothing" if value is None else type(value).__name__
            raise BadData(f"{where}: {place}{key}: {shown}, a {kind.__name__} is wanted; is it `wepose validate`'s?")
        return value

    results = []
    for k, item in enumerate(read_value(content, "results", list, "")):
        place = f"results[{k}]."
        experiment, trial, method = (read_value(item, key, str, place) for key in ("experiment", "trial", "method"))
        series = read_value(item, "series", dict, place, {})
        for curve in series:
            read_value(series, curve, list, f"{place}series.")
        results.append(Result(experiment, trial, method, read_value(item, "figures", dict, place), series))
    if not results:
        raise BadData(f"{where}: results: the list is empty; is it `wepose validate`'s?")
    return Document(
        results,
        read_value(content, "quick", bool, "", False),
        read_value(content, "versions", dict, "", {}),
        read_value(content, "presets", dict, "", {}),
        read_value(content, "noise", dict, "", {}),
        read_value(content, "gains", dict, "", {}),
        [
            Skipped(*(read_value(item, key, str, f"skipped[{k}].") for key in Skipped._fields))
            for k, item in enumerate(read_value(content, "skipped", list, "", []))
        ],
        read_value(content, "planned", dict, "", {}),
    )


def _plain(value: Any) -> Any:
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # NumPy's
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not abs(value) < float("inf") else value
