"""The rules by which the project is cut, read from the source itself."""

from __future__ import annotations

import ast
import importlib
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import cudc_bench
from cudc_bench import plugins

from .slow import slow_in, slow_tests

ROOT = Path(cudc_bench.__file__).resolve().parent.parent
STAGES = ("collectors", "relabelers", "evaluators", "leaderboard")
CORE = sorted((ROOT / "cudc_bench").rglob("*.py"))
SOURCES = {path: stage for stage in STAGES for path in sorted((ROOT / stage).rglob("*.py"))} | dict.fromkeys(CORE, "core")
# Of these, two have tensors for those who ask for them.
DATA = [path for path in CORE if path.parent.name in {"data", "artefacts"} and path.stem not in {"transitions", "exports"}]
# Of the stages with methods: their own files, and what they are made of. The rest of a stage has folders of its own.
METHODS = [
    path
    for path, stage in SOURCES.items()
    if stage in {"collectors", "evaluators"} and path.parent == ROOT / stage and path.stem not in {"__init__", "command", "contract"}
]
# The rooms of the core, the lowest first: each may import those before it. The four stages stand above all but ``suites``.
ROOMS = (
    "errors", "files", "text", "plugins", "settings", "artefacts", "execution", "learning", "envs", "data", "runs", "cli", "stages",
    "suites",
)  # fmt: skip
# Those of the stage that is large enough to have some.
HOUSES = {
    "cudc_bench": ROOMS,
    "cudc_bench.leaderboard": ("methods", "numbers", "intake", "datasets", "show", "site", "output", "api", "command"),
}
ids = {path: path.relative_to(ROOT).as_posix() for path in SOURCES}.get


def module_of(path: Path) -> str:
    """The dotted name under which a file is imported."""
    relative = path.relative_to(ROOT).with_suffix("")
    parts = relative.parts if relative.parts[0] == "cudc_bench" else ("cudc_bench", *relative.parts)
    return ".".join(parts).removesuffix(".__init__")


def resolved(module: str, is_package: bool, node: ast.AST) -> list[str]:
    """The absolute names that an import statement asks for; none for any other node."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    base = node.module or ""
    if node.level:
        parts = module.split(".")
        package = parts[: len(parts) - node.level + is_package]
        base = ".".join([*package, *([base] if base else [])])
    return [base, *(f"{base}.{alias.name}" for alias in node.names)]


def imports(path: Path) -> set[str]:
    """Every module that a file imports anywhere, functions included, with relative imports resolved."""
    module, package = module_of(path), path.name == "__init__.py"
    return {name for node in ast.walk(ast.parse(path.read_text())) for name in resolved(module, package, node)}


NAMED = {module_of(path): path for path in SOURCES}


def needed(path: Path) -> set[str]:
    """The modules of the project that a file imports anywhere; of packages those whose own file it needs."""
    module, package = module_of(path), path.name == "__init__.py"
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        base, *names = resolved(module, package, node) or [""]
        found |= {name for name in names if name in NAMED} if isinstance(node, ast.ImportFrom) else {base, *names} & set(NAMED)
        if isinstance(node, ast.ImportFrom) and base in NAMED and not all(name in NAMED for name in names):
            found.add(base)
    return found - {module}


def stages_in(names: set[str]) -> set[str]:
    """The stages that some imported names belong to, by either of the names of a stage's folder."""
    found = set()
    for name in names:
        parts = name.split(".")
        if parts[0] == "cudc_bench" and len(parts) > 1 and parts[1] in STAGES:
            found.add(parts[1])
        elif parts[0] in STAGES:
            found.add(parts[0])
    return found


def test_the_reader_of_imports_sees_every_way_to_write_one() -> None:
    source = """
import cudc_bench.collectors.api as a
from cudc_bench import evaluators
def f():
    from ..leaderboard.load import x
    from .. import relabelers
    from . import base
"""
    found = {name for node in ast.walk(ast.parse(source)) for name in resolved("cudc_bench.collectors.api", is_package=False, node=node)}
    assert stages_in(found) == set(STAGES)
    assert {"cudc_bench.collectors.api", "cudc_bench.evaluators", "cudc_bench.leaderboard.load.x", "cudc_bench.relabelers"} <= found
    assert "cudc_bench.collectors.base" in found
    package = ast.parse("from .a import b").body[0]
    assert resolved("cudc_bench.envs", is_package=True, node=package) == ["cudc_bench.envs.a", "cudc_bench.envs.a.b"]


