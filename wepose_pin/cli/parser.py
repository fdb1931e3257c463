"""The options of a command from the fields of its job, by argparse; what is wrong with them as one `BadOption`."""

from __future__ import annotations

import argparse
import inspect
import math
import re
import shutil
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from ..errors import BadOption, one_of
from ..jobs.fields import REQUIRED, choices_of, field_defaults, field_types

WIDEST = 100  # columns of a help text
EXIT_CODES = "0 success, 2 invalid input."
_EXAMPLE = "Example: "


@dataclass(frozen=True)
class Command:
    """A command: the job whose fields are its options, and what runs it.

    Parameters
    ----------
    job : dataclass; its docstring is the help
    run : does the job, prints what came of it and returns the exit code
    example : a line that works, without the program's name
    arguments : fields that are given by position; all others are options
    exit_codes : what they mean; empty: `EXIT_CODES`
    removed : options of earlier versions → what to do instead
    """

    job: type
    run: Callable[[Any], int]
    example: str
    arguments: tuple[str, ...] = ()
    exit_codes: str = ""
    removed: Mapping[str, str] = field(default_factory=dict)

    def summary(self) -> str:
        """Its line in the list of commands."""
        return _description(self.job).split("\n")[0]


def parse(name: str, command: Command, argv: Sequence[str]) -> Any:
    """The job that these words ask for; ``--help`` prints the help and ends by `SystemExit`.

    Raises
    ------
    BadOption
        An option that is not known, lacks its value, has one of another type, or is missing.
    """
    see = f"see wepose {name} --help"
    options = {field: _Option(command, field, hint) for field, hint in field_types(command.job).items()}
    known = ["--help", *(each.switch for each in options.values() if each.switch)]
    for word in argv[: argv.index("--") if "--" in argv else None]:
        switch = word.partition("=")[0]
        if switch in command.removed:
            raise BadOption(f"{switch} is no option any more: {command.removed[switch]}")
        if switch.startswith("--") and switch not in known:
            raise BadOption(f"{switch} is not an option of wepose {name}; {one_of(known, switch)}; {see}")
    parser = _parser(name, command, list(options.values()))
    try:
        arguments, more = parser.parse_known_args(argv)
    except argparse.ArgumentError as error:
        raise BadOption(f"{error.argument_name}: {error.message}; {see}") from None
    if more:
        raise BadOption(f"'{more[0]}' is one word too many for wepose {name}; {see}")
    values = {field: value for field, value in vars(arguments).items() if value is not None}
    missing = [options[field].shown for field in options if options[field].required and field not in values]
    if missing:
        raise BadOption(f"wepose {name} needs {' and '.join(missing)}; {see}")
    return command.job(**{field: options[field].collect(value) for field, value in values.items()})


class _Option:
    """One field as argparse has it.

    Attributes
    ----------
    switch : ``--name``, or ``--no-name`` of what is true by default; empty for an argument by position
    shown : as an error names it
    """

    def __init__(self, command: Command, field: str, hint: Any) -> None:
        self.field, self.kinds, self.default = field, choices_of(hint), field_defaults(command.job)[field]
        self.required = self.default is REQUIRED
        self.metavar, self.help = _help_of(command.job)[field]
        if get_origin(self.kinds[0]) is Literal:
            self.metavar = "|".join(get_args(self.kinds[0]))
        name = field.rstrip("_").replace("_", "-")
        self.switch = "" if field in command.arguments else f"--no-{name}" if self.default is True else f"--{name}"
        self.shown = f"{self._names()[0]} {self.metavar}" if self.switch else self.metavar

    def add_to(self, group: argparse._ArgumentGroup) -> None:
        """Add it to a group of argparse's; where it is not given its value is None."""
        if not self.switch:
            several = {"nargs": "*"} if get_origin(self.kinds[0]) is tuple else {"nargs": "?"}
            group.add_argument(self.field, help=self._help(), **self._value() | several)
            return
        value = self._value() if bool not in self.kinds else {}
        action = "store_false" if self.default is True else "store_true" if self.default is False else None
        value |= {"action": action} if action else {}
        group.add_argument(*self._names(), dest=self.field, default=None, help=self._help(), **value)

    def collect(self, value: Any) -> Any:
        """The field's value from what argparse collected.

        Raises
        ------
        BadOption
            A name is given twice.
        """
        if get_origin(self.kinds[0]) is tuple:
            return tuple(value)
        if not isinstance(value, list):
            return value
        entries: dict[str, Any] = {}
        for name, entry in value:
            if name in entries:
                raise BadOption(f"{self.switch} {name}={entry}: '{name}' is given twice")
            entries[name] = entry
        return entries

    def _names(self) -> list[str]:
        return ["-o", self.switch] if self.field == "out" else [self.switch]

    def _help(self) -> str:
        text = self.help
        if self.default is True:
            text = f"Do not {text[0].lower()}{text[1:]}"
        elif isinstance(self.default, str | float | int | Path) and self.default is not False:
            text += f" (default: {f'{self.default:g}' if isinstance(self.default, float) else self.default})"
        return text.replace("%", "%%")

    def _value(self) -> dict[str, Any]:
        """How argparse reads the value."""
        kind, parts = get_origin(self.kinds[0]), get_args(self.kinds[0])
        if kind is tuple and parts[-1] is Ellipsis:
            return {"type": _CONVERTERS[parts[0]], "metavar": self.metavar}
        if kind is tuple:
            return {"type": _number, "nargs": len(parts), "metavar": tuple(self.metavar.split())}
        if kind is Mapping:
            return {"type": _entry(choices_of(parts[1]), self.metavar), "action": "append", "metavar": self.metavar}
        return {"type": _one_of(parts) if kind is Literal else _CONVERTERS[self.kinds[0]], "metavar": self.metavar}


