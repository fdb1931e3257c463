"""Types of options: what a value is called in the help, how it is read, and what is wrong with it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter, Token, validators

from ..errors import BadOption, WrongOption

MORE = Parameter(group=Group("More options", sort_key=2))
RESEARCH = Parameter(group=Group("Options for research", sort_key=3))

Method = Literal["amekf", "smoother", "smekf", "smekf_published", "ncf", "gdc"]
LiveMethod = Literal["amekf", "smekf", "smekf_published", "ncf", "gdc"]
Formulation = Literal["full", "paper"]
Arms = Literal["left", "right", "both"]


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


# Options of several commands, with their help ------------------------------------------------------------------------

Force = Annotated[bool, Parameter(help="Replace the files of an earlier run.")]
AcceptFailed = Annotated[bool, Parameter(help="Use a subject even if its calibration failed, which is else refused.")]
_GAPS = "Accept gaps of more than 50 ms: bridge them, and mark them in pose.parquet. Without it such a gap is an error."
Gaps = Annotated[bool, Parameter(help=_GAPS)]
Interval = Annotated[
    tuple[float, float],
    Parameter(metavar="FROM TO", help="Use only this time of the recording, in seconds."),
    _checked_by("recording:check_selection"),
]
Phase = Annotated[
    str,
    Parameter(
        metavar="NAME",
        help="Use only this phase of the recording. Of a phase with several intervals NAME:2 is the second.",
    ),
]
_FILTERS = (
    "Estimate orientations by this filter: amekf (Kalman filter, corrected in motion too), {}smekf (Kalman filter of "
    "Lisini Baldi et al. 2019, corrected in static phases, with an exact covariance and two more conditions of the "
    "static test), smekf_published (the same as published), ncf (complementary filter, Mahony et al. 2008), gdc "
    "(gradient descent, Madgwick et al. 2011)."
)
MethodOption = Annotated[Method, Parameter(help=_FILTERS.format("smoother (the same forward and backward in time), "))]
LiveMethodOption = Annotated[LiveMethod, Parameter(help=_FILTERS.format(""))]


# Values --------------------------------------------------------------------------------------------------------------

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