def test_there_is_something_to_check() -> None:
    assert set(SOURCES.values()) == {*STAGES, "core"}
    assert len(SOURCES) > 30
    # The stage folders are the ones that are imported.
    for stage in STAGES:
        assert Path(importlib.import_module(f"cudc_bench.{stage}").__file__ or "").parent == ROOT / stage


@pytest.mark.parametrize("path", SOURCES, ids=ids)
def test_a_stage_imports_the_core_and_itself_and_the_core_no_stage(path: Path) -> None:
    assert stages_in(imports(path)) <= {SOURCES[path]}


def room_of(module: str, house: str) -> str:
    """The room of a house that a module of it lies in; empty for the house's own file."""
    return module.removeprefix(house).removeprefix(".").split(".")[0]


IN_ROOMS = [
    (house, path)
    for house, paths in {"cudc_bench": CORE, "cudc_bench.leaderboard": sorted((ROOT / "leaderboard").rglob("*.py"))}.items()
    for path in paths
    if room_of(module_of(path), house)
]


@pytest.mark.parametrize(("house", "path"), IN_ROOMS, ids=[ids(path) for _, path in IN_ROOMS])
def test_a_room_imports_only_those_below_it(house: str, path: Path) -> None:
    """But for the package's own file, which offers what lies in all of them."""
    rooms = HOUSES[house]
    below = rooms[: rooms.index(room_of(module_of(path), house)) + 1]
    assert {room_of(name, house) for name in needed(path) if f"{name}.".startswith(f"{house}.")} <= {*below, ""}


@pytest.mark.parametrize("path", sorted((ROOT / "leaderboard" / "numbers").rglob("*.py")), ids=ids)
def test_numbers_know_nothing_of_pictures(path: Path) -> None:
    assert "matplotlib" not in {name.split(".")[0] for name in imports(path)}


def test_no_module_needs_itself_through_others() -> None:
    """Neither when it is imported, nor later, nor for the checker of types alone."""
    left = {module_of(path): needed(path) for path in SOURCES}
    del left["cudc_bench"]  # offers what is deeper in, and imports it when somebody asks
    while free := [module for module, needs in left.items() if not needs & set(left)]:
        for module in free:
            del left[module]
    # What is left needs each other; some only because they need one that does.
    assert sorted(left) == []


@pytest.mark.parametrize("path", [path for path, stage in SOURCES.items() if stage != "core"], ids=ids)
def test_inside_a_stage_imports_are_relative(path: Path) -> None:
    absolute = {
        name
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import) or (isinstance(node, ast.ImportFrom) and not node.level)
        for name in resolved(module_of(path), is_package=False, node=node)
    }
    assert stages_in(absolute) == set()


@pytest.mark.parametrize("path", [*(path for path, stage in SOURCES.items() if stage == "leaderboard"), *DATA], ids=ids)
def test_records_and_data_need_neither_torch_nor_a_simulator(path: Path) -> None:
    assert not {name.split(".")[0] for name in imports(path)} & {"torch", "dm_control", "mujoco"}


@pytest.mark.parametrize(
    "module",
    [
        "cudc_bench",
        "cudc_bench.leaderboard.api",
        "cudc_bench.leaderboard.datasets.diagnostics",
        "cudc_bench.data.reader",
        "cudc_bench.data.writer",
        "cudc_bench.envs",
    ],
)
def test_nor_does_anything_that_they_import(module: str, python: Callable) -> None:
    done = python(f"import sys, {module}; print(sorted({{n.split('.')[0] for n in sys.modules}} & {{'torch', 'dm_control', 'mujoco'}}))")
    assert done == (0, "[]\n", "")


@pytest.mark.parametrize("path", METHODS, ids=ids)
def test_methods_touch_no_file_and_no_environment(path: Path) -> None:
    """A method file has mathematics in it and nothing else; the loop and the commands do the rest."""
    forbidden = {"os", "pathlib", "logging", "h5py", "minari", "gymnasium", "mujoco", "dm_control", "cudc_bench.envs", "cudc_bench.data"}
    assert not {name for name in imports(path) for bad in forbidden if name == bad or name.startswith(f"{bad}.")}


# ---------------------------------------------------------------------------------------------------------------------- documentation


