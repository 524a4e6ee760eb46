"""Networks, Adam and slow copies in their plainest form, one member at a time: what the product's stacked ones must equal.

Oracles are written with these and with PyTorch's own functions. Nothing here is imported from the product. All is meant for float64
(:func:`doubles`), in which two right versions of a formula agree to twelve digits and a wrong factor, sign or order does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Weights = list[Tensor]
"""One network: weight and bias of each of its layers in order, as ``torch.nn`` keeps them."""


@contextmanager
def doubles() -> Iterator[None]:
    """Within this context everything that is made is float64, the product's networks and noise included."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def plain(part: Tensor) -> Tensor:
    """One network's part of a stacked parameter, as ``torch.nn`` has it: weights (in, out) -> (out, in), biases (1, size) -> (size,)."""
    if part.dim() < 2:
        return part
    return part[0] if part.shape[0] == 1 else part.T


def perturb(module: nn.Module, scale: float, seed: int) -> None:
    """Move every parameter: fresh biases are 0, fresh LayerNorms do nothing, and fresh slow copies are what they copy."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator))


def assert_same(found: Tensor, expected: Tensor, what: str) -> None:
    """Compare two versions of one tensor that were computed in float64, up to 1e-8 of its largest number.

    Sums in another order differ by some 1e-15 of it. Two things make more of that: Adam divides a gradient by its size, but by no less than
    1e-8, so that where it is nearly 0, another rounding moves the weight by up to 1e-8 of the learning rate; and terms may be large that
    cancel, such as those of a log-density whose deviation is e^-10. No more than 1e-9 was seen. Where all terms cancel, as in the gradient
    of a bias that moves nothing but differences, what is left is their own rounding, below 1e-15, and no number to compare with.
    """
    assert found.dtype == expected.dtype == torch.float64, f"{what} is {found.dtype}, and should be float64"
    largest = float(expected.abs().max()) if expected.numel() else 0.0
    bound = 1e-8 * largest if largest > 1e-15 else 1e-15
    if found.shape == expected.shape and bool(((found - expected).abs() <= bound).all()):
        return  # without the tenth of a millisecond that it takes to say what differs
    torch.testing.assert_close(found, expected, rtol=0.0, atol=bound, msg=lambda text: f"{what} differs. {text}")


# Networks


def mlp(weights: Sequence[Tensor], x: Tensor) -> Tensor:
    """Linear layers with ReLU between them."""
    for layer in range(0, len(weights) - 2, 2):
        x = torch.relu(F.linear(x, weights[layer], weights[layer + 1]))
    return F.linear(x, weights[-2], weights[-1])


def trunk(weights: Sequence[Tensor], x: Tensor) -> Tensor:
    """Linear, LayerNorm, tanh: four tensors."""
    weight, bias, scale, shift = weights
    hidden = F.linear(x, weight, bias)
    return torch.tanh(F.layer_norm(hidden, hidden.shape[-1:], scale, shift))


def trunk_mlp(weights: Sequence[Tensor], x: Tensor) -> Tensor:
    """The trunk, and linear layers with ReLU between them on top of it."""
    return mlp(weights[4:], trunk(weights[:4], x))


def noisy(mean: Tensor, noise: Tensor, std: float, clip: float) -> Tensor:
    """clamp(μ + clip(σ ε, -c, c)) to just inside [-1, 1] as in URLB; its gradient to μ is 1 everywhere."""
    action = (mean.detach() + (std * noise).clamp(-clip, clip)).clamp(-1.0 + 1e-6, 1.0 - 1e-6)
    return mean - mean.detach() + action


# Learning


class Adam:
    """Kingma and Ba 2015, algorithm 1, over some tensors; ``rate`` may be changed between steps.

    Attributes:
        first, second: the moments of each tensor.
        gradients: of the last step.
    """

    def __init__(self, weights: Sequence[Tensor], rate: float, betas: tuple[float, float] = (0.9, 0.999), epsilon: float = 1e-8) -> None:
        self.weights, self.rate, self.betas, self.epsilon, self.steps = list(weights), rate, betas, epsilon, 0
        self.first = [torch.zeros_like(weight) for weight in weights]
        self.second = [torch.zeros_like(weight) for weight in weights]
        self.gradients = [torch.zeros_like(weight) for weight in weights]

    def minimise(self, loss: Tensor) -> None:
        """One step down the gradient of a loss."""
        self.steps += 1
        self.gradients = list(torch.autograd.grad(loss, self.weights))
        one, two = self.betas
        with torch.no_grad():
            for i, (weight, gradient) in enumerate(zip(self.weights, self.gradients, strict=True)):
                self.first[i] = one * self.first[i] + (1 - one) * gradient
                self.second[i] = two * self.second[i] + (1 - two) * gradient**2
                mean, square = self.first[i] / (1 - one**self.steps), self.second[i] / (1 - two**self.steps)
                weight -= self.rate * mean / (square.sqrt() + self.epsilon)


@torch.no_grad()
def ema(slow: Weights, online: Weights, tau: float) -> None:
    """slow <- (1 - τ) slow + τ online, in place."""
    for old, new in zip(slow, online, strict=True):
        old.copy_((1 - tau) * old + tau * new)


class Member:
    """Member ``e`` of a stack of learners, taken out of it as plain tensors under the stack's own names, each a leaf that can be trained.

    A network becomes a list of tensors (``member.actor``), several of them for each member a list of such lists (``member.critic[1]``), in
    which those that have layers in common have the same tensors; a parameter of its own a tensor (``member.log_std``).

    Args:
        learner: the stack; it is copied from, and stays as it is.
        e: which member.
        trained: the names of what each optimiser trains, by the optimiser's name.
        rate: the learning rate of all of them.

    Attributes:
        branches: which outcomes the conditions given to :meth:`branch` have had.
    """

    def __init__(self, learner: Any, e: int, trained: Mapping[str, Sequence[str]], rate: float) -> None:
        self.e = e
        self.branches: dict[str, set[bool]] = {}
        self._places: dict[str, tuple[str, int, Tensor]] = {}  # by label: the stacked parameter's name, this one's row in it, this one
        for name, module in learner.named_children():
            networks = self._take(name, module, len(learner.seeds))
            if networks:
                setattr(self, name, networks if len(networks) > 1 else networks[0])
        for name, parameter in learner.named_parameters(recurse=False):
            setattr(self, name, self._leaf(name, name, parameter, e))
        self.adam: dict[str, Adam] = {}
        for optimiser, names in trained.items():
            weights = [weight for label, (_, _, weight) in self._places.items() if label.split("[")[0].split(".")[0] in names]
            self.adam[optimiser] = Adam(weights, rate)
        # Noise is an input of an update, not what is tested: it comes from copies of the member's own generators, drawn in the order and
        # the shapes in which the product draws.
        self._generators = {}
        for purpose, random in learner.random.items():
            self._generators[purpose] = torch.Generator()
            self._generators[purpose].set_state(random.generators[e].get_state())

    def _take(self, name: str, module: nn.Module, members: int) -> list[Weights]:
        parameters = dict(module.named_parameters(prefix=name))
        if not parameters:
            return []
        networks: list[Weights] = [[] for _ in range(max(parameter.shape[0] for parameter in parameters.values()) // members)]
        for path, parameter in parameters.items():
            each = parameter.shape[0] // members  # a member's networks lie one after the other; of some layers all have one and the same
            leaves = [self._leaf(f"{name}[{j}].{path}", path, parameter, self.e * each + j) for j in range(each)]
            for network, leaf in zip(networks, leaves * (len(networks) // each), strict=True):
                network.append(leaf)
        return networks

    def _leaf(self, label: str, path: str, parameter: Tensor, row: int) -> Tensor:
        leaf = plain(parameter.detach()[row]).clone().requires_grad_()
        self._places[label] = (path, row, leaf)
        return leaf

    def branch(self, condition: Tensor, what: str) -> Tensor:
        """The condition itself, noted: data for which it is always or never true do not tell a formula's one branch from its other."""
        self.branches.setdefault(what, set()).update(condition.unique().tolist())
        return condition

    def normal(self, *shape: int, purpose: str = "noise") -> Tensor:
        """Standard normal noise."""
        return torch.empty(shape).normal_(generator=self._generators[purpose])

    def uniform(self, *shape: int, purpose: str = "noise", dtype: torch.dtype = torch.float32) -> Tensor:
        """Noise in [0, 1), which the product draws in float32."""
        drawn = torch.empty(shape, dtype=dtype).uniform_(generator=self._generators[purpose])
        return drawn.to(torch.get_default_dtype())

    def assert_equals(self, learner: Any, when: str) -> None:
        """Compare with the stack: weights and slow copies, and of what is trained its last gradient and both of Adam's moments.

        Adam divides by the size of gradients, so that a wrong factor in a loss shows in the moments and hardly in weights.

        Args:
            learner: the stack that this member was taken out of, after the same updates.
            when: for the message of what differs.
        """
        stacked = dict(learner.named_parameters())
        states: dict[Tensor, Any] = {}
        for optimiser in learner.optimisers.values():
            states |= {parameter: optimiser.state.get(parameter, {}) for group in optimiser.param_groups for parameter in group["params"]}
        adams = {id(weight): (adam, i) for adam in self.adam.values() for i, weight in enumerate(adam.weights)}

        def compare(what: str, theirs: Tensor, ours: Tensor) -> None:
            assert_same(plain(theirs), ours, f"{when}, member {self.e}: {what}")

        for label, (path, row, weight) in self._places.items():
            parameter = stacked[path]
            compare(label, parameter.detach()[row], weight.detach())
            assert (id(weight) in adams) == (parameter in states), f"{label} is trained by one of both only"
            if parameter not in states:
                continue
            adam, i = adams[id(weight)]
            state = states[parameter]
            steps = int(state["step"].item()) if state else 0
            assert steps == adam.steps, f"{when}: {label} took {steps} steps of Adam instead of {adam.steps}"
            if steps:
                compare(f"the first moment of {label}", state["exp_avg"][row], adam.first[i])
                compare(f"the second moment of {label}", state["exp_avg_sq"][row], adam.second[i])
            if steps and parameter.grad is not None:
                # Where it is kept: it holds what this weight's own loss says, and nothing that another loss left there.
                compare(f"the gradient of {label}", parameter.grad[row], adam.gradients[i])
