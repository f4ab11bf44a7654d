"""The verdict of an audit and what to do about it: levels, words, and figures that are those of the audit."""

from __future__ import annotations

from dataclasses import replace

import pytest
from toy import SEES, telling_scene

import l2p
from l2p.auditing.advice import advice_of
from l2p.auditing.report import figures_of, report_page
from l2p.auditing.verdict import FEW, verdict_of
from l2p.judging.scores import Scores


@pytest.fixture(scope="module")
def found() -> l2p.Audit:
    return l2p.audit(telling_scene(FEW), [1, 0.5], method=SEES)


def told(found: l2p.Audit, within: float, half: float) -> l2p.Audit:
    """The audit with other figures."""
    trials = [
        replace(trial, scores=Scores(trial.scores.figures | {"within_1": within, "confident_half": half}))
        for trial in found.trials
        if trial.scores is not None
    ]
    return replace(found, trials=tuple(trials))


@pytest.mark.parametrize(
    ("within", "half", "level", "words"),
    [
        (0.88, 0.97, "exposed", "Exposed: an attacker gets 88 % of the points back, near where they were."),
        (0.40, 0.85, "exposed", "Exposed: an attacker gets 40 % of the points back"),
        (0.30, 0.5, "partly", "Partly exposed: an attacker gets 30 % of the points back"),
        (0.05, 0.1, "little", "Little comes back: this attack gets 5 % of the points back"),
    ],
)
def test_levels_and_words(found, within, half, level, words):
    audit = told(found, within, half)
    verdict = verdict_of(audit)
    assert verdict.level == level == figures_of(audit)["verdict"]
    assert str(verdict).replace("\N{NO-BREAK SPACE}", " ").startswith(words)
    page = report_page(audit).decode()
    assert f'<div class="lead {level}">' in page and page.index(verdict.word) < page.index("within 1 spacing")


def test_a_metric_map_and_a_part_of_it(found):
    metric = replace(told(found, 0.7, 0.9), metric=True, spacing=0.041)
    part = replace(metric, trials=metric.trials[4:])
    assert len(part.trials[0]) < FEW and verdict_of(part).level == "unknown", "too few points"
    said = str(verdict_of(metric)).replace("\N{NO-BREAK SPACE}", " ")
    assert said.endswith("gets 70 % of the points back, to within 4.1 cm of where they were.")


def test_lines_without_a_probability_have_no_verdict(found):
    lines = l2p.audit(found.trials[0].lines, method="tomography")
    assert verdict_of(lines).level == "unknown" and "nobody can tell" in str(verdict_of(lines))
    advice = advice_of(lines, verdict_of(lines), decided=False, shared=False)
    assert advice[0].what == "Audit the map itself." and not any("Leave out the place" in each.what for each in advice)


def test_advice_has_the_figures_of_the_audit(found):
    audit = told(found, 0.8, 0.9)
    advice = {each.what: each.how for each in advice_of(audit, verdict_of(audit), decided=False, shared=True)}
    fewer = advice["Publish fewer points."].replace("\N{NO-BREAK SPACE}", " ")
    assert fewer.startswith("With 100 % of the points published, 80 % of the map come back; with 50 %")
    assert "published, 40 %. Cameras are localized less well" in fewer
    assert "Leaving out" in advice["Leave out the colours and descriptors that cameras can do without."]
    assert "picture" not in advice["Leave out the place that nobody may see."], "a shared page has none"
    one = replace(audit, trials=audit.trials[3:4])
    assert "Publish fewer points." not in [
        each.what for each in advice_of(one, verdict_of(one), decided=False, shared=False)
    ]
