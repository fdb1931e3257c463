"""The command line, by cyclopts: types of options, help in plain lines, and mistakes in one line."""

import ast
import contextlib
import inspect
import io
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from cyclopts import App, CycloptsError, Group, Parameter, Token, UnknownOptionError, UnusedCliTokensError, validators
from cyclopts.help import HelpPanel
from rich.console import Console, ConsoleOptions, RenderableType

from .. import __version__
from ..errors import BadOption, WeposeError, WrongOption, one_of

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
Interval = Annotated[tuple[float, float], Parameter(metavar="FROM TO"), _checked_by("recording.intervals:check_order")]
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
Repetitions = Annotated[str, Parameter(metavar="PHASE|ANGLE")]
Address = Annotated[str, Parameter(metavar="ADDRESS")]
Folder = Annotated[Path, Parameter(metavar="DIR")]
PhaseName = Annotated[str, Parameter(metavar="PHASE")]
Stature = Annotated[float, Parameter(metavar="METRES"), _checked_by("body.table:check_stature")]
ProtocolName = Annotated[str, Parameter(metavar="NAME|FILE.toml"), _checked_by("calibration:load_protocol")]
Robot = Annotated[str, Parameter(metavar="NAME|FILE")]
Speed = Annotated[str, Parameter(metavar="FACTOR")]
RobotName = Annotated[str, Parameter(metavar="NAME|FILE"), _checked_by("retargeting:find_map")]
RobotHz = Annotated[Hz, Parameter(validator=validators.Number(gte=10, lte=2000))]
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

# The command line -----------------------------------------------------------------------------------------------------

# In the order of `wepose --help`; each is imported when it is needed.
COMMANDS = {
    "demo": "wepose_pin.commands.simulate:demo",
    "info": "wepose_pin.commands.recordings:info",
    "simulate": "wepose_pin.commands.simulate:simulate",
    **{name: f"wepose_pin.commands.recordings:{name}" for name in ("calibrate", "track")},
    **{name: f"wepose_pin.commands.results:{name}" for name in ("view", "evaluate", "angles", "export")},
    **{name: f"wepose_pin.commands.{name}:{name}" for name in ("retarget", "live", "batch")},
}
HELP, VERSION = ("--help", "-h"), ("--version", "-V")
WIDEST = 98  # columns of a help text
_LABEL = 24  # columns of an option's name beside its text


def parse(words: Sequence[str]) -> tuple[Callable[..., Any], inspect.BoundArguments]:
    """The command that these words name, and its arguments; ``--help`` and ``--version`` are commands too.

    `BadOption`: a command or an option that is not known, lacks its value or has one that is not possible, or is
    missing.
    """
    first = words[0] if words else ""
    if first and first not in (*COMMANDS, *HELP, *VERSION):
        raise BadOption(f"'{first}' is not a command; {one_of(COMMANDS, first)}; see wepose --help")
    if first in ("", *HELP):
        for name in COMMANDS:
            APP[name]  # imported, for its line in the help
    try:
        command, bound, _ = APP.parse_args(words, print_error=False, exit_on_error=False)
    except CycloptsError as error:
        if isinstance(error.__cause__, WeposeError):  # of a validator
            raise error.__cause__ from None
        raise BadOption(f"{_describe(error, first)}; see wepose {first} --help") from None
    return command, bound


def _describe(error: CycloptsError, command: str) -> str:
    if isinstance(error, UnknownOptionError):
        switch = error.token.keyword or error.token.value
        names = [argument.name for argument in error.argument_collection if argument.name.startswith("--")]
        return f"{switch} is not an option of wepose {command}; {one_of(names, switch)}"
    if isinstance(error, UnusedCliTokensError):
        return f"'{(error.unused_tokens or [''])[0]}' is one word too many for wepose {command}"
    error.verbose = False
    begin, text = 'Command ".*" parameter (.*) requires ', str(error).rstrip(".")
    text = re.sub(f"{begin}an argument", rf"wepose {command} needs a value for \1", text)
    return re.sub(rf"{begin}(\d+) positional .* got", rf"wepose {command} needs \2 values for \1 and not", text)


class PlainHelp:
    """The help as paragraphs and two columns of text, without boxes; of a switch that is on, how to turn it off."""

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:  # noqa: ARG002
        for k, entry in enumerate(panel.entries):
            names, text = entry.display_labels_with_metavar, _plain(entry.description)
            if entry.negative_names:
                turns_off = entry.default == "True"
                names = entry.negative_names if turns_off else entry.positive_names + entry.positive_shorts
                text = f"Do not {text[0].lower()}{text[1:]}" if turns_off else text
            elif entry.default is not None:
                text += f" (default: {entry.default})"
            label, indent = f"  {', '.join(names)}", " " * _LABEL
            if entry.choices:
                label = label.removesuffix("CHOICE") + "|".join(entry.choices)
            columns = _fill(text, console.width, indent)
            below = f"\n{columns}" if len(label) >= _LABEL else columns[len(label) :]
            heading = f"{panel.title}:\n" if k == 0 else ""
            console.out(f"{heading}{label}{below}".rstrip(), highlight=False)
        if panel.entries:
            console.out("")

    def render_usage(self, console: Console, options: ConsoleOptions, usage: RenderableType) -> None:  # noqa: ARG002
        console.out(_plain(usage).replace("[ARGS...]", "[FURTHER...]"), highlight=False, end="\n\n")

    def render_description(self, console: Console, options: ConsoleOptions, text: RenderableType) -> None:  # noqa: ARG002
        for paragraph in _plain(text, paragraphs=True).split("\n\n"):
            line = " ".join(paragraph.split())
            if not line.startswith("Example: "):
                line = _fill(line, console.width)
            console.out(line, highlight=False, end="\n\n")


def _fill(text: str, width: int, indent: str = "") -> str:
    width = min(width, WIDEST)
    return textwrap.fill(text, width, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)


def _plain(text: RenderableType | None, paragraphs: bool = False) -> str:
    """What a renderable says, in one line or with its paragraphs."""
    console = Console(file=io.StringIO(), width=100_000, no_color=True)
    with console.capture() as capture:
        console.print("" if text is None else text, highlight=False)
    return capture.get().strip() if paragraphs else " ".join(capture.get().split())


def _refuse_nan(_kind: type, value: Any) -> None:
    if isinstance(value, float) and value != value:
        raise ValueError("a number is needed")


APP = App(
    name="wepose",
    help="Upper-body pose from wearable IMUs without magnetometers. `wepose demo` shows the "
    "steps from a recording to its pose.",
    help_epilogue="wepose COMMAND --help says what a command does, with its options and an example. Exit code: 0 "
    "success; 2 invalid options or input; 3 or 4 where the output must be checked or must not be used, as the help of "
    "calibrate, retarget and batch says; 130 stopped. Terms: docs/glossary.md.",
    version=f"wepose-pin {__version__}",
    version_flags=VERSION,
    help_flags=HELP,
    help_format="plaintext",
    help_formatter=PlainHelp(),
    group_arguments=Group("Arguments", sort_key=0),
    group_parameters=Group("Options", sort_key=1),
    default_parameter=Parameter(negative_iterable=(), negative_none=(), validator=_refuse_nan),
)
for _number, (_name, _place) in enumerate(COMMANDS.items()):
    APP.command(_place, name=_name, help_epilogue="", sort_key=_number)
