"""The site in a browser, without a network: what readers do with it, on a phone, in the dark, on paper, and with the keyboard alone."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ...waiting import PATIENCE

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install 'cudc-bench[dev]'")
CHROMIUM = shutil.which("chromium")
if CHROMIUM is None:
    pytest.skip("chromium is not here: apt-get install chromium", allow_module_level=True)

MATRIX = 'table:has(caption:has-text("profile paper, {}"))'
PAGES = ("index.html", "paper.td3.walker/index.html", "paper.td3.walker/task-walk.html", "paper.td3.walker/runs-walk.cudc.html",
         "methods/index.html", "methods/method-cudc.html", "datasets/index.html", "cpu.td3.walker/k-bound.html")  # fmt: skip


class Reader:
    """A page of the site in a context of its own; whatever goes wrong in it is kept."""

    def __init__(self, browser: Any, report: Path, **options: Any) -> None:
        self.report = report
        self.context = browser.new_context(offline=True, **{"viewport": {"width": 1280, "height": 900}, **options})
        self.context.set_default_timeout(1000 * PATIENCE)
        self.wrong: list[str] = []
        self.page = self.context.new_page()
        self.page.on("console", lambda message: self.wrong.append(message.text) if message.type in {"error", "warning"} else None)
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("requestfailed", lambda request: self.wrong.append(f"{request.url}: {request.failure}"))
        self.page.on("request", lambda request: None if request.url.startswith("file://") else self.wrong.append(request.url))

    def open(self, path: str) -> Any:
        name, mark, query = path.partition("?")
        self.page.goto(f"{(self.report / name).as_uri()}{mark}{query}")
        return self.page

    def run(self, script: str, *arguments: Any) -> Any:
        return self.page.evaluate(script, *arguments)

    def names(self, table: str) -> list[str]:
        """Heads of the rows that are seen, in order."""
        rows = self.page.locator(f"{table} tbody tr:visible th")
        return [text.strip() for text in rows.all_inner_texts()]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []  # Chromium refuses root its sandbox.
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield browser
        browser.close()


@pytest.fixture
def reader(browser: Any, example_report: Path, request: pytest.FixtureRequest) -> Iterator[Reader]:
    """Its parameter is given to the context."""
    one = Reader(browser, example_report, **getattr(request, "param", {}))
    yield one
    one.context.close()
    assert one.wrong == []


def test_the_checks_see_what_goes_wrong(browser, example_report, tmp_path):
    folder = tmp_path / "report"
    shutil.copytree(example_report, folder)
    page = (folder / "index.html").read_text()
    bad = '<img src="https://example.org/x.png" alt=""><script>alert(1)</script><img src="nothing.png" alt="">'
    (folder / "index.html").write_text(page.replace("</main>", f"{bad}</main>"))
    one = Reader(browser, folder)
    one.open("index.html")
    said = "\n".join(one.wrong)
    one.context.close()
    assert "example.org" in said
    assert "nothing.png" in said
    assert re.search("inline script", said)


def test_columns_sort_as_numbers_with_missing_cells_last(reader):
    reader.open("index.html")
    table = MATRIX.format("500K")
    assert reader.names(table) == ["cudc", "icm", "random", "mine"]
    head = reader.page.locator(f"{table} thead tr:last-child th").nth(2)
    button = reader.page.locator(f"{table} thead tr:last-child th button").nth(2)
    assert head.get_attribute("aria-sort") == "none"
    button.click()
    # As texts 1000 would stand between 120 and 480.
    assert (reader.names(table), head.get_attribute("aria-sort")) == (["mine", "cudc", "icm", "random"], "descending")
    button.click()
    assert (reader.names(table), head.get_attribute("aria-sort")) == (["random", "icm", "cudc", "mine"], "ascending")
    run = reader.page.locator(f"{table} thead tr:last-child th").nth(3)
    for order in (["cudc", "icm", "random", "mine"], ["random", "icm", "cudc", "mine"]):
        run.locator("button").click()
        assert reader.names(table) == order
    assert head.get_attribute("aria-sort") == "none"
    reader.page.locator(f"{table} thead tr:last-child th button").first.click()
    assert reader.names(table) == ["cudc", "icm", "mine", "random"]


def test_the_filter_counts_what_it_shows_and_says_so(reader):
    page = reader.open("index.html")
    page.get_by_label("Filter methods").fill("C")
    assert reader.names(MATRIX.format("500K")) == ["cudc", "icm"]
    assert page.locator("#found").inner_text() == "2 of 4 shown"
    assert page.locator("#found").get_attribute("aria-live") == "polite"
    page.get_by_label("Filter methods").fill("nothing like it")
    assert reader.names(MATRIX.format("500K")) == []
    page.get_by_label("Filter methods").fill("")
    assert len(reader.names(MATRIX.format("500K"))) == 4


def test_datasets_are_found_by_their_method(reader):
    page = reader.open("datasets/index.html")
    page.get_by_label("Filter datasets").fill("icm")
    # Three on each of two domains, and two of profile cpu.
    assert page.locator("#found").inner_text().endswith(" shown")
    assert len(reader.names("table")) == 3 + 3 + 2
    page.get_by_label("Filter datasets").fill("jaco/")
    assert len(reader.names("table")) == 9


def test_milestones_returns_and_the_paper_switch(reader):
    page = reader.open("index.html")
    last, before = (page.locator(MATRIX.format(one)) for one in ("500K", "100K"))
    cell = last.locator("tbody tr:nth-child(1) td").nth(1)
    assert (last.is_visible(), before.is_visible()) == (True, False)
    assert " ".join(cell.inner_text().split()) == "900 ± 10 (3)"
    page.get_by_label("normalised").check()
    assert " ".join(cell.inner_text().split()) == "0.900 ± 0.010 (3)"
    page.get_by_label("The paper’s numbers beside ours").check()
    assert re.search(r"\(3\) paper 0\.\d{3} ± 0\.\d{3}, [+-]\d+\.\d σ$", " ".join(cell.inner_text().split()))
    page.get_by_label("raw").check()
    assert re.search(r"^900 ± 10 \(3\) paper \d+ ± \d+, ", " ".join(cell.inner_text().split()))
    page.get_by_role("radio", name="100K").check()
    assert (last.is_visible(), before.is_visible()) == (False, True)
    page.get_by_role("radio", name="all").check()
    assert (last.is_visible(), before.is_visible()) == (True, True)


def test_figures_follow_the_switch_between_milestones(reader):
    page = reader.open("paper.td3.walker/index.html")
    drawn = {one: page.locator(f'figure[data-milestone="{one}"]').first for one in ("500000", "100000")}
    chosen = {one: page.locator(f'.plot g[data-milestone="{one}"]').first for one in drawn}
    for milestone, other in (("500000", "100000"), ("100000", "500000")):
        page.get_by_role("radio", name=f"{milestone[0]}00K").check()
        for found in (drawn, chosen):
            assert reader.run("(one) => getComputedStyle(one).display", found[milestone].element_handle()) != "none"
            assert reader.run("(one) => getComputedStyle(one).display", found[other].element_handle()) == "none"


def test_what_is_chosen_stands_in_the_address_and_comes_back_from_it(reader):
    page = reader.open("index.html")
    assert "?" not in page.url
    table = MATRIX.format("100K")
    page.get_by_role("radio", name="100K").check()
    page.get_by_label("normalised").check()
    page.get_by_label("Filter methods").fill("c")
    page.get_by_role("button", name="Dark mode").click()
    page.locator(f"{table} thead tr:last-child th button").nth(0).click()
    page.locator(f"{table} thead tr:last-child th button").nth(0).click()
    address, shown = page.url, reader.names(table)
    assert shown == ["icm", "cudc"]
    for part in ("milestone=100000", "scale=scaled", "filter=c", "theme=dark", "sort="):
        assert part in address, part
    # Somebody else opens it.
    page.context.clear_cookies()
    reader.run("localStorage.clear()")
    page.goto("about:blank")
    page.goto(address)
    assert (page.url, reader.names(table)) == (address, shown)
    assert page.get_by_label("Filter methods").input_value() == "c"
    assert page.get_by_role("button", name="Light mode").is_visible()
    # What another page has, too, goes along; what is this page's own does not.
    page.locator(f"{table} tbody tr:visible").nth(1).locator("td").nth(1).locator("a").click()
    page.wait_for_url("**/runs-walk.cudc.html?*")
    assert "milestone=100000" in page.url
    assert "filter" not in page.url
    assert page.url.endswith("#at-100000")
    reader.open("index.html?milestone=7&scale=x&sort=nothing~1~up&sort=filter~0~up&sort=x&theme=<b>&filter=")
    assert page.locator(MATRIX.format("500K")).is_visible()


@pytest.mark.parametrize("reader", [{"permissions": ["clipboard-read", "clipboard-write"]}, {}], indirect=True, ids=["allowed", "refused"])
def test_a_cell_opens_its_runs_and_a_command_can_be_copied(reader):
    page = reader.open("index.html")
    page.locator(MATRIX.format("500K")).locator("tbody tr:nth-child(1) td").nth(1).locator("a").click()
    assert page.url.endswith("runs-walk.cudc.html#at-500000")
    assert page.locator("h1").inner_text() == "cudc on walker walk"
    run = page.locator("#run-2")
    command = "cudc-bench evaluate --method cudc --seed 2"
    assert run.locator("pre").inner_text() == command
    assert "899.5, 900.5" in run.inner_text()
    run.get_by_role("button", name="Copy").click()
    page.wait_for_function("document.getElementById('said').textContent !== ''")
    if page.locator("#said").inner_text() == "Copied.":
        assert reader.run("navigator.clipboard.readText().catch(() => null)") in {command, None}
    else:
        assert reader.run("getSelection().toString()") == command


@pytest.mark.parametrize("reader", [{"color_scheme": "light"}, {"color_scheme": "dark"}], indirect=True, ids=["light", "dark"])
def test_the_theme_follows_the_system_until_somebody_chooses_and_is_remembered(reader, request):
    page = reader.open("index.html")

    def is_dark() -> bool:
        red, green, blue = map(int, re.findall(r"\d+", reader.run("getComputedStyle(document.body).backgroundColor"))[:3])
        return red + green + blue < 200

    began = "dark" in request.node.name
    assert is_dark() is began
    for turn in (1, 2, 3):
        page.get_by_role("button", name="Light mode" if is_dark() else "Dark mode").click()
        assert is_dark() is (began ^ bool(turn % 2))
    reader.open("paper.td3.walker/task-walk.html")
    assert is_dark() is not began
    # Figures follow.
    ink = reader.run("getComputedStyle(document.querySelector('.plot .title, .plot .tick')).fill")
    assert ink == reader.run("getComputedStyle(document.querySelector('figcaption')).color")


@pytest.mark.parametrize("reader", [{"viewport": {"width": 360, "height": 740}}], indirect=True)
def test_on_a_phone_only_tables_scroll_sideways_under_their_first_column(reader):
    for path in PAGES:
        reader.open(path)
        assert reader.run("document.documentElement.scrollWidth") <= 360, path
        reader.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        assert reader.run("document.documentElement.scrollWidth") <= 360, path
    reader.open("index.html")
    shift = """(table) => {
        const box = table.parentElement, head = table.tBodies[0].rows[0].cells[0], left = head.getBoundingClientRect().left;
        box.scrollLeft = 200;
        return [box.scrollLeft, head.getBoundingClientRect().left - left];
    }"""
    assert reader.page.locator(MATRIX.format("500K")).evaluate(shift) == [200, 0]


def test_with_the_keyboard_alone_one_gets_to_a_run_and_its_command(reader):
    page = reader.open("index.html")
    page.keyboard.press("Tab")
    assert reader.run("document.activeElement.textContent") == "Skip to the content"
    page.keyboard.press("Enter")
    assert reader.run("document.activeElement.id") == "main"
    seen = []
    for _ in range(200):
        page.keyboard.press("Tab")
        where = reader.run("""() => {
            const one = document.activeElement, style = getComputedStyle(one);
            return [one.tagName, one.getAttribute("href") || "", style.outlineStyle, parseFloat(style.outlineWidth)];
        }""")
        seen.append(where)
        assert where[0] != "BODY", "the focus was lost"
        assert where[2] != "none", where
        assert where[3] >= 2, where
        if "runs-walk.cudc.html#at-500000" in where[1]:
            break
    else:
        raise AssertionError(seen)
    page.keyboard.press("Enter")
    page.wait_for_url("**/runs-walk.cudc.html*")
    for _ in range(60):
        page.keyboard.press("Tab")
        if reader.run("document.activeElement.className") == "copy":
            break
    page.keyboard.press("Enter")
    page.wait_for_function("document.getElementById('said').textContent !== ''")


def test_on_paper_there_are_tables_and_no_switches(reader, browser):
    page = reader.open("index.html")
    page.get_by_role("button", name="Dark mode").click()
    page.emulate_media(media="print")
    assert reader.run("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert reader.run("getComputedStyle(document.body).color") == "rgb(0, 0, 0)"
    for gone in ("#switches", "#theme", ".skip"):
        assert not page.locator(gone).is_visible()
    assert page.locator(MATRIX.format("500K")).is_visible()
    assert reader.run("getComputedStyle(document.querySelector('.scroll')).overflowX") == "visible"
    assert page.pdf().startswith(b"%PDF")


@pytest.mark.parametrize("reader", [{"java_script_enabled": False}], indirect=True)
def test_without_javascript_everything_is_there(reader):
    page = reader.open("index.html")
    for milestone in ("500K", "100K"):
        assert page.locator(MATRIX.format(milestone)).is_visible()
    cell = " ".join(page.locator(MATRIX.format("500K")).locator("tbody tr:nth-child(1) td").nth(1).inner_text().split())
    assert cell.startswith("900 ± 10 0.900 ± 0.010")
    assert "paper" in cell
    assert not page.locator("button").first.is_visible()
    page.locator(MATRIX.format("500K")).locator("tbody tr:nth-child(1) td").nth(1).locator("a").click()
    assert page.locator("#run-1 pre").is_visible()


# Relative luminance and contrast as WCAG 2.1 defines them.
CONTRASTS = """() => {
    const parts = (colour) => (colour.match(/[\\d.]+/g) || []).map(Number);
    const linear = (x) => (x /= 255) <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
    const luminance = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
    const ground = (one) => {
        for (; one; one = one.parentElement) {
            const found = parts(getComputedStyle(one).backgroundColor);
            if (found.length < 4 || found[3] > 0) return found;
        }
        return [255, 255, 255];
    };
    const found = {};
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
        const one = walker.currentNode.parentElement;
        if (!walker.currentNode.textContent.trim() || !one.checkVisibility()) continue;
        const colour = getComputedStyle(one).color, [a, b] = [luminance(parts(colour)), luminance(ground(one))];
        const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
        found[`${colour} on ${ground(one)}`] = contrast;
    }
    return found;
}"""


@pytest.mark.parametrize("reader", [{"color_scheme": "light"}, {"color_scheme": "dark"}], indirect=True, ids=["light", "dark"])
def test_text_can_be_read_and_everything_has_a_name(reader):
    for path in PAGES:
        page = reader.open(path)
        contrasts = reader.run(CONTRASTS)
        assert len(contrasts) > 3
        assert {colours: ratio for colours, ratio in contrasts.items() if ratio < 4.5} == {}, path
        for field in page.locator("input").all():
            assert field.evaluate("(one) => one.labels.length") == 1
        for kind in ("button", "a"):
            names = page.locator(f"{kind}:visible").evaluate_all(
                "(all) => all.map((one) => one.textContent.trim() || one.querySelector('img')?.alt)"
            )
            assert all(names), path
        assert [page.locator(one).count() for one in ("body > header", "main", "body > footer")] == [1, 1, 1]