def public(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    """The functions and classes of a module whose names do not hide them."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node


@pytest.mark.parametrize("path", SOURCES, ids=ids)
def test_everything_public_says_what_it_is(path: Path) -> None:
    tree = ast.parse(path.read_text())
    assert not tree.body or ast.get_docstring(tree), "the module has no docstring"
    assert [node.name for node in public(tree) if not ast.get_docstring(node)] == []


@pytest.mark.parametrize("path", SOURCES, ids=ids)
def test_what_a_base_class_asks_for_is_described(path: Path) -> None:
    """Abstract methods are the contract with third parties' plug-ins."""
    for kind in (node for node in public(ast.parse(path.read_text())) if isinstance(node, ast.ClassDef)):
        for method in (node for node in kind.body if isinstance(node, ast.FunctionDef)):
            if any(ast.unparse(decorator) == "abstractmethod" for decorator in method.decorator_list):
                assert ast.get_docstring(method), f"{kind.name}.{method.name}"


# --------------------------------------------------------------------------------------------------------------------------- plug-ins


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind in plugins.KINDS for name in plugins.names(kind)])
def test_everything_registered_can_be_loaded(kind: str, name: str) -> None:
    assert callable(plugins.load(kind, name))


def test_what_is_registered_is_what_the_project_declares() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    for kind in plugins.KINDS:
        # Domains are registered by other packages only: ours are known without looking for any.
        assert set(declared.get(f"cudc_bench.{kind}", {} if kind == "domains" else None)) <= set(plugins.names(kind))


# Of each folder of stages one that has a public function in it.
FIRST = {module.split(".")[1]: module for module in sorted(plugins.target("stages", name)[0] for name in plugins.names("stages"))}


# Importing a subpackage makes it an attribute of the package, whatever stood there: no function may share its name.
@pytest.mark.parametrize("before", [[], list(FIRST.values())], ids=["nothing", "all stages"])
def test_public_names_are_there_whatever_was_imported(before: list[str], python: Callable) -> None:
    script = f"""
for module in {before}:
    __import__(module)
import cudc_bench
for name in cudc_bench.__all__:
    assert callable(getattr(cudc_bench, name)), name
    assert name in dir(cudc_bench)
try:
    cudc_bench.nothing
except AttributeError as error:
    print(error)
"""
    assert python(script) == (0, "module 'cudc_bench' has no attribute 'nothing'\n", "")


def test_any_stage_can_be_imported_first(python: Callable) -> None:
    """In processes of their own, forked from one that has what others have written."""
    script = f"""
import os, sys
import minari, pandas, pydantic, torch, typer
for module in {list(FIRST.values())}:
    if not (child := os.fork()):
        assert not any(name.split(".")[0] == "cudc_bench" for name in sys.modules)
        __import__(module)
        sys.exit()
    assert os.waitpid(child, 0)[1] == 0, module
"""
    assert python(script) == (0, "", "")


# ----------------------------------------------------------------------------------------------------------------------------- tests

THROUGH_ALL = {"faults", "documents", "mutants", "stopping"}


def test_tests_lie_where_what_they_test_lies() -> None:
    """A test file outside the rooms is of a file outside the rooms, or of all of the package."""
    packages = {path.parent.name for path in ROOT.glob("cudc_bench/*/__init__.py")} | set(STAGES)
    folders = {path.parent.relative_to(ROOT / "tests").parts[0] for path in ROOT.glob("tests/*/**/*.py")}
    assert folders <= packages | THROUGH_ALL
    rooms = {path.parent.relative_to(ROOT / "tests").as_posix() for path in ROOT.glob("tests/leaderboard/*/*.py")}
    assert all((ROOT / room / "__init__.py").exists() for room in rooms)
    loose = {path.stem.removeprefix("test_") for path in ROOT.glob("tests/test_*.py")}
    assert {name for name in loose if name.rstrip("s") in packages or name in packages} == set()


def test_the_list_of_slow_tests_is_read_from_what_pytest_prints_and_names_tests_that_exist() -> None:
    printed = """
0.30s call     tests/a.py::TestB::test_c[x y]
0.20s setup    tests/a.py::TestB::test_c[z::[1]]
0.39s call     tests/a.py::test_d
2.00s teardown tests/data/e.py::test_f
3 passed in 3.00s
"""
    assert slow_in(printed.splitlines()) == ["tests/a.py::TestB::test_c", "tests/data/e.py::test_f"]
    for test in slow_tests():
        path, *_, name = test.split("::")
        # Those of the batteries stand in the battery.
        battery = ROOT / path.removeprefix("tests/").replace("zero_shot/", "").replace("test_contract", "contract")
        assert any(f"def {name}(" in one.read_text() for one in (ROOT / path, battery) if one.exists()), test
