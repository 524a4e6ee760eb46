"""What a collector is, in the words of its own source, without importing it: that would load torch, or run a stranger's code."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from cudc_bench import plugins
from cudc_bench.errors import CudcBenchError

_DEPTH = 8  # of base classes and of names that modules take from one another
_LARGEST = 1_000_000  # bytes of a source file


@dataclass(frozen=True)
class Method:
    """A collector as its class describes itself.

    Attributes:
        name: as on the command line.
        family, citation: how it explores and the paper; empty where the class does not say.
        text: paragraphs of its docstring, without the sections on arguments and attributes.
        package: the distribution that registers it, with its version; empty if none does here.
    """

    name: str
    family: str = ""
    citation: str = ""
    text: tuple[str, ...] = ()
    package: str = ""

    @property
    def known(self) -> bool:
        """Whether it is registered here."""
        return bool(self.package)


@cache
def describe(name: str) -> Method:
    """What is registered as a collector of that name; for others only the name. Whatever is wrong with a source, there is an answer."""
    try:
        module, attribute = plugins.target("collectors", name)
        package = " ".join(f"{one} {version}" for one, version in plugins.package("collectors", name).items())
    except CudcBenchError:
        return Method(name)
    texts: list[str] = []
    values: dict[str, str] = {}
    for kind in _ancestry(module, attribute):
        texts += filter(None, [ast.get_docstring(kind)])
        for node in kind.body:
            match node:
                case ast.Assign(targets=[ast.Name(id=one)], value=ast.Constant(value=str(text))):
                    values.setdefault(one, text)
                case ast.AnnAssign(target=ast.Name(id=one), value=ast.Constant(value=str(text))):
                    values.setdefault(one, text)
    paragraphs = _paragraphs(texts[0]) if texts else ()
    return Method(name, values.get("family", ""), values.get("citation", ""), paragraphs, package or module)


def _paragraphs(docstring: str) -> tuple[str, ...]:
    found = []
    for block in inspect.cleandoc(docstring).split("\n\n"):
        if block.split("\n")[0].strip() in {"Args:", "Attributes:", "Class attributes:", "Raises:", "Returns:", "Yields:"}:
            break
        found.append(block.strip("\n"))
    return tuple(filter(None, found))


def _ancestry(module: str, name: str, depth: int = _DEPTH) -> Iterator[ast.ClassDef]:
    """A class and its bases, as far as their sources can be found, nearest first."""
    tree = _tree(module)
    if tree is None or depth == 0:
        return
    for node in reversed(tree.body):
        match node:
            case ast.ClassDef(name=found) if found == name:
                yield node
                for base in node.bases:
                    if isinstance(base, ast.Name) and base.id != name:
                        yield from _ancestry(module, base.id, depth - 1)
                return
            case ast.Assign(targets=[ast.Name(id=found)], value=ast.Name(id=other)) if found == name != other:
                yield from _ancestry(module, other, depth - 1)
                return
            case ast.ImportFrom(names=aliases):
                for alias in aliases:
                    if (alias.asname or alias.name) == name:
                        yield from _ancestry(_absolute(module, node), alias.name, depth - 1)
                        return


def _absolute(module: str, node: ast.ImportFrom) -> str:
    if not node.level:
        return node.module or ""
    parts = module.split(".")
    path = _file(module)
    package = parts if path is not None and path.name == "__init__.py" else parts[:-1]
    return ".".join([*package[: len(package) - node.level + 1], *([node.module] if node.module else [])])


@cache
def _tree(module: str) -> ast.Module | None:
    path = _file(module)
    try:
        if path is None or path.stat().st_size > _LARGEST:
            return None
        return ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return None


def _file(module: str) -> Path | None:
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
