"""The region of the viewer in a browser: what it says of a box is what NumPy finds, and its flags are those of l2p."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_page import PHONE, WIDE, Opened, browser, same
from toy import SEES, telling_scene

import l2p
from l2p.auditing.exposed_parts import parts_of
from l2p.auditing.report import save_report
from l2p.maps.region import Box
from l2p.show.exhibit import Exhibit
from l2p.show.page.file_view import view_page
from l2p.show.page.sides import sides_of
from l2p.show.page.view import _thinned
from l2p.show.stance import Stance

__all__ = ["browser"]
#: A rotation, so that no axis of the view is one of the map.
TURN = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
AXES = "xyz"


def turned(scene: l2p.Scene) -> l2p.Scene:
    cameras = scene.camera_centers
    moved = [places @ TURN + [100.0, -20.0, 3.0] for places in (scene.xyz, *([] if cameras is None else [cameras]))]
    up = None if scene.up is None else scene.up @ TURN
    return replace(scene, xyz=moved[0], camera_centers=None if cameras is None else moved[1], up=up)


@pytest.fixture(scope="module")
def found(tiny_checkpoint) -> l2p.Audit:
    return l2p.audit(turned(l2p.simulate("room", 1500, 1)), [1, 0.2], checkpoint=tiny_checkpoint)


@pytest.fixture(scope="module")
def report(found, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("region") / "report"
    save_report(found, folder)
    return folder / "index.html"


@pytest.fixture
def opened(browser, report) -> Iterator[Opened]:
    shown = Opened(browser, report, color_scheme="light")
    shown.choose("layer", "recovered")
    yield shown
    assert shown.wrong == []
    shown.context.close()


def flags(shown: Opened) -> list[str]:
    """The flags to copy."""
    return shown.page.locator("#region-flags code").first.inner_text().split()


def box_of(shown: Opened) -> Box:
    flag, *numbers = flags(shown)
    assert flag == "--drop-box"
    return Box.of([float(number) for number in numbers])


def told(shown: Opened) -> str:
    return shown.text("region-status")


def expected(trial, box: Box, spacing: float, rows: np.ndarray | None = None) -> str:
    """The sentence on a box, of some of the points."""
    rows = np.arange(len(trial)) if rows is None else rows
    inside = rows[box.contains(trial.truth.xyz[rows])]
    error = np.linalg.norm(trial.recovery.xyz - trial.truth.xyz, axis=1)[inside] / spacing
    right = int((error <= 1).sum())
    return (
        f"The box holds {len(inside):,} of the {len(rows):,} published points ({100 * len(inside) / len(rows):.0f} %). "
        f"{right:,} of these ({100 * right / len(inside):.0f} %) came back within 1 spacing; the median error is "
        f"{np.median(error):.2f} spacings."
    )


def test_nothing_is_there_until_it_is_asked_for(opened):
    before = opened.picture()
    for name in ("sides", "region-status", "region-flags"):
        assert not opened.page.locator(f"#{name}").is_visible()
    opened.page.check("#region")
    for name in ("sides", "region-status", "region-flags"):
        assert opened.page.locator(f"#{name}").is_visible()
    assert not same(before, opened.picture())
    opened.page.uncheck("#region")
    assert same(before, opened.picture())


def test_the_box_first_is_the_middle_half(opened):
    opened.page.check("#region")
    box = box_of(opened)
    for axis, low, high in zip(AXES, box.low, box.high, strict=True):
        least, most = (float(opened.page.get_attribute(f"#{axis}-from", name) or "") for name in ("min", "max"))
        assert low - least == pytest.approx(most - high)
        assert (high - low) / (most - least) == pytest.approx(0.5, abs=0.02)


def test_what_is_said_is_what_numpy_finds(opened, found):
    opened.page.check("#region")
    for _ in range(3):
        for number, trial in enumerate(found.trials):
            opened.choose("cloud", str(number))
            assert told(opened) == expected(trial, box_of(opened), found.spacing)
        for axis in AXES:
            opened.page.locator(f"#{axis}-from").press("PageUp")
            opened.page.locator(f"#{axis}-to").press("ArrowRight")


def test_each_attacker_has_figures_of_its_own(browser, tmp_path):
    audit = l2p.audit(turned(telling_scene(900)), [1, 0.5], method=SEES)
    save_report(audit, tmp_path / "report")
    shown = Opened(browser, tmp_path / "report" / "index.html")
    shown.page.check("#region")
    for number, trial in enumerate(audit.trials):
        shown.choose("cloud", str(number // 4))
        shown.choose("attacker", str(number % 4))
        assert told(shown) == expected(trial, box_of(shown), audit.spacing)
    shown.choose("layer", "lines")
    assert told(shown) == expected(audit.trials[-1], box_of(shown), audit.spacing), "whatever the picture shows"
    assert shown.wrong == []
    shown.context.close()


def test_the_flags_leave_out_what_was_counted(opened, found):
    opened.page.check("#region")
    opened.slide("x-from", float(opened.page.get_attribute("#x-from", "min") or ""))
    truth = found.trials[0].truth
    drop = box_of(opened).contains(truth.xyz)
    assert told(opened).startswith(f"The box holds {drop.sum():,} of the 1,500")
    assert len(l2p.lift(truth.xyz, seed=0, drop=drop)) == 1500 - drop.sum()
    assert all("e" not in word for word in flags(opened)[1:])


def test_sides_work_by_keyboard_and_may_be_swapped(opened):
    opened.page.check("#region")
    page, start = opened.page, box_of(opened)
    page.focus("#y-from")
    page.keyboard.press("ArrowRight")
    step = float(page.get_attribute("#y-from", "step") or "")
    assert box_of(opened).low[1] == pytest.approx(start.low[1] + step)
    assert opened.text("y-from-value") == page.input_value("#y-from")
    page.keyboard.press("End")
    most = float(page.get_attribute("#y-from", "max") or "")
    assert (box_of(opened).low[1], box_of(opened).high[1]) == (start.high[1], most)


def test_an_empty_box_says_so(opened):
    opened.page.check("#region")
    for axis in AXES:
        for end in ("from", "to"):
            opened.page.locator(f"#{axis}-{end}").press("Home")
    assert told(opened) == "The box holds none of the 1,500 published points."


def test_edges_are_drawn_between_the_corners(opened, found):
    """The projection of the viewer, once more in NumPy."""
    opened.page.check("#region")
    opened.choose("layer", "lines")
    picture = opened.picture()
    height, width = picture.shape[:2]
    stance = Stance.before(Exhibit(points=found.trials[0].truth.xyz, camera_centers=found.camera_centers, up=found.up))
    assert np.abs(stance.axes).max() < 0.99, "the box is turned in the view"
    box = np.array([box_of(opened).low, box_of(opened).high])
    azimuth, elevation, distance = -0.96, 0.5, 2.6
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    rows = np.array([[-sa, ca, 0], [-ca * se, -sa * se, ce], [-ca * ce, -sa * ce, -se]])
    for one in np.ndindex(2, 2, 2):
        for axis in range(3):
            if one[axis] == 1:
                continue
            other = list(one)
            other[axis] = 1
            ends = [np.array([box[end[k], k] for k in range(3)]) for end in (one, tuple(other))]
            for share in (0, 0.25, 0.5, 0.8, 1):
                right, up, far = rows @ stance.enter(ends[0] + share * (ends[1] - ends[0])) + [0, 0, distance]
                focal = 0.475 * min(width, height) * distance / far
                column, row = round(width / 2 + focal * right), round(height / 2 - focal * up)
                patch = picture[row - 2 : row + 4, column - 2 : column + 4].reshape(-1, 3)
                assert (patch.max(axis=1) < 48).any(), "the ink of the page, which nothing else in the picture has"


def test_behind_points_the_edges_are_dashed(opened):
    opened.page.check("#region")
    opened.slide("size", 8)
    pictures = [opened.picture()]
    opened.choose("layer", "lines")
    pictures.append(opened.picture())
    ink = [(picture.max(axis=2) < 48).sum() for picture in pictures]
    assert 0.3 * ink[1] < ink[0] < ink[1]


def test_a_part_of_the_map_is_shown_as_a_box_that_holds_it(opened, found):
    parts = parts_of(found)
    buttons = opened.page.locator("button.part")
    assert buttons.count() == len(parts) == 8
    truth = found.trials[0].truth.xyz
    exhibit = Exhibit(points=truth, camera_centers=found.camera_centers, up=found.up)
    sides = sides_of(exhibit, Stance.before(exhibit))
    reach = Box.of([float(side[end]) for end in ("least", "most") for side in sides]).contains(truth)
    for number in (0, 7):
        buttons.nth(number).click()
        inside = box_of(opened).contains(truth)
        within = Box(parts[number].low, parts[number].high).contains(truth)
        assert within.sum() == parts[number].points
        assert not (within & reach & ~inside).any(), "the sliders reach as far as the picture"
        assert told(opened).startswith(f"The box holds {inside.sum():,} of the 1,500 published points")


def test_of_a_thinned_map_the_points_drawn_are_counted(browser, found, tmp_path):
    save_report(found, tmp_path / "report", most_points=400)
    shown = Opened(browser, tmp_path / "report" / "index.html")
    shown.page.check("#region")
    words = expected(found.trials[0], box_of(shown), found.spacing, _thinned(1500, 400))
    assert told(shown) == f"{words} Only points that the picture shows are counted."
    shown.choose("cloud", "1")
    assert "Only points" not in told(shown), "300 points are all drawn"
    shown.context.close()


def test_a_line_cloud_is_told_by_its_confidence(browser, found, tmp_path, tiny_checkpoint):
    blind = l2p.audit(found.trials[0].lines, checkpoint=tiny_checkpoint)
    save_report(blind, tmp_path / "report")
    shown = Opened(browser, tmp_path / "report" / "index.html")
    shown.page.check("#region")
    recovery = blind.trials[0].recovery
    inside = box_of(shown).contains(recovery.xyz)
    share = 100 * recovery.confidence[inside].mean()
    held = f"The box holds {inside.sum():,} of the 1,500 recovered points ({100 * inside.mean():.0f} %). About "
    assert told(shown).startswith(held) and told(shown).endswith(" % of these are expected to be within 1 spacing.")
    assert abs(int(told(shown).removeprefix(held).split()[0]) - share) <= 1
    assert shown.wrong == []
    shown.context.close()


def test_views_of_files_have_a_region_where_there_is_something_to_tell(browser, found, tmp_path):
    trial = found.trials[0]
    for name, exhibit, has in (
        ("points", Exhibit(points=trial.truth.xyz), True),
        ("lines", Exhibit(lines=trial.lines), False),
        ("ranked", Exhibit(recovered=trial.recovery.xyz, confidence=trial.recovery.confidence), False),
    ):
        path = tmp_path / f"{name}.html"
        path.write_bytes(view_page(exhibit, name, "something"))
        shown = Opened(browser, path)
        assert shown.page.locator("#region").is_visible() == has
        if has:
            shown.page.check("#region")
            inside = box_of(shown).contains(trial.truth.xyz)
            assert told(shown) == f"The box holds {inside.sum():,} of the 1,500 points ({100 * inside.mean():.0f} %)."
        assert shown.wrong == []
        shown.context.close()


@pytest.mark.parametrize("size", [WIDE, PHONE])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_and_has_names_and_is_printed(browser, report, size, scheme):
    shown = Opened(browser, report, size, color_scheme=scheme)
    page = shown.page
    page.check("#region")
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    right = (
        "Math.max(...[...document.querySelectorAll('.controls *, p, code')].map(e => e.getBoundingClientRect().right))"
    )
    assert page.evaluate(right) <= size[0]
    for axis in AXES:
        for end in ("from", "to"):
            assert page.get_by_label(f"{axis} {end}").get_attribute("id") == f"{axis}-{end}"
    assert page.get_by_label("Look at a region").is_checked()
    page.emulate_media(media="print")
    assert not page.locator("#sides").is_visible() and page.locator("#region-status").is_visible()
    assert shown.wrong == []
    shown.context.close()


def test_without_javascript_there_is_no_region(browser, report):
    shown = Opened(browser, report, java_script_enabled=False)
    for name in ("region", "region-status", "region-flags"):
        assert not shown.page.locator(f"#{name}").is_visible()
    shown.context.close()


def sides_of_points(points: np.ndarray) -> list[dict[str, str]]:
    exhibit = Exhibit(points=points)
    return sides_of(exhibit, Stance.before(exhibit))


@pytest.mark.parametrize("scale", [1e-6, 0.3, 1, 40, 1e7])
@pytest.mark.parametrize("shift", [0.0, 5e5])
def test_ranges_hold_what_is_in_view_and_steps_meet_their_ends(rng, scale, shift):
    points = rng.normal(size=(400, 3)) * [1, 2, 0.001] * scale + shift
    exhibit = Exhibit(points=points)
    stance = Stance.before(exhibit)
    near = points[np.linalg.norm(stance.enter(points), axis=1) <= 1]
    for axis, side in enumerate(sides_of(exhibit, stance)):
        least, most, step, low, high = (float(side[name]) for name in ("least", "most", "step", "low", "high"))
        assert least <= near[:, axis].min() <= near[:, axis].max() <= most
        assert least < low < high < most
        assert 100 <= round((most - least) / step) <= 1002
        for value in (low, high, most):
            assert (value - least) / step == pytest.approx(round((value - least) / step), abs=1e-3)
        assert all(side[name] == f"{float(side[name]):.{len(step_places(side))}f}" for name in ("least", "low"))


def step_places(side: dict[str, str]) -> str:
    return side["step"].partition(".")[2]


def test_one_point_and_no_points():
    assert [float(side["most"]) > float(side["least"]) for side in sides_of_points(np.ones((1, 3)))] == [True] * 3
    assert sides_of(Exhibit(recovered=np.ones((3, 3))), Stance(np.zeros(3), 1.0, np.eye(3))) == []
