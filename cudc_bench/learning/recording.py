"""The operations of one update, as PyTorch carries them out: what a graph repeats, and what a compiler turns into one function.

An update is written once, as ordinary PyTorch with ``backward`` and optimisers. Whatever Python decides is decided while it is recorded;
what is left are operations on tensors. Those that were there before are its inputs: networks, slow copies, optimiser states, data. Random
numbers depend on nothing that an update computes, so that their draws can come first (:meth:`Recording.draw`), from the same generators in
the same order. The rest (:meth:`Recording.graph`) is a pure function of its inputs, which says which of them it changes to what.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor, fx
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from cudc_bench.learning.networks import MemberRandom, whole_stacks

T = TypeVar("T")
Place = tuple[int, int, tuple[int, ...], tuple[int, ...], torch.dtype]

# The host reads a number, or the size of a result depends on numbers, or a number of the host becomes a tensor, by a copy that waits.
_WAITING = frozenset({"aten::_local_scalar_dense", "aten::item", "aten::nonzero", "aten::masked_select", "aten::is_nonzero",
                      "aten::equal", "aten::_unique2", "aten::unique_dim", "aten::repeat_interleave.Tensor", "aten::repeat_interleave",
                      "aten::lift_fresh"})  # fmt: skip
_DRAWS = frozenset({"aten::normal_", "aten::uniform_"})


class WaitsForDeviceError(AssertionError):
    """An update needs a result on the host, or a number of the host as a tensor."""


class NotRepeatableError(Exception):
    """An update does something that a repetition of its operations would not do."""


@dataclass
class Call:
    """One operation and the very tensors that it read, wrote and made."""

    function: Any
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    result: Any

    @property
    def name(self) -> str:
        """Without its overload."""
        return str(self.function._schema.name)

    def read(self) -> list[Tensor]:
        """Its arguments that are tensors."""
        return _tensors((self.args, self.kwargs))

    def written(self) -> list[Tensor]:
        """Those of its arguments that it changes."""
        schema = self.function._schema.arguments
        given = {argument.name: value for argument, value in zip(schema, self.args, strict=False)} | self.kwargs
        changed = [a.name for a in schema if a.alias_info is not None and a.alias_info.is_write]
        return _tensors([given.get(name) for name in changed])


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_flatten(tree)[0] if isinstance(leaf, Tensor)]


class Recorder(TorchDispatchMode):
    """Carries operations out and notes them; those for which the host would have to wait for a device are refused.

    ``tolist`` and ``numpy`` cannot be seen: on a CPU they are no operations.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Call] = []

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # PyTorch would wrap what follows for its compiler, and import that for it: a second and a half in every process.
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None) -> Any:
        name = func._schema.name
        if name in _WAITING or (name == "aten::index" and any(t.dtype == torch.bool for t in _tensors(args[1]))):
            what = f"{name} has the host wait for the device"
            if name == "aten::lift_fresh":
                what = "torch.tensor of a number has the host wait for the device (torch.full is filled there)"
            raise WaitsForDeviceError(f"{what}; an update that does so cannot become a graph")
        call = Call(func, args, kwargs or {}, None)
        self.before(call)
        call.result = func(*args, **call.kwargs)
        if func.namespace != "profiler":
            self.calls.append(call)
        return call.result

    def before(self, call: Call) -> None:
        """Called before an operation is carried out."""


def _place(tensor: Tensor) -> Place:
    """Where a tensor's numbers are. The same ones come as several objects: autograd wraps anew what it has kept for a gradient."""
    return tensor.untyped_storage()._cdata, int(tensor.storage_offset()), tuple(tensor.shape), tuple(tensor.stride()), tensor.dtype


class _TakingBack(Recorder):
    """A recorder that knows what was changed of what had been there before."""

    def __init__(self) -> None:
        super().__init__()
        self._made: set[int] = set()
        self._saved: dict[int, tuple[Tensor, Tensor]] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None) -> Any:
        result = super().__torch_dispatch__(func, types, args, kwargs)
        if func.namespace != "profiler" and all(returned.alias_info is None for returned in func._schema.returns):
            self._made.update(tensor.untyped_storage()._cdata for tensor in _tensors(result))
        return result

    def before(self, call: Call) -> None:
        for tensor in call.written():
            storage = tensor.untyped_storage()
            if storage._cdata not in self._made and storage._cdata not in self._saved:
                whole = torch.empty(0, dtype=tensor.dtype, device=tensor.device).set_(storage)
                self._saved[storage._cdata] = whole, whole.clone()

    def take_back(self) -> None:
        """Everything as it was."""
        with torch.no_grad():
            for tensor, before in self._saved.values():
                tensor.copy_(before)


