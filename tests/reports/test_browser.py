"""The report in a real browser: Debian's Chromium without a window."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from conftest import require
from support.handmade import write_run

from merge_sumo.analysis.comparison import compare
from merge_sumo.analysis.explanation import EXPLANATIONS, Axis, Explanation
from merge_sumo.campaigns.recorded import RecordedCampaign, failures, spread_failures
from merge_sumo.metrics.merge import Conflict, Severity
from merge_sumo.records import to_plain
from merge_sumo.reports import report
from merge_sumo.reports.comparison_page import comparison_page
from merge_sumo.reports.text import changes, timelines
from merge_sumo.road.loader import centre_lines, road_for
from merge_sumo.scenario.scenario import DT_S, US23

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
def made(tmp_path_factory) -> RecordedCampaign:
    run = write_run(tmp_path_factory.mktemp("browser") / "run", errors={})
    report.write_report(run)
    return run


@contextmanager
def shown(browser, file: Path, **options) -> Iterator:
    """Open a file; afterwards, fail for messages, errors, dialogs and requests of the page."""
    complaints: list[str] = []

    def note_request(request) -> None:
        if not request.url.startswith(("file:", "data:")):
            complaints.append(request.url)

    context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
    page = context.new_page()
    page.set_default_timeout(60_000)
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda dialog: complaints.append(f"dialog {dialog.message}"))
    page.on("request", note_request)
    try:
        page.goto(file.as_uri())
        yield page
    finally:
        context.close()
    assert complaints == []


def chosen(page) -> int:
    """Return the index of the case that is shown."""
    return int(page.inner_text("#case-title").split()[1])


def test_it_opens_without_a_complaint_and_fits_the_window(browser, made):
    narrow = {"width": 380, "height": 800}
    with shown(browser, made.folder / report.REPORT, viewport=narrow) as page:
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
        conflict = Conflict.of(made.trajectory(worst[0]), centre_lines(road_for(US23)))
        row, what = conflict.row, f"{conflict.what} at {conflict.row / 10:.1f} s"
        assert page.locator("#before").get_attribute("title") == f"Plays from 3 s before {what}"
        # In one go, before the animation has its first frame.
        jump = "button => { button.click(); return [slider.value, playing]; }"
        assert page.locator("#before").evaluate(jump) == [str(row - 30), True]
        page.locator("#play").click()
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
        assert third.locator("input[type=range]").is_disabled(), "all at once is ticked"
        third.locator("input[type=checkbox]").uncheck()
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
        page.locator("#facts").click()
        page.locator("#about").click()
        assert page.locator("#chart-fmc .line").first.is_visible()
        page.emulate_media(media="print")
        assert not page.locator("#play").is_visible()
        assert page.locator(".levels").is_visible()


def test_a_comparison_has_one_player_and_does_not_grow_with_its_cases(browser, tmp_path, made):
    file = tmp_path / "page.html"
    file.write_text(comparison_page(compare([made, made])))
    with shown(browser, file, viewport={"width": 1400, "height": 900}) as page:
        buttons = page.locator(".pairs button")
        assert buttons.count() == len(failures(made.outcomes)) > 20
        assert page.evaluate("document.documentElement.scrollHeight") < 2800
        assert page.locator("#play").bounding_box()["y"] < 800
        buttons.first.focus()
        page.keyboard.press("ArrowDown")
        assert str(chosen(page)) == buttons.nth(1).inner_text()
        assert page.locator(".view:visible").count() == 2
        assert page.locator("#chart-speed .line").count() == 4
        page.locator(".map [data-pair='0']").click(force=True)
        assert page.url.endswith(f"#2-case-{chosen(page)}")
        assert str(chosen(page)) == buttons.first.inner_text()


def test_the_first_screen_answers(browser, made):
    options = {"viewport": {"width": 1400, "height": 900}}
    with shown(browser, made.folder / report.REPORT, **options) as page:
        box = "all => all.map((one) => one.getBoundingClientRect().toJSON())"
        title, *maps, panel, road = page.locator("h1, .map > svg, #case, #road").evaluate_all(box)
        assert title["top"] >= 0
        assert [one["bottom"] < 860 and one["width"] > 300 for one in maps] == [True] * 3
        assert panel["top"] < 500
        assert road["bottom"] < 860
        assert page.inner_text("#case-role") == "Worst case"
        assert page.locator("#case-link").get_attribute("href") == f"#case-{chosen(page)}"
        assert page.locator("#marks button").last.get_attribute("class") == "", "of no car"
        heights = page.locator(".charts figcaption:visible").evaluate_all(box)
        assert len({one["height"] for one in heights}) == 1
        assert not re.search(r"(^|\s)-\d", page.inner_text(".first"), re.MULTILINE)
        region = page.locator(".regions tbody tr").first
        level, number, _, found, _ = region.locator("td").all_inner_texts()
        region.locator("button").click()
        assert page.locator(f".map[data-level='{level}'] text.number").text_content() == number
        assert page.inner_text("#filtered-number").split()[0] == found


def rows(page) -> list[int]:
    """Return the cases of the table of all cases, from top to bottom."""
    return [int(text) for text in page.locator("#table td button").all_inner_texts()]


def test_errors_and_timeouts_are_drawn_as_no_result_shown_first_and_grouped(browser, tmp_path):
    run = write_run(
        tmp_path / "run", 20, errors={4: "boom", 9: EVIL, 11: "boom"}, timeouts=(0, 3, 6)
    )
    with shown(browser, report.write_report(run)) as page:
        drawn = page.locator(".map .mark.error").evaluate_all(
            "all => all.map((m) => m.dataset.case)"
        )
        assert sorted(map(int, drawn)) == [0, 3, 4, 6, 9, 11]
        page.locator(".untested [data-case='4']").click()
        assert page.inner_text("#case-words").startswith("VUT_ERROR")
        assert page.locator("#case-timeline li").last.inner_text().endswith("boom")
        page.locator(".lists [data-case='3']").click()
        assert page.inner_text("#case-words").startswith("Timeout")
        last = page.locator("#case-timeline li").last.inner_text()
        assert "the VUT did not reach the merge point in" in last
        verdict = page.locator("#filters [name=verdict]")
        for label, expected in (
            ("boom (2)", [4, 11]),
            ("VUT_ERROR (3)", [4, 9, 11]),
            ("TIMEOUT (3)", [0, 3, 6]),
        ):
            verdict.select_option(label=label)
            assert sorted(rows(page)) == expected


def test_the_timeline_and_the_changes_of_a_failure_are_drawn_and_said(browser, tmp_path):
    run = write_run(tmp_path / "run", errors={})
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
    words = list(changes(known, first.case))
    told = timelines(run, [first])[first.index]
    with shown(browser, report.write_report(run)) as page:
        page.evaluate(f"location.hash = '#case-{first.index}'")
        page.locator("#why-known").wait_for()
        assert page.locator("#why-words li").all_text_contents() == [
            one.replace(" -", " \u2212") for one in words
        ]
        texts = page.locator("#why-changes text:not(.edge)").all_text_contents()
        signed = [f"{value:.1f}".replace("-", "\u2212") for value in (x_m, below_m, above_m)]
        of_start = [f"x_POV0 {signed[0]} m", *signed[1:], f"v_POV0 {v_mps:.2f} m/s", "25.50"]
        assert texts == [*of_start, "the VUT's gap_m 16.20", "14.10"]
        listed = page.locator("#case-timeline li").all_text_contents()
        assert listed == [f"{event.time_s:.1f} s {event.text}" for event in told.events]
        marks = page.locator("#marks button")
        assert marks.count() == len(listed)
        for buttons in (marks, page.locator("#case-timeline button")):
            page.evaluate("at(0)")
            buttons.last.click()
            assert page.inner_text("#time-value") == f"{told.events[-1].time_s:.1f} s"
        page.evaluate(f"location.hash = '#case-{second.index}'")
        page.locator("#why-ask").wait_for()
        assert not page.locator("#why-known").is_visible()
        explain = f"merge-sumo explain {run.folder} {second.index} --vut handmade"
        assert page.inner_text("#why-ask code") == explain
        passed = next(o.index for o in run.outcomes if not o.failed)
        page.evaluate(f"location.hash = '#case-{passed}'")
        page.wait_for_function(f"chosen === place.get({passed})")
        assert not page.locator("#why").is_visible()


def test_two_cars_at_contact_are_drawn_to_scale_with_outlines_the_one_behind_on_top(browser, made):
    contacts = [o for o in made.outcomes if o.measures.severity is Severity.CONTACT]
    with shown(browser, made.folder / report.REPORT) as page:
        for behind, ahead in (("pov", "vut"), ("vut", "pov")):
            case = next(o for o in contacts if (o.measures.dx_m > 0.0) == (behind == "vut"))
            page.evaluate(f"location.hash = '#case-{case.index}'")
            page.wait_for_function(f"chosen === place.get({case.index})")
            page.evaluate(f"at({case.measures.t_end_s / DT_S:.0f})")
            cars = page.locator("#road .car, #road .outline").evaluate_all(
                """all => all.map((car) => [car.classList.value, car.getAttribute("width"),
                car.getAttribute("height"),
                car.closest("[transform]").getAttribute("transform")])"""
            )
            under, over, *outlines = cars
            assert (under[0], over[0]) == (f"car {ahead}", f"car {behind}")
            for body, outline in zip(sorted((under, over)), outlines, strict=True):
                name, *where = body
                assert outline == [name.replace("car", "outline"), *where], "above all bodies"
                assert where[:2] == ["5", "1.8"]
                assert where[2].endswith("scale(1)")
