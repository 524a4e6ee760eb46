from __future__ import annotations

import subprocess
import sys

import pytest
import typer
from typer.testing import CliRunner

from cudc_bench.errors import RunError, UsageError
from cudc_bench.leaderboard.api import make_leaderboard
from cudc_bench.leaderboard.command import leaderboard as command
from cudc_bench.leaderboard.output.incremental import LEDGER
from cudc_bench.leaderboard.show.documents import LeaderboardDocument

from ..waiting import PATIENCE

FILES = {"table.md", "table.tex", "table.csv"}
OVERALL = {"overall.md", "overall.tex", "overall.csv", "scores.csv"}
FIGURES = {f"{name}.{kind}" for name in ("curves", "bars", "intervals", "profiles", "ranks") for kind in ("svg", "pdf")} | {"task-walk.svg"}


def of_site(file):
    """Whether ``test_site.py`` looks at it."""
    return file.suffix in {".html", ".css", ".js", ".webp"}


def test_writes_files_for_each_table_and_each_group(make_record, save, tmp_path):
    results = save(make_record(), make_record(profile="paper"))
    report = make_leaderboard(results, tmp_path / "out")
    assert [table.slug for table in report.tables] == ["cpu.td3.walker", "paper.td3.walker"]
    assert [overall.slug for overall in report.overall] == ["cpu.td3", "paper.td3"]
    expected = {(table.slug, name) for table in report.tables for name in FILES}
    expected |= {(overall.slug, name) for overall in report.overall for name in OVERALL}
    assert {(file.parent.name, file.name) for file in report.files if not of_site(file)} == expected
    assert tmp_path / "out" / "index.html" in report.files
    assert sorted(p for p in (tmp_path / "out").rglob("*") if p.is_file() and p.name != LEDGER) == sorted(report.files)
    assert report.problems == []


def test_two_builds_give_identical_bytes(make_record, save, tmp_path):
    results = save(*(make_record(method=m, seed=s) for m in ("cudc", "icm") for s in (1, 2)))
    built = [make_leaderboard(results, tmp_path / name, figures=True).files for name in ("a", "b")]
    assert {file.name for file in built[0] if not of_site(file)} == FILES | OVERALL | FIGURES
    for first, second in zip(*built, strict=True):
        assert first.read_bytes() == second.read_bytes()


def test_without_output_nothing_is_written(make_record, save, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(make_record())
    before = sorted(tmp_path.rglob("*"))
    report = make_leaderboard(output=None)
    assert (len(report.tables), report.files) == (1, [])
    assert sorted(tmp_path.rglob("*")) == before


def test_filters(make_record, save):
    results = save(
        make_record(),
        make_record(profile="paper", overrides={"gamma": 0.5}),
        make_record(algorithm="cql"),
        make_record(dataset_domain="cheetah"),
    )

    def slugs(**wanted):
        return [table.slug.split(".") for table in make_leaderboard(results, None, **wanted).tables]

    assert len(slugs()) == 4
    assert [slug[0][:12] for slug in slugs(profile="paper")] == ["paper-evalua"]
    assert slugs(algo="cql") == [["cpu", "cql", "walker"]]
    assert slugs(domain="cheetah") == [["cpu", "td3", "cheetah"]]


@pytest.mark.parametrize(
    ("wanted", "named"),
    [
        ({"profile": "papr"}, ["'papr'", "cpu, paper", "mean 'paper'"]),
        ({"domain": "jaco"}, ["'jaco'", "walker"]),
        ({"algo": "td4"}, ["'td4'", "mean 'td3'"]),
    ],
)
def test_unknown_filters_are_refused_with_what_there_is(wanted, named, make_record, save):
    results = save(make_record(), make_record(profile="paper"))
    with pytest.raises(UsageError) as caught:
        make_leaderboard(results, None, **wanted)
    assert all(part in str(caught.value) for part in named)
    assert "\n" not in str(caught.value)


def test_missing_or_empty_results_say_what_to_run(tmp_path):
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "none", tmp_path / "empty"):
        with pytest.raises(UsageError, match=r"cudc-bench evaluate --algo td3") as caught:
            make_leaderboard(path, None)
        assert str(path) in str(caught.value)


