"""What a shell offers for the value of an option (``cudc-bench --install-completion``).

A shell asks anew at each press of the key, so that nothing heavy may be imported here: neither numpy nor Gymnasium, let alone torch.
Whatever goes wrong, there is an answer, and nothing else is printed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from cudc_bench.envs.domains import Domain

Completer = Callable[[typer.Context, str], list[str]]


def completer(names: Callable[[typer.Context], Iterable[str]], several: bool = False) -> Completer:
    """A function that typer asks for values.

    Args:
        names: all that there are, given what the command line says so far.
        several: whether commas separate more than one.
    """

    def complete(ctx: typer.Context, incomplete: str) -> list[str]:
        try:
            known = list(names(ctx))
        except Exception:  # where nothing can be offered, nothing is
            return []
        head, comma, last = incomplete.rpartition(",") if several else ("", "", incomplete)
        given = head.split(",")
        return [f"{head}{comma}{name}" for name in known if name.startswith(last) and name not in given]

    return complete


def one_of(*names: str) -> Completer:
    """Of names that never change."""
    return completer(lambda _: names)


def _registered(kind: str) -> Callable[[typer.Context], list[str]]:
    def names(_: typer.Context) -> list[str]:
        from cudc_bench import plugins

        return plugins.names(kind)

    return names


def _our_domains() -> dict[str, Domain]:
    from cudc_bench.settings import sources

    # To import the room of the environments is to import Gymnasium.
    found: dict[str, Domain] = sources.value("cudc_bench.envs.domains", "DOMAINS")
    return found


def _domains(ctx: typer.Context) -> list[str]:
    return [*_our_domains(), *_registered("domains")(ctx)]


def _tasks(ctx: typer.Context) -> list[str]:
    """Of the domains that the command line names, or else of all; those of other packages would have to be imported."""
    given: Any = next((value for name in ("domain", "domains") if (value := ctx.params.get(name))), "")
    domains = [domain for name, domain in _our_domains().items() if not given or name in str(given).split(",")]
    return list(dict.fromkeys(task for domain in domains for task in domain.tasks))


def _profiles(_: typer.Context) -> list[str]:
    from cudc_bench.settings.profiles import PROFILES

    return list(PROFILES)


def _datasets(_: typer.Context) -> list[str]:
    from cudc_bench.artefacts.ids import stored_ids

    return list(map(str, stored_ids()))


def _all_names(ctx: typer.Context) -> list[str]:
    names = [*_registered("collectors")(ctx), *_registered("evaluators")(ctx), *_domains(ctx), *_profiles(ctx), *_tasks(ctx)]
    return list(dict.fromkeys(names))


methods, some_methods = completer(_registered("collectors")), completer(_registered("collectors"), several=True)
algos, some_algos = completer(_registered("evaluators")), completer(_registered("evaluators"), several=True)
domains, some_domains = completer(_domains), completer(_domains, several=True)
some_tasks = completer(lambda ctx: [*_tasks(ctx), "all"], several=True)
profiles, some_profiles = completer(lambda ctx: [*_profiles(ctx), "auto"]), completer(_profiles, several=True)
datasets, some_datasets = completer(_datasets), completer(_datasets, several=True)
all_names = completer(_all_names)
