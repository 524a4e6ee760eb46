"""Stacked networks: E independent members side by side, member axis first.

Parameters are (E, in, out), batches (E, B, dim). Every operation is a batched one, so a member never sees another: with losses summed
over E, gradients and Adam stay independent. E=1 is the ordinary case. Weights are drawn from each member's own generator.

On a CPU, in one thread and not compiled, a member's numbers are the same to the last bit whoever is beside it. Two kernels round by the
size of the whole stack, and are therefore called for each member: products with a vector, and Adam (:class:`MemberAdam`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call

from cudc_bench.settings.seeding import stream_seed

WIDE = 64  # Narrower products take little time, and values and actions come from them.
_bf16_products = False
_members_apart = True


@contextmanager
def bf16_products() -> Iterator[None]:
    """Within this context wide layers multiply numbers of bfloat16, forwards and backwards. All else stays float32: what comes out of a
    layer, sums, losses, targets, weights and optimisers, and layers with fewer than 64 inputs or outputs."""
    global _bf16_products
    before, _bf16_products = _bf16_products, True
    try:
        yield
    finally:
        _bf16_products = before


@contextmanager
def whole_stacks() -> Iterator[None]:
    """Within this context optimisers take stacks as a whole on a CPU, too: what is compiled has no use for PyTorch's kernels."""
    global _members_apart
    before, _members_apart = _members_apart, False
    try:
        yield
    finally:
        _members_apart = before