def test_only_broken_records_says_why(tmp_path):
    (tmp_path / "x.json").write_text("{}")
    with pytest.raises(UsageError, match=r"x\.json is not a run record"):
        make_leaderboard(tmp_path, None)


def test_an_output_that_cannot_be_a_folder_is_refused(make_record, save, tmp_path):
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(UsageError, match="out"):
        make_leaderboard(save(make_record()), tmp_path / "out")


def test_a_failed_write_is_one_line_and_leaves_no_part(make_record, save, tmp_path):
    blocked = tmp_path / "out" / "cpu.td3.walker" / "table.tex"
    blocked.mkdir(parents=True)
    with pytest.raises(RunError) as caught:
        make_leaderboard(save(make_record()), tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "out").rglob("*.tmp"))


def run(*arguments):
    app = typer.Typer()
    app.command("leaderboard")(command)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_command_prints_tables_problems_and_files(make_record, save, tmp_path):
    results = save(make_record(), make_record(method="icm", overrides={"note": "[red]"}))
    (results / "broken.json").write_text("{}")
    done = run(results, "--output", tmp_path / "out", "--profile", "cpu")
    assert done.exit_code == 0
    assert "cudc" in done.stdout
    assert "[red]" in done.stdout
    assert "broken.json" not in done.stdout
    assert "broken.json is not a run record" in done.stderr.replace("\n", "")
    printed = [line for line in done.stdout.splitlines() if line.startswith(str(tmp_path))]
    # Of the pages of the site the first is enough.
    expected = {str(p) for p in (tmp_path / "out").rglob("*") if p.is_file() and p.suffix != ".html" and p.name != LEDGER} | {
        str(tmp_path / "out" / "index.html")
    }
    assert (len(printed), set(printed)) == (len(expected), expected)
    assert len(expected) == 2 * len(FILES | OVERALL) + len({"index.html", "site.css", "site.js", "walker.webp", "walker-moving.webp"})

    told = run(results, "--output", tmp_path / "out", "--profile", "cpu", "--json")
    found = LeaderboardDocument.model_validate_json(told.stdout)
    assert (told.exit_code, sorted(found.files)) == (0, sorted(expected))
    assert [(one.group, one.methods) for one in found.tables] == [("cpu", ["cudc"]), ('cpu (evaluate: note="[red]")', ["icm"])]
    assert len(found.problems) == 1
    assert "broken.json is not a run record" in told.stderr.replace("\n", "")


def test_command_reads_results_by_default(make_record, save, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(make_record())
    assert run().exit_code == 0
    assert (tmp_path / "report" / "cpu.td3.walker" / "table.md").exists()


def test_command_passes_errors_on(tmp_path):
    assert isinstance(run(tmp_path / "none").exception, UsageError)


def modules_after(code):
    listing = f"{code}\nimport sys; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    return set(
        subprocess.run(
            [sys.executable, "-c", listing], check=True, capture_output=True, text=True, timeout=PATIENCE
        ).stdout.split("\n")[-2].split()
    )  # fmt: skip


def test_needs_neither_torch_nor_a_simulator(make_record, save, tmp_path):
    paths = (str(save(make_record())), str(tmp_path / "out"))
    loaded = modules_after(
        "from cudc_bench.leaderboard.api import make_leaderboard\n"
        "from cudc_bench.leaderboard.intake.load import load_records, to_frame\n"
        "from cudc_bench.leaderboard.show import terminal\n"
        f"report = make_leaderboard(*{paths!r}); terminal.of_table(report.tables[0]); to_frame(report.tables[0].records)\n"
        "terminal.of_overall(report.overall[0])"
    )
    assert {"jinja2", "pandas"} <= loaded
    # Pages draw their figures themselves; files of figures are only made where somebody asks for them.
    assert not loaded & {"torch", "dm_control", "mujoco", "minari", "matplotlib"}


def test_the_command_is_light_to_import():
    loaded = modules_after("import cudc_bench.leaderboard.command")
    assert "typer" in loaded
    assert not loaded & {"torch", "mujoco", "pandas", "matplotlib", "jinja2", "numpy", "pydantic"}
