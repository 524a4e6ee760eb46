"""The bundle for machines with a GPU: what goes into it, how wheels are trimmed and unpacked, its limit; and how parts of its check end."""

from __future__ import annotations

import lzma
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from benchmarks.gpu import bundle, install
from benchmarks.gpu.bundle import BundleError
from benchmarks.gpu.check import ENGINES, Part, carry_out, gpu_tests, judge, parts
from cudc_bench import plugins


def wheel_at(folder: Path, name: str, files: dict[str, str]) -> Path:
    path = folder / f"{name}-1.0-py3-none-any.whl"
    info = f"{name}-1.0.dist-info"
    listed = "".join(f"{one},sha256=abc,{len(text)}\n" for one, text in files.items()) + f"{info}/RECORD,,\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as wheel:
        for one, text in {**files, f"{info}/METADATA": f"Name: {name}\n", f"{info}/RECORD": listed}.items():
            wheel.writestr(one, text)
    return path


def test_what_is_needed_follows_from_metadata_for_the_other_python() -> None:
    asks = {
        "a": ["b[fast]>=1", "torch>=2", 'old; python_version < "3.12"', 'windows; sys_platform == "win32"'],
        "b": ['quick; extra == "fast"', 'slow; extra == "slow"', "c"],
        "c": ["a", "b[slow]"],
        "torch": ["cuda"],
        "slow": None,
        "quick": [],
        "old": [],
    }
    requires = lambda name: asks[name]  # noqa: E731
    assert bundle.needed([Requirement("A")], ["torch"], "3.12", requires) == ["a", "b", "c", "quick", "slow"]
    assert bundle.needed([Requirement("a")], ["torch", "c"], "3.11", requires) == ["a", "b", "old", "quick"]

    def missing(name: str) -> list[str]:
        raise PackageNotFoundError(name)

    with pytest.raises(BundleError, match="a is needed there and not installed here; run make setup first"):
        bundle.needed([Requirement("a")], [], "3.12", missing)


def test_versions_are_those_of_the_constraints_and_what_has_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "c.txt").write_text("# tested\nDm_Control==1.0\nnumpy==2.4  # why\n\n")
    constraints = bundle.read_constraints(tmp_path / "c.txt")
    assert bundle.pinned(["dm-control", "numpy"], constraints) == ["Dm_Control==1.0", "numpy==2.4"]
    with pytest.raises(BundleError, match=r"no version of scipy, torch; add one"):
        bundle.pinned(["numpy", "scipy", "torch"], constraints)


def test_the_projects_own_bundle_has_all_but_what_is_left_out() -> None:
    project = {
        "dependencies": ["dm-control>=1", "torch", "pandas"],
        "optional-dependencies": {"dev": ["pytest>=8", "ruff", "hypothesis"]},
    }
    assert [one.name for one in bundle.asked_for(project)] == ["dm-control", "torch", "pandas", "pytest", "hypothesis"]
    wanted = bundle.needed(bundle.asked_for(project), bundle.LEFT_OUT, "3.12")
    assert {"dm-control", "mujoco", "pytest", "numpy"} <= set(wanted)
    assert not {*bundle.LEFT_OUT, "ruff", "matplotlib"} & set(wanted)
    assert all("==" in one for one in bundle.pinned(wanted, bundle.read_constraints(bundle.ROOT / "constraints.txt")))


@pytest.mark.parametrize("version", ["3.10", "3.13", "3", "3.12.1", "three"])
def test_a_python_that_cannot_be_is_refused(version: str) -> None:
    bundle.check_python("3.12", ">=3.11,<3.13")
    with pytest.raises(BundleError, match=r"PYTHON_VERSION=.* cannot be; the project runs on >=3\.11,<3\.13"):
        bundle.check_python(version, ">=3.11,<3.13")


def test_wheels_lose_what_nothing_uses_and_list_what_is_left(tmp_path: Path) -> None:
    files = {
        "dm_control/suite/walker.py": "walk = 1\n",
        "dm_control/suite/tests/test_walker.py": "",
        "dm_control/suite/dog_assets/dog.stl": "x" * 1000,
        "dm_control/locomotion/maze.py": "",
        "dm_control/viewer/window.py": "",
        "dm_control-1.0.data/purelib/extra.py": "here = True\n",
        "dm_control-1.0.data/scripts/run": "",
    }
    to = tmp_path / "trimmed.whl"
    bundle.trim(wheel_at(tmp_path, "dm_control", files), to)
    with zipfile.ZipFile(to) as wheel:
        assert all(one.compress_type == zipfile.ZIP_STORED for one in wheel.infolist())
        left = wheel.namelist()
        listed = [line.split(",")[0] for line in wheel.read("dm_control-1.0.dist-info/RECORD").decode().splitlines()]
    kept = ["dm_control/suite/walker.py", "dm_control-1.0.data/purelib/extra.py", "dm_control-1.0.data/scripts/run"]
    assert left == [*kept, "dm_control-1.0.dist-info/METADATA", "dm_control-1.0.dist-info/RECORD"]
    assert listed == [*kept, "dm_control-1.0.dist-info/RECORD"]

    install.unpack(to, tmp_path / "site")
    assert (tmp_path / "site/dm_control/suite/walker.py").read_text() == "walk = 1\n"
    assert (tmp_path / "site/extra.py").exists()
    assert not list(tmp_path.glob("site/**/run"))


