"""Pages beside a result that is written already: one that fails is a warning, and the result stays."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from ..errors import WeposeError
from ..page import reason
from .folder import whole_file


class PageWriter:
    """Makes the pages of a result folder after its results have landed there, each whole or not at all.

    Pages of an earlier run under these names go first: they would show another motion.

    Parameters
    ----------
    folder : holds the result
    names : of all pages to come

    Attributes
    ----------
    warnings : a line for each page, or section of one, that cannot be made: which, and why
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self.warnings: list[str] = []
        self._folder = folder
        for name in names:
            with contextlib.suppress(OSError):
                (folder / name).unlink()

    def write(self, name: str, make: Callable[[list[str]], str]) -> str | None:
        """Write a page and give its text, None where it fails; `make` is given a list for what of it fails alone."""
        failures: list[str] = []
        text = None
        try:
            made = make(failures)
            with whole_file(self._folder / name, force=True) as partial:
                partial.write_text(made, encoding="utf-8")
            text = made
        except Exception as error:
            failures.append(f"cannot be made: {reason(error)}; the other files of the result are whole")
        self.warnings += [f"{name}: {failure}" for failure in failures]
        return text

    def add_warnings(self, file: str) -> None:
        """Add them to the ``warnings`` of a JSON file of the result, if there are any."""
        if not self.warnings:
            return
        path = self._folder / file
        content = json.loads(path.read_text(encoding="utf-8"))
        content["warnings"] = [*content.get("warnings", []), *self.warnings]
        try:
            with whole_file(path, force=True) as partial:
                partial.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        except (OSError, WeposeError) as error:  # a full disk, say: what is there stays as it was
            self.warnings.append(f"{file}: these warnings cannot be added: {reason(error)}")
