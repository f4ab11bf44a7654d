"""The audit of a map without some of its points: its figures are those of a slow loop, and the words say them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from toy import SEES, telling_scene

import l2p
from l2p.auditing import report
from l2p.auditing.left_out import LeftOut, Near
from l2p.auditing.words import headline, left_out, sentences
from l2p.judging.accuracy import spacing
from l2p.judging.near import share_near
from l2p.maps.region import Box


def slow_share(points: np.ndarray, others: np.ndarray, reach: float) -> float:
    """Share of points with another one within reach, one by one."""
    near = [any(np.linalg.norm(point - other) <= reach for other in others) for point in points]
    return sum(near) / len(near)


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    return telling_scene(240)


@pytest.fixture(scope="module")
def drop(scene) -> np.ndarray:
    return Box.of([0, 0, -9, 9, 9, 9]).contains(scene.xyz)


@pytest.fixture(scope="module")
def found(scene, drop) -> l2p.Audit:
    return l2p.audit(scene, [1, 0.3], seed=5, method=SEES, drop=drop)


def test_figures_are_those_of_a_slow_loop(found, scene, drop):
    assert found.spacing == spacing(scene.xyz), "of the whole map"
    out = found.left_out
    assert out is not None and out.points == drop.sum() and len(out.near) == len(found.trials) == 8
    for trial, near in zip(found.trials, out.near, strict=True):
        assert trial.truth is not None
        assert near.recovered == slow_share(scene.xyz[drop], trial.recovery.xyz, found.spacing)
        assert near.published == slow_share(scene.xyz[drop], trial.truth.xyz, found.spacing)
    assert 0 < out.near[0].published < 1


def test_everything_else_is_as_of_a_map_that_never_had_the_points(found, scene, drop):
    other = l2p.audit(scene.rows(~drop), [1, 0.3], seed=5, method=SEES)
    for one, two in zip(found.trials, other.trials, strict=True):
        np.testing.assert_array_equal(one.lines.moment, two.lines.moment)
        np.testing.assert_array_equal(one.recovery.xyz, two.recovery.xyz)
        np.testing.assert_array_equal(one.rgb, two.rgb)
        assert one.truth is not None and not drop[one.truth.index].any()
        assert scene.rgb is not None
        np.testing.assert_array_equal(one.rgb, scene.rgb[one.truth.index])


def test_the_share_near_counts_the_reach_itself_and_needs_others(rng):
    points = rng.normal(size=(40, 3))
    assert share_near(np.zeros((1, 3)), np.array([[0.0, 3.0, 4.0]]), 5.0) == 1
    assert share_near(np.zeros((1, 3)), np.array([[0.0, 3.0, 4.0]]), np.nextafter(5.0, 0)) == 0
    assert share_near(points, np.zeros((0, 3)), 1e9) == 0
    shares = [share_near(points, rng.normal(size=(30, 3)), reach) for reach in (0.1, 1e9)]
    assert shares[0] < 1 and shares[1] == 1


def test_words_say_the_figures_of_the_strongest_attacker(found):
    told = replace(found, points=4000, left_out=LeftOut(1234, (Near(0.02, 0.013), *[Near(0.9, 0.9)] * 7)))
    assert left_out(told).replace("\N{NO-BREAK SPACE}", " ") == (
        "1,234 points of the map were left out (31 %): 2 % of them have a recovered point within 1 spacing; 1 % have a "
        "published neighbour that near."
    )
    assert left_out(told) in sentences(told) and left_out(told) in report.report_page(told).decode()
    assert left_out(replace(told, left_out=LeftOut(1, told.left_out.near))).startswith(
        "1 point of the map was left out"
    )
    assert "of the published points are recovered" in headline(told)
    part = headline(replace(told, trials=told.trials[4:])).replace("\N{NO-BREAK SPACE}", " ")
    assert "of the published points (30 % of what is left) are recovered" in part


def test_the_table_and_the_file_have_every_trial(found):
    assert found.left_out is not None
    table = report._tables(found)[-1]
    assert table.heading == "What was left out" and len(table.rows) == len(found.trials)
    assert all(len(row) == table.columns for row in table.rows)
    figures = json.loads(json.dumps(report.figures_of(found), allow_nan=False))["left_out"]
    assert figures["points"] == found.left_out.points
    assert [near["recovered"] for near in figures["near"]] == [near.recovered for near in found.left_out.near]


@pytest.mark.parametrize("mask", [np.zeros(240, dtype=bool), np.ones(240, dtype=bool), np.ones(3, dtype=bool)])
def test_a_mask_of_none_all_or_other_points_is_refused(scene, mask):
    with pytest.raises(l2p.InputError, match="points to drop"):
        l2p.audit(scene, [1], method="tomography", drop=mask)