@dataclass
class Recording:
    """One update: its draws, and the pure function that is the rest.

    Attributes:
        graph: operations of ATen, inputs first; it returns nothing, and changes inputs in place.
        inputs: the tensors that it is called with, always the same ones.
        draws: what fills those of them that hold random numbers, in the order of the update.
        operations: how many an update carries out one by one, its draws among them.
    """

    graph: fx.GraphModule
    inputs: list[Tensor]
    draws: list[Call] = field(repr=False)
    operations: int

    @classmethod
    def of(cls, update: Callable[[], T], random: Iterable[MemberRandom]) -> tuple[Recording, T]:
        """Record an update, and take back what it did.

        Args:
            update: changes tensors in place.
            random: the streams that it may draw from.

        Returns:
            The recording, and what the update returned. Its tensors, as far as they are those of a dataclass or a container, hold the
            results of each repetition.

        Raises:
            WaitsForDeviceError: it needs a result on the host.
            NotRepeatableError: it draws from other streams, or changes what overlaps.
        """
        streams = list(random)
        before = [stream.state_dict() for stream in streams]
        recorder = _TakingBack()
        try:
            with whole_stacks(), recorder:
                result = update()
        finally:
            recorder.take_back()
            for stream, state in zip(streams, before, strict=True):
                stream.load_state_dict(state)
        known = {getattr(generator, "_cdata", None) for stream in streams for generator in stream.generators}
        return cls._from(recorder.calls, _results(result), known), result

    @classmethod
    def _from(cls, calls: list[Call], results: list[Tensor], generators: set[Any]) -> Recording:
        draws, filled = [], set()
        for call in calls:
            if call.name in _DRAWS and getattr(call.kwargs.get("generator"), "_cdata", 0) in generators:
                draws.append(call)
                filled.add(call.args[0].untyped_storage()._cdata)
            elif torch.Tag.nondeterministic_seeded in call.function.tags:
                raise NotRepeatableError(f"{call.name} draws random numbers from a stream that is not one of the learner's")
        drawn = {id(call) for call in draws}
        rest = [call for call in calls if id(call) not in drawn and not _is_room(call, filled)]
        builder = _Builder()
        builder.find_inputs(rest, results, filled)
        for call in rest:
            builder.add(call)
        return cls(builder.module(results), builder.inputs, draws, len(calls))

    @contextmanager
    def taken_back(self, random: Iterable[MemberRandom]) -> Iterator[None]:
        """Take back what repetitions within this context do, and what they draw from these streams."""
        streams = list(random)
        states = [stream.state_dict() for stream in streams]
        before = [(one, one.clone()) for one in self.inputs]
        try:
            yield
        finally:
            for tensor, was in before:
                tensor.copy_(was)
            for stream, state in zip(streams, states, strict=True):
                stream.load_state_dict(state)

    def draw(self) -> None:
        """Fill the inputs that hold random numbers."""
        for call in self.draws:
            call.function(*call.args, **call.kwargs)


def _is_room(call: Call, filled: set[int]) -> bool:
    """Whether it makes the tensor that random numbers are drawn into, which becomes an input."""
    made = _tensors(call.result)
    if not (made and all(returned.alias_info is None for returned in call.function._schema.returns)):
        return False
    if not any(tensor.untyped_storage()._cdata in filled for tensor in made):
        return False
    if call.name != "aten::empty":
        raise NotRepeatableError(f"random numbers are drawn into what {call.name} made; draw them with MemberRandom")
    return True


def _results(result: Any) -> list[Tensor]:
    """The tensors of what an update returned: of a container, or of a dataclass whose fields are tensors."""
    return _tensors(vars(result) if hasattr(result, "__dataclass_fields__") else result)


class _Builder:
    """Turns operations on tensors into a graph of operations on the places where these tensors are."""

    def __init__(self) -> None:
        self.inputs: list[Tensor] = []
        self._graph = fx.Graph()
        self._nodes: dict[Place, fx.Node] = {}
        self._written: set[Place] = set()

    def find_inputs(self, calls: list[Call], results: list[Tensor], filled: set[int]) -> None:
        """Inputs are what is read before it is made; results that are made are inputs, too: a repetition writes them there."""
        made: dict[Place, None] = {}
        for call in calls:
            for tensor in call.read():
                if _place(tensor) not in made:
                    self._input(tensor)
            self._written.update(map(_place, call.written()))
            made |= dict.fromkeys(map(_place, _tensors(call.result)))
        self._kept = {
            _place(one): self._graph.placeholder(f"result{i}")
            for i, one in enumerate(results)
            if _place(one) in made and _place(one) not in self._nodes
        }
        by_place = {_place(one): one for one in results}
        self.inputs += [by_place[place].detach() for place in self._kept]
        self._refuse_overlaps(filled)

    def _input(self, tensor: Tensor) -> None:
        place = _place(tensor)
        if place not in self._nodes:
            self._nodes[place] = self._graph.placeholder(f"input{len(self.inputs)}")
            self.inputs.append(tensor.detach())

    def _refuse_overlaps(self, filled: set[int]) -> None:
        """A function of two inputs cannot know that one changes with the other."""
        by_storage: dict[int, list[Place]] = {}
        for place in self._nodes:
            by_storage.setdefault(place[0], []).append(place)
        for storage, places in by_storage.items():
            if len(places) > 1 and storage not in filled and any(place in self._written for place in places):
                spans = sorted((p[1], p[1] + 1 + sum((n - 1) * s for n, s in zip(p[2], p[3], strict=True))) for p in places)
                if any(first[1] > second[0] for first, second in pairwise(spans)):
                    raise NotRepeatableError("it changes a tensor of which it also reads a part that was taken before")

    def add(self, call: Call) -> None:
        """One operation more."""
        node = self._graph.call_function(call.function, tree_map(self._node, call.args), tree_map(self._node, call.kwargs))
        if isinstance(call.result, Tensor):
            self._nodes[_place(call.result)] = node
        elif isinstance(call.result, (tuple, list)):
            for index, one in enumerate(call.result):
                if isinstance(one, Tensor):
                    self._nodes[_place(one)] = self._graph.call_function(operator.getitem, (node, index))

    def _node(self, value: Any) -> Any:
        return self._nodes[_place(value)] if isinstance(value, Tensor) else value

    def module(self, results: Iterable[Tensor]) -> fx.GraphModule:
        """All of it, with the results written where they were."""
        for place, kept in self._kept.items():
            self._graph.call_function(torch.ops.aten.copy_.default, (kept, self._nodes[place]))
        self._graph.output(())
        return fx.GraphModule(torch.nn.Module(), self._graph)


def leaves(state: Any) -> list[Any]:
    """What a state consists of: for each tensor where it is, all else as it is."""
    return [_place(leaf) if isinstance(leaf, Tensor) else leaf for leaf in tree_flatten(state)[0]]
