"""The decision: which release to choose, by what it gives away and how well cameras are localized in it."""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import shlex
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from toy import SEES

import l2p
from l2p.auditing.audit import Audit
from l2p.auditing.decision import Goal, Option, best_of, decide, parsed_goal
from l2p.auditing.tradeoff import ReleaseInputs, decision_sentences, option_table, tradeoff
from l2p.cli.main import main
from l2p.errors import InputError
from l2p.simulator import simulate_model
from l2p.utility.localization import Limit, checked_limits
from l2p.utility.releases import LocalizeConfig, queries_at

pytest.importorskip("poselib", reason="localization needs poselib: pip install 'l2p[utility]'")

CHEAP = ("--method", "tomography", "--fractions", "1", "0.5")


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("decision") / "model"
    simulate_model("room", 400, 2).save_colmap(folder)
    return folder


@pytest.fixture(scope="module")
def audit(model) -> Audit:
    """An audit of a model whose colours an attacker uses."""
    scene = l2p.load(model, l2p.Scene)
    queries = queries_at(model, scene)
    config = LocalizeConfig(most_queries=5, wrong=(0.1,))
    return l2p.audit(scene, [1, 0.5, 0.2], method=SEES, queries=queries, localizing=config, name="room")


def option(recovered: float, localized: float, position: float = 0.1, matchable: bool = True) -> Option:
    return Option("uniform", (), 1.0, recovered, recovered, recovered, localized, position, 0.1, matchable)


def test_every_release_of_the_audit_is_an_option_with_its_figures(audit):
    decision = decide(audit)
    assert decision is not None
    lines = {(each.published, each.fraction): each for each in decision.options if each.scheme != "points"}
    assert set(lines) == set(product(audit.attackers, audit.fractions))
    for trial in audit.trials:
        found = lines[trial.used, trial.fraction]
        bare = next(each for each in audit.of_attacker(()) if each.fraction == trial.fraction)
        assert (found.of_published, found.recovered) == (trial.within, trial.fraction * trial.within)
        assert found.alone == bare.fraction * bare.within
    points = [each for each in decision.options if each.scheme == "points"]
    assert [each.recovered for each in points] == list(audit.fractions)
    assert all(each.of_published == 1 for each in points)


def test_localization_does_not_depend_on_what_else_is_published(audit):
    decision = decide(audit)
    assert decision is not None
    for fraction in audit.fractions:
        same = {
            (each.localized, each.position, each.rotation)
            for each in decision.options
            if each.fraction == fraction and each.scheme != "points"
        }
        assert len(same) == 1


def test_a_release_is_dominated_if_another_is_no_worse_anywhere(rng):
    values = rng.integers(0, 4, size=(40, 3)) / 4
    options = [option(*row) for row in values]
    for one, other in product(options, options):
        mine, its = (one.recovered, -one.localized, one.position), (other.recovered, -other.localized, other.position)
        assert one.dominates(other) == (all(a <= b for a, b in zip(mine, its, strict=True)) and mine != its)
    assert not option(0.1, 1.0, matchable=False).dominates(option(0.9, 0.5))


def test_the_best_release_gives_away_least_of_those_that_localize_enough(rng):
    options = [option(*row) for row in rng.random((50, 3))]
    best = best_of(options, Goal(Limit(0.005), 0.7))
    enough = [each for each in options if each.localized >= 0.7]
    assert best is not None and best.recovered == min(each.recovered for each in enough)
    most = best_of(options, Goal(Limit(0.005), recovered=0.3))
    little = [each for each in options if each.recovered <= 0.3]
    assert most is not None and most.localized == max(each.localized for each in little)


def test_a_release_that_cannot_be_matched_is_never_the_best():
    assert best_of([option(0.1, 1.0, matchable=False)], Goal(Limit(0.005))) is None


def test_no_release_may_be_good_enough(audit):
    decision = decide(audit, Goal(Limit(1e-12), 1.0))
    assert decision is not None and decision.best is None
    headline = decision_sentences(audit, decision)[0]
    assert headline.startswith("No release that was tried would localize") and "The nearest" in headline


def test_points_as_they_are_are_never_recommended_silently(audit):
    decision = decide(audit)
    assert decision is not None
    plain = next(each for each in decision.options if each.scheme == "points")
    said = " ".join(decision_sentences(audit, replace(decision, best=plain)))
    assert "published as they are" in said
    assert "Of those that hide them" in said or "No release that hides them" in said


@pytest.mark.parametrize(
    ("localize", "recovered", "goal"),
    [
        ("0.25m,2deg=90%", None, Goal(Limit(0.25, 2, True), 0.9)),
        ("50cm, 5deg = 80%", None, Goal(Limit(0.5, 5, True), 0.8)),
        ("0.5%=0.95", None, Goal(Limit(0.005), 0.95)),
        ("1%,1deg", None, Goal(Limit(0.01, 1), 0.9)),
        (None, "20%", Goal(Limit(0.005), recovered=0.2)),
        ("1%", "0.2", Goal(Limit(0.01), recovered=0.2)),
    ],
)
def test_goals_are_parsed(localize, recovered, goal):
    assert parsed_goal(localize, recovered) == goal


