"""Tables, curves and figures of a run, from rows whose figures are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

pytest.importorskip("hydra", reason="the evaluation program needs the extra train: pip install 'l2p[train]'")

from eval.contenders import contenders_of
from eval.figures import draw_figures
from eval.mean_curves import pooled_calibration_error, pooled_reliability, sampled_reliability
from eval.result_tables import document, method_table, overview, tables, updated
from eval.targets import References, target_table, with_ratios
from l2p.errors import InputError
from l2p.judging.calibration import calibration_error
from l2p.judging.curves import (
    SHARES,
    THRESHOLDS,
    distribution,
    sampled_precision,
    sampled_risk,
)
from l2p.maps.recovery import Recovery

REFERENCES = References("heuristic", "LOO", frozenset({"LOO"}))


def row(method: str, scene: str = "a", **figures: Any) -> dict[str, Any]:
    """A row with every figure that tables and figures read."""
    curves = {"within": np.linspace(0, 1, len(THRESHOLDS)).tolist()}
    curves |= dict.fromkeys(("risk", "reliability", "neighbors"))
    curves |= figures.pop("curves", {})
    plain = {"scene": scene, "kind": "indoor", "fraction": 1.0, "seed": 0, "method": method, "lines": 100}
    plain |= {"median_spacings": 1.0, "within_1": 0.5, "neighbor_precision": 0.5, "under_half_outliers": 0.5}
    plain |= {"confident_half": 0.7, "calibration_error": 0.1, "seconds": 1.0}
    return {**plain, **figures, "curves": curves}


def test_medians_are_pooled_geometrically_and_seeds_give_a_spread() -> None:
    figures = {"within_1": 0.5, "neighbor_precision": None, "under_half_outliers": None, "seconds": 1.0}
    rows = [
        {"scene": scene, "seed": seed, "method": "m", "median_spacings": median * (1 + seed), **figures}
        for seed in (0, 1)
        for scene, median in (("a", 0.1), ("b", 10.0))
    ]
    # Geometric means 1 and 2 of the two seeds.
    assert method_table(rows, 1.0).body == [["m", "1.500 ± 0.707", "50.0 % ± 0.0 %", "-", "-", "1.0 ± 0.0"]]


def test_a_method_without_some_scenes_says_so() -> None:
    row = {"seed": 0, "median_spacings": 1.0, "within_1": 0.5, "seconds": 1.0}
    row |= {"neighbor_precision": None, "under_half_outliers": None}
    rows = [
        {**row, "scene": "a", "method": "m"},
        {**row, "scene": "b", "method": "n"},
        {**row, "scene": "a", "method": "n"},
    ]
    assert [line[0] for line in method_table(rows, 1.0).body] == ["m (1 of 2 scenes)", "n"]


def test_distribution_counts_errors(rng: np.random.Generator) -> None:
    error = rng.lognormal(size=200)
    assert np.array_equal(distribution(error), [(error <= limit).mean() for limit in THRESHOLDS])


def test_scenes_count_alike_in_the_pooled_calibration(rng: np.random.Generator) -> None:
    large = sampled_reliability(np.full(15000, 0.9), np.arange(15000) % 10 > 0)
    small = sampled_reliability(np.full(150, 0.5), np.arange(150) % 10 == 0)
    assert pooled_calibration_error([large]) == pytest.approx(0, abs=1e-9)
    assert pooled_calibration_error([large, small]) == pytest.approx((0 + 0.4) / 2)
    share, confidence, inside = pooled_reliability([large, small])
    assert share.sum() == pytest.approx(1)
    assert (share * confidence).sum() == pytest.approx((0.9 + 0.5) / 2)
    assert (share * inside).sum() == pytest.approx((0.9 + 0.1) / 2)


def test_what_one_scene_overstates_and_another_understates_cancels(rng: np.random.Generator) -> None:
    confidence = rng.random((2, 1500))
    bold = sampled_reliability(confidence[0], rng.random(1500) < confidence[0] - 0.2)
    shy = sampled_reliability(confidence[1], rng.random(1500) < confidence[1] + 0.2)
    assert min(pooled_calibration_error([bold]), pooled_calibration_error([shy])) > 0.15
    assert pooled_calibration_error([bold, shy]) < 0.06


@pytest.mark.parametrize("lines", [1, 7, 100, 1500, 4003])
def test_the_pooled_calibration_of_one_scene_is_its_own(lines: int, rng: np.random.Generator) -> None:
    confidence = rng.random(lines)
    inside = rng.random(lines) < confidence**2
    pooled = pooled_calibration_error([sampled_reliability(confidence, inside)])
    assert pooled == pytest.approx(calibration_error(confidence, inside), abs=1e-9 if lines % 150 == 0 else 0.03)


@pytest.mark.parametrize("lines", [1, 3, 100, 777])
def test_risk_is_sampled_at_shares_of_the_lines(lines: int, rng: np.random.Generator) -> None:
    confidence, inside = rng.random(lines), rng.random(lines) < 0.5
    order = np.argsort(-confidence)
    risk = sampled_risk(confidence, inside)
    for i in (0, 36, 49, 99):
        kept = order[: max(1, -(-(i + 1) * lines // 100))]
        assert risk[i] == pytest.approx(1 - inside[kept].mean())


def test_missing_neighbours_are_no_pairs(rng: np.random.Generator) -> None:
    neighbors = np.array([[1, 2, -1], [0, -1, -1], [0, 1, -1]])
    right = neighbors == 0
    plain = Recovery(np.zeros((3, 3)), np.ones(3, np.float32), np.zeros(3), neighbors=neighbors)
    np.testing.assert_allclose(sampled_precision(plain, right), 2 / 5)
    none = Recovery(np.zeros((3, 3)), np.ones(3, np.float32), np.zeros(3), neighbors=np.full((3, 2), -1))
    assert sampled_precision(none, np.zeros((3, 2), bool)).shape == SHARES.shape


def test_targets_are_ratios_on_the_same_line_cloud() -> None:
    sure = {"reliability": sampled_reliability(np.full(150, 0.8), np.arange(150) % 2 == 0).tolist()}
    rows = [
        row("heuristic", "a", median_spacings=1.0, neighbor_precision=0.2),
        row("heuristic", "b", median_spacings=2.0, neighbor_precision=0.4),
        row("LOO", "a", within_1=0.8),
        row("LOO", "b", within_1=0.5),
        row("mine", "a", median_spacings=0.1, within_1=0.4, neighbor_precision=0.4, calibration_error=0.3, curves=sure),
        row("mine", "b", median_spacings=0.8, within_1=0.5, neighbor_precision=0.8, calibration_error=0.4, curves=sure),
    ]
    table = target_table(rows, REFERENCES)
    assert table is not None
    assert [line[:2] for line in table.body] == [["heuristic", "100 %"], ["mine", "100 %"]], "no bounds: they know"
    found = dict(zip(table.head[2:], table.body[1][2:], strict=True))
    # Of 0.1 and 0.4 the geometric mean; of shares 1/2 and 1; both precisions are twice the heuristic's.
    assert found["median / heuristic's"] == "0.200"
    assert found["the same, worst scene"] == "0.400"
    assert found["neighbour precision / heuristic's"] == "2.000"
    assert found["share within 1 / LOO's"] == "0.707"
    assert found["scenes not below LOO"] == "50.0 %"
    assert found["calibration error"] == "0.300"
    assert found["calibration error, worst scene"] == "0.400"
    assert len(set(table.head)) == len(table.head)
    assert found["most confident half within 1"] == "70.0 %"
    assert table.body[0][table.head.index("calibration error")] == "-", "it claims none"


def test_targets_need_their_references() -> None:
    rows = [row("heuristic"), row("mine")]
    assert target_table(rows, References(None, None, frozenset())) is None
    table = target_table(rows, References("heuristic", None, frozenset()))
    assert table is not None and "share within 1 / LOO's" not in table.head and "calibration error" not in table.head
    assert target_table([row("LOO")], REFERENCES) is None
    assert with_ratios([row("mine")], REFERENCES)[0]["median_ratio"] is None
    alone = target_table([row("mine")], REFERENCES)
    assert alone is not None and set(alone.body[0][2:7]) == {"-"}


def test_references_are_the_methods_of_the_paper_and_the_bound() -> None:
    methods = [{"name": "heuristic", "fraction": 0.05, "label": "other counts"}, {"name": "tomography"}]
    assert References.of(contenders_of(methods)) == References(None, None, frozenset())
    methods += [{"name": "heuristic", "label": "paper"}, {"name": "loo"}, {"name": "oracle"}]
    assert References.of(contenders_of(methods)) == References("paper", "LOO", frozenset({"LOO", "oracle 50"}))


def test_the_overview_has_a_column_for_each_fraction() -> None:
    rows = [row("m"), row("m", fraction=0.1, median_spacings=2.345, within_1=0.126), row("n", fraction=0.1)]
    table = overview(rows, [1.0, 0.1])
    assert table.head == ["fraction of the points", "100 %", "10 %"]
    assert table.body == [["m", "1.00 / 50 %", "2.35 / 13 %"], ["n", "-", "1.00 / 50 %"]]


def test_a_table_says_what_its_spread_is() -> None:
    one, three = [row("m")], [row("m", seed=seed, median_spacings=1.0 + seed) for seed in (0, 1, 2)]
    assert "±" not in overview(one, [1.0]).title
    assert overview(three, [1.0]).title.endswith(", mean ± standard deviation of 3 seeds")
    assert overview(three, [1.0]).body == [["m", "2.00 ± 1.00 / 50 % ± 0 %"]]
    about = {"command": "python -m eval", "machine": {"processor": "x", "cores": 2}, "versions": {}}
    about["config"] = {"name": "mine", "threads": 1}
    pages = [document([{**r, "commit": "abc"} for r in rows], [], about, [], Path()) for rows in (one, three)]
    assert "Line clouds of one seed (0)." in pages[0]
    assert "the standard deviation over 3 seeds of the line clouds (0, 1, 2)" in pages[1]


def test_tables_replace_what_is_between_their_marks() -> None:
    found = tables([row("m")])
    text = "a\n<!-- eval:mine:overview -->\nold\n<!-- /eval -->\nb\n<!-- eval:mine:100% -->\n<!-- /eval -->\nc\n"
    once = updated(text, "mine", found)
    assert once is not None and "old" not in once and once.count("| m |") == 2
    assert once.startswith("a\n<!-- eval:mine:overview -->\n\n| fraction") and once.endswith("|\n\n<!-- /eval -->\nc\n")
    assert updated(once, "mine", found) == once
    assert updated(text, "other", found) is None
    with pytest.raises(InputError, match=r"got <!-- eval:mine:none -->; expected a table of overview, 100%, scenes"):
        updated("<!-- eval:mine:none -->\n<!-- /eval -->", "mine", found)
    for open_end in ("<!-- eval:mine:100% -->\n", "<!-- eval:mine:100% -->\n" + text):
        with pytest.raises(InputError, match=r"got <!-- eval:mine:100% --> without <!-- /eval --> after it"):
            updated(open_end, "mine", found)


def test_the_legend_is_in_the_figure_however_long_its_labels_are(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: seen.append(figure))
    draw_figures([row(f"a method with a long name and {k} neighbours") for k in range(6)], [])
    for figure in seen:
        figure.canvas.draw()
        legend, whole = figure.legends[0].get_window_extent(), figure.bbox
        assert whole.x0 <= legend.x0 and legend.x1 <= whole.x1 and whole.y0 <= legend.y0
        assert all(legend.y1 <= axes.get_tightbbox().y0 for axes in figure.axes)


def test_figures_are_drawn_of_what_there_is_and_alike_each_time() -> None:
    rows = [row("m"), row("n")]
    assert [drawing.name for drawing in draw_figures(rows, [])] == ["error_cdf.svg", "density.svg"]
    rows.append(row("n", scene="b", fraction=0.1, curves={"risk": SHARES.tolist()}))
    drawn = draw_figures(rows, ["n"])
    names = [drawing.name for drawing in drawn]
    assert names == [f"{name}.svg" for name in ("error_cdf", "error_sparsity", "density", "risk_coverage")]
    assert drawn == draw_figures(rows, ["n"])
    assert "error_kinds.svg" in [drawing.name for drawing in draw_figures([row("m"), row("m", kind="outdoor")], [])]
