"""The decision on the page, in a browser: marks tell their figures, commands are copied, the table is downloaded."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_page import PHONE, WIDE, Opened, browser
from toy import SEES

import l2p
from l2p.auditing.decision import decide
from l2p.auditing.report import save_report
from l2p.auditing.tradeoff import ReleaseInputs
from l2p.simulator import simulate_model
from l2p.utility.releases import LocalizeConfig, queries_at

pytest.importorskip("poselib", reason="localization needs poselib: pip install 'l2p[utility]'")

__all__ = ["browser"]
#: A name that would break out of an attribute.
HOSTILE = "map\"><img src=x onerror=\"document.title='broken'\">'"


@pytest.fixture(scope="module")
def audit(tmp_path_factory) -> l2p.Audit:
    folder = tmp_path_factory.mktemp("decision") / "model"
    simulate_model("room", 500, 2).save_colmap(folder)
    scene = l2p.load(folder, l2p.Scene)
    config = LocalizeConfig(most_queries=5, wrong=(0.1,))
    return l2p.audit(scene, [1, 0.4], method=SEES, queries=queries_at(folder, scene), localizing=config)


@pytest.fixture(scope="module")
def report(audit, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("page") / "report"
    save_report(audit, folder, release=ReleaseInputs(scene=HOSTILE))
    return folder / "index.html"


@pytest.fixture(params=[(WIDE, "light"), (PHONE, "dark")], ids=["wide, light", "phone, dark"])
def opened(browser, report, request) -> Iterator[Opened]:
    size, scheme = request.param
    shown = Opened(browser, report, size, color_scheme=scheme, permissions=["clipboard-read", "clipboard-write"])
    yield shown
    assert shown.wrong == []
    shown.context.close()


def test_the_section_fits_the_page_and_names_a_release(opened):
    page = opened.page
    assert "Of the releases that localize" in page.locator(".decision .headline").inner_text()
    assert page.evaluate("document.documentElement.scrollWidth") <= page.viewport_size["width"]
    assert page.locator(".releases .best").count() == 1
    assert page.title() != "broken" and page.locator("img").count() == 0


def test_every_release_has_a_mark_in_both_charts_that_tells_it(opened, audit):
    decision = decide(audit)
    assert decision is not None
    for chart in opened.page.locator(".tradeoff svg").all():
        titles = chart.locator("title").all_text_contents()
        assert len(titles) == len(decision.options)
        assert all("of the map comes back" in title for title in titles)


def test_commands_are_copied(opened):
    page = opened.page
    buttons = page.locator("button.copy")
    assert buttons.count() == 1 + page.locator(".releases tbody td.copies").count()
    for button in (buttons.first, buttons.last):
        button.scroll_into_view_if_needed()
        button.click()
        page.wait_for_function("label => label.textContent === 'Copied'", arg=button.element_handle())
        assert page.evaluate("navigator.clipboard.readText()") == button.get_attribute("data-copy")
    assert "l2p lift" in (buttons.first.get_attribute("data-copy") or "")


def test_the_table_is_downloaded(opened, audit):
    decision = decide(audit)
    assert decision is not None
    with opened.page.expect_download() as waiting:
        opened.page.locator('a[download="releases.csv"]').click()
    rows = list(csv.DictReader(io.StringIO(Path(waiting.value.path()).read_text())))
    assert [float(row["recovered_of_map"]) for row in rows] == [each.recovered for each in decision.options]


def test_on_paper_there_are_no_buttons(opened):
    opened.page.emulate_media(media="print")
    assert not any(button.is_visible() for button in opened.page.locator("button.copy").all())
    assert opened.page.locator(".tradeoff svg").first.is_visible()
