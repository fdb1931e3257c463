"""Body models and calibration files, of the checkout where there is one, else of the wheel; and plug-ins by name."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from .errors import BadOption, reason

_PACKAGE = Path(__file__).resolve().parent


def asset(folder: str, name: str) -> Path:
    """Path of `name` in ``urdf/`` or ``calibration/``."""
    for root in (_PACKAGE.parent, _PACKAGE / "_assets"):
        path = root / folder / name
        if path.is_file():
            return path
    raise FileNotFoundError(f"wepose_pin was installed without {folder}/{name}; install it again")


@cache
def find_plugins(group: str) -> dict[str, EntryPoint]:
    """Name → what distributions register as entry points ``wepose.GROUP``: "readers", "writers", "sources", "outputs".

    What this package brings is registered in the same way, in pyproject.toml. It stands first, and its names are taken.
    """
    found = sorted(entry_points(group=f"wepose.{group}"), key=lambda each: not each.value.startswith("wepose_pin."))
    if not found or not found[0].value.startswith("wepose_pin."):
        raise BadOption(f"no {group} of wepose-pin are registered: install the package again")
    plugins: dict[str, EntryPoint] = {}
    for each in found:
        plugins.setdefault(each.name, each)
    return plugins


@cache
def load_plugin(group: str, name: str) -> Any:
    """Load the object that is registered by this name; raise `BadOption` where it cannot be imported."""
    try:
        return find_plugins(group)[name].load()
    except (ImportError, AttributeError) as error:
        raise BadOption(f"plug-in {name} of wepose.{group} cannot be imported: {reason(error)}") from error
