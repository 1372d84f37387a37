"""The report in a real browser: Debian's Chromium without a window."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from campaigning import campaign_settings, run_campaign
from conftest import require, some
from foreign_nets import corridor_of
from handmade import write_run

from merge_sumo.campaigns.run import Run, failures, spread_failures
from merge_sumo.reports import report, report_model
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.studies.counterfactuals import AVOIDANCE, Avoidance
from merge_sumo.studies.explanation import EXPLANATIONS, Axis, Explanation, in_words
from merge_sumo.system.records import to_plain
from merge_sumo.verdict import diagnosis

LONG = partial(pytest.param, marks=pytest.mark.long)
EVIL = "<script>alert(1)</script><img src=x onerror=alert(2)>"


@pytest.fixture(scope="module")
def browser():
    program = shutil.which("chromium") or shutil.which("google-chrome")
    require(program is not None, "chromium is not on the PATH")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # No sandbox: CI runs as root, and the page is our own.
        opened = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Run:
    run = write_run(tmp_path_factory.mktemp("browser") / "run", error=None)
    report.write_report(run)
    return run


INSIDE = """() => {
    const all = byId("road").getBoundingClientRect();
    return Object.values(view.cars).map(({ group }) => {
        const car = group.getBoundingClientRect();
        return car.left >= all.left && car.right <= all.right
            && car.top >= all.top && car.bottom <= all.bottom;
    });
}"""
"""Whether each car is in the picture."""


@contextmanager
def shown(browser, file: Path, **options) -> Iterator:
    """Open a file; afterwards, fail if the page had anything to complain about."""
    complaints: list[str] = []
    context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
    page = context.new_page()
    page.set_default_timeout(60_000)
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda dialog: complaints.append(f"dialog {dialog.message}"))
    page.on(
        "request",
        lambda request: complaints.extend(
            [] if request.url.startswith(("file:", "data:")) else [request.url]
        ),
    )
    try:
        page.goto(file.as_uri())
        yield page
    finally:
        context.close()
    assert complaints == []


def chosen(page) -> int:
    """Return the index of the case that is shown."""
    return int(page.inner_text("#case-title").split()[1])


NARROW = {"viewport": {"width": 380, "height": 800}}
LOOKS = pytest.mark.parametrize(
    "options", [NARROW, LONG({"color_scheme": "dark"})], ids=["narrow", "dark"]
)


@LOOKS
def test_it_opens_without_a_complaint_and_fits_the_window(browser, made, options):
    with shown(browser, made.folder / report.REPORT, **options) as page:
        assert page.locator(".map .mark.fail").count() == len(failures(made.outcomes))
        width = page.evaluate("document.documentElement.scrollWidth")
        assert width <= page.viewport_size["width"]


def test_a_reader_goes_through_the_page_by_mouse_and_by_keys(browser, made):
    """One page: the worst case, slider, lists, map, animation, command, zoom, print."""
    worst = [o.index for o in spread_failures(made.outcomes)]
    allowed = ["clipboard-read", "clipboard-write"]
    with shown(browser, made.folder / report.REPORT, permissions=allowed) as page:
        assert chosen(page) == worst[0]
        last = len(made.trajectory(worst[0]).motion) - 1
        assert page.input_value("#time") == str(last), "a failure is shown as it ended"
        page.locator("#copy").click()
        page.locator("#copy:text('Copied')").wait_for()
        command = f"merge-sumo replay {made.folder} {worst[0]} --gui"
        assert page.evaluate("navigator.clipboard.readText()") == command
        page.locator("#time").fill("0")
        before = page.locator("#road").get_attribute("viewBox")
        page.locator("#play").click()
        for _ in range(600):
            if int(page.input_value("#time")) > 3:
                break
            page.wait_for_timeout(50)
        page.locator("#play").click()
        assert page.locator("#road").get_attribute("viewBox") != before
        third = page.locator(".map[data-level='2'] .third")
        third.locator("input[type=range]").fill("0.2")
        assert third.locator("output").inner_text() == "0.20 rad (11\u00b0)"
        far = [o for o in made.outcomes if o.case.level == 2 and abs(o.case.svo_rad - 0.2) > 0.1]
        faint = page.locator(".map[data-level='2'] .mark.faint")
        assert faint.count() == len(far)
        third.locator("input[type=checkbox]").check()
        assert faint.count() == 0
        page.locator(".list button").first.focus()
        page.keyboard.press("ArrowDown")
        assert chosen(page) == worst[1]
        page.locator(".map[data-level='0'] > svg").focus()
        page.keyboard.press("ArrowLeft")
        start = made.outcome(chosen(page)).case
        page.keyboard.press("ArrowUp")
        assert made.outcome(chosen(page)).case.v_pov0_mps > start.v_pov0_mps
        page.keyboard.press("Escape")
        page.locator("#about").click()
        assert page.locator("#chart-fmc .line").first.is_visible()
        page.emulate_media(media="print")
        assert not page.locator("#play").is_visible()
        assert page.locator(".levels").is_visible()


def in_sight(page, part: str) -> bool:
    """Return whether a part of the page is in the window and nothing lies over its middle."""
    return page.locator(part).evaluate(
        """(part) => {
            const { top, bottom, left, right } = part.getBoundingClientRect();
            const over = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
            return top >= 0 && bottom <= innerHeight && left >= 0 && right <= innerWidth
                && (part === over || part.contains(over));
        }"""
    )


def click(page, part: str) -> None:
    """Click where something is drawn, once it has come into the window."""
    found = page.locator(part)
    found.scroll_into_view_if_needed()
    box = found.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)


WIDE, PHONE = (1280, 900), (390, 800)
WINDOWS = pytest.mark.parametrize("size", [WIDE, LONG(PHONE)], ids=["wide", "phone"])
BOTH = pytest.mark.parametrize("size", [WIDE, PHONE], ids=["wide", "phone"])
"""Where the layout itself is what the test looks at."""


@BOTH
def test_a_click_on_a_mark_shows_its_case_and_the_mark_without_scrolling(browser, made, size):
    viewport = {"width": size[0], "height": size[1]}
    level = failures(made.outcomes)[0].case.level
    lowest = min(
        (o for o in made.outcomes if o.failed and o.case.level == level),
        key=lambda o: o.case.v_pov0_mps,
    )
    mark = f".map [data-case='{lowest.index}'].mark"
    with shown(browser, made.folder / report.REPORT, viewport=viewport) as page:
        click(page, mark)
        assert chosen(page) == lowest.index
        for part in ("#case-title", "#road", "#play"):
            assert in_sight(page, part), part
        box, panel = (page.locator(part).bounding_box() for part in (mark, "#case"))
        assert box["y"] >= 0.0
        assert box["y"] + box["height"] <= panel["y"]
        assert page.evaluate(INSIDE) == [True, True]
        assert page.evaluate("location.hash") == f"#case-{lowest.index}"
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        page.keyboard.press("Escape")
        assert not in_sight(page, "#case-title")


def rows(page) -> list[int]:
    """Return the cases of the table of all cases, from top to bottom."""
    return [int(text) for text in page.locator("#table td button").all_inner_texts()]


def column(page, name: str) -> list[str]:
    names = [text.strip() for text in page.locator("#table th").all_inner_texts()]
    cells = page.locator(f"#table td:nth-child({names.index(name) + 1})")
    return cells.all_inner_texts()


def bright(page) -> list[int]:
    """Return the cases that are drawn and not faint; maps with a slider show all values."""
    for check in page.locator(".map input[type=checkbox]").all():
        check.check()
    found = page.locator(".map .mark:not(.faint)").evaluate_all(
        "all => all.map((m) => m.dataset.case)"
    )
    return sorted(map(int, found))


def all_rows(page) -> list[int]:
    """Return the cases of the whole table."""
    while page.locator("#more").is_visible():
        page.locator("#more").click()
    return sorted(rows(page))


@WINDOWS
def test_a_click_on_a_region_in_words_shows_its_cases_in_maps_and_table(browser, made, size):
    viewport = {"width": size[0], "height": size[1]}
    found = failures(made.outcomes)
    near = [o for o in made.outcomes if o.is_tested and not o.failed]
    boxes = [b for n in (0, 1, 2) for b in diagnosis.failure_boxes(found + near, n)]
    with shown(browser, made.folder / report.REPORT, viewport=viewport) as page:
        sentences = page.locator(".sentences button")
        assert sentences.all_inner_texts() == [
            f"POV level {box.level}, {box.where}: {box.failures} of {box.cases} cases fail."
            for box in boxes
        ]
        for number in (0, len(boxes) - 1):
            sentences.nth(number).click()
            inside = sorted(boxes[number].indices)
            assert len(inside) == boxes[number].cases
            assert all_rows(page) == inside
            assert bright(page) == inside
            assert sentences.nth(number).get_attribute("aria-pressed") == "true"
            assert page.inner_text("#filtered-number").startswith(f"{len(inside)} of 180 cases")
        sentences.nth(len(boxes) - 1).click()
        assert len(bright(page)) == 180
        assert not page.locator("#filtered").is_visible()
        kind = page.locator("[data-filter=kind]").first
        kind.click()
        assert set(column(page, "kind")) == {kind.get_attribute("data-value")}
        page.locator("#filtered .reset").click()
        assert len(all_rows(page)) == 180
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]


def test_the_address_keeps_the_filters_through_reload_back_and_forward(browser, made):
    found = failures(made.outcomes)
    of_level = sorted(o.index for o in found if o.case.level == 1)
    with shown(browser, made.folder / report.REPORT) as page:
        filters = page.locator("#filters")
        filters.locator("[name=verdict]").select_option("failure")
        filters.locator("[name=level]").select_option("1")
        page.evaluate(f"openCase(place.get({of_level[0]}))")
        address = page.evaluate("location.hash")
        assert address == f"#case-{of_level[0]}&level=1&verdict=failure"
        assert page.get_attribute("#case-link", "href") == address
        page.reload()
        assert (all_rows(page), chosen(page)) == (of_level, of_level[0])
        page.go_back()
        page.locator("#matching:not(:text-is(''))").wait_for()
        assert all_rows(page) == sorted(o.index for o in found)
        page.go_back()
        assert len(all_rows(page)) == 180
        page.go_forward()
        page.go_forward()
        assert all_rows(page) == bright(page) == of_level
        filters.locator("[name=measure]").select_option(label="margin")
        filters.locator("[name=to]").press_sequentially("-12")
        assert "measure=margin&to=-12" in page.evaluate("location.hash")
        page.go_back()  # one step back is the whole number
        assert all_rows(page) == of_level


ADDRESSES = [
    "#verdict=nothing&level=7&kind=%3Cscript%3E&region=9:9&box=99&avoided=me&from=x&to=1e999",
    "#case-1e3&level=%E0%A4%A&__proto__=1&constructor=2&box=-1&measure=__proto__&from=",
    "#&&&===&verdict&%00&x=" + "y" * 10_000,
    "#case-0x1&verdict=failure%0A&kind=" + EVIL,
]


@pytest.mark.slow
def test_what_an_address_says_wrongly_is_left_out(browser, made):
    with shown(browser, made.folder / report.REPORT) as page:
        for address in ADDRESSES:
            page.evaluate("(address) => { location.hash = address; }", address)
            page.wait_for_timeout(100)
            assert len(all_rows(page)) == 180, address
            page.reload()
            assert len(all_rows(page)) == 180, address
            assert page.locator(".map .mark").count() == 180, address


def test_errors_and_timeouts_are_drawn_as_no_result_shown_first_and_grouped(browser, tmp_path):
    run = write_run(
        tmp_path / "run", 20, errors={4: "boom", 9: EVIL, 11: "boom"}, timeouts=(0, 3, 6)
    )
    with shown(browser, report.write_report(run)) as page:
        drawn = page.locator(".map .mark.error").evaluate_all(
            "all => all.map((m) => m.dataset.case)"
        )
        assert sorted(map(int, drawn)) == [0, 3, 4, 6, 9, 11]
        assert page.inner_text("#case-words").startswith("VUT_ERROR: boom")
        page.locator(".list [data-case='3']").click()
        words = page.inner_text("#case-words")
        assert words.startswith("Timeout: the VUT did not reach the merge point")
        verdict = page.locator("#filters [name=verdict]")
        for label, expected in (
            ("boom (2)", [4, 11]),
            (f"{EVIL[:60]} (1)", [9]),
            ("VUT_ERROR (3)", [4, 9, 11]),
            ("TIMEOUT (3)", [0, 3, 6]),
        ):
            verdict.select_option(label=label)
            assert sorted(rows(page)) == expected
        verdict.select_option(label="boom (2)")
        assert set(column(page, "verdict")) == {"VUT_ERROR: boom"}


@pytest.mark.parametrize("name", some([None, "curved"], None, "curved"))
def test_both_cars_are_in_the_picture_on_any_road(browser, tmp_path, monkeypatch, name):
    if name is not None:
        corridor = corridor_of(name, tmp_path)
        monkeypatch.setattr(report_model, "road_for", lambda _scenario: corridor)
    run = write_run(tmp_path / "run", per_level=3, error=None)
    with shown(browser, report.write_report(run)) as page:
        for step in ("0", "0.5 * moving.rows", "moving.rows - 1"):
            page.evaluate(f"at({step})")
            assert page.evaluate(INSIDE) == [True, True]


def test_failures_are_told_apart_by_who_avoids_them(browser, tmp_path):
    run = write_run(tmp_path / "run", error=None)
    found = failures(run.outcomes)
    first, others = found[0].index, [o.index for o in found[1:]]
    lines = [Avoidance(first, ("careful", "rss"), 3.0, pov_careful=True)]
    lines += [Avoidance(index, (), None, pov_careful=False) for index in others]
    AVOIDANCE.write_lines(run.folder, lines)
    with shown(browser, report.write_report(run)) as page:
        assert "In the VUT's place careful, rss would have avoided it." in page.inner_text("#case")
        page.locator(".map input[type=checkbox]").first.check()
        bright = page.locator(".map .mark.fail:not(.faint)")
        for value, wanted in (("careful", 1), ("pov", 1), ("fsm", 0), ("", len(found))):
            page.select_option("#avoided-by", value)
            assert bright.count() == wanted
        page.select_option("#avoided-by", "none")
        assert bright.count() == len(others)


def test_why_a_failure_failed_is_drawn_and_said(browser, tmp_path):
    run = write_run(tmp_path / "run", error=None)
    first, second = [o for o in failures(run.outcomes) if o.case.level == 1][:2]
    x_m, v_mps = first.case.x_pov0_m, first.case.v_pov0_mps
    below_m, above_m = round(x_m - 3.1, 1), round(x_m + 12.0, 1)
    start = (
        Axis("x_pov0_m", x_m, -340.0, -180.0, 1.0, 1, below_m, above_m),
        Axis("v_pov0_mps", v_mps, 25.0, 35.0, 0.06, 2, 25.5),
    )
    gap = Axis("gap_m", 16.2, 8.1, 32.4, 0.6, 2, below=14.1)
    known = Explanation(first.index, start, {"0": True, "2": False}, (gap,))
    line = json.dumps(to_plain(known))
    (run.folder / EXPLANATIONS.name).write_text(f"{line}\n", encoding="utf-8")
    words = list(in_words(known, first))
    moments = [
        t for t in (first.measures.last_avoidable_s, first.measures.t_end_s) if t is not None
    ]
    with shown(browser, report.write_report(run)) as page:
        page.evaluate(f"location.hash = '#case-{first.index}'")
        page.locator("#why-known").wait_for()
        assert page.locator("#why-words li").all_text_contents() == words
        texts = page.locator("#why-changes text:not(.edge)").all_text_contents()
        signed = [f"{value:.1f}".replace("-", "\u2212") for value in (x_m, below_m, above_m)]
        of_start = [f"x_POV0 {signed[0]} m", *signed[1:], f"v_POV0 {v_mps:.2f} m/s", "25.50"]
        assert texts == [*of_start, "vut: gap_m 16.20", "14.10"]
        # What fails is between the two values that pass: 15.1 m of the 36 m that are drawn.
        stuck, track = (page.locator(f"#why-changes .{name}").first for name in ("stuck", "track"))
        share = (above_m - below_m) / (2 * 1.5 * (above_m - x_m))
        assert _box(stuck)["width"] / _box(track)["width"] == pytest.approx(share, abs=0.01)
        drawn = page.locator("#why-time text.named").all_text_contents()
        assert [float(text.split()[-2]) for text in drawn] == [round(t, 1) for t in moments]
        before = _box(page.locator("#why-time .now"))["x"]
        page.evaluate("at(0)")
        assert _box(page.locator("#why-time .now"))["x"] < before - 50
        page.evaluate(f"location.hash = '#case-{second.index}'")
        page.locator("#why-ask").wait_for()
        assert not page.locator("#why-known").is_visible()
        explain = f"merge-sumo explain {run.folder} {second.index}"
        command = f"{explain} && merge-sumo report {run.folder}"
        assert page.inner_text("#why-ask code") == command
        passed = next(o.index for o in run.outcomes if not o.failed)
        page.evaluate(f"location.hash = '#case-{passed}'")
        page.wait_for_function(f"chosen === place.get({passed})")
        assert not page.locator("#why").is_visible()


LEAVES = """
class Vut:
    def act(self, seen):
        late = seen.x_vut_m > -90.0
        self.signals = {"mode <b>": "late" if late else "early", "level": 2.0 if late else -1.0}
        return 1.0
"""


def test_signals_are_drawn_beside_the_motion_and_follow_its_slider(browser, tmp_path):
    (tmp_path / "my_vut.py").write_text(LEAVES, encoding="utf-8")
    vut = f"{tmp_path / 'my_vut.py'}:Vut"
    settings = campaign_settings(vut=vut, cases=24, batch=24, sampler="uniform")
    run = run_campaign(settings, tmp_path / "run")
    with shown(browser, report.write_report(run)) as page:
        page.evaluate(f"location.hash = '#case-{ReportModel(run).shown[0].index}'")
        figures = page.locator("#signals figure")
        figures.nth(1).wait_for()
        assert figures.count() == 2
        assert page.locator("#signals figcaption").all_text_contents() == [
            "signal mode <b>",
            "signal level",
        ]
        words = figures.nth(0).locator("svg text").all_text_contents()
        assert {"early", "late"} <= set(words)
        early, late = (box["x"] for box in map(_box, figures.nth(0).locator("rect.word").all()))
        assert early < late
        page.evaluate("at(0)")
        before = _box(figures.nth(1).locator(".now"))["x"]
        page.evaluate("at(final)")
        assert _box(figures.nth(1).locator(".now"))["x"] > before + 50


def _box(locator):
    return locator.bounding_box()
