"""The pages in a real browser: they load from disk without errors or network, and their controls work."""

from __future__ import annotations

import base64
import io
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy import SEES, telling_scene

import l2p
from l2p.auditing.report import save_report
from l2p.show.exhibit import Exhibit
from l2p.show.page.file_view import view_page

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]
HOSTILE = "</script><img src=x onerror=\"document.title='broken'\">'&amp;"
WIDE, PHONE = (1100, 800), (360, 740)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install -e .[dev]")
    if not CHROMIUM.exists():
        pytest.skip(f"needs {CHROMIUM}: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def found(tiny_checkpoint) -> l2p.Audit:
    scene = l2p.simulate("room", points=1500, seed=1)
    return l2p.audit(scene, fractions=[1, 0.2], checkpoint=tiny_checkpoint, name=HOSTILE, metric=True)


@pytest.fixture(scope="module")
def report(found, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pages") / "report"
    l2p.save_report(found, folder, command=f"l2p audit '{HOSTILE}' -o report")
    return folder / "index.html"


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> Path:
    """A report that compares attackers."""
    folder = tmp_path_factory.mktemp("compared") / "report"
    l2p.save_report(l2p.audit(telling_scene(1500), [1, 0.2], method=SEES, metric=True), folder)
    return folder / "index.html"


def pixels(png: bytes) -> np.ndarray:
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def foreground(picture: np.ndarray) -> int:
    """Pixels that are not background."""
    flat = picture.reshape(-1, 3)
    return int((np.abs(flat - np.median(flat, axis=0)).max(axis=1) > 25).sum())


class Opened:
    """A page from disk, and everything that went wrong while it was open."""

    def __init__(self, browser: Any, path: Path, size: tuple[int, int] = WIDE, **settings: Any) -> None:
        viewport = {"width": size[0], "height": size[1]}
        self.context = browser.new_context(viewport=viewport, **settings)
        self.page = self.context.new_page()
        self.wrong: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: self.wrong.append(message.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        assert self.requests == [path.as_uri()], "the page itself, and nothing else"

    def picture(self) -> np.ndarray:
        """The pixels of the 3D view, (height, width, 3), after all that was asked for is drawn."""
        self.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        url = self.page.locator("canvas").evaluate("canvas => canvas.toDataURL()")
        return pixels(base64.b64decode(url.partition(",")[2]))

    def drawn(self) -> int:
        """Pixels that are not background."""
        return foreground(self.picture())

    def text(self, name: str = "status") -> str:
        return self.page.locator(f"#{name}").inner_text().replace("\N{NO-BREAK SPACE}", " ")

    def choose(self, name: str, value: str) -> None:
        self.page.check(f'input[name="{name}"][value="{value}"]')

    def slide(self, name: str, value: float) -> None:
        self.page.locator(f"#{name}").fill(str(value))


@pytest.fixture
def opened(browser, report) -> Iterator[Opened]:
    """The report; whatever a test does to it, nothing may go wrong and nothing may be loaded."""
    shown = Opened(browser, report, color_scheme="light")
    yield shown
    assert shown.wrong == []
    assert len(shown.requests) == 1
    shown.context.close()


def same(before: np.ndarray, after: np.ndarray) -> bool:
    return np.array_equal(before, after)


def test_the_view_is_not_blank_and_has_the_colours_of_its_scale(opened):
    opened.picture()
    seen = pixels(opened.page.locator("canvas").screenshot())
    assert foreground(seen) > 1500
    assert len({tuple(colour) for colour in seen.reshape(-1, 3)}) > 20


def test_true_points_lines_and_recovered_points_are_three_pictures(opened):
    pictures = []
    for layer, words in (("recovered", "recovered points."), ("points", "1,500 points."), ("lines", "1,500 lines.")):
        opened.choose("layer", layer)
        assert words in opened.text()
        assert opened.drawn() > 1500
        pictures.append(opened.picture())
    assert not any(same(a, b) for a, b in ((pictures[0], pictures[1]), (pictures[1], pictures[2])))
    assert opened.page.locator("#floor").is_disabled(), "lines and true points have no confidence"
    assert opened.page.locator("#size").is_disabled(), "nor have lines a size"


def test_the_first_view_is_the_map_beside_what_comes_back(opened):
    both = opened.picture()
    half = both.shape[1] // 2
    sides = [both[30:, : half - 2], both[30:, half + 2 :]]
    assert all(foreground(side) > 700 for side in sides) and not same(*sides)
    assert not opened.page.locator("#floor").is_disabled()
    opened.slide("floor", 100)
    assert same(opened.picture()[30:, : half - 2], sides[0]), "the map is as it is"
    opened.page.set_viewport_size({"width": 390, "height": 844})
    narrow = opened.picture()
    assert narrow.shape[0] > 1.5 * narrow.shape[1], "one above the other"


def test_the_exposed_part_of_the_map_is_red(opened, found):
    opened.choose("layer", "exposed")
    trial = found.trials[0]
    inside = int((np.linalg.norm(trial.recovery.xyz - trial.truth.xyz, axis=1) <= found.spacing).sum())
    assert opened.text().startswith(f"1,500 points. {inside:,} of these")
    seen = opened.picture().reshape(-1, 3)
    red = (seen[:, 0] > 150) & (seen[:, 1:].max(axis=1) < 90)
    assert red.sum() > 100
    assert opened.text("legend").startswith("exposed: in its place")
    assert opened.page.locator("#color").is_disabled()


def test_the_share_that_is_published_can_be_chosen(opened):
    before = opened.picture()
    opened.choose("cloud", "1")
    assert opened.text().startswith("300 recovered points.")
    assert not same(before, opened.picture())


def test_the_attacker_can_be_chosen(browser, compared):
    shown = Opened(browser, compared)
    pictures, told = [], []
    for share in ("0", "1"):
        shown.choose("cloud", share)
        for attacker in "0123":
            shown.choose("attacker", attacker)
            pictures.append(shown.picture())
            told.append(shown.text())
    assert not any(same(a, b) for a, b in itertools.combinations(pictures, 2))
    assert all(each.startswith("1,500 recovered") for each in told[:4])
    assert all(each.startswith("300 recovered") for each in told[4:])
    shown.choose("layer", "points")
    assert shown.page.locator("#attackers input").first.is_disabled(), "true points are the same for all"
    assert shown.drawn() > 300 and shown.text() == "300 points."
    shown.choose("layer", "lines")
    assert shown.drawn() > 300 and shown.text().startswith("300 lines.")
    assert shown.wrong == []
    shown.context.close()


def test_one_attacker_is_no_choice(opened):
    assert not opened.page.locator("#attackers").is_visible()


@pytest.mark.parametrize("size", [WIDE, PHONE])
def test_a_comparison_of_attackers_fits(browser, compared, size):
    shown = Opened(browser, compared, size)
    page = shown.page
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    right = "Math.max(...[...document.querySelectorAll('.controls *, p')].map(e => e.getBoundingClientRect().right))"
    assert page.evaluate(right) <= size[0]
    page.locator(".scroll").first.evaluate("e => e.scrollLeft = 150")
    for place in ("tbody th[scope=row]", "tbody th[scope=rowgroup] span"):
        assert 0 <= page.locator(place).first.bounding_box()["x"] < 40, place
    page.set_viewport_size({"width": 703, "height": 1000})
    page.emulate_media(media="print")
    wider = "[...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth > e.clientWidth).length"
    assert page.evaluate(wider) == 0, "nothing is cut off on paper"
    assert shown.wrong == []
    shown.context.close()


def test_the_confidence_slider_hides_points_and_counts_the_rest(opened, found):
    trial = found.trials[0]
    confidence, drawn = trial.recovery.confidence.astype(float), opened.drawn()
    inside = np.linalg.norm(trial.recovery.xyz - trial.truth.xyz, axis=1) <= found.spacing
    level = int(100 * np.quantile(confidence, 0.7))
    opened.slide("floor", level)
    kept = confidence >= level / 100
    assert 0 < kept.sum() < 1500
    share = f"{100 * kept.mean():.0f} %"
    right = f"{(kept & inside).sum():,} of these"
    assert opened.text().startswith(f"{kept.sum():,} of 1,500 points ({share}) are at least so confident. {right}")
    assert opened.text("floor-value") == f"{level} %"
    assert opened.drawn() < drawn


def test_the_slider_never_hides_everything(opened):
    opened.page.locator("#floor").press("End")
    assert not opened.text().startswith("0 of")


def test_colours_and_legend_can_be_chosen(opened):
    pictures = [opened.picture()]
    assert "spacings off" in opened.text("legend")
    for color in ("confidence", "rgb"):
        opened.page.select_option("#color", color)
        pictures.append(opened.picture())
    assert not same(pictures[0], pictures[1]) and not same(pictures[1], pictures[2])
    assert not opened.page.locator("#legend").is_visible(), "the map's own colours have no scale"


def test_points_can_be_larger(opened):
    opened.slide("size", 1)
    small = opened.drawn()
    opened.slide("size", 8)
    assert opened.drawn() > 3 * small


def test_hands_turn_move_and_come_closer_and_reset_goes_back(opened):
    page, start = opened.page, opened.picture()
    box = page.locator("canvas").bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def drag():
        page.mouse.move(*middle)
        page.mouse.down()
        page.mouse.move(middle[0] + 80, middle[1] + 30)
        page.mouse.up()

    def move():
        page.keyboard.down("Shift")
        drag()
        page.keyboard.up("Shift")

    for act in (drag, move, lambda: page.mouse.wheel(0, -200), lambda: page.click("#closer")):
        before = opened.picture()
        act()
        page.wait_for_timeout(50)
        assert not same(before, opened.picture())
    page.click("#reset")
    assert same(start, opened.picture())


def test_the_heading_of_a_row_stays_while_its_table_scrolls(browser, report):
    shown = Opened(browser, report, PHONE)
    shown.page.locator(".scroll").first.evaluate("e => e.scrollLeft = 150")
    place = shown.page.locator("tbody th").first.bounding_box()
    assert 0 <= place["x"] < 40
    shown.context.close()


def test_lines_that_pass_by_are_counted(browser, tmp_path, rng):
    points = np.concatenate([rng.normal(size=(60, 3)), [[500.0, 0, 0]]])
    lines = l2p.LineCloud(np.tile([0.0, 0, 1], (61, 1)), np.cross(points, [0.0, 0, 1]))
    path = tmp_path / "lines.html"
    path.write_bytes(view_page(Exhibit(lines=lines), "lines", "something"))
    shown = Opened(browser, path)
    assert shown.text() == "61 lines. Left out of the picture: 1, far from the others."
    assert not shown.page.locator("#size").is_visible()
    shown.context.close()


def test_the_page_scrolls_until_the_picture_was_clicked(opened):
    before = opened.picture()
    box = opened.page.locator("canvas").bounding_box()
    opened.page.mouse.move(box["x"] + 50, box["y"] + 50)
    opened.page.mouse.wheel(0, 100)
    opened.page.wait_for_timeout(150)
    assert opened.page.evaluate("scrollY") > 0
    opened.page.evaluate("scrollTo(0, 0)")
    assert same(before, opened.picture())


def test_keys_turn_and_reset(opened):
    start = opened.picture()
    opened.page.locator("canvas").focus()
    focused = opened.picture()
    before = focused
    for key in ("ArrowLeft", "ArrowUp", "+", "Shift+ArrowLeft", "Shift+ArrowUp"):
        opened.page.keyboard.press(key)
        after = opened.picture()
        assert not same(before, after), key
        before = after
    opened.page.keyboard.press("0")
    assert same(focused, opened.picture())
    assert start.shape == focused.shape


def test_names_are_text_and_never_code(opened):
    assert opened.page.title() == f"Privacy audit of {HOSTILE}"
    assert opened.page.locator("h1").inner_text() == f"Privacy audit of {HOSTILE}"
    assert opened.page.locator("img").count() == 0
    assert HOSTILE in opened.page.locator("pre").inner_text()


def test_figures_curves_and_meaning_are_there(opened):
    words = opened.page.locator("main").inner_text()
    for part in ("within 1 spacing", "In centimetres", "What this means", "How to reproduce", "A low figure"):
        assert part in words
    assert opened.page.locator("figure svg").count() == 3


def test_everything_has_a_name_for_those_who_do_not_see_it(opened):
    unnamed = opened.page.evaluate(
        "[...document.querySelectorAll('input, select')].filter(e => !e.labels.length || !e.labels[0].innerText.trim())"
        ".map(e => e.outerHTML)"
    )
    assert unnamed == []
    assert opened.page.locator("h1").count() == 1
    for picture in opened.page.locator("[role=img]").all():
        assert len(picture.get_attribute("aria-label")) > 10
    assert opened.page.locator("th:not([scope])").count() == 0
    levels = opened.page.evaluate("[...document.querySelectorAll('h1, h2, h3')].map(e => +e.tagName[1])")
    assert all(after - before <= 1 for before, after in itertools.pairwise(levels))


def luminance(colour: str) -> float:
    """Relative luminance of ``rgb(r, g, b)`` (WCAG 2)."""
    channels = np.array([int(value) for value in re.findall(r"\d+", colour)[:3]]) / 255
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_light_and_dark_are_readable(browser, report, scheme):
    shown = Opened(browser, report, color_scheme=scheme)
    style = "(e, name) => getComputedStyle(e)[name]"
    ground = luminance(shown.page.locator("body").evaluate("e => getComputedStyle(e).backgroundColor"))
    assert (ground > 0.5) == (scheme == "light")
    paper = luminance(shown.page.locator("figure").first.evaluate("e => getComputedStyle(e).backgroundColor"))
    for place, behind in (
        ("h1", ground),
        (".note", paper),
        (".verdict strong", paper),
        ("figcaption", paper),
        ("thead th", paper),
    ):
        colour = luminance(shown.page.locator(place).first.evaluate(style, "color"))
        light, dark = max(colour, behind), min(colour, behind)
        assert (light + 0.05) / (dark + 0.05) >= 4.5, place
    ink = luminance(shown.page.locator("figure svg text").first.evaluate(style, "fill"))
    assert (max(ink, paper) + 0.05) / (min(ink, paper) + 0.05) >= 4.5, "labels of the curves"
    assert (np.median(shown.picture()) > 128) == (scheme == "light"), "the ground of the view"
    shown.context.close()


def test_the_switch_turns_light_into_dark_and_back(opened):
    light = opened.picture()
    opened.page.click("#theme")
    assert np.median(opened.picture()) < 64
    opened.page.click("#theme")
    assert same(light, opened.picture())


def test_paper_is_light(browser, report):
    shown = Opened(browser, report, color_scheme="dark")
    assert np.median(shown.picture()) < 64
    shown.page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert np.median(shown.picture()) > 128
    shown.page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert np.median(shown.picture()) < 64
    assert shown.page.pdf(format="A4").startswith(b"%PDF")
    right = "Math.max(...[...document.querySelectorAll('table, figure')].map(e => e.getBoundingClientRect().right))"
    shown.page.set_viewport_size({"width": 703, "height": 1000})  # A4 without its margins
    shown.page.emulate_media(media="print")
    assert not shown.page.locator(".controls").is_visible()
    assert shown.page.evaluate(right) <= 703, "nothing is cut off"
    assert shown.wrong == []
    shown.context.close()


def test_a_phone_is_wide_enough(browser, report):
    shown = Opened(browser, report, PHONE, device_scale_factor=2, has_touch=True, is_mobile=True)
    assert shown.page.evaluate("document.documentElement.scrollWidth") <= PHONE[0]
    assert shown.drawn() > 1500
    right = shown.page.evaluate(
        "Math.max(...[...document.querySelectorAll('.controls *, h1, p')].map(e => e.getBoundingClientRect().right))"
    )
    assert right <= PHONE[0]
    assert shown.wrong == []
    shown.context.close()


def test_without_javascript_the_figures_are_still_there(browser, report):
    shown = Opened(browser, report, java_script_enabled=False)
    assert "The 3D view needs JavaScript" in shown.page.locator(".view").inner_text()
    for useless in ("canvas", ".controls", "#theme"):
        assert not shown.page.locator(useless).is_visible(), useless
    assert shown.page.locator("table").count() == 2
    shown.context.close()


def test_a_line_cloud_gives_a_prediction(browser, found, tmp_path, tiny_checkpoint):
    blind = l2p.audit(found.trials[1].lines, checkpoint=tiny_checkpoint, name="lines.npz")
    save_report(blind, tmp_path / "report")
    shown = Opened(browser, tmp_path / "report" / "index.html")
    assert "A prediction, not a measurement." in shown.page.locator(".lead").inner_text()
    assert "are expected to be within 1 spacing" in shown.text()
    assert shown.page.locator('input[value="points"]').count() == 0
    assert shown.drawn() > 300
    assert shown.wrong == []
    shown.context.close()


def test_views_of_files(browser, found, tmp_path):
    trial = found.trials[0]
    ranked = Exhibit(recovered=trial.recovery.xyz, confidence=trial.recovery.confidence)
    exhibits = {
        "points": (Exhibit(points=trial.truth.xyz), "1,500 points."),
        "coloured": (Exhibit(points=trial.truth.xyz, rgb=trial.rgb), "1,500 points."),
        "lines": (Exhibit(lines=trial.lines), "1,500 lines."),
        "recovered": (ranked, "1,500 recovered points."),
    }
    for name, (exhibit, words) in exhibits.items():
        path = tmp_path / f"{name}.html"
        path.write_bytes(view_page(exhibit, HOSTILE, "something"))
        shown = Opened(browser, path)
        assert shown.text().startswith(words)
        assert shown.drawn() > 1500
        assert shown.page.locator("h1").inner_text() == HOSTILE
        assert shown.wrong == []
        shown.context.close()
