"""A scheme is one file and one row: it is hidden, saved, lifted by the command and scored like those of l2p."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import l2p
from l2p.cli.main import main
from l2p.errors import InputError
from l2p.judging.accuracy import errors, spacing
from l2p.schemes.scheme import SCHEMES, Scheme, scheme_of


@pytest.fixture(autouse=True)
def _toys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.setitem(SCHEMES, "pairs", "toy_schemes:Pairs")
    monkeypatch.setitem(SCHEMES, "fakes", "toy_schemes:Fakes")


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    return l2p.simulate("room", points=300, seed=0)


def beta_of(hidden: l2p.Hiding) -> np.ndarray:
    """Position of each true point on its line."""
    lines, truth = hidden.map, hidden.truth
    return np.sum((truth.xyz - lines.origin[truth.element]) * lines.direction[truth.element], axis=1)


@pytest.mark.parametrize("name", ["uniform", "pairs", "fakes"])
def test_every_point_lies_on_its_line(name: str, scene: l2p.Scene) -> None:
    assert isinstance(scheme_of(name), Scheme)
    hidden = l2p.hide(scene, seed=3, fraction=0.5, scheme=name)
    truth, own = hidden.truth, hidden.truth.element
    apart = np.cross(truth.xyz, hidden.map.direction[own]) - hidden.map.moment[own]
    assert np.linalg.norm(apart, axis=1).max() < 1e-3, "points are moved within their lattice cell"
    np.testing.assert_array_equal(truth.xyz, scene.xyz[truth.index])
    assert scene.ids is not None and truth.ids is not None
    np.testing.assert_array_equal(truth.ids, scene.ids[truth.index])
    assert np.bincount(own).max() == scheme_of(name).answers
    assert len(hidden.map) == {"uniform": 150, "pairs": 75, "fakes": 300}[name]
    assert (hidden.map.scheme, truth.seed, truth.spacing) == (name, 3, None)


@pytest.mark.parametrize("name", ["pairs", "fakes"])
def test_hide_save_load_evaluate(name: str, scene: l2p.Scene, tmp_path: Path) -> None:
    hidden = l2p.hide(scene, seed=3, scheme=name)
    with pytest.raises(InputError, match="got a truth without a spacing; measure that of the whole map first"):
        l2p.save(hidden.truth, tmp_path / "truth.npz")
    l2p.save(replace(hidden.truth, spacing=spacing(scene.xyz)), tmp_path / "truth.npz")
    truth = l2p.load(tmp_path / "truth.npz", l2p.Truth)
    np.testing.assert_array_equal(truth.element, hidden.truth.element)
    beta = beta_of(hidden)
    element = truth.element
    perfect = l2p.Recovery(hidden.map.at(np.zeros(len(hidden.map)))[element], np.ones(len(beta), np.float32), beta)
    perfect = replace(perfect, xyz=truth.xyz + 1e-3, element=element)
    # The rows of a recovery come in any order.
    mixed = perfect.rows(np.random.default_rng(0).permutation(len(beta)))
    l2p.save(mixed, tmp_path / "out.npz")
    again = l2p.load(tmp_path / "out.npz", l2p.Recovery)
    np.testing.assert_array_equal(again.element, mixed.element)
    scores = l2p.evaluate(again, truth)
    assert scores.lines == len(truth) and scores.spacing == truth.spacing
    assert scores.median == pytest.approx(1e-3 * np.sqrt(3)) and scores.within_spacings["1"] == 1


def test_one_row_a_line_finds_one_point_of_each_pair(scene: l2p.Scene) -> None:
    hidden = l2p.hide(scene, seed=3, scheme="pairs")
    result = l2p.recover(hidden.map, method="tomography")
    scores = l2p.evaluate(result, hidden.truth)
    assert scores.lines == 300 and scores.mean == np.inf and scores.within_spacings["5"] <= 0.5
    assert scores.as_dict()["mean"] is None, "JSON knows no infinity"
    json.loads(json.dumps(scores.as_dict(), allow_nan=False))


def test_recovered_rows_of_fakes_count_nowhere(scene: l2p.Scene) -> None:
    hidden = l2p.hide(scene, seed=3, scheme="fakes")
    result = l2p.recover(hidden.map, method="tomography")
    own = np.zeros(len(hidden.map), dtype=bool)
    own[hidden.truth.element] = True
    elsewhere = replace(result, xyz=np.where(own[:, None], result.xyz, 1e6))
    assert l2p.evaluate(elsewhere, hidden.truth) == l2p.evaluate(result, hidden.truth)
    known = l2p.evaluate(result, hidden.truth)
    assert known.fakes_auc is not None, "the confidence tells them apart, for better or worse"
    assert l2p.evaluate(result.rows(own), hidden.truth).figures == {**known.figures, "fakes_auc": None}
    np.testing.assert_allclose(
        errors(result, hidden.truth), np.linalg.norm(result.xyz[hidden.truth.element] - hidden.truth.xyz, axis=1)
    )


def test_the_command_hides_and_scores_by_any_scheme(scene: l2p.Scene, tmp_path: Path, capsys) -> None:
    np.savez(tmp_path / "scene.npz", xyz=scene.xyz)
    names = {name: str(tmp_path / f"{name}.npz") for name in ("scene", "lines", "truth", "out")}
    words = ["lift", names["scene"], "-o", names["lines"], "--truth", names["truth"], "--seed", "3"]
    assert main([*words, "--scheme", "pairs"]) == 0
    assert "150 lines of 300 points" in capsys.readouterr().out
    assert main(["recover", names["lines"], "-o", names["out"], "--method", "tomography"]) == 0
    capsys.readouterr()
    assert main(["evaluate", names["out"], names["truth"], "--json", "-"]) == 0
    figures = json.loads(capsys.readouterr().out)["all"]
    truth = l2p.load(names["truth"], l2p.Truth)
    assert figures == l2p.evaluate(l2p.load(names["out"], l2p.Recovery), truth).as_dict()


def test_a_hiding_knows_its_lines(scene: l2p.Scene) -> None:
    lines = l2p.lift(scene, seed=0)
    with pytest.raises(InputError, match="got a point behind element 300 of 300"):
        l2p.Hiding(lines, l2p.Truth(scene.xyz[:1], np.arange(1), element=np.array([300])))


def test_colours_of_a_scene_are_stored_if_asked_for(scene: l2p.Scene) -> None:
    assert scene.rgb is not None
    hidden = l2p.hide(scene, seed=0, rgb=True)
    assert hidden.map.rgb is not None
    np.testing.assert_array_equal(hidden.map.rgb, scene.rgb[hidden.truth.index])
    assert l2p.lift(scene, seed=0).rgb is None
    with pytest.raises(InputError, match="got rgb=True for points without colours"):
        l2p.hide(scene.xyz, seed=0, rgb=True)


def test_a_single_point_is_hidden() -> None:
    hidden = l2p.hide(np.ones((1, 3)), seed=0)
    assert len(hidden.map) == len(hidden.truth) == 1 and hidden.truth.spacing is None
