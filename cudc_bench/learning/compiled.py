"""An update as one compiled function: recorded once, made free of changes in place, and given to PyTorch's compiler (Inductor).

On a CPU this is a C++ function without Python in it. It needs a C++ compiler, takes up to half a minute the first time for each method,
size and number of threads, and is kept on the disk. Results are those of updates one by one up to rounding: the compiler fuses operations,
and changes the order of sums.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import subprocess
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, fx

from cudc_bench.execution import interrupts
from cudc_bench.execution.progress import echo
from cudc_bench.learning import kept
from cudc_bench.learning.cuda_graphs import CudaGraph, Graph
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.recording import NotRepeatableError, Recording

T = TypeVar("T")
aten = torch.ops.aten
_CACHE = "TORCHINDUCTOR_CACHE_DIR"
_here: dict[str, Callable[[list[Tensor]], Any]] = {}  # what this process has compiled: pure functions, for any tensors of the same shapes


class CannotCompileError(Exception):
    """The compiler is missing, or does not take an update."""


@cache
def missing_compiler() -> str | None:
    """What keeps this machine from compiling for its CPU; None if nothing does."""
    name = os.environ.get("CXX", "g++")
    if (path := shutil.which(name)) is None:
        return f"there is no C++ compiler '{name}'"
    # Clang and old compilers may lack OpenMP's header, with which every compiled function begins.
    source = "#include <omp.h>\nint main() { return omp_get_max_threads() > 0 ? 0 : 1; }\n"
    try:
        run = subprocess.run([path, "-x", "c++", "-std=c++17", "-fopenmp", "-fsyntax-only", "-"],
                             input=source, text=True, capture_output=True, timeout=60, check=False)  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"'{name}' cannot be run ({error})"
    return None if run.returncode == 0 else f"'{name}' knows no C++17 with OpenMP"


def cache_folder() -> Path:
    """Where compiled functions are kept: ``TORCHINDUCTOR_CACHE_DIR``, by default a folder of the user's cache."""
    if given := os.environ.get(_CACHE):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cudc-bench" / "compiled"


class CompiledGraph(Graph):
    """An update on a CPU as one function.

    It needs no warm-up, so that a run that is continued is compiled from its next update on. Minibatches are drawn before, so that datasets
    of all sizes share one function.
    """

    warm_up = 0
    draws = False

    def capture(self, function: Callable[[], T], random: Iterable[MemberRandom]) -> T:
        self._recording, result = Recording.of(function, random)
        self._run = compile_recording(self._recording)
        return result

    def replay(self) -> None:
        self._recording.draw()
        self._run()


class CompiledCudaGraph(CudaGraph):
    """A CUDA graph of a compiled update: few kernels, and no Python between them."""

    def capture(self, function: Callable[[], T], random: Iterable[MemberRandom]) -> T:
        streams = list(random)
        recording, result = Recording.of(function, streams)
        run = compile_recording(recording)

        def update() -> None:
            recording.draw()
            run()

        # Kernels are loaded when they first run, which a capture does not allow.
        with recording.taken_back(streams):
            self.warm(update)
        super().capture(update, streams)
        return result


def compile_recording(recording: Recording) -> Callable[[], None]:
    """The function that does what was recorded, apart from its draws.

    Raises:
        CannotCompileError: the compiler does not take it.
        Interrupted: the process was asked to leave meanwhile.
    """
    os.environ.setdefault(_CACHE, str(cache_folder()))
    key = _key(recording)
    try:
        _check_steps(recording)
        compiled = _here[key] if key in _here else _here.setdefault(key, _known(recording, cache_folder() / "known" / key))
    except Exception as error:  # whatever the compiler raises: single steps remain
        if interrupts.requested():
            # Ctrl-C ends the compilers that it started as well.
            raise interrupts.interrupted("") from None
        raise CannotCompileError(f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:200]}") from error
    inputs = recording.inputs

    def run() -> None:
        with torch.no_grad():
            compiled(list(inputs))

    return run


