"""The command line, by cyclopts: words → a command and its arguments; help in plain lines; mistakes in one line."""

from __future__ import annotations

import inspect
import io
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

from cyclopts import App, CycloptsError, Group, Parameter, UnknownOptionError, UnusedCliTokensError
from cyclopts.help import HelpPanel
from rich.console import Console, ConsoleOptions, RenderableType

from .. import __version__
from ..errors import BadOption, WeposeError, one_of

# In the order of `wepose --help`; each is imported when it is needed.
COMMANDS = {
    **{name: f"wepose_pin.commands.{name}:{name}" for name in ("demo", "info", "simulate", "calibrate", "track")},
    **{name: f"wepose_pin.commands.{name}:{name}" for name in ("view", "evaluate", "angles", "export", "retarget")},
    "live": "wepose_pin.commands.live:live",
    "batch": "wepose_pin.batch.command:batch",
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
    return str(error).rstrip(".")


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
            columns = textwrap.fill(text, min(console.width, WIDEST), initial_indent=indent, subsequent_indent=indent)
            below = f"\n{columns}" if len(label) >= _LABEL else columns[len(label) :]
            heading = f"{panel.title}:\n" if k == 0 else ""
            console.out(f"{heading}{label}{below}".rstrip(), highlight=False)
        if panel.entries:
            console.out("")

    def render_usage(self, console: Console, options: ConsoleOptions, usage: RenderableType) -> None:  # noqa: ARG002
        console.out(_plain(usage), highlight=False, end="\n\n")

    def render_description(self, console: Console, options: ConsoleOptions, text: RenderableType) -> None:  # noqa: ARG002
        for paragraph in _plain(text, paragraphs=True).split("\n\n"):
            line = " ".join(paragraph.split())
            if not line.startswith("Example: "):
                line = textwrap.fill(line, min(console.width, WIDEST))
            console.out(line, highlight=False, end="\n\n")


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
