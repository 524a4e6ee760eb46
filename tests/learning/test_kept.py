"""Compiled functions on the disk: only what is whole, and of the same update on the same machine, is ever loaded."""

from __future__ import annotations

import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cudc_bench.learning import compiled, kept
from cudc_bench.learning.recording import Recording

LIBRARY = b"\x7fELF" + bytes(range(256)) * 3


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    (folder / "library.so").write_bytes(LIBRARY)
    kept.keep(folder / "known" / "key", folder / "library.so")
    return folder / "known" / "key"


@given(st.data())
def test_whatever_happens_to_a_file_it_is_not_loaded(file: Path, data: st.DataObject) -> None:
    content = file.read_bytes()
    assert kept.whole(file)
    assert content.startswith(LIBRARY)
    place = data.draw(st.integers(0, len(content) - 1))
    damaged = data.draw(
        st.sampled_from(
            [
                content[:place],
                content[place + 1 :],
                content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :],
                content + content[place:],
            ]
        )
    )
    try:
        file.write_bytes(damaged)
        assert not kept.whole(file)
        assert kept.kept(file) is None
    finally:
        file.write_bytes(content)


def test_what_is_no_library_of_this_key_is_not_loaded(file: Path, tmp_path: Path) -> None:
    assert kept.kept(tmp_path / "nothing") is None
    assert kept.kept(tmp_path) is None
    (tmp_path / "other").write_bytes(file.read_bytes())
    assert not kept.whole(tmp_path / "other")
    # Whole, but the system refuses it.
    assert kept.whole(file)
    assert kept.kept(file) is None


def _recording(number: float = 1.0, size: int = 3) -> Recording:
    return Recording.of(lambda: torch.ones(size).add_(number), [])[0]


def _processor(monkeypatch: pytest.MonkeyPatch) -> None:
    read = Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda self, *_: "flags : sse" if self == Path("/proc/cpuinfo") else read(self))


def _own_text(monkeypatch: pytest.MonkeyPatch) -> None:
    read = Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda self, *_: read(self) + ("#" if self == Path(compiled.__file__) else ""))


CHANGES: dict[str, Callable[[pytest.MonkeyPatch], Any]] = {
    "processor": _processor,
    "how updates are taken apart": _own_text,
    "compiler": lambda patch: patch.setenv("CXX", "false"),
    "C library": lambda patch: patch.setattr(platform, "libc_ver", lambda: ("glibc", "1.0")),
    "PyTorch": lambda patch: patch.setattr(torch, "__version__", "2.99"),
    "instructions that PyTorch uses": lambda patch: patch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "DEFAULT"),
    "a setting of the compiler": lambda patch: patch.setenv("TORCHINDUCTOR_CPP_MAX_HORIZONTAL_FUSION_SIZE", "1"),
    "threads": lambda patch: patch.setattr(torch, "get_num_threads", lambda: 99),
    "precision of products": lambda patch: patch.setattr(torch, "get_float32_matmul_precision", lambda: "medium"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_what_compiled_code_depends_on_is_in_its_key(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def key() -> str:
        kept.machine.cache_clear()
        kept.compiler.cache_clear()
        return compiled._key(_recording())

    before = key()
    assert key() == before
    try:
        with monkeypatch.context() as patch:
            CHANGES[what](patch)
            assert key() != before
    finally:
        assert key() == before


def test_an_update_and_its_shapes_are_in_its_key() -> None:
    keys = {compiled._key(_recording(number, size)) for number in (1.0, 1.0 + 2**-50) for size in (3, 4)}
    assert len(keys) == 4


def test_where_it_is_kept_is_not_in_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    before = compiled._key(_recording())
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "/elsewhere")
    assert compiled._key(_recording()) == before
