"""One function a command does the whole job: a frozen dataclass of its options in, an outcome out, nothing printed.

The command line and batch build the same dataclass and call the same function. A docstring's
``Parameters`` are the help of the options: of ``name : METAVAR`` the second word is what the value is called there. An
option that is true by default is described as what happens by default; its switch is ``--no-NAME``.

Heavy rooms load inside the functions, so that help and mistakes in options are answered at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

Method = Literal["amekf", "smoother", "smekf", "smekf_published", "ncf", "gdc"]
LiveMethod = Literal["amekf", "smekf", "smekf_published", "ncf", "gdc"]
Formulation = Literal["full", "paper"]
Arms = Literal["left", "right", "both"]
Progress = Callable[[str, float], None]  # the current step, and the fraction of the job that is done; may raise


def no_progress(_text: str, _fraction: float) -> None:
    """Progress that is not shown."""