def _key(recording: Recording) -> str:
    """What a compiled function depends on: the update, how it is taken apart here, the machine and what people have set."""
    shapes = [(tuple(one.shape), tuple(one.stride()), str(one.dtype), str(one.device)) for one in recording.inputs]
    text = f"{Path(__file__).read_text()} {kept.machine()} {kept.settings(_CACHE)} {shapes} {recording.graph.code}"
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _known(recording: Recording, path: Path) -> Callable[[list[Tensor]], Any]:
    """What was compiled before, else compile it, and keep it for the next time."""
    on_cpu = _on_cpu(recording)
    if on_cpu and (found := kept.kept(path)) is not None:
        return found
    start = time.perf_counter()
    # On CUDA the compiler keeps what it made, and a mark says that it did.
    if aloud := on_cpu or not path.exists():
        echo("compiling an update for this method, size and machine; it is kept, and most take less than half a minute")
    with _quiet():
        compiled = compile_anew(recording)
    if aloud:
        echo(f"compiled in {time.perf_counter() - start:.0f} s")
    with contextlib.suppress(OSError, ImportError, AttributeError, KeyError):
        if not on_cpu:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        elif (library := kept.library_of(compiled)) is not None:
            kept.keep(path, library)
            # As later starts call it.
            return kept.load(library)
    return compiled


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """What the compiler says to its own developers is nothing to people who train."""
    log = logging.getLogger("torch._inductor")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(before)


def _on_cpu(recording: Recording) -> bool:
    return all(one.device.type == "cpu" for one in recording.inputs)


def compile_anew(recording: Recording) -> Any:
    """The function that the compiler makes of a recording, whose inputs it takes as a list; what is kept is not looked for."""
    from torch._guards import TracingContext, tracing
    from torch._inductor import config
    from torch._inductor.compile_fx import compile_fx_inner
    from torch._subclasses.fake_tensor import FakeTensorMode

    mode = FakeTensorMode()
    graph, inputs = functional(recording, mode)
    on_cpu = _on_cpu(recording)
    options = {"cpp.threads": torch.get_num_threads(), "cpp_wrapper": on_cpu, "fx_graph_cache": True}
    with torch.no_grad(), mode, tracing(TracingContext(mode)), config.patch(options):
        compiled: Any = compile_fx_inner(graph, inputs, cpp_wrapper=on_cpu, is_inference=True)
    return compiled


def functional(recording: Recording, mode: Any) -> tuple[fx.GraphModule, list[Tensor]]:
    """The recorded operations without changes in place but for one copy at the end into each input that changes, and with optimisers and
    slow copies taken apart into arithmetic.

    Args:
        recording: of an update.
        mode: a ``FakeTensorMode``, in which the graph is traced.

    Returns:
        The graph and stand-ins for its inputs.

    Raises:
        NotRepeatableError: its optimiser is none that can be taken apart.
    """
    from torch._inductor.decomposition import select_decomp_table
    from torch.fx.experimental.proxy_tensor import make_fx

    _check_steps(recording)
    inputs = [mode.from_tensor(one) for one in recording.inputs]
    interpreter = _TakingApart(recording.graph)

    def run(*arguments: Tensor) -> tuple[()]:
        interpreter.run(*arguments)
        return ()

    with torch.no_grad(), mode:
        changing = torch.func.functionalize(run, remove="mutations")
        graph = make_fx(changing, decomposition_table=select_decomp_table())(*inputs)
    return graph, inputs


