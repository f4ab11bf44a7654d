"""A figure of merit is declared once: it appears in every table, page, CSV and JSON without another edit."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import l2p
from l2p.auditing.report import report_page
from l2p.cli.main import main
from l2p.judging import measure
from l2p.judging.measure import MEASURES, Figure, Form, Measure, Need, figures


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    """A measure with one figure: the greatest error."""
    worst = Figure("worst", "worst error (spacings)", Form.SPACINGS, max, compared="worst (spacings)")
    made = Measure((worst,), lambda outcome: {"worst": float(outcome.spacings.max())})
    monkeypatch.setattr(measure, "MEASURES", (*MEASURES, made))


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    return l2p.simulate("room", points=120, seed=0)


@pytest.mark.usefixtures("toy")
def test_a_new_figure_appears_in_evaluate_and_audit(scene: l2p.Scene, tmp_path: Path, capsys) -> None:
    np.savez(tmp_path / "scene.npz", xyz=scene.xyz)
    scene_file, lines, truth, out = (str(tmp_path / f"{name}.npz") for name in ("scene", "lines", "truth", "out"))
    assert main(["lift", scene_file, "-o", lines, "--truth", truth, "--seed", "0"]) == 0
    assert main(["recover", lines, "-o", out, "--method", "tomography"]) == 0
    assert main(["evaluate", out, truth, "--json", str(tmp_path / "figures.json")]) == 0
    worst = json.loads((tmp_path / "figures.json").read_text())["all"]["worst"]
    assert worst == l2p.evaluate(l2p.load(out, l2p.Recovery), l2p.load(truth, l2p.Truth)).worst > 0
    assert re.search(rf"worst error \(spacings\) +│ {worst:.3f}", capsys.readouterr().out)
    words = ["audit", scene_file, "-o", str(tmp_path / "report"), "--fractions", "1", "--method", "tomography"]
    assert main(words) == 0
    assert re.search(rf"worst error \(spacings\) +│ {worst:.3f}", capsys.readouterr().out)
    assert json.loads((tmp_path / "report" / "audit.json").read_text())["trials"][0]["scores"]["worst"] == worst
    page = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    assert "Worst error (spacings)" in page and f"<td>{worst:.2f}</td>" in page


@pytest.mark.usefixtures("toy")
def test_a_new_figure_appears_in_eval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    pytest.importorskip("hydra", reason="the evaluation program needs the extra train: pip install 'l2p[train]'")
    from hydra import compose, initialize_config_dir

    from eval.eval_config import CONFIGS, settings_of
    from eval.evaluation import evaluate_all

    monkeypatch.setattr("eval.evaluation.draw_figures", lambda rows, knowing: [])
    keys = ["scenes=[sim:room:120:0]", "fractions=[1.0]", "threads=1", "methods=[{name: oracle, k: 10}]"]
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        settings = settings_of(compose("eval", keys))
    assert evaluate_all(settings, tmp_path, "python -m eval") == 0
    with (tmp_path / "results.csv").open(newline="") as file:
        row = next(csv.DictReader(file))
    assert float(row["worst"]) > float(row["median_spacings"])
    assert "worst (spacings)" in (tmp_path / "results.md").read_text()
    monkeypatch.undo()
    assert evaluate_all(settings, tmp_path, "python -m eval") == 0
    assert "worst" not in (tmp_path / "results.csv").read_text(), "old rows are scored again"


def test_figures_have_names_of_their_own() -> None:
    names = [figure.name for figure in figures()]
    assert len(set(names)) == len(names)


def recovery_of(truth: np.ndarray, **columns: object) -> l2p.Recovery:
    columns = {"confidence": np.linspace(0, 1, len(truth), dtype=np.float32), **columns}
    return l2p.Recovery(truth + 0.01, beta=np.zeros(len(truth)), **columns)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("need", "without", "enough"),
    [
        (Need.CALIBRATED, {}, {"calibrated": True}),
        (Need.RANKS, {"confidence": np.ones(60, dtype=np.float32)}, {}),
        (Need.NEIGHBORS, {}, {"neighbors": np.zeros((60, 1), dtype=np.int64)}),
        (Need.NEIGHBORS, {"neighbors": np.zeros((60, 1), dtype=np.int64), "element": np.arange(60)[::-1]}, None),
        (Need.METRIC, {}, None),
    ],
)
def test_nothing_is_made_up(need: Need, without: dict, enough: dict | None, rng: np.random.Generator) -> None:
    truth = rng.normal(size=(60, 3))
    own = [figure.name for figure in figures() if figure.need is need]
    behind = l2p.Truth(truth, np.arange(60))
    scores = l2p.evaluate(recovery_of(truth, **without), behind)
    assert own and all(scores.figures[name] is None for name in own)
    if enough is not None:
        found = l2p.evaluate(recovery_of(truth, **enough), behind)
        assert any(found.figures[name] is not None for name in own)


def test_names_of_figures_are_attributes(rng: np.random.Generator) -> None:
    truth = rng.normal(size=(60, 3))
    scores = l2p.evaluate(recovery_of(truth), truth, metric=True)
    assert all(getattr(scores, figure.name) == scores.figures[figure.name] for figure in figures())
    assert list(scores.within_spacings) == ["0.25", "0.5", "1", "2", "5"] and scores.within_cm["5"] == 1
    with pytest.raises(AttributeError, match="scores have no figure 'best'"):
        scores.best  # noqa: B018


def test_a_page_leaves_out_columns_that_no_trial_has(scene: l2p.Scene, tiny_checkpoint: Path) -> None:
    audits: dict[str, Callable[[], l2p.Audit]] = {
        "tomography": lambda: l2p.audit(scene, [1], method="tomography", metric=True),
        "learned": lambda: l2p.audit(scene, [1], checkpoint=tiny_checkpoint),
    }
    pages = {name: report_page(audit()).decode() for name, audit in audits.items()}
    for heading, own in {
        "as predicted": "learned",
        "Calibration error": "learned",
        "Recovered within … cm": "tomography",
    }.items():
        assert {name for name, page in pages.items() if f">{heading}</th>" in page} == {own}
