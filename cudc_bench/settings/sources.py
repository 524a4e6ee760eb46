"""What a module's source says, without importing it: that would load torch, or run a stranger's code.

:func:`ancestry` finds a class and its bases as syntax. :func:`value` makes one object of a module, such as the dataclass of a method's
hyperparameters, out of nothing but the definitions that it needs.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from cudc_bench.errors import RunError

_DEPTH = 24  # of base classes and of names that modules take from one another
_LARGEST = 1_000_000  # bytes of a source file
# Whose objects are imported as they are; those of the rest of the project are made from its source.
_LIGHT = ("cudc_bench.errors", "cudc_bench.text", "cudc_bench.settings")
_OWN = "cudc_bench"


@dataclass(frozen=True)
class Class:
    """A class as it stands in a source.

    Attributes:
        module: that it stands in.
        node: its syntax.
    """

    module: str
    node: ast.ClassDef


def ancestry(module: str, name: str, depth: int = _DEPTH) -> Iterator[Class]:
    """A class and its bases, as far as their sources can be found, nearest first. Nothing is imported."""
    source = tree(module)
    if source is None or depth == 0:
        return
    for node in reversed(source.body):
        match node:
            case ast.ClassDef(name=found) if found == name:
                yield Class(module, node)
                for base in node.bases:
                    if isinstance(base, ast.Name) and base.id != name:
                        yield from ancestry(module, base.id, depth - 1)
                return
            case ast.Assign(targets=[ast.Name(id=found)], value=ast.Name(id=other)) if found == name != other:
                yield from ancestry(module, other, depth - 1)
                return
            case ast.ImportFrom(names=aliases):
                for alias in aliases:
                    if (alias.asname or alias.name) == name:
                        yield from ancestry(absolute(module, node), alias.name, depth - 1)
                        return


def docstring(module: str, name: str) -> str:
    """What a function of a module says of itself; empty where its source cannot be found."""
    source = tree(module)
    for node in reversed(source.body if source is not None else []):
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return ast.get_docstring(node) or ""
    return ""


def absolute(module: str, node: ast.ImportFrom) -> str:
    """The module that a line of another one imports from."""
    if not node.level:
        return node.module or ""
    parts = module.split(".")
    path = file_of(module)
    package = parts if path is not None and path.name == "__init__.py" else parts[:-1]
    return ".".join([*package[: len(package) - node.level + 1], *([node.module] if node.module else [])])


@cache
def tree(module: str) -> ast.Module | None:
    """The syntax of a module; None where it has no source that can be read."""
    path = file_of(module)
    try:
        if path is None or path.stat().st_size > _LARGEST:
            return None
        return ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return None


def file_of(module: str) -> Path | None:
    """Where a module's source is. Unlike ``importlib.util.find_spec`` this does not import its packages."""
    path: list[str] | None = None
    spec = None
    parts = module.split(".")
    for index in range(len(parts)):
        name = ".".join(parts[: index + 1])
        try:
            spec = next(filter(None, (finder.find_spec(name, path) for finder in sys.meta_path if hasattr(finder, "find_spec"))), None)
        except (ImportError, AttributeError, ValueError, OSError):
            return None
        if spec is None:
            return None
        path = list(spec.submodule_search_locations or [])
    return Path(spec.origin) if spec is not None and spec.origin and spec.origin.endswith(".py") else None


def attribute(module: str, name: str, wanted: str) -> Any:
    """The value of a class's attribute, of the nearest class that has it; None if none has.

    Args:
        module, name: of the class; one of this project's.
        wanted: the attribute.

    Raises:
        RunError: its value needs more than definitions.
    """
    for one in ancestry(module, name):
        for node in reversed(one.node.body):
            match node:
                case ast.Assign(targets=[ast.Name(id=found)], value=found_value) if found == wanted:
                    return _evaluated(one.module, found_value)
                case ast.AnnAssign(target=ast.Name(id=found), value=ast.expr() as found_value) if found == wanted:
                    return _evaluated(one.module, found_value)
    return None


@cache
def value(module: str, name: str) -> Any:
    """One object of a module of this project, made from the definitions that it needs.

    Classes lack their methods, which may need anything: what is left of a dataclass are its fields.

    Raises:
        RunError: there is none of that name, or it needs more than definitions.
    """
    if not module.startswith(f"{_OWN}.") or any(f"{module}.".startswith(f"{one}.") for one in _LIGHT):
        return getattr(import_module(module), name)
    source = tree(module)
    for node in reversed(source.body if source is not None else []):
        match node:
            case ast.ClassDef(name=found) if found == name:
                return _made(module, node)
            case ast.Assign(targets=[ast.Name(id=found)], value=given) if found == name:
                return _evaluated(module, given)
            case ast.AnnAssign(target=ast.Name(id=found), value=ast.expr() as given) if found == name:
                return _evaluated(module, given)
            case ast.ImportFrom(names=aliases):
                for alias in aliases:
                    if (alias.asname or alias.name) == name:
                        return value(absolute(module, node), alias.name)
            case ast.Import(names=aliases):
                for alias in aliases:
                    if (alias.asname or alias.name) == name:
                        return import_module(alias.name)
    raise RunError(f"'{name}' is not defined in the source of {module}.")


def _made(module: str, node: ast.ClassDef) -> Any:
    # A copy without its functions, whose annotations and defaults may need torch.
    body = [one for one in node.body if not isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)] or [ast.Pass()]
    fields = ast.ClassDef(node.name, node.bases, node.keywords, body, node.decorator_list)
    ast.copy_location(fields, node)
    names = _names(fields)
    # Annotations are evaluated at once, and so need no module to be looked up in later.
    code = compile(ast.Module([fields], []), f"<{module}>", "exec", dont_inherit=True)
    space = {"__name__": module, **names_of(module, names)}
    exec(code, space)
    return space[node.name]


def _evaluated(module: str, node: ast.expr) -> Any:
    code = compile(ast.Expression(node), f"<{module}>", "eval", dont_inherit=True)
    return eval(code, names_of(module, _names(node)))


def names_of(module: str, names: set[str]) -> dict[str, Any]:
    """What some names stand for in a module."""
    import builtins

    return {name: value(module, name) for name in sorted(names) if not hasattr(builtins, name)}


def _names(node: ast.AST) -> set[str]:
    names = [one for one in ast.walk(node) if isinstance(one, ast.Name)]
    # Without what a comprehension itself gives a name to.
    return {one.id for one in names if isinstance(one.ctx, ast.Load)} - {one.id for one in names if isinstance(one.ctx, ast.Store)}
