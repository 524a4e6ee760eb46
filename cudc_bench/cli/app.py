"""The command line: sub-commands are found through entry points, errors end in one line.

Nothing heavy is imported before a command runs, so that ``--help`` answers at once.
"""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import wraps
from typing import Annotated, Any, get_args

import typer

from cudc_bench import plugins
from cudc_bench.errors import DEBUG, CudcBenchError, RunError, finishing, traceback_of, wants_traceback
from cudc_bench.execution.interrupts import Interrupted, Terminated, tidying_up
from cudc_bench.execution.progress import QUIET
from cudc_bench.execution.streams import open_streams
from cudc_bench.text import shortened, visible

# The class that all of typer's own complaints about the command line descend from (typer brings its own copy of click).
_CommandLineError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")
_ORDER = (
    "run", "collect", "pilot", "import-exorl", "import-minari", "mix", "relabel", "evaluate", "reference", "tiers", "render", "export",
    "leaderboard", "submit", "diagnostics", "stats", "compare", "verify", "list", "show", "delete", "doctor",
)  # fmt: skip
_COMPLETION = "_CUDC_BENCH_COMPLETE"  # the environment variable by which a shell asks what could come next


class _Left(CudcBenchError):
    """A run was interrupted, and has kept what it could; unlike the interruption itself, this gets past typer."""

    def __init__(self, interrupted: Interrupted | Terminated) -> None:
        super().__init__(interrupted.message)
        self.exit_code = interrupted.exit_code


def _leaving_well(command: Callable[..., None]) -> Callable[..., None]:
    @wraps(command)
    def run(*arguments: Any, **options: Any) -> None:
        try:
            with finishing():
                command(*arguments, **{name: value for name, value in options.items() if name not in added})
        except (Interrupted, Terminated) as error:
            raise _Left(error) from None

    own = inspect.signature(command, eval_str=True).parameters
    taken = {*own, *(name for one in own.values() for name in _spellings(one))}
    added = {name: kind for name, kind in _EVERYWHERE.items() if not {name, *_spelled(get_args(kind)[1])} & taken}
    more = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind) for name, kind in added.items()]
    # Typer reads the options from one or the other.
    run.__signature__ = inspect.Signature([*own.values(), *more])  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in (*own.values(), *more) if one.annotation is not one.empty}
    return run


def _spellings(parameter: inspect.Parameter) -> Iterator[str]:
    """How an option is written; nothing for what is none."""
    for one in (parameter.default, *getattr(parameter.annotation, "__metadata__", ())):
        yield from _spelled(one)


def _spelled(information: Any) -> list[str]:
    # Inside of an annotation the first name stands where the default would.
    names = (getattr(information, "default", None), *(getattr(information, "param_decls", None) or ()))
    return [name for name in names if isinstance(name, str) and name.startswith("-")]


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"cudc-bench {version('cudc-bench')}")
        raise typer.Exit


def _show_tracebacks(wanted: bool) -> None:
    if wanted:
        os.environ[DEBUG] = "1"


def _say_less(wanted: bool) -> None:
    if wanted:
        os.environ[QUIET] = "1"


DebugOption = Annotated[
    bool, typer.Option("--debug", callback=_show_tracebacks, is_eager=True, help=f"Show where an error came from, as {DEBUG}=1 does.")
]
QuietOption = Annotated[
    bool,
    typer.Option("--quiet", "-q", callback=_say_less, is_eager=True, help=f"Only results, errors and problems, as {QUIET}=1 does."),
]
# What is given before a command or behind it; their callbacks do all that they do.
_EVERYWHERE: Mapping[str, Any] = {"debug": DebugOption, "quiet": QuietOption}


def _root(
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")] = False,
    debug: DebugOption = False,
    quiet: QuietOption = False,
) -> None:
    """Collect data without rewards, relabel it, train offline on it, and compare. --debug and --quiet may also stand behind a command."""


def build_app() -> typer.Typer:
    """The application with every installed sub-command, ours first."""
    app = typer.Typer(
        name="cudc-bench", no_args_is_help=True, pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )  # fmt: skip
    app.callback()(_root)
    names = plugins.names("commands")
    for name in sorted(names, key=lambda name: (_ORDER.index(name) if name in _ORDER else len(_ORDER), name)):
        try:
            command = plugins.load("commands", name)
            if not plugins.is_own("commands", name):
                _check_parameters(name, command)
        except RunError as error:
            if _COMPLETION not in os.environ:  # what a shell asks for is all that it should get
                _complain(f"{error} It is left out.", error, "warning")
        else:
            app.command(name)(_leaving_well(command))
    return app


def _check_parameters(name: str, command: Callable[..., None]) -> None:
    """Refuse a third party's command that typer cannot offer: it finds out when the command line is read, and then offers none.

    Raises:
        RunError: it has parameters of a kind that typer does not know.
    """
    alone = typer.Typer()
    try:
        alone.command()(command)
        typer.main.get_command(alone)
    except Exception as error:  # of any kind: what annotations may be has no end
        raise plugins.unusable("commands", name, f"{type(error).__name__}: {error}") from error


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 failed, 2 wrong input, 130 interrupted (143 by SIGTERM)."""
    open_streams()
    with tidying_up():
        sys.exit(_run(arguments))


def _run(arguments: list[str] | None) -> int:
    """The exit code of a command."""
    code: Any
    try:
        code = build_app()(arguments, prog_name="cudc-bench", standalone_mode=False)
        if code == 130:  # typer takes Ctrl-C for itself, and says nothing
            _complain("interrupted.")
        _flush()
    except CudcBenchError as error:
        _complain(str(error), error)
        code = error.exit_code
    except _CommandLineError as error:
        # Without any argument the help has been shown, and there is nothing to say.
        if message := error.format_message():  # type: ignore[attr-defined]
            _complain(message)
        code = 2
    except (KeyboardInterrupt, typer.Abort):
        _complain("interrupted.")
        code = 130
    except BrokenPipeError:
        code = 1
        _forget_output()
    except OSError as error:  # of a library that writes by itself
        where = f" ({error.filename})" if error.filename else ""
        _complain(f"the system refused to go on: {error.strerror or error}{where}.", error)
        code = 1
        _forget_output()
    except Exception as error:
        if not _is_out_of_memory(error):
            raise
        _complain("there is not enough memory for these sizes; choose a smaller profile, or smaller steps, width or batch_size.", error)
        code = 1
    return code if isinstance(code, int) else 0


def _flush() -> None:
    """Write what was printed, so that a disk that is full, or a reader that has left, ends the command as any other failure does."""
    sys.stdout.flush()


def _forget_output() -> None:
    """Drop what is printed and cannot be written: Python would try again at its end, and complain."""
    with suppress(OSError):
        sys.stdout.flush()
        return
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _is_out_of_memory(error: Exception) -> bool:
    """Whether the memory could not be had; PyTorch and MuJoCo say so in the text of an error of another kind."""
    text = str(error).lower()
    return isinstance(error, MemoryError) or "allocate memory" in text or "out of memory" in text


def _complain(message: str, error: BaseException | None = None, kind: str = "error") -> None:
    with suppress(OSError):  # nobody may be there any more to read it
        if error is not None and wants_traceback():
            print(traceback_of(error), end="", file=sys.stderr)
        print(f"cudc-bench: {kind}: {shortened(visible(message))}", file=sys.stderr)


if __name__ == "__main__":
    main()
