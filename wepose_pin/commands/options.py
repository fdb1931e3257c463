"""Types of options: what a value is called in the help, how it is read, and what is wrong with it."""

from __future__ import annotations

import ast
import contextlib
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from cyclopts import Group, Parameter, Token, validators

from ..errors import BadOption, WrongOption

MORE = Parameter(group=Group("More options", sort_key=2))
RESEARCH = Parameter(group=Group("Options for research", sort_key=3))

Method = Literal["amekf", "smoother", "smekf", "smekf_published", "ncf", "gdc"]
LiveMethod = Literal["amekf", "smekf", "smekf_published", "ncf", "gdc"]
Formulation = Literal["full", "paper"]
Arms = Literal["left", "right", "both"]


Command = TypeVar("Command", bound=Callable[..., Any])
_PACKAGE = Path(__file__).parents[1]
_PARAMETERS = "Parameters\n----------\n"


def described_by(*functions: str) -> Callable[[Command], Command]:
    """Take the help of a command's options from functions ``FILE:NAME`` of the package, the first that has the option.

    Their docstrings are read from the source: importing those rooms takes a second. What the command's own docstring
    says of an option follows.
    """

    def complete(command: Command) -> Command:
        shared: dict[str, str] = {}
        for place in functions:
            file, _, name = place.partition(":")
            tree = ast.parse((_PACKAGE / file).read_text(encoding="utf-8"))
            function = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name)
            shared = read_descriptions(ast.get_docstring(function)) | shared
        own, entries = read_descriptions(command.__doc__), ""
        for name, parameter in inspect.signature(command).parameters.items():
            texts = shared.get(name) if parameter.kind is parameter.KEYWORD_ONLY else None, own.get(name)
            entries += f"{name}\n    {' '.join(filter(None, texts))}\n"
        command.__doc__ = inspect.cleandoc(command.__doc__ or "").partition(_PARAMETERS)[0] + _PARAMETERS + entries
        return command

    return complete


def read_descriptions(docstring: str | None) -> dict[str, str]:
    """Parameter → its description in a NumPy docstring, in one line."""
    section = inspect.cleandoc(docstring or "").partition(_PARAMETERS)[2].partition("\n\n")[0]
    entries = re.findall(r"^(\w[\w, ]*?)(?: :.*)?\n((?:    .+\n?)+)", section, re.MULTILINE)
    return {name: " ".join(text.split()) for names, text in entries for name in names.split(", ")}


def _read_whole_number(_kind: type, tokens: Sequence[Token]) -> int:
    if not tokens[0].value.lstrip("-").isdecimal():  # cyclopts would round it
        raise ValueError(f"'{tokens[0].value}' is not a whole number")
    return int(tokens[0].value)


def _check_model(_kind: type, model: str | None) -> None:
    """A batch learns of a misspelt file before it calibrates."""
    if model is not None and Path(model).suffix and not Path(model).is_file():
        raise WrongOption(
            "model", model, "no such file; a URDF, a TOML that names one, or the name of a body is needed"
        )


def _checked_by(place: str) -> Parameter:
    """The check is a function ``MODULE:NAME`` of this package, imported when the option is given."""

    def check(_kind: type, value: Any) -> None:
        module, _, name = place.partition(":")
        if value is not None:
            getattr(import_module(f"wepose_pin.{module}"), name)(value)

    return Parameter(validator=check)


def _read_entries(numbers: bool, words: Sequence[Token]) -> dict[str, Any]:
    """What several ``NAME=VALUE`` say: numbers alone, or else a text where it is no number."""
    needed, entries = "NAME=METRES" if numbers else "NAME=VALUE", dict[str, Any]()
    for word in words:
        name, equals, value = word.value.partition("=")
        if not (name and equals):
            raise BadOption(f"{word.keyword}: '{word.value}': {needed} is needed")
        if name in entries:
            raise BadOption(f"{word.keyword} {word.value}: '{name}' is given twice")
        entries[name] = value
        with contextlib.suppress(ValueError):
            entries[name] = int(value) if value.isdecimal() else float(value)
        if entries[name] != entries[name] or (numbers and entries[name] == value):
            raise BadOption(f"{word.keyword}: {word.value}: '{value}' is not a number; {needed} is needed")
    return entries


Force = Annotated[bool, Parameter(help="Replace the files of an earlier run.")]
Interval = Annotated[tuple[float, float], Parameter(metavar="FROM TO"), _checked_by("recording:check_selection")]
Out = Annotated[Path, Parameter(alias="-o", metavar="DIR")]
OutFile = Annotated[Path, Parameter(alias="-o", metavar="FILE")]
Subject = Annotated[Path, Parameter(metavar="SUBJECT")]
Session = Annotated[Path, Parameter(metavar="SESSION")]
Model = Annotated[str, Parameter(metavar="NAME|FILE", validator=_check_model)]
File = Annotated[Path, Parameter(metavar="FILE")]
Name = Annotated[str, Parameter(metavar="NAME")]
Number = Annotated[int, Parameter(metavar="NUMBER", converter=_read_whole_number)]
Seed = Annotated[Number, Parameter(validator=validators.Number(gte=0))]
Count = Annotated[Number, Parameter(validator=validators.Number(gte=1))]
Hz = Annotated[float, Parameter(metavar="HZ")]
SampleHz = Annotated[Hz, Parameter(validator=validators.Number(gte=20, lte=2000))]
Seconds = Annotated[float, Parameter(metavar="SECONDS")]
Duration = Annotated[Seconds, Parameter(validator=validators.Number(gte=5, lte=7200))]
Factor = Annotated[float, Parameter(metavar="FACTOR")]
Share = Annotated[float, Parameter(metavar="SHARE")]
Radians = Annotated[float, Parameter(metavar="RAD")]
Text = Annotated[str, Parameter(metavar="TEXT")]
Angle = Annotated[str, Parameter(metavar="ANGLE")]
Address = Annotated[str, Parameter(metavar="ADDRESS")]
Folder = Annotated[Path, Parameter(metavar="DIR")]
PhaseName = Annotated[str, Parameter(metavar="PHASE")]
Stature = Annotated[float, Parameter(metavar="METRES"), _checked_by("body.anthropometry:check_stature")]
ProtocolName = Annotated[str, Parameter(metavar="NAME|FILE.toml"), _checked_by("calibration:load_protocol")]
Robot = Annotated[str, Parameter(metavar="NAME|FILE")]
Speed = Annotated[str, Parameter(metavar="FACTOR")]
RobotName = Annotated[str, Parameter(metavar="NAME|FILE"), _checked_by("retargeting:find_map")]
RobotHz = Annotated[float, Parameter(metavar="HZ"), _checked_by("retargeting.trajectory:check_rate")]
ExportHz = Annotated[float, Parameter(metavar="HZ"), _checked_by("writers.motion:check_rate")]
if TYPE_CHECKING:
    Measured = Mapping[str, float]
    Imperfection = Mapping[str, float | str]
else:  # cyclopts collects the values of an option that is given several times only of a list
    Measured = Annotated[
        list[str], Parameter(metavar="NAME=METRES", converter=lambda _, words: _read_entries(True, words))
    ]
    Imperfection = Annotated[
        list[str], Parameter(metavar="NAME=VALUE", converter=lambda _, words: _read_entries(False, words))
    ]