def _parser(name: str, command: Command, options: Sequence[_Option]) -> argparse.ArgumentParser:
    several = [f"[{option.shown}]" for option in options if not option.switch and get_origin(option.kinds[0]) is tuple]
    named = [
        [option.shown for option in options if option.required and bool(option.switch) is k] for k in (False, True)
    ]
    shown = " ".join([*named[False], *several, *named[True]])
    texts = [_description(command.job), f"Exit code: {command.exit_codes or EXIT_CODES}"]
    parser = argparse.ArgumentParser(
        prog=f"wepose {name}",
        usage=" ".join(f"wepose {name} {shown} [options]".split()),
        description="\n\n".join(filter(None, texts)),
        epilog=f"{_EXAMPLE}wepose {command.example}\n\nTerms: docs/glossary.md.",
        formatter_class=_Formatter,
        allow_abbrev=False,
        exit_on_error=False,
        add_help=False,
    )
    arguments, others = parser.add_argument_group("arguments"), parser.add_argument_group("options")
    for option in options:
        option.add_to(others if option.switch else arguments)
    others.add_argument("-h", "--help", action="help", help="Show this text and exit.")
    return parser


class _Formatter(argparse.HelpFormatter):
    """Paragraphs stay paragraphs, an example stays a line, and lines stay readable on a wide terminal."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=26, width=min(shutil.get_terminal_size().columns, WIDEST) - 2)

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(text, width, break_on_hyphens=False)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = [
            part if part.startswith(_EXAMPLE) else "\n".join(self._split_lines(" ".join(part.split()), width))
            for part in text.split("\n\n")
        ]
        return textwrap.indent("\n\n".join(paragraphs), indent)


# The help from a job's docstring -----------------------------------------------------------------------------------


def _description(job: type) -> str:
    """The docstring without its ``Parameters``."""
    return (inspect.getdoc(job) or "").partition("\n\nParameters\n")[0]


def _help_of(job: type) -> dict[str, tuple[str, str]]:
    """Field → METAVAR and help; of ``name : METAVAR`` and the indented lines below it."""
    section = (inspect.getdoc(job) or "").partition("\nParameters\n----------\n")[2]
    helps = {}
    for entry in re.split(r"\n(?=\w)", section.rstrip()):
        head, *lines = entry.splitlines()
        field, _, metavar = head.partition(" : ")
        helps[field] = (metavar.strip() or field.upper(), " ".join(line.strip() for line in lines))
    return helps


# Values ------------------------------------------------------------------------------------------------------------


def _one_of(choices: tuple[str, ...]) -> Callable[[str], str]:
    def chosen(word: str) -> str:
        if word not in choices:
            raise argparse.ArgumentTypeError(f"'{word}' is not known; {one_of(choices, word)}")
        return word

    return chosen


def _whole_number(word: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{word}' is not a whole number") from None


def _number(word: str) -> float:
    try:
        number = float(word)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        raise argparse.ArgumentTypeError(f"'{word}' is not a number")
    return number


def _entry(kinds: tuple[Any, ...], metavar: str) -> Callable[[str], tuple[str, Any]]:
    """What makes a key and a value of ``NAME=VALUE``; of a value that may be a text, a number where it is one."""

    def entry(word: str) -> tuple[str, Any]:
        name, equals, value = word.partition("=")
        if not (name and equals):
            raise argparse.ArgumentTypeError(f"'{word}': {metavar} is needed")
        try:
            return name, _number(value)
        except argparse.ArgumentTypeError as error:
            if str in kinds:
                return name, value
            raise argparse.ArgumentTypeError(f"{word}: {error}; {metavar} is needed") from None

    return entry


_CONVERTERS: dict[Any, Callable[[str], Any]] = {str: str, Path: Path, int: _whole_number, float: _number}