def test_a_wheel_cannot_write_beside_its_folder(tmp_path: Path) -> None:
    install.unpack(wheel_at(tmp_path, "evil", {"../outside.py": "", "evil.py": ""}), tmp_path / "site")
    assert not (tmp_path / "outside.py").exists()
    assert (tmp_path / "site/evil.py").exists()


def test_an_archive_of_several_blocks_is_read_by_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "_BLOCK", 5_000)
    folder = tmp_path / bundle.NAME
    folder.mkdir()
    (folder / "text").write_text("".join(map(str, range(5_000))))
    size = bundle.compress(folder, tmp_path / "b.tar.xz")
    assert size == (tmp_path / "b.tar.xz").stat().st_size
    assert lzma.decompress((tmp_path / "b.tar.xz").read_bytes())
    with tarfile.open(tmp_path / "b.tar.xz") as tar:
        (member,) = [one for one in tar if one.isfile()]
        assert (member.name, member.uid, member.uname) == (f"{bundle.NAME}/text", 0, "")
        file = tar.extractfile(member)
        assert file is not None
        assert file.read() == (folder / "text").read_bytes()


def test_too_much_is_refused_with_the_largest_files(tmp_path: Path) -> None:
    (tmp_path / "wheels").mkdir()
    wheel_at(tmp_path / "wheels", "big", {"big/data.bin": "x" * 2**20, "big/small.py": ""})
    (tmp_path / "notes").write_text("y" * 2**19)
    bundle.check_size(100, tmp_path, 100)
    with pytest.raises(BundleError, match=r"2\.0 MiB are more than 1; .* big-1\.0-py3-none-any\.whl:big/data\.bin 1\.0, notes 0\.5,"):
        bundle.check_size(2**21, tmp_path, 2**20)


def test_the_installer_refuses_another_python_and_one_without_pytorch(monkeypatch: pytest.MonkeyPatch) -> None:
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert install.unfit(here) is None
    assert f"make gpu-bundle PYTHON_VERSION={here}" in str(install.unfit("3.9"))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "has no PyTorch" in str(install.unfit(here))


def test_every_method_is_tried_with_every_engine(tmp_path: Path) -> None:
    together, alone = parts("cuda", tmp_path)
    tried = [part.command for part in together if "learners" in part.command]
    for engine in ENGINES["cuda"]:
        named = {word for command in tried if command[command.index("--engine") + 1] == engine for word in command}
        for kind in plugins.KINDS:
            if kind in ("collectors", "evaluators"):
                wanted = {"cudc", "td3"} & set(plugins.names(kind)) if engine == "compiled" else set(plugins.names(kind))
                assert wanted <= named, (engine, kind)
    names = [part.name for part in [*together, *alone]]
    assert len(set(names)) == len(names)
    assert {"tests", "doctor", "repeat", "resume", "paper", "speed"} <= set(names)
    assert "tests/learning/test_graphs.py" in gpu_tests()


@pytest.mark.parametrize(
    ("code", "text", "state", "said"),
    [
        (0, "a\nall done\n\n", "ok", "all done"),
        (1, "", "failed", "exit code 1"),
        (2, "it broke", "failed", "it broke"),
        (77, "no CUDA", "skipped", "no CUDA"),
        (0, "45 skipped in 2.00s", "skipped", "45 skipped in 2.00s"),
        (0, "3 passed, 1 skipped in 2.00s", "ok", "3 passed, 1 skipped in 2.00s"),
        (None, "half", "failed", "not done in 7 s; so far: half"),
    ],
)
def test_how_a_part_ended(code: int | None, text: str, state: str, said: str) -> None:
    result = judge("x", code, 7.0, text)
    assert (result.state, result.said) == (state, said)


WAITING = """
try:
    print("begun", flush=True)
    time.sleep(60)
finally:
    print("so many rows")
"""


def test_parts_that_fail_or_take_too_long_do_not_end_the_others(tmp_path: Path) -> None:
    some = [
        Part("slow", ("-c", f"import signal, time; signal.signal(signal.SIGINT, signal.default_int_handler){WAITING}"), 1.0),
        Part("broken", ("-c", "raise SystemExit('no')"), 20),
        Part("fine, 1 of 1", ("-c", "import os; print(os.environ['MINARI_DATASETS_PATH'])"), 20),
    ]
    results = carry_out(some, [Part("last", ("-c", "print('done')"), 20)], tmp_path, 60)
    assert [(one.name, one.state) for one in results] == [("slow", "failed"), ("broken", "failed"), ("fine, 1 of 1", "ok"), ("last", "ok")]
    assert "so many rows" in (tmp_path / "slow.log").read_text()
    assert results[2].said.endswith("fine-1-of-1/datasets")
    assert (tmp_path / "broken.log").read_text() == "no\n"
    late = carry_out(some[2:], [], tmp_path, 0)
    assert (late[0].state, late[0].said) == ("failed", "there was no time left")


def test_the_check_is_one_script(tmp_path: Path) -> None:
    script = Path(bundle.__file__).with_name("gpu-check.sh")
    assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