class _TakingApart(fx.Interpreter):
    """Carries out optimisers and slow copies as arithmetic on lists, which the compiler makes one kernel of on a GPU, and what libraries
    are slow at as arithmetic that becomes part of the loops around it."""

    def call_function(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if target is aten.detach.default:
            return args[0]
        if (apart := _APART.get(target)) is not None:
            return apart(*args, **kwargs)
        if str(target).startswith(("aten._foreach", "aten._fused")):
            raise NotRepeatableError(f"{target} is not taken apart here; use the optimisers of cudc_bench.learning.networks")
        return super().call_function(target, args, kwargs)


def _set(old: Sequence[Tensor], new: Sequence[Tensor]) -> None:
    for one, value in zip(old, new, strict=True):
        one.copy_(value)


def _lerp(targets: list[Tensor], onlines: list[Tensor], weight: Any) -> None:
    _set(targets, torch._foreach_add(targets, torch._foreach_mul(torch._foreach_sub(onlines, targets), weight)))


def _add(tensors: list[Tensor], number: Any) -> None:
    if all(one.ndim == 0 for one in tensors):
        # An optimiser's counts of steps, which are all the same (see :func:`_check_steps`).
        _set(tensors, [tensors[0] + number] * len(tensors))
    else:
        _set(tensors, torch._foreach_add(tensors, number))


def _adam(
    parameters: list[Tensor], gradients: list[Tensor], averages: list[Tensor], squares: list[Tensor],
    most: list[Tensor], steps: list[Tensor], *, lr: Any, beta1: float, beta2: float, weight_decay: float, eps: float,
    amsgrad: bool, maximize: bool, **_: Any,
) -> None:  # fmt: skip
    """Kingma and Ba's Adam as PyTorch's fused kernel computes it."""
    if weight_decay or amsgrad or maximize:
        raise NotRepeatableError("only plain Adam is taken apart")
    # All are equal. In single precision 1 - 0.999 would keep four digits.
    count = steps[0].double()
    root = (1.0 - beta2**count).sqrt()
    # Both sides of the fraction times the root: one division for each number instead of two.
    size, least = (one.to(parameters[0].dtype) for one in (lr * root / (1.0 - beta1**count), eps * root))
    times = torch._foreach_mul
    moved = torch._foreach_add(averages, times(torch._foreach_sub(gradients, averages), 1.0 - beta1))
    wider = torch._foreach_add(times(squares, beta2), times(times(gradients, gradients), 1.0 - beta2))
    divisors = torch._foreach_add(torch._foreach_sqrt(wider), [least] * len(wider))
    changed = torch._foreach_sub(parameters, torch._foreach_div(times(moved, size), divisors))
    for old, new in ((averages, moved), (squares, wider), (parameters, changed)):
        _set(old, new)


def _product(left: Tensor, right: Tensor) -> Tensor:
    """(E, B, K) times (E, K, N). A product with a vector is a sum, for which libraries take ten times as long on a CPU."""
    if right.shape[2] > 1:
        return torch.bmm(left, right)
    return (left * right.transpose(1, 2)).sum(2, keepdim=True)


def _layer(bias: Tensor, left: Tensor, right: Tensor, *, beta: float = 1.0, alpha: float = 1.0) -> Tensor:
    """A product and its bias, which is a copy before the product otherwise; as a sum it is part of what follows."""
    product = _product(left, right)
    return torch.add(bias if beta == 1.0 else bias * beta, product, alpha=alpha)


# Cephes' (Moshier), by powers of the square below where the other formula would cancel.
_TANH = (-5.70498872745e-3, 2.06390887954e-2, -5.37397155531e-2, 1.33314422036e-1, -3.33332819422e-1)
_TANH_SMALL = 0.625


def _tanh(x: Tensor) -> Tensor:
    """As exact as single precision, up to three units of the last place, in half the time that the vectorised library takes."""
    if x.dtype != torch.float32 or x.device.type != "cpu":
        return torch.tanh(x)
    square = x * x
    powers = square * _TANH[0]
    for one in _TANH[1:]:
        powers = (powers + one) * square
    return torch.where(x.abs() < _TANH_SMALL, x + x * powers, 1.0 - 2.0 / ((2.0 * x).exp() + 1.0))


_APART: dict[Any, Callable[..., Any]] = {
    aten.bmm.default: _product,
    aten.baddbmm.default: _layer,
    aten.tanh.default: _tanh,
    aten._foreach_add_.Scalar: _add,
    aten._foreach_lerp_.Scalar: _lerp,
    aten._fused_adam_.default: _adam,
    aten._fused_adam_.tensor_lr: _adam,
}


def _check_steps(recording: Recording) -> None:
    """An optimiser's parameters have one count of steps, though each has a tensor of its own for it.

    Raises:
        NotRepeatableError: they do not, or the optimiser had made no state when it was recorded.
    """
    given = dict(zip(recording.graph.graph.find_nodes(op="placeholder"), recording.inputs, strict=True))
    for node in recording.graph.graph.nodes:
        if node.target is aten._foreach_add_.Scalar:
            counts = [given[one] for one in node.args[0] if one in given and given[one].ndim == 0]
        elif node.target in (aten._fused_adam_.default, aten._fused_adam_.tensor_lr):
            if any(step not in given for step in node.args[5]):
                raise NotRepeatableError("its optimiser makes its state only now")
            counts = [given[step] for step in node.args[5]]
        else:
            continue
        if len({float(count) for count in counts}) > 1:
            raise NotRepeatableError("its optimiser has counted different steps for its parameters")
