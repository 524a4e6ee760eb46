"""One update of libraries on PyPI beside our own: d3rlpy, Stable-Baselines3 and TorchRL, in one process, in turns, one thread, CPU time.

What is measured on all sides is one gradient step as the library's own training loop makes it: a minibatch of single transitions is drawn
from a buffer of 50 episodes of 1,000 steps with Walker's sizes (24 observations, 6 actions), and then learned from. Each side is called
as its documents say: d3rlpy ``sample_transition_batch`` and ``update`` (what ``fit`` does, without its logger and progress bar),
Stable-Baselines3 ``train``, TorchRL as in its own TD3 script (``value_loss``, ``actor_loss``, ``SoftUpdate``), ours ``Updater``, one by
one and compiled.

Equal on all sides: width, minibatch, learning rate 3e-4 (Adam), γ 0.99, τ 0.005; two critics; networks of three linear layers with ReLU
(observation or both to width, to width, to output); TD3 and TD3+BC with Fujimoto's values (target actor, σ 0.2, clipped at 0.5, the actor
and the slow copies in every second update, the actor maximises the first critic); CQL with a temperature that is learned, a fixed penalty
weight, no entropy in the target, three actions of each kind for each state; IQL with expectile 0.7 and β 3.

What one does and another does not:

- Ours: the first layer of actors and critics, but for IQL's, is followed by LayerNorm and tanh in the place of ReLU, which costs us time;
  "plain networks" are ours without these, one by one. Python never reads a loss; metrics are read in one update of a thousand, and not
  here. IQL's learning rate follows a cosine.
- d3rlpy: each loss becomes a Python number in each update. A minibatch is put together in Python, one transition after the other. Its
  Adam goes over lists of tensors. BC minimises squared errors, ours a likelihood, which differs from it by a constant factor. CQL weighs
  its actions by their density; IQL judges each state three times. Its compiled mode needs CUDA and is not here.
- Stable-Baselines3: losses become Python numbers; minibatches are gathered in NumPy, rows of one array after the other. Of what is here
  it has TD3 alone.
- TorchRL: both critics are one call of ``vmap``. Its losses also give TD errors and values, which nobody reads here. Its script can be
  compiled by hand; that is not here.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any
from unittest.mock import patch

import gymnasium
import numpy as np
import torch
from torch import nn

from benchmarks.engines import EPISODES, updates
from benchmarks.measure import Row, fastest_interleaved
from cudc_bench import plugins
from cudc_bench.evaluators import actor_critic, cql
from cudc_bench.execution.parallel import kept_memory
from cudc_bench.learning import networks
from cudc_bench.learning.compiled import missing_compiler

INSTALL = "pip install -c constraints.txt -e '.[peers]'"
S, A, STEPS = 24, 6, 1000
SIZES = {128: (10, 40), 256: (4, 30), 1024: (2, 5)}  # width and minibatch: updates that are timed as one, and how often
COMMON = {"learning_rate": 3e-4, "discount": 0.99, "critic_tau": 0.005}
FUJIMOTO = {**COMMON, "target_actor": True, "policy_delay": 2, "maximise": "first", "actor_noise": False, "noise_clip": 0.5}
OURS: dict[str, tuple[str, dict[str, Any]]] = {
    "TD3": ("td3", FUJIMOTO),
    "TD3+BC": ("td3-bc", FUJIMOTO),
    "CQL": ("cql-fixed", {**COMMON, "penalty_samples": 3}),
    "IQL": ("iql", COMMON),
    "BC": ("bc", {"learning_rate": 3e-4}),
}
PLAIN = "eager, plain networks"  # a first layer as the peers' own: ReLU, no LayerNorm
Maker = Callable[[str, int, int], Callable[[], object]]  # of an algorithm, a size, and a number of updates


def run() -> Iterator[Row]:
    """Every algorithm that a library has, at each size; what is not installed is a row that says so."""
    torch.set_num_threads(1)
    there: dict[str, tuple[tuple[str, ...], Maker]] = {}
    for name, algorithms, make in PEERS:
        try:
            there[f"{name} {version(name)}"] = algorithms, make
        except PackageNotFoundError:
            yield Row(f"{name}: {', '.join(algorithms)}", "", f"not installed; {INSTALL}", "", "", False)
    missing = missing_compiler()
    if missing:
        yield Row("compiled updates", "", missing, "", "", False)
    engines = ("eager", PLAIN) if missing else ("eager", PLAIN, "compiled")
    for size, (count, rounds) in SIZES.items():
        for algorithm in OURS:
            if makers := {name: make for name, (algorithms, make) in there.items() if algorithm in algorithms}:
                with kept_memory():  # as our runs have it, here for all
                    rows = list(_compare(algorithm, size, count, rounds, makers, engines))
                yield from rows


def _compare(algorithm: str, size: int, count: int, rounds: int, makers: dict[str, Maker], engines: tuple[str, ...]) -> Iterator[Row]:
    engines = tuple(one for one in engines if one != PLAIN or algorithm != "IQL")  # whose networks are plain
    runs = [_ours(algorithm, engine, size, count) for engine in engines]
    runs += [make(algorithm, size, count) for make in makers.values()]
    times = [seconds / count * 1e3 for seconds in fastest_interleaved(runs, rounds, clock=time.process_time)]
    for peer, theirs in zip(makers, times[len(engines) :], strict=True):
        for engine, ours in zip(engines, times, strict=False):
            what = f"{algorithm}, {size} x {size}, ours {engine}"
            yield Row(what, f"{ours:.2f} ms", f"{peer} {theirs:.2f} ms", f"{theirs / ours:.2f}x", "≥ 1x", theirs >= ours)


def _ours(algorithm: str, engine: str, size: int, count: int) -> Callable[[], object]:
    name, values = OURS[algorithm]
    kind = plugins.load("evaluators", name)
    with ExitStack() as patched:
        for module in (networks, actor_critic, cql) if engine == PLAIN else ():
            patched.enter_context(patch.object(module, "trunk", _plain))
        learner = kind(S, A, kind.configure({}, {**values, "width": size, "batch_size": size}), [1])
    return updates(learner, "compiled" if engine == "compiled" else "eager", count)


def _plain(random: networks.MemberRandom, inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(networks.Linear(random, inputs, outputs), networks.Activation(torch.relu_))


def _data() -> dict[str, np.ndarray]:
    """Steps of all episodes, one after the other."""
    random, rows = np.random.default_rng(1), EPISODES * STEPS
    ends = np.zeros((rows, 1), dtype=np.float32)
    ends[STEPS - 1 :: STEPS] = 1
    return {
        "observations": random.standard_normal((rows, S), dtype=np.float32),
        "actions": random.uniform(-1, 1, (rows, A)).astype(np.float32),
        "rewards": random.random((rows, 1), dtype=np.float32),
        "ends": ends,
    }


# ------------------------------------------------------------------------------------------------------------------------------ d3rlpy


def _d3rlpy(algorithm: str, size: int, count: int) -> Callable[[], object]:
    import_module("structlog").configure(wrapper_class=import_module("structlog").make_filtering_bound_logger(logging.ERROR))
    library, algos = import_module("d3rlpy"), import_module("d3rlpy.algos")
    data = _data()
    buffer = import_module("d3rlpy.dataset").MDPDataset(
        data["observations"], data["actions"], data["rewards"], np.zeros_like(data["ends"]), timeouts=data["ends"]
    )
    encoder = library.models.VectorEncoderFactory([size, size])
    of_critics = {
        "critic_learning_rate": 3e-4, "actor_learning_rate": 3e-4, "gamma": 0.99, "tau": 0.005, "n_critics": 2,
        "actor_encoder_factory": encoder, "critic_encoder_factory": encoder, "batch_size": size,
    }  # fmt: skip
    td3 = {**of_critics, "target_smoothing_sigma": 0.2, "target_smoothing_clip": 0.5, "update_actor_interval": 2}
    configs: dict[str, Callable[[], Any]] = {
        "TD3": lambda: algos.TD3Config(**td3),
        "TD3+BC": lambda: algos.TD3PlusBCConfig(**td3, alpha=2.5),
        "CQL": lambda: algos.CQLConfig(
            **of_critics, temp_learning_rate=3e-4, alpha_learning_rate=0.0, initial_alpha=1.0, alpha_threshold=0.0,
            conservative_weight=0.01, n_action_samples=3, soft_q_backup=False,
        ),
        "IQL": lambda: algos.IQLConfig(**of_critics, value_encoder_factory=encoder, expectile=0.7, weight_temp=3.0, max_weight=100.0),
        "BC": lambda: algos.BCConfig(learning_rate=3e-4, encoder_factory=encoder, batch_size=size),
    }  # fmt: skip
    learner = configs[algorithm]().create(device=False)
    learner.create_impl((S,), A)

    def together() -> None:
        for _ in range(count):
            learner.update(buffer.sample_transition_batch(size))

    return together


# ------------------------------------------------------------------------------------------------------------------- stable-baselines3


def _stable_baselines3(algorithm: str, size: int, count: int) -> Callable[[], object]:
    library = import_module("stable_baselines3")
    data, rows = _data(), EPISODES * STEPS
    observations, actions = gymnasium.spaces.Box(-np.inf, np.inf, (S,)), gymnasium.spaces.Box(-1.0, 1.0, (A,))

    class Nowhere(gymnasium.Env):
        """The spaces alone: nothing is collected here."""

        observation_space, action_space = observations, actions

    learner = library.TD3(
        "MlpPolicy", Nowhere(), learning_rate=3e-4, buffer_size=rows, batch_size=size, tau=0.005, gamma=0.99, policy_delay=2,
        target_policy_noise=0.2, target_noise_clip=0.5, policy_kwargs={"net_arch": [size, size]}, seed=1, device="cpu",
    )  # fmt: skip
    learner.set_logger(import_module("stable_baselines3.common.logger").Logger(None, []))
    buffer = learner.replay_buffer
    buffer.observations[:, 0], buffer.actions[:, 0], buffer.rewards[:] = data["observations"], data["actions"], data["rewards"]
    buffer.next_observations[:-1, 0] = data["observations"][1:]
    buffer.pos, buffer.full = 0, True
    return partial(learner.train, gradient_steps=count, batch_size=size)


# ----------------------------------------------------------------------------------------------------------------------------- TorchRL


def _torchrl(algorithm: str, size: int, count: int) -> Callable[[], object]:
    modules, losses, storage = import_module("torchrl.modules"), import_module("torchrl.objectives"), import_module("torchrl.data")
    tensordict = import_module("tensordict")
    logging.getLogger("torchrl").setLevel(logging.ERROR)
    made = import_module("tensordict.nn").TensorDictModule(
        nn.Sequential(modules.MLP(S, A, num_cells=[size, size], activation_class=nn.ReLU), nn.Tanh()),
        in_keys=["observation"],
        out_keys=["action"],
    )
    critic = modules.ValueOperator(
        modules.MLP(S + A, 1, num_cells=[size, size], activation_class=nn.ReLU), in_keys=["observation", "action"]
    )
    kind, more = (losses.TD3Loss, {}) if algorithm == "TD3" else (losses.TD3BCLoss, {"alpha": 2.5})
    loss = kind(
        actor_network=made, qvalue_network=critic, num_qvalue_nets=2, bounds=(-torch.ones(A), torch.ones(A)), policy_noise=0.2,
        noise_clip=0.5, loss_function="l2", delay_actor=True, delay_qvalue=True, **more,
    )  # fmt: skip
    loss.make_value_estimator(gamma=0.99)
    targets = losses.SoftUpdate(loss, eps=0.995)
    of_actor = torch.optim.Adam(list(loss.actor_network_params.flatten_keys().values()), lr=3e-4)
    of_critic = torch.optim.Adam(list(loss.qvalue_network_params.flatten_keys().values()), lr=3e-4)
    buffer = _filled(storage, tensordict, size)
    value_of = getattr(loss, "value_loss" if algorithm == "TD3" else "qvalue_loss")
    done = 0

    def together() -> None:
        nonlocal done
        for _ in range(count):
            done += 1
            batch = buffer.sample()
            of_critic.zero_grad()
            value_loss, *_ = value_of(batch)
            value_loss.backward()
            of_critic.step()
            if done % 2 == 0:
                of_actor.zero_grad()
                actor_loss, *_ = loss.actor_loss(batch)
                actor_loss.backward()
                of_actor.step()
                targets.step()

    return together


def _filled(storage: Any, tensordict: Any, size: int) -> Any:
    data, rows = _data(), EPISODES * STEPS
    tensors = {name: torch.from_numpy(value) for name, value in data.items()}
    never = torch.zeros(rows, 1, dtype=torch.bool)
    following = {"observation": tensors["observations"].roll(-1, 0), "reward": tensors["rewards"], "done": never, "terminated": never}
    steps = tensordict.TensorDict(
        {"observation": tensors["observations"], "action": tensors["actions"], "next": tensordict.TensorDict(following, [rows])}, [rows]
    )
    buffer = storage.TensorDictReplayBuffer(storage=storage.LazyTensorStorage(rows), batch_size=size)
    buffer.extend(steps)
    return buffer


PEERS: tuple[tuple[str, tuple[str, ...], Maker], ...] = (
    ("d3rlpy", ("TD3", "TD3+BC", "CQL", "IQL", "BC"), _d3rlpy),
    ("stable-baselines3", ("TD3",), _stable_baselines3),
    ("torchrl", ("TD3", "TD3+BC"), _torchrl),
)