class MemberRandom:
    """One random stream for each member, for one purpose.

    Args:
        seeds: the E members' seeds.
        purpose: what is drawn; streams of different purposes are independent.
        device: where the numbers are drawn.

    Attributes:
        fold: how many networks of each member have streams here, see :class:`Ensemble`.
    """

    def __init__(self, seeds: Sequence[int], purpose: str, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.fold = 1
        self.generators = [torch.Generator(self.device).manual_seed(stream_seed(seed, purpose)) for seed in seeds]

    @property
    def count(self) -> int:
        """E, the number of members."""
        return len(self.generators)

    def normal(self, *shape: int) -> Tensor:
        """Standard normal float32 numbers (E, *shape)."""
        out = torch.empty((self.count, *shape), device=self.device)
        for row, generator in zip(out, self.generators, strict=True):
            row.normal_(generator=generator)
        return out

    def uniform(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Numbers in [0, 1) of shape (E, *shape)."""
        out = torch.empty((self.count, *shape), device=self.device, dtype=dtype)
        for row, generator in zip(out, self.generators, strict=True):
            row.uniform_(generator=generator)
        return out

    def state_dict(self) -> list[Tensor]:
        """The state of each member's generator."""
        return [generator.get_state() for generator in self.generators]

    def load_state_dict(self, state: Sequence[Tensor]) -> None:
        """Continue where ``state_dict`` was taken."""
        for generator, value in zip(self.generators, state, strict=True):
            generator.set_state(value.cpu())


class Linear(nn.Module):
    """E linear layers with orthogonal weights (gain 1) and zero biases.

    Args:
        random: the members' streams for initial weights.
        inputs: size of the input.
        outputs: size of the output.
        blocks: the output is this many blocks that are initialised separately, as if they were layers of their own.
        orthogonal: False for PyTorch's default instead, weights and biases uniform within ±1/√inputs.
    """

    def __init__(self, random: MemberRandom, inputs: int, outputs: int, blocks: int = 1, orthogonal: bool = True) -> None:
        super().__init__()
        weight = torch.empty(random.count, inputs, outputs, device=random.device)
        bias = torch.zeros(random.count, 1, outputs, device=random.device)
        for member, shift, generator in zip(weight, bias, random.generators, strict=True):
            if not orthogonal:
                for part in (member, shift):
                    part.uniform_(-(inputs**-0.5), inputs**-0.5, generator=generator)
                continue
            for block in member.chunk(blocks, dim=1):
                drawn = torch.empty(block.shape[1], block.shape[0], device=random.device)
                block.copy_(nn.init.orthogonal_(drawn, generator=generator).T)
        self.weight = nn.Parameter(weight)
        self.bias = nn.Parameter(bias)
        # One of each member's networks: a member that is alone has a product of one matrix, which is another kernel's work if it is one
        # with a vector.
        self._apart = random.count // random.fold if random.device.type == "cpu" else 0

    def forward(self, x: Tensor) -> Tensor:
        """(E, B, inputs) -> (E, B, outputs)."""
        if _bf16_products and min(self.weight.shape[1:]) >= WIDE:
            # The sum with the bias is float32 again.
            return torch.bmm(x.bfloat16(), self.weight.bfloat16()) + self.bias
        if self._apart == len(x) > 1 and 1 in (x.shape[1], self.weight.shape[2]):
            members = zip(self.bias.split(1), x.split(1), self.weight.split(1), strict=True)
            return torch.cat([torch.baddbmm(*member) for member in members])
        return torch.baddbmm(self.bias, x, self.weight)


class LayerNorm(nn.Module):
    """E layer normalisations with their own scale and shift."""

    def __init__(self, random: MemberRandom, size: int) -> None:
        super().__init__()
        self.size = size
        self.weight = nn.Parameter(torch.ones(random.count, 1, size, device=random.device))
        self.bias = nn.Parameter(torch.zeros(random.count, 1, size, device=random.device))

    def forward(self, x: Tensor) -> Tensor:
        """(E, B, size) -> (E, B, size)."""
        return torch.addcmul(self.bias, F.layer_norm(x, (self.size,)), self.weight)


class Activation(nn.Module):
    """An element-wise function as a layer."""

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, x: Tensor) -> Tensor:
        return self.function(x)


def mlp(random: MemberRandom, *sizes: int, output: Callable[[Tensor], Tensor] | None = None, orthogonal: bool = True) -> nn.Sequential:
    """Linear layers of the given sizes with ReLU between them, and ``output`` applied at the end (none: linear)."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [Linear(random, inputs, outputs, orthogonal=orthogonal), Activation(torch.relu_)]
    layers.pop()
    if output is not None:
        layers.append(Activation(output))
    return nn.Sequential(*layers)


def trunk(random: MemberRandom, inputs: int, outputs: int) -> nn.Sequential:
    """Linear, LayerNorm, tanh: the first layer of every actor and critic of URLB and ExORL."""
    return nn.Sequential(Linear(random, inputs, outputs), LayerNorm(random, outputs), Activation(torch.tanh))


def actor(random: MemberRandom, observation: int, action: int, width: int) -> nn.Sequential:
    """The policy's mean: trunk, hidden layer, tanh. (E, B, S) -> (E, B, A) in (-1, 1)."""
    return nn.Sequential(trunk(random, observation, width), *mlp(random, width, width, action, output=torch.tanh))


class SharedTrunkCritic(nn.Module):
    """Twin critics on one trunk, as in URLB's DDPG. The heads are computed as one wide layer.

    Args:
        random: the members' streams for initial weights.
        inputs: size of observation and action together.
        width: of the hidden layers.
        outputs: of each head; 1 gives a value, more give successor features.
    """

    head_mask: Tensor

    def __init__(self, random: MemberRandom, inputs: int, width: int, outputs: int = 1) -> None:
        super().__init__()
        self.trunk = trunk(random, inputs, width)
        self.hidden = Linear(random, width, 2 * width, blocks=2)
        # Head j reads only its own half of the hidden layer: the other half of its column is masked and starts at zero.
        self.outputs = outputs
        self.out = Linear(random, width, 2 * outputs, blocks=2)
        mask = torch.zeros(1, 2 * width, 2 * outputs, device=random.device)
        mask[:, :width, :outputs] = 1.0
        mask[:, width:, outputs:] = 1.0
        self.register_buffer("head_mask", mask, persistent=False)
        self.out.weight = nn.Parameter(torch.cat([self.out.weight.detach()] * 2, dim=1) * mask)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """(E, B, S), (E, B, A) -> both values (E, B, 2), or both heads (E, B, 2, outputs) of several outputs."""
        hidden = torch.relu_(self.hidden(self.trunk(torch.cat([observation, action], dim=-1))))
        heads = torch.baddbmm(self.out.bias, hidden, self.out.weight * self.head_mask)
        return heads if self.outputs == 1 else heads.unflatten(-1, (2, self.outputs))


class Ensemble(nn.Module):
    """N networks for each member, folded into the member axis.

    Args:
        random: the members' streams for initial weights; a member's networks draw one after the other from its own.
        size: N.
        make: builds the stacked network from the streams that it is given.
    """

    def __init__(self, random: MemberRandom, size: int, make: Callable[[MemberRandom], nn.Module]) -> None:
        super().__init__()
        folded = MemberRandom([], "ensemble", random.device)
        folded.generators = [generator for generator in random.generators for _ in range(size)]
        folded.fold = size * random.fold
        self.size = size
        self.layers = make(folded)

    def forward(self, x: Tensor) -> Tensor:
        """(E, B, inputs) -> (E, N, B, outputs)."""
        out = self.layers(x.repeat_interleave(self.size, dim=0))
        return out.unflatten(0, (-1, self.size))

    def first(self, x: Tensor) -> Tensor:
        """(E, B, inputs) -> (E, B, outputs) of each member's first network, without the work of the others; as of all but for rounding."""
        own = {name: stacked[:: self.size] for name, stacked in self.layers.named_parameters()}
        out: Tensor = functional_call(self.layers, own, x)
        return out


class TwinCritic(nn.Module):
    """Two separate critics.

    Args:
        random: the members' streams for initial weights.
        make: builds one stacked critic, (E, B, S + A) -> (E, B, 1), from the streams that it is given.
    """

    def __init__(self, random: MemberRandom, make: Callable[[MemberRandom], nn.Module]) -> None:
        super().__init__()
        self.twins = Ensemble(random, 2, make)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """(E, B, S), (E, B, A) -> both values (E, B, 2)."""
        return self.twins(torch.cat([observation, action], dim=-1)).squeeze(-1).transpose(1, 2)

    def first(self, observation: Tensor, action: Tensor) -> Tensor:
        """(E, B, S), (E, B, A) -> the first critic's values (E, B), without the work of the second; as of both but for rounding."""
        return self.twins.first(torch.cat([observation, action], dim=-1)).squeeze(-1)


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """Within this context no gradient is computed for the module's weights; it still flows through to its inputs."""
    parameters = list(module.parameters())
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)


