"""Lines with a false place are attacked as pairs of points, of which the likelier is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import l2p
from l2p.attacks.run import run
from l2p.attacks.structured import likelier_places
from l2p.judging.accuracy import errors, spacing
from l2p.judging.references import LeaveOneOut
from l2p.schemes.recognition import recognise


@pytest.fixture(scope="module")
def hidden() -> l2p.Hiding:
    return l2p.hide(l2p.simulate("room", points=600, seed=0), seed=0, scheme="decoys")


def test_the_likelier_place_of_each_line_is_kept() -> None:
    rng = np.random.default_rng(0)
    element = rng.permutation(np.repeat(np.arange(20), 2))
    places = l2p.Recovery(rng.normal(size=(40, 3)), rng.random(40).astype(np.float32), rng.random(40), element=element)
    kept = likelier_places(places)
    np.testing.assert_array_equal(kept.element, np.arange(20))
    for line in range(20):
        rows = [row for row in range(40) if element[row] == line]
        best = max(rows, key=lambda row: places.confidence[row])
        np.testing.assert_array_equal(kept.xyz[line], places.xyz[best])


def test_lines_with_false_places_have_one_point_each(hidden: l2p.Hiding) -> None:
    untold = replace(hidden.map, scheme="uniform")
    assert recognise(hidden.map).scheme == "false places" and recognise(untold).scheme == "unknown"
    assert recognise(hidden.map).sentence.endswith("The file names the scheme decoys.")
    told, naive = (l2p.recover(each, method="tomography") for each in (hidden.map, untold))
    assert told.one_each and len(told) == len(hidden.map) and not told.calibrated
    unit = spacing(hidden.truth.xyz)
    share = [float((errors(each, hidden.truth) <= unit).mean()) for each in (told, naive)]
    assert share[0] > share[1]


def test_bounds_know_one_point_of_a_line(hidden: l2p.Hiding) -> None:
    bound = run(hidden.map, LeaveOneOut(hidden.truth.xyz))
    assert bound.one_each and len(bound) == len(hidden.map)
