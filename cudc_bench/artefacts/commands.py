"""Commands that somebody wrote down, read by the command line's own parser: what they would do, without doing it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import typer

from cudc_bench import plugins
from cudc_bench.artefacts.provenance import is_own_command
from cudc_bench.errors import UsageError
from cudc_bench.settings.config import parse_settings
from cudc_bench.settings.seeds import parse_seeds

LONGEST = 8_000  # characters of a command that is read at all; one with all of a method's hyperparameters has about 1,000
# The class that all complaints about a command line descend from (typer brings its own copy of click).
_CommandLineError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


@dataclass(frozen=True)
class Parsed:
    """A command of this project.

    Attributes:
        name: of the sub-command.
        values: of all of its parameters, by their names in Python, defaults included.
        given: the names of those that the command itself gives.
    """

    name: str
    values: Mapping[str, Any]
    given: frozenset[str]

    @property
    def settings(self) -> dict[str, str]:
        """What ``--set`` says, and ``--precision``.

        Raises:
            UsageError: it is not name=value, or says something twice.
        """
        found = parse_settings(self.values.get("settings") or [])
        if (precision := self.values.get("precision")) is not None:
            found["precision"] = precision
        return found

    def names(self, parameter: str) -> tuple[str, ...]:
        """The values of a parameter that takes several, separated by commas or each by itself; none where it is not given."""
        value = self.values.get(parameter)
        if isinstance(value, list | tuple):
            return tuple(str(one) for one in value)
        parts = "" if value is None else str(value)
        return tuple(part.strip() for part in parts.split(",") if part.strip())

    def contradictions(self, expected: Mapping[str, str | int | None]) -> Iterator[str]:
        """Where a command, with its defaults, would not do what it is said to have done.

        Args:
            expected: of some parameters what is among their values, or None where nothing is.

        Yields:
            Parts of sentences.
        """
        for parameter, wanted in expected.items():
            option = "--" + parameter.replace("_", "-")
            told = self.names(parameter)
            if parameter in {"seed", "seeds", "training_seeds"} and wanted is not None:
                try:
                    fits = str(wanted) in told or wanted in parse_seeds(",".join(told), option)
                except UsageError:
                    fits = False
            else:
                fits = str(wanted) in told if wanted is not None else not told
            if parameter == "tasks" and told == ("all",):
                fits = wanted is not None
            if not fits:
                says = f"says {option} {','.join(told):.80}" if told else f"does not say {option}"
                yield f"its command {says}, and it has {'none' if wanted is None else wanted}"


def parse_command(text: str) -> Parsed:
    """Read a command line as this program would.

    Raises:
        UsageError: it is none of this project's, or of this version's; the message is a part of a sentence.
    """
    if len(text) > LONGEST:
        raise UsageError(f"its command has {len(text):,} characters, at most {LONGEST:,} are read")
    if not is_own_command(text):
        raise UsageError(f"its command is none of cudc-bench's: {text:.80}")
    name, *arguments = shlex.split(text)[1:] or [""]
    if name not in plugins.names("commands"):
        raise UsageError(f"its command is none of cudc-bench's: {text:.80}")
    command = _command(name)
    try:
        context = command.make_context(name, list(arguments))
    except _CommandLineError as error:
        raise UsageError(f"its command is refused ({error.format_message().rstrip('.')}): {text:.80}") from None  # type: ignore[attr-defined]
    given = {one for one in context.params if str(context.get_parameter_source(one)).endswith("COMMANDLINE")}
    return Parsed(name, dict(context.params), frozenset(given))


@cache
def _command(name: str) -> Any:
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    # Without --help, which would print and leave.
    app.command(name, add_help_option=False)(plugins.load("commands", name))
    return typer.main.get_command(app)


def settings_that_differ(told: Mapping[str, str], overrides: Mapping[str, Any], everything: Mapping[str, Any]) -> Iterator[str]:
    """Where the settings of a command are not those of what it is said to make.

    Args:
        told: the command's.
        overrides: values that differ from the profile's, which the command has to tell.
        everything: all values; a command may also tell one that the profile has.

    Yields:
        Parts of sentences.
    """
    for name, text in told.items():
        if name not in everything or not _same(text, everything[name]):
            value = _written(everything[name]) if name in everything else "no such value"
            yield f"its command says --set {name}={text}"[:120] + f", and it has {value:.80}"
    for name, value in overrides.items():
        if name not in told:
            yield f"its command does not say --set {name}={_written(value)}"[:160]


def _written(value: Any) -> str:
    return json.dumps(value) if isinstance(value, list) else str(value)


def _same(text: str, value: Any) -> bool:
    """Whether a text of ``--set`` is a value; numbers and lists may be written in several ways."""
    if text == _written(value):
        return True
    try:
        return bool(json.loads(text.lower()) == value)
    except ValueError:
        return False