@pytest.mark.parametrize(
    ("localize", "recovered", "said"),
    [
        ("near=90%", None, "got limit 'near'"),
        ("2deg=90%", None, "got limit '2deg'"),
        ("-1m=90%", None, "got limit '-1m'"),
        ("0.5%=often", None, "got --localize with the share 'often'"),
        ("0.5%=120%", None, "got --localize with the share '120%'"),
        (None, "0%", "got --recovered with the share '0%'"),
        ("0.5%=90%", "20%", "expected one share to reach, not two"),
    ],
)
def test_wrong_goals_are_refused(localize, recovered, said):
    with pytest.raises(InputError, match=said.replace("(", "\\(")):
        parsed_goal(localize, recovered)


def test_metres_need_a_metric_map(audit):
    with pytest.raises(InputError, match="whose unit is not known"):
        decide(audit, Goal(Limit(0.25, 2, True)))
    checked_limits([Limit(0.25, 2, True)], metric=True)


def test_the_table_file_and_the_json_have_the_same_figures(audit):
    decision = decide(audit)
    assert decision is not None
    rows = list(csv.DictReader(io.StringIO(base64.b64decode(tradeoff(audit, decision).csv).decode())))
    plain = decision.as_dict()["releases"]
    assert len(rows) == len(plain) == len(option_table(audit, decision)[1])
    for row, one in zip(rows, plain, strict=True):
        assert float(row["recovered_of_map"]) == one["recovered"]
        assert float(row["localized"]) == one["localized"]
        assert bool(int(row["best"])) == one["best"]
    json.dumps(plain)


def test_marks_of_the_charts_say_their_figures(audit):
    decision = decide(audit)
    assert decision is not None
    seen = [each for each in decision.options if math.isfinite(each.position)]
    for chart in tradeoff(audit, decision).charts:
        assert chart.svg.count("<title>") >= len(seen)


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_the_command_tells_and_writes_the_decision(model, tmp_path, capsys):
    assert run("audit", model, "-o", tmp_path / "report", *CHEAP, "--queries", 4, "--localize", "1%=50%") == 0
    told = capsys.readouterr().out
    assert "releases of the map" in told and "localize 50" in told
    figures = json.loads((tmp_path / "report" / "audit.json").read_text())
    assert figures["decision"]["goal"] == {"limit": "1 %", "localized": 0.5, "recovered": None}
    assert figures["localization"]["queries"] == 4
    assert "--localize 1%=50% " in figures["command"] + " " and "--queries 4" in figures["command"]


def test_the_command_of_every_release_makes_it(model, audit, tmp_path, capsys):
    decision = decide(audit)
    assert decision is not None
    for row in [row for _, rows in tradeoff(audit, decision, ReleaseInputs(scene=str(model))).groups for row in rows]:
        program, *words = shlex.split(row.command)
        output = tmp_path / f"{len(list(tmp_path.iterdir()))}.npz"
        words[words.index("-o") + 1] = str(output)
        assert program == "l2p" and main(words) == 0
        with np.load(output) as made:
            name = "xyz" if "points" in words else "direction"
            assert len(made[name]) == round(float(words[words.index("--fraction") + 1]) * audit.points)
            assert ("rgb" in made) == ("--rgb" in words)
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--localize", "0.25m,2deg=90%"), "--metric"),
        (("--queries", "-1"), "got --queries -1"),
        (("--queries", "0", "--recovered", "10%"), "--queries 0"),
        (("--wrong", "1"), "wrong matches"),
        (("--localize", "5"), "got limit '5'"),
    ],
)
def test_wrong_flags_are_refused(model, tmp_path, capsys, words, said):
    assert run("audit", model, "-o", tmp_path / "report", *CHEAP, *words) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1
    assert not (tmp_path / "report").exists()


def test_a_goal_needs_a_model_with_images(tmp_path, capsys):
    np.savez(tmp_path / "scene.npz", xyz=l2p.simulate("room", 300).xyz)
    assert run("audit", tmp_path / "scene.npz", "-o", tmp_path / "report", *CHEAP, "--recovered", "10%") == 2
    assert "only a COLMAP model" in capsys.readouterr().err


def test_without_poselib_the_page_says_so(model, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "poselib", None)
    assert run("audit", model, "-o", tmp_path / "report", *CHEAP) == 0
    page = (tmp_path / "report" / "index.html").read_text()
    assert "l2p[utility]" in page and 'id="decision"' not in page
    assert run("audit", model, "-o", tmp_path / "other", *CHEAP, "--recovered", "10%") == 2
    assert "poselib" in capsys.readouterr().err
