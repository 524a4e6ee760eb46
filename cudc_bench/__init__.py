"""cudc-bench: unsupervised data collection, Minari datasets, relabelling, offline RL and a leaderboard around CUDC."""

from __future__ import annotations

import os as _os

# Read once, when MuJoCo or dm_control is first imported: without a display they would try GLFW and complain. Nothing in collection,
# relabelling or training draws.
if not _os.environ.get("DISPLAY"):
    _os.environ.setdefault("MUJOCO_GL", "disabled")

import sys as _sys
from importlib import import_module as _import_module
from importlib.abc import MetaPathFinder as _MetaPathFinder
from importlib.machinery import ModuleSpec as _ModuleSpec
from importlib.util import find_spec as _find_spec
from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

if _TYPE_CHECKING:
    from cudc_bench.data.descriptors import DescriptorCoverage as DescriptorCoverage
    from cudc_bench.data.descriptors import coverage as coverage
    from cudc_bench.data.exports import to_d3rlpy as to_d3rlpy
    from cudc_bench.data.exports import to_torchrl as to_torchrl
    from cudc_bench.data.transitions import Transitions as Transitions
    from cudc_bench.data.transitions import load_transitions as load_transitions
    from cudc_bench.data.verification import Verification as Verification
    from cudc_bench.data.verification import verify as verify

__all__ = [
    "DescriptorCoverage",
    "Transitions",
    "Verification",
    "ask_policy",
    "collect",
    "compare_datasets",
    "coverage",
    "draw_diagnostics",
    "evaluate",
    "export_policy",
    "import_exorl",
    "import_minari",
    "load_policy",
    "load_transitions",
    "make_leaderboard",
    "make_references",
    "make_tiers",
    "measure_quality",
    "mix",
    "pilot",
    "relabel",
    "render_policy",
    "rerun",
    "run_suite",
    "submit",
    "to_d3rlpy",
    "to_torchrl",
    "verify",
]
_STAGES = (
    "collect", "pilot", "import_exorl", "import_minari", "mix", "relabel", "evaluate", "make_references", "make_tiers", "ask_policy",
    "load_policy", "render_policy", "export_policy", "make_leaderboard", "submit", "draw_diagnostics", "measure_quality",
    "compare_datasets", "run_suite", "rerun",
)  # fmt: skip
_DATA = {
    "Transitions": "transitions", "load_transitions": "transitions", "DescriptorCoverage": "descriptors", "coverage": "descriptors",
    "to_d3rlpy": "exports", "to_torchrl": "exports", "Verification": "verification", "verify": "verification",
}  # fmt: skip


def __getattr__(name: str) -> _Any:
    """Load a public function when it is first used: importing the package itself is light and needs neither torch nor MuJoCo."""
    if name in _STAGES:
        from cudc_bench import plugins

        found = plugins.load("stages", name)
    elif name in _DATA:
        found = getattr(_import_module(f"cudc_bench.data.{_DATA[name]}"), name)
    else:
        raise AttributeError(f"module 'cudc_bench' has no attribute '{name}'")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])


class _AfterGymnasium(_MetaPathFinder):
    """Registers the environments' ids once Gymnasium has registered its own.

    Gymnasium takes a quarter of a second to import, which ``cudc-bench --help`` would have to wait for.
    """

    def find_spec(self, name: str, path: object = None, target: _ModuleType | None = None) -> _ModuleSpec | None:
        if name != "gymnasium.envs":
            return None
        _sys.meta_path.remove(self)
        spec = _find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def then_register(module: _ModuleType) -> None:
                execute(module)
                _import_module("cudc_bench.envs")

            spec.loader.exec_module = then_register  # type: ignore[method-assign]
        return spec


if "gymnasium.envs" in _sys.modules:
    _import_module("cudc_bench.envs")
else:
    _sys.meta_path.insert(0, _AfterGymnasium())
