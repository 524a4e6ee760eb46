"""``cudc-bench doctor``: is this machine ready?"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import requires
from typing import TYPE_CHECKING, Any

from cudc_bench.cli.options import JsonOption
from cudc_bench.errors import RunError

if TYPE_CHECKING:
    from cudc_bench.cli.documents import DoctorCheck


def doctor(as_json: JsonOption = False) -> None:
    """Check versions, pins, threads, CUDA and one step of each environment."""
    from cudc_bench.cli.documents import DoctorCheck, DoctorDocument, print_json

    checks = []
    for name, check in _CHECKS:
        try:
            good, detail = check()
        except Exception as error:  # a check that breaks in any way is a finding to report, not a crash
            good, detail = False, f"{type(error).__name__}: {error}"
        checks.append(DoctorCheck(name=name, ok=good, detail=detail))
        if not as_json:
            _print(checks[-1])
    failed = sum(not one.ok for one in checks)
    if as_json:
        print_json(DoctorDocument(ok=not failed, checks=checks))
    if failed:
        raise RunError(f"{failed} of {len(checks)} checks failed; reinstall with: pip install -c constraints.txt cudc-bench")


def _print(one: DoctorCheck) -> None:
    from rich.console import Console

    from cudc_bench.cli.tables import Cell, Column, Row, Table

    columns = (Column("", least=4), Column("", least=12), Column("", prose=True))
    status = Cell("ok", "green") if one.ok else Cell("FAIL", "red")
    Console(highlight=False).print(Table(columns, (Row((status, Cell(one.name), Cell(one.detail))),), shortens=False))


def _python() -> tuple[bool, str]:
    import platform
    import sys

    return (3, 11) <= sys.version_info[:2] < (3, 13), f"{platform.python_version()} (3.11 and 3.12 work)"


def _versions() -> tuple[bool, str]:
    from packaging.requirements import Requirement

    from cudc_bench.artefacts.provenance import versions

    ranges = {r.name: r.specifier for r in map(Requirement, requires("cudc-bench") or []) if r.marker is None}
    wrong = [
        f"{name} {found} (needs {ranges[name]})"
        for name, found in versions().items()
        if name in ranges and (found == "missing" or found not in ranges[name])
    ]
    # A local label such as +cpu is part of the version and does not change whether it is in range.
    return not wrong, "; ".join(wrong) or ", ".join(f"{name} {found}" for name, found in versions().items())


def _processor() -> tuple[bool, str]:
    import torch

    from cudc_bench.artefacts.provenance import processor
    from cudc_bench.execution.parallel import cores

    return True, f"{processor()}, {cores()} cores, torch uses {torch.get_num_threads()} threads"


def _cuda() -> tuple[bool, str]:
    import torch

    from cudc_bench.settings.profiles import resolve_profile

    found = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none"
    return True, f"{found}; --profile auto means {resolve_profile('auto').name}"


def _updates() -> tuple[bool, str]:
    import torch

    from cudc_bench.learning.compiled import cache_folder, missing_compiler

    missing = missing_compiler()
    said = "long runs on a CPU are compiled" + (f", and kept in {cache_folder()}" if missing is None else f" not: {missing}")
    if not torch.cuda.is_available():
        return True, said
    tried = [try_updates(kind, name, "cuda") for kind, name in (("evaluators", "td3"), ("collectors", "cudc"))]
    return all(good for good, _ in tried), "; ".join([said, *(how for _, how in tried)])


def try_updates(kind: str, name: str, device: str, engine: str = "auto") -> tuple[bool, str]:
    """Some updates of a small learner.

    Args:
        kind: ``evaluators`` or ``collectors``.
        name: the algorithm or method.
        device: where.
        engine: how they are to be carried out, see :mod:`cudc_bench.learning.engines`; ``auto`` captures them on CUDA.

    Returns:
        Whether they could be repeated without Python and gave finite numbers; and what happened.
    """
    from types import SimpleNamespace

    import torch

    from cudc_bench import plugins
    from cudc_bench.learning.cuda_graphs import WARM_UP, Updater
    from cudc_bench.learning.engines import graphs_for, set_engine
    from cudc_bench.learning.networks import MemberRandom
    from cudc_bench.learning.replay import Episodes

    made = plugins.load(kind, name)
    settings = {"width": 32, "batch_size": 16, "feature_dim": 16}
    settings = {key: value for key, value in settings.items() if key in made.config_class.__dataclass_fields__}
    observation, action, length = 3, 2, 50
    if kind == "evaluators":
        learner = made(observation, action, made.configure(settings), [1], device)
    else:
        # What a stage tells its collectors of a run; the stage itself is not known here.
        sizes = SimpleNamespace(domain="walker", observation=observation, action=action, episode_length=length, seed_steps=length,
                                update_every=1, steps=2 * length)  # fmt: skip
        learner = made(sizes, made.configure("walker", settings), [1], device)
    set_engine(learner, engine)
    random, skill = MemberRandom([1], "replay", device), getattr(learner, "skill_size", 0)
    data = Episodes(1, 1, length, observation, action, random, skill=skill, rewards=True)
    skills = torch.rand(length, skill) if skill else None
    data.add(0, torch.randn(length + 1, observation), torch.rand(length, action), skills, torch.rand(length))
    one = torch.ones(1, dtype=torch.int64, device=device)

    def draw(measure: bool) -> Any:
        horizon, following = getattr(learner, "horizon", one), getattr(learner, "wants_next_action", False)
        return data.sample(settings["batch_size"], horizon, measure, getattr(learner, "min_horizon", None), following, learner.wants_future)

    update = Updater(learner, draw, random, graphs_for(learner, learner.device))
    for _ in range(WARM_UP + 3):
        update(False)
    finite = all(bool(one.isfinite().all()) for one in learner.parameters())
    captured = learner.engine != "eager"
    how = "are repeated without Python" if captured else "cannot be captured, and go one by one"
    wrong = "" if finite else ", with results that are not finite"
    return finite and captured, f"updates of a small {name} {how} on {device.upper()}{wrong}"


def _rendering() -> tuple[bool, str]:
    import os

    from cudc_bench.envs.drawing import INSTALL, probe

    # Nothing else draws, so that its absence is no fault.
    backend = probe(os.environ.get("MUJOCO_GL"))
    return True, f"cudc-bench render {f'works, with {backend}' if backend else f'would not work: {INSTALL}'}"


def _root() -> tuple[bool, str]:
    import shutil

    from cudc_bench.artefacts.ids import datasets_root
    from cudc_bench.files import check_folder

    root = check_folder(datasets_root(), "the dataset root")
    place = root
    while not place.exists():
        place = place.parent
    return True, f"{root}, {shutil.disk_usage(place).free / 1e9:,.0f} GB free"


def _environment() -> tuple[bool, str]:
    import numpy as np

    from cudc_bench.envs import DOMAINS, make_simulators, reward_function

    for domain in DOMAINS.values():
        simulator = make_simulators(domain.name, 1)[0]
        simulator.reset(1)
        simulator.step(np.zeros(domain.action_size, np.float32))
        quantities = np.empty(len(domain.quantities))
        simulator.quantities(quantities)
        rewards = reward_function(domain.name)(quantities)
        if rewards.shape != (len(domain.tasks),) or not np.isfinite(rewards).all():
            return False, f"{domain.name}: one step gave rewards {rewards}"
    return True, f"one step of {', '.join(DOMAINS)}"


_CHECKS: tuple[tuple[str, Callable[[], tuple[bool, str]]], ...] = (
    ("python", _python),
    ("versions", _versions),
    ("processor", _processor),
    ("cuda", _cuda),
    ("updates", _updates),
    ("rendering", _rendering),
    ("dataset root", _root),
    ("environment", _environment),
)
