"""The one door for everything that can be plugged in: Python entry points.

Collectors, relabelers, evaluators, stages and sub-commands are all found here, ours and third parties' alike, so that the core
never names a stage and an extension needs no change in this package.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from cudc_bench.errors import RunError, unknown

OWN = "cudc-bench"  # the distribution that this is
KINDS = ("collectors", "relabelers", "evaluators", "domains", "stages", "commands")
_SINGULAR = {
    "collectors": "method",
    "relabelers": "domain",
    "evaluators": "algo",
    "domains": "domain",
    "stages": "stage",
    "commands": "command",
}


# What anything of a kind must at least be, for lists and for whoever is about to use it.
_ATTRIBUTES: dict[str, tuple[str, ...]] = {"collectors": ("family", "citation"), "evaluators": ("summary", "citation")}


@cache
def _points(kind: str) -> dict[str, list[EntryPoint]]:
    found: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=f"cudc_bench.{kind}"):
        found.setdefault(point.name, []).append(point)
    return found


def _point(kind: str, name: str) -> EntryPoint:
    points = _points(kind)[check_name(kind, name)]
    if len(points) > 1:
        # Whichever were taken, somebody's results would bear the name of another method.
        rivals = ", ".join(sorted(f"{point.dist.name} ({point.value})" if point.dist else point.value for point in points))
        raise RunError(f"the {_SINGULAR[kind]} '{name}' is registered by several installed packages: {rivals}. Uninstall all but one.")
    return points[0]


def names(kind: str) -> list[str]:
    """The names registered for a kind (one of ``KINDS``), sorted. Nothing is imported."""
    return sorted(_points(kind))


def check_name(kind: str, name: str) -> str:
    """Return the name if it is registered for that kind.

    Raises:
        UsageError: it is not; the message lists the names that are.
    """
    if name not in _points(kind):
        raise unknown(_SINGULAR[kind], name, names(kind))
    return name


def package(kind: str, name: str) -> dict[str, str]:
    """The distribution that registered a name, and its version, as {distribution: version}; nothing is imported.

    Raises:
        UsageError: no such name.
        RunError: several packages registered it.
    """
    found = _point(kind, name).dist
    return {} if found is None else {found.name: found.version}


def target(kind: str, name: str) -> tuple[str, str]:
    """The module and the object in it that are registered under a name; nothing is imported.

    Raises:
        UsageError: no such name.
        RunError: several packages registered it.
    """
    point = _point(kind, name)
    return point.module, point.attr


def is_own(kind: str, name: str) -> bool:
    """Whether this package itself registered a name; nothing is imported."""
    found = _point(kind, name).dist
    return found is not None and found.name == OWN


def unusable(kind: str, name: str, why: str) -> RunError:
    """The one failure for what is registered and will not do.

    Args:
        kind: of plug-in.
        name: that it is registered under.
        why: in a few words, without a full stop.
    """
    point = _point(kind, name)
    package = f" of the package {point.dist.name}" if point.dist else ""
    return RunError(f"the {_SINGULAR[kind]} '{name}' ({point.value}){package} is installed but cannot be used: {why.rstrip('.')}.")


def load(kind: str, name: str) -> Any:
    """Import and return what is registered under a name.

    Raises:
        UsageError: no such name.
        RunError: the plug-in is registered but cannot be imported or is no such thing, or several packages registered it.
    """
    point = _point(kind, name)
    try:
        found = point.load()
    except (ImportError, AttributeError) as error:
        raise unusable(kind, name, str(error)) from error
    except SystemExit as error:
        raise unusable(kind, name, f"it ends the process when it is imported (exit code {error.code!r})") from error
    except Exception as error:  # somebody else's code, which may do anything when it is imported
        raise unusable(kind, name, f"{type(error).__name__}: {error}") from error
    attributes = _ATTRIBUTES.get(kind, ())
    if kind == "domains":
        return found  # a description, which whoever asks for it looks at
    if not callable(found) or not all(isinstance(getattr(found, one, None), str) for one in attributes):
        needs = f" with {' and '.join(attributes)}, each a text" if attributes else ""
        raise unusable(kind, name, f"it is nothing that can be called{needs}")
    return found


def load_sound(kind: str, left_out: Callable[[RunError], None]) -> dict[str, Any]:
    """Everything of a kind that can be used, by its name in sorted order: one broken plug-in is no reason to do without the others.

    Args:
        kind: one of ``KINDS``.
        left_out: told of each that cannot be used.
    """
    found = {}
    for name in names(kind):
        try:
            found[name] = load(kind, name)
        except RunError as error:
            left_out(error)
    return found