ModuleT = TypeVar("ModuleT", bound=nn.Module)
Trainable = nn.Module | nn.Parameter | tuple[nn.Module, float]


class MemberAdam(torch.optim.Adam):
    """A fused Adam that takes each member's numbers on their own on a CPU: PyTorch's kernel rounds the last few of a tensor differently.

    Attributes:
        members: E.
    """

    members = 1
    # PyTorch's own, without what is wrapped around them for its compiler and imports that: a second and a half in every process.
    add_param_group = inspect.unwrap(torch.optim.Optimizer.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Optimizer.zero_grad)
    state_dict = inspect.unwrap(torch.optim.Optimizer.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Optimizer.load_state_dict)
    _step = inspect.unwrap(torch.optim.Adam.step)

    def step(self, closure: Any = None) -> Any:
        with torch.no_grad():
            return self._step(closure)

    def _init_group(self, group: Any, *lists: list[Tensor]) -> bool:
        complex_numbers: bool = super()._init_group(group, *lists)
        parameters, gradients, averages, squares, _, steps = lists
        if self.members == 1 or not _members_apart or not parameters or parameters[0].device.type != "cpu":
            return complex_numbers
        whole = list(zip(parameters, gradients, averages, squares, steps, strict=True))
        for many in (parameters, gradients, averages, squares, steps):
            many.clear()
        for parameter, gradient, average, square, step in whole:
            rows = self.members if parameter.ndim and parameter.shape[0] % self.members == 0 else 1
            gradients += gradient.reshape(rows, -1)
            for many, one in ((parameters, parameter), (averages, average), (squares, square)):
                many += one.view(rows, -1)
            # Each of them is counted up, and a parameter's own but once.
            steps += [step, *(step.clone() for _ in range(rows - 1))]
        return complex_numbers


def adam(trained: Sequence[Trainable], learning_rate: float, members: int = 1) -> MemberAdam:
    """One fused Adam with the default betas over the parameters of some modules; a pair gives a module its own learning rate.

    Learning rates are tensors, and the state is there from the start: a graph repeats what it was recorded with.
    """
    groups: dict[float, list[nn.Parameter]] = {}
    for one in trained:
        module, rate = one if isinstance(one, tuple) else (one, learning_rate)
        groups.setdefault(rate, []).extend([module] if isinstance(module, nn.Parameter) else module.parameters())
    device = next(parameters[0].device for parameters in groups.values())
    on_cuda = device.type == "cuda"
    # On a CPU as exact as the number itself.
    rates = {rate: torch.tensor(rate, device=device, dtype=torch.float32 if on_cuda else torch.float64) for rate in groups}
    optimiser = MemberAdam(
        [{"params": parameters, "lr": rates[rate]} for rate, parameters in groups.items()], fused=True, capturable=on_cuda
    )
    optimiser.members = members
    for parameters in groups.values():
        for parameter in parameters:
            optimiser.state[parameter] = {
                "step": torch.zeros((), dtype=torch.float32, device=device),
                "exp_avg": torch.zeros_like(parameter, memory_format=torch.preserve_format),
                "exp_avg_sq": torch.zeros_like(parameter, memory_format=torch.preserve_format),
            }
    return optimiser


def minimise(loss: Tensor, optimiser: torch.optim.Optimizer) -> None:
    """One optimiser step on the sum of the members' losses (E,)."""
    optimiser.zero_grad(set_to_none=True)
    loss.sum().backward()
    optimiser.step()


def make_target(online: ModuleT, target: ModuleT) -> ModuleT:
    """Turn ``target`` (built like ``online``) into its exact copy that takes no gradient."""
    target.load_state_dict(online.state_dict())
    return target.requires_grad_(False)


@torch.no_grad()
def soft_update(online: nn.Module, target: nn.Module, tau: float) -> None:
    """target <- (1 - tau) target + tau online, for every parameter."""
    if any(True for _ in target.parameters()):
        torch._foreach_lerp_(list(target.parameters()), list(online.parameters()), tau)


def noisy_action(mean: Tensor, noise: Tensor, std: float, clip: float | None) -> Tensor:
    """URLB's "truncated normal" action: clamped to just inside [-1, 1], with the gradient passed straight through the clamp.

    Args:
        mean: (E, B, A).
        noise: standard normal, of the same shape.
        std: standard deviation.
        clip: bound of the scaled noise; None when acting.
    """
    scaled = noise * std
    if clip is not None:
        scaled = scaled.clamp(-clip, clip)
    action = mean + scaled
    return action + (action.clamp(-1.0 + 1e-6, 1.0 - 1e-6) - action).detach()
