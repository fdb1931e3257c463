"""The command line as a user types it, in this process."""

import inspect

import pytest

from wepose_pin.commands import main
from wepose_pin.commands.options import APP


def run(*words: object) -> int:
    """The exit code of ``wepose`` with these words."""
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(stop.value.code or 0)


def options(name: str) -> dict[str, inspect.Parameter]:
    """Name → parameter of what a command takes besides words by position."""
    parameters = inspect.signature(APP[name].default_command).parameters.values()
    return {each.name: each for each in parameters if each.kind is each.KEYWORD_ONLY}
