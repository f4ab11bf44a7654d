"""Attackers of an audit: who is tried, in which order, on which lines, and what the page says of each."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from toy import SEES, Sees, telling_scene

import l2p
from l2p.auditing import report
from l2p.auditing.attackers import attackers_of
from l2p.auditing.charts import charts
from l2p.auditing.words import alone, headline, savings, sentences, sparser
from l2p.judging.scores import Scores
from l2p.maps.appearance import Appearance
from l2p.show.page.view import view_data

BOTH, DESCRIPTOR, RGB, ALONE = ("rgb", "descriptor"), ("descriptor",), ("rgb",), ()
ALL = (BOTH, DESCRIPTOR, RGB, ALONE)


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    return telling_scene()


@pytest.fixture(scope="module")
def found(scene: l2p.Scene) -> l2p.Audit:
    return l2p.audit(scene, [0.3, 1], seed=2, method=SEES)


@pytest.fixture(scope="module")
def blind(scene: l2p.Scene) -> l2p.Audit:
    """Of a line cloud."""
    return l2p.audit(l2p.lift(scene, seed=2, rgb=True, descriptor=True), method=SEES)


def plain(sentence: str) -> str:
    return sentence.replace("\N{NO-BREAK SPACE}", " ")


def test_every_attacker_is_tried_from_the_one_who_knows_all_to_lines_alone(found: l2p.Audit) -> None:
    assert [(trial.fraction, trial.used) for trial in found.trials] == [(f, used) for f in (1.0, 0.3) for used in ALL]
    assert all(trial.recovery.info["used"] == list(trial.used) for trial in found.trials)
    assert found.attackers == ALL and found.fractions == (1.0, 0.3)
    assert [trial.fraction for trial in found.strongest] == [1.0, 0.3]


def test_all_attackers_attack_the_same_lines(scene: l2p.Scene, found: l2p.Audit) -> None:
    for fraction in found.fractions:
        trials = [trial for trial in found.trials if trial.fraction == fraction]
        lines = l2p.lift(scene.xyz, seed=2, fraction=fraction)
        for trial in trials:
            assert trial.lines is trials[0].lines and trial.truth is trials[0].truth
            np.testing.assert_array_equal(trial.lines.moment, lines.moment)
            assert trial.lines.appearance.names == ()
            on_line = np.cross(trial.recovery.xyz, lines.direction)
            np.testing.assert_allclose(on_line, lines.moment, atol=1e-6)


def test_who_sees_more_recovers_more(found: l2p.Audit, scene: l2p.Scene) -> None:
    for fraction in found.fractions:
        shares = [
            trial.scores.within_spacings["1"] for trial in found.trials if trial.fraction == fraction and trial.scores
        ]
        assert len(shares) == len(found.attackers)
        assert shares == sorted(shares, reverse=True) and shares[0] > shares[-1]
    only = l2p.audit(replace(scene, descriptor=None, descriptor_kind=None), [1], seed=2, method=SEES)
    assert [trial.scores for trial in only.trials] == [found.without(DESCRIPTOR).scores, found.trials[3].scores]


@pytest.mark.parametrize(
    ("ignore", "expected"),
    [((), ALL), (RGB, (DESCRIPTOR, ALONE)), (DESCRIPTOR, (RGB, ALONE)), (["descriptor", "rgb"], (ALONE,))],
)
def test_ignored_attributes_are_used_by_nobody(scene: l2p.Scene, ignore: tuple, expected: tuple) -> None:
    for given in (scene, l2p.lift(scene, seed=0, rgb=True, descriptor=True)):
        found = l2p.audit(given, None if given is not scene else [0.3], method=SEES, ignore=ignore)
        assert found.attackers == expected
        assert found.published == expected[0] and set(found.ignored) == set(ignore)
        assert found.trials[0].rgb is not None, "for pictures"


def test_attributes_to_ignore_are_checked(scene: l2p.Scene) -> None:
    with pytest.raises(l2p.InputError, match="got attribute 'colour' to leave out; expected some of rgb, descriptor"):
        l2p.audit(scene, [1], method=SEES, ignore=["colour"])


def test_a_method_or_a_map_without_attributes_has_one_attacker(scene: l2p.Scene) -> None:
    for given, method in ((scene, "tomography"), (scene.xyz, SEES)):
        found = l2p.audit(given, [1, 0.5], method=method)
        assert found.attackers == (ALONE,)
        assert alone(found) == savings(found) == "" and "With the" not in headline(found)
        page = report.report_page(found).decode()
        assert "The attack saw the lines and nothing else" in page
        assert "By fraction of the points</h3>" in page and "Attacker sees" not in page
        assert ("Nobody used the descriptors" in page) == (given is scene)


def test_attackers_are_those_that_the_attack_tells_apart() -> None:
    class OnlySift(Sees):
        def uses(self, appearance: Appearance) -> tuple[str, ...]:
            return tuple(name for name in appearance.names if name == "rgb" or appearance.descriptor_kind == "sift")

    class Claims(Sees):
        def uses(self, appearance: Appearance) -> tuple[str, ...]:
            return ("descriptor", "rgb")

    rgb, descriptor = np.zeros((2, 3), np.uint8), np.zeros((2, 4), np.float32)
    assert attackers_of(OnlySift(), Appearance(rgb, descriptor, "orb")) == (RGB, ALONE)
    assert attackers_of(OnlySift(), Appearance(rgb, descriptor, "sift")) == ALL
    assert attackers_of(Claims(), Appearance(rgb)) == (RGB, ALONE), "nobody uses what is not there"


def told(found: l2p.Audit, shares: dict[tuple[str, ...], float]) -> l2p.Audit:
    """The audit with other shares of right points, at all fractions."""
    trials = []
    for trial in found.trials:
        within = shares[trial.used]
        if trial.scores is not None:
            scores = Scores(trial.scores.figures | {"within_1": within, "confident_half": within})
            trials.append(replace(trial, scores=scores))
        else:
            assert trial.prediction is not None
            trials.append(replace(trial, prediction=replace(trial.prediction, within_spacing=within)))
    return replace(found, trials=tuple(trials))


def test_the_headline_is_that_of_the_attacker_who_uses_all(found: l2p.Audit, blind: l2p.Audit) -> None:
    shares = {BOTH: 0.89, DESCRIPTOR: 0.86, RGB: 0.75, ALONE: 0.71}
    audit = told(found, shares)
    assert plain(headline(audit)).startswith(
        "With the colours and descriptors beside the lines, 89 % of the points are recovered within 1 spacing ("
    )
    assert plain(alone(audit)) == "From the lines alone, 71 % would be recovered."
    assert savings(audit) == (
        "Leaving out the descriptors would save 14 of 100 points; cameras are then no longer localized by them. "
        "Leaving out the colours would save 3 of 100 points. Leaving out both would save 18 of 100 points."
    )
    assert plain(sparser(audit)).endswith(
        "89 % of these are recovered within 1 spacing, and 71 % from the lines alone."
    )
    expected = told(blind, shares)
    assert "beside the lines, about 89 % of the points are expected to be recovered" in plain(headline(expected))
    assert plain(alone(expected)) == "From the lines alone, 71 % would be expected."
    assert "Leaving out the colours would save about 3 of 100 points." in savings(expected)


def test_with_one_attribute_nothing_is_said_of_the_other(found: l2p.Audit) -> None:
    shares = {RGB: 0.75, DESCRIPTOR: 0.86, ALONE: 0.71}
    for used, words in (
        (RGB, "Leaving out the colours would save 4 of 100 points."),
        (
            DESCRIPTOR,
            "Leaving out the descriptors would save 15 of 100 points; cameras are then no longer localized by them.",
        ),
    ):
        audit = told(
            replace(found, trials=tuple(trial for trial in found.trials if trial.used in (used, ALONE))), shares
        )
        assert savings(audit) == words
        assert headline(audit).startswith(f"With the {'colours' if used == RGB else 'descriptors'} beside the lines, ")


def test_an_attacker_who_is_misled_is_told_honestly(found: l2p.Audit, blind: l2p.Audit) -> None:
    shares = {BOTH: 0.70, DESCRIPTOR: 0.698, RGB: 0.72, ALONE: 0.74}
    assert plain(alone(told(found, shares))) == (
        "From the lines alone, it would be more, 74 %: what is published beside them misleads this attack, and an "
        "attacker can ignore it."
    )
    assert savings(told(found, shares)) == (
        "Leaving out the descriptors would save nothing, as this attack recovers 2 of 100 points more without them; "
        "cameras are then no longer localized by them. Leaving out the colours would save hardly any point. "
        "Leaving out both would save nothing, as this attack recovers 4 of 100 points more without them."
    )
    assert "this attack expects 2 of 100 points more" in savings(told(blind, shares))
    same = dict.fromkeys(ALL, 0.7)
    assert alone(told(found, same)) == "From the lines alone, it would be about as many."
    assert savings(told(found, same)).count("would save hardly any point") == 3


@pytest.mark.parametrize("shares", [(1, 1, 1, 1), (0, 0, 0, 0), (1, 0, 1, 0), (0, 1, 0, 1), (0.996, 0.994, 0.005, 0)])
def test_savings_are_never_negative(found: l2p.Audit, blind: l2p.Audit, shares: tuple) -> None:
    for audit in (found, blind):
        words = sentences(told(audit, dict(zip(ALL, map(float, shares), strict=True))))
        assert all(words) and not any("-" in sentence for sentence in words)


def test_the_sentence_and_the_percents_agree(found: l2p.Audit) -> None:
    shares = {BOTH: 0.884, DESCRIPTOR: 0.8, RGB: 0.8, ALONE: 0.706}
    audit = told(found, shares)
    assert "88 %" in plain(headline(audit)) and "71 %" in plain(alone(audit))
    assert "both would save 17 of 100" in savings(audit)


def test_a_confidence_that_only_ranks_compares_nothing(blind: l2p.Audit) -> None:
    trials = tuple(replace(trial, prediction=None) for trial in blind.trials)
    audit = replace(blind, trials=trials)
    assert alone(audit) == savings(audit) == ""
    assert "not known" in headline(audit)


def test_tables_have_a_row_for_each_attacker_in_groups_of_a_fraction(found: l2p.Audit, blind: l2p.Audit) -> None:
    sees = ["lines + colours + descriptors", "lines + descriptors", "lines + colours", "lines"]
    tables = report._tables(replace(found, metric=True))
    assert len(tables) == 2
    for table in tables:
        assert [plain(group.heading) for group in table.groups] == [f"{n} % of the points published" for n in (100, 30)]
        assert all([row[0] for row in group.rows] == sees for group in table.groups)
        assert all(len(row) == table.columns for row in table.rows)
    (expected,) = report._tables(blind)
    assert [row[0] for row in expected.rows] == sees and expected.groups[0].heading == ""
    assert all(len(row) == expected.columns for row in expected.rows)


def test_charts_compare_the_attackers(found: l2p.Audit, blind: l2p.Audit) -> None:
    drawn = charts(found)
    assert [chart.heading for chart in drawn[:2]] == [
        "How much do colours and descriptors give away?",
        "How much does a thinner map give away?",
    ]
    assert len(drawn) == 5
    for chart in drawn[:2]:
        assert all(f">{label}</text>" in chart.svg for label in ("lines", "lines + colours + descriptors"))
    assert all("The attacker sees lines + colours + descriptors." in chart.caption for chart in drawn[2:])
    assert len(charts(replace(found, trials=found.trials[:4]))) == 4, "one fraction"
    (expected,) = charts(blind)
    assert ">lines + colours</text>" in expected.svg


def test_points_and_lines_are_stored_once_for_all_attackers(found: l2p.Audit) -> None:
    exhibits = [(str(trial.fraction), report._exhibit(trial, found)) for trial in found.trials]
    clouds = view_data(exhibits)["clouds"]
    for layer in ("points", "lines", "rgb"):
        assert [cloud[layer] for cloud in clouds[1:4]] == [0, 0, 0]
        assert [cloud[layer] for cloud in clouds[5:]] == [4, 4, 4]
        assert isinstance(clouds[0][layer], str) and isinstance(clouds[4][layer], str)
    assert len({cloud["recovered"] for cloud in clouds}) == 8


def test_figures_say_who_used_what(found: l2p.Audit, blind: l2p.Audit) -> None:
    for audit in (found, blind):
        figures = json.loads(json.dumps(report.figures_of(audit), allow_nan=False))
        assert figures["version"] == 5 and figures["published"] == list(BOTH) and figures["ignored"] == []
        assert [tuple(trial["used"]) for trial in figures["trials"]] == [trial.used for trial in audit.trials]
        assert all(trial["attack"]["used"] == trial["used"] for trial in figures["trials"])


def test_the_page_says_what_the_attackers_saw(found: l2p.Audit, scene: l2p.Scene) -> None:
    page = " ".join(report.report_page(found).decode().split())
    for words in (
        *(" ".join(sentence.split()) for sentence in sentences(found)[1:]),
        "The strongest attacker saw the lines, and the colours and descriptors of their points",
        "<dt>Published beside the lines</dt><dd>colours and descriptors</dd>",
    ):
        assert words in page
    assert "--descriptors" not in page and "nothing else" not in page
    coloured = replace(scene, descriptor=None, descriptor_kind=None)
    assert "--descriptors" in report.report_page(l2p.audit(coloured, [1], method=SEES)).decode()
    ignoring = report.report_page(l2p.audit(scene, [1], method=SEES, ignore=["descriptor"])).decode()
    assert "--descriptors" not in ignoring and "<dt>Ignored on request</dt><dd>descriptors</dd>" in ignoring
