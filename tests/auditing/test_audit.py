"""The audit: what is lifted and scored, what is predicted, its curves, its words, and the folder it is written to."""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

import l2p
from l2p.auditing import FRACTIONS, report
from l2p.auditing.scheme_comparison import comparison_table
from l2p.auditing.words import headline, sparser, typical, unexpected
from l2p.judging.accuracy import spacing
from l2p.judging.calibration import BINS
from l2p.judging.curves import SHARES, THRESHOLDS
from l2p.judging.scores import Scores
from l2p.show.page.numbers import length

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&amp;"


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    return l2p.simulate("room", points=500, seed=1)


@pytest.fixture(scope="module")
def found(scene, tiny_checkpoint) -> l2p.Audit:
    return l2p.audit(scene, fractions=[0.2, 1, 0.2], seed=4, checkpoint=tiny_checkpoint, name=HOSTILE)


@pytest.fixture(scope="module")
def blind(scene, tiny_checkpoint) -> l2p.Audit:
    """Of a line cloud."""
    return l2p.audit(l2p.lift(scene.xyz, seed=4), checkpoint=tiny_checkpoint)


def test_each_fraction_is_attacked_once_from_the_largest_to_the_smallest(found):
    assert [(trial.fraction, len(trial)) for trial in found.trials] == [(1.0, 500), (0.2, 100)]
    assert found.points == 500


def test_lines_are_those_of_the_seed_and_scores_those_of_the_true_points(scene, found):
    for trial in found.trials:
        hidden = l2p.hide(scene.xyz, seed=4, fraction=trial.fraction)
        lines, index = hidden.map, hidden.truth.index
        np.testing.assert_array_equal(trial.lines.moment, lines.moment)
        assert trial.scores == l2p.evaluate(trial.recovery, scene.xyz[index], spacing(scene.xyz))


def test_the_attack_knows_the_fraction(found):
    for trial in found.trials:
        assert trial.recovery.info["settings"]["fraction"] == trial.fraction


def test_points_alone_give_the_same_figures(scene):
    audits = [l2p.audit(given, [0.5], method="tomography") for given in (scene, scene.xyz)]
    assert audits[0].trials[0].scores == audits[1].trials[0].scores
    assert audits[0].trials[0].rgb is not None and audits[1].trials[0].rgb is None


def test_another_seed_gives_other_figures(scene):
    audits = [l2p.audit(scene, [0.5], seed, method="tomography") for seed in (0, 0, 1)]
    scores = [each.trials[0].scores for each in audits]
    assert scores[0] == scores[1] != scores[2]


def test_every_method_can_be_audited(scene):
    for method in ("tomography", "heuristic"):
        trial = l2p.audit(scene.xyz[:150], [1], method=method).trials[0]
        assert trial.recovery.info["method"] == method
        assert trial.prediction is None and not trial.curves.claimed


def test_progress_counts_the_lines(scene):
    class Counting:
        def __init__(self):
            self.tasks = {}

        @contextmanager
        def task(self, name, total):
            done = self.tasks.setdefault(name, [])
            yield done.append
            assert name != "lines of 2 attacks" or sum(done) == total

    progress = Counting()
    l2p.audit(scene, [1, 0.1], method="tomography", progress=progress)
    assert progress.tasks["lines of 2 attacks"] == [50, 500]
    assert len(progress.tasks) > 1, "the attack shows its own progress"


@pytest.mark.parametrize("fractions", [[0.5, 0], [1.5], [float("nan")], []])
def test_fractions_out_of_range_are_refused(scene, fractions):
    with pytest.raises(l2p.InputError, match=r"a number in \(0, 1\]"):
        l2p.audit(scene, fractions, method="tomography")


def test_a_scene_without_extent_is_refused():
    with pytest.raises(l2p.InputError, match="without extent"):
        l2p.audit(np.zeros((60, 3)), method="tomography")


def test_a_few_points_are_enough():
    few = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    found = l2p.audit(few, method="tomography")
    assert [len(trial) for trial in found.trials] == [5, 2, 1, 1, 1]
    assert len(found.trials) == len(FRACTIONS)
    report.report_page(found)


def test_of_a_line_cloud_the_confidence_predicts(blind, scene):
    trial = blind.trials[0]
    assert not blind.known and trial.scores is None and trial.truth is None
    assert trial.prediction is not None
    confidence = trial.recovery.confidence.astype(float)
    assert trial.prediction.within_spacing == pytest.approx(confidence.mean())
    assert trial.prediction.confident_half == pytest.approx(np.sort(confidence)[250:].mean())
    assert trial.curves.risk[-1] == pytest.approx(1 - confidence.mean())
    assert not trial.curves.within and not trial.curves.right


def test_the_spacing_of_a_line_cloud_is_near_the_true_one(scene):
    blind = l2p.audit(l2p.lift(scene.xyz, seed=4), method="tomography")
    assert blind.spacing == pytest.approx(spacing(scene.xyz), rel=0.3)


def test_a_line_cloud_is_attacked_as_it_is(scene):
    with pytest.raises(l2p.InputError, match="attacked as it is"):
        l2p.audit(l2p.lift(scene.xyz), [1])


def test_curves_agree_with_the_scores(found):
    for trial in found.trials:
        curves, scores = trial.curves, trial.scores
        assert np.all(np.diff(curves.within) >= 0) and len(curves.within) == len(THRESHOLDS)
        below, above = np.searchsorted(THRESHOLDS, 1) - 1, np.searchsorted(THRESHOLDS, 1)
        assert curves.within[below] <= scores.within_spacings["1"] <= curves.within[above]
        assert curves.risk[-1] == pytest.approx(1 - scores.within_spacings["1"])
        assert curves.risk[np.searchsorted(SHARES, 0.5)] == pytest.approx(1 - scores.confident_half)
        assert np.all(np.diff(curves.claimed) >= 0)
        size = [len(part) for part in np.array_split(np.arange(len(trial)), BINS)]
        assert np.average(curves.right, weights=size) == pytest.approx(scores.within_spacings["1"])


def test_figures_are_plain_and_complete(found):
    figures = json.loads(json.dumps(report.figures_of(found, "l2p audit x"), allow_nan=False))
    assert {"seed", "method", "versions", "machine", "spacing", "command", "thresholds", "coverage"} <= set(figures)
    assert figures["versions"]["l2p"] == l2p.__version__
    for trial, part in zip(found.trials, figures["trials"], strict=True):
        assert part["scores"] == trial.scores.as_dict()
        assert part["attack"]["settings"]["digest"]
        assert part["attack"]["seconds"] > 0


def told(found: l2p.Audit, within: float, half: float | None) -> l2p.Audit:
    """The audit with other figures."""
    trials = [
        replace(trial, scores=Scores(trial.scores.figures | {"within_1": within, "confident_half": half}))
        for trial in found.trials
        if trial.scores is not None
    ]
    return replace(found, trials=tuple(trials))


@pytest.mark.parametrize(
    ("within", "half", "words"),
    [
        (0.62, 0.93, "the attacker knows which: the most confident half is right 93 % of the time."),
        (0.62, 0.70, "the attacker has some idea which: the most confident half is right 70 % of the time."),
        (0.62, 0.62, "the attacker can hardly tell which: the most confident half is right only 62 % of the time."),
        (1.0, 1.0, "the attacker knows which: the most confident half is right 100 % of the time."),
    ],
)
def test_headline_says_the_figures_in_plain_words(found, within, half, words):
    metric = replace(told(found, within, half), metric=True, spacing=0.041)
    sentence = headline(metric).replace("\N{NO-BREAK SPACE}", " ")
    assert sentence == f"{100 * within:.0f} % of the points are recovered within 1 spacing (4.1 cm); {words}"
    assert "scene units" in headline(replace(metric, metric=False))
    assert headline(told(metric, within, None)).endswith("recovered within 1 spacing (4.1\N{NO-BREAK SPACE}cm).")


def test_a_map_in_metres_tells_what_is_typical(found):
    metric = replace(found, metric=True)
    median = found.trials[0].scores.median
    assert typical(metric) == f"Half of the points come out within {length(median, True)} of their true place."
    assert typical(metric) in report.report_page(metric).decode()
    assert typical(found) == ""


def test_headings_of_a_table_cover_its_columns(found, blind, scene):
    few = scene.xyz[:60]
    ranked = [l2p.audit(given, method="tomography", metric=True) for given in (few, l2p.lift(few, seed=0))]
    for audit in (found, blind, *ranked):
        for table in report._tables(audit):
            assert all(len(row) == sum(len(head.under) or 1 for head in table.heads) for row in table.rows)


def test_a_headline_of_a_part_of_the_map_says_so(found):
    part = replace(found, trials=found.trials[1:])
    assert "published points (20\N{NO-BREAK SPACE}% of the map)" in headline(part)
    assert sparser(part) == ""
    assert "(100 lines)" in sparser(found)


def test_a_headline_without_truth_is_a_prediction_or_none(blind, scene):
    assert "are expected to be recovered" in headline(blind)
    ranked = l2p.audit(l2p.lift(scene.xyz, seed=4), method="tomography")
    assert "not known" in headline(ranked)
    page = report.report_page(ranked).decode()
    assert "only ranks points" in page and "Neither measured nor predicted" in page
    for word in ("A prediction", "Predicted", "The prediction holds", "mean confidence"):
        assert word not in page, "there is none"


@pytest.mark.parametrize("centers", [1, 2])
def test_a_report_on_other_than_uniform_lines_states_no_probability(centers, scene, tiny_checkpoint):
    center = np.array([[0.0, 0, 0], [1, 1, 0]])[np.arange(500) % centers]
    rays = l2p.audit(l2p.LineCloud.through(scene.xyz, scene.xyz - center), checkpoint=tiny_checkpoint)
    said = unexpected(rays)
    assert said.startswith("All 500 lines pass through one") and "No probability is stated" in said
    assert not rays.calibrated and not rays.recognised["expected"] and "not known" in headline(rays)
    trial = rays.as_dict()["trials"][0]
    assert trial["prediction"] is None and not trial["curves"]["risk"]
    page = report.report_page(rays).decode()
    assert said in page and "Neither measured nor predicted" in page and "may be wrong throughout" in page
    for word in (
        "A prediction",
        "Predicted",
        "The prediction holds",
        "mean confidence",
        "estimated)",
        "gives a prediction",
    ):
        assert word not in page, "no share is stated"


def test_uniform_lines_need_no_warning(found, blind):
    assert unexpected(found) == unexpected(blind) == ""


def test_the_report_is_a_page_and_its_figures(found, tmp_path):
    l2p.save_report(found, tmp_path / "report", command="l2p audit x")
    assert {path.name for path in (tmp_path / "report").iterdir()} == set(report.FILES)
    assert json.loads((tmp_path / "report" / report.FIGURES).read_text())["command"] == "l2p audit x"
    with pytest.raises(l2p.InputError, match="exists"):
        l2p.save_report(found, tmp_path / "report")
    l2p.save_report(found, tmp_path / "report", overwrite=True)


def test_a_folder_with_anything_else_is_never_replaced(found, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(l2p.InputError, match="did not write"):
        l2p.save_report(found, tmp_path, overwrite=True)


def test_a_report_is_whole_or_absent(found, tmp_path, monkeypatch):
    def broken(*words):
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "report_page", broken)
    with pytest.raises(KeyboardInterrupt):
        l2p.save_report(found, tmp_path / "report")
    assert list(tmp_path.iterdir()) == []


def test_names_and_commands_are_escaped(found):
    page = report.report_page(found, command=HOSTILE).decode()
    assert "<img" not in page and "onerror=alert(1)&gt;" in page
    assert page.count("</script>") == 2, "the data and the program"


def test_the_page_names_what_was_run(found, blind):
    page = report.report_page(found).decode()
    digest = found.trials[0].recovery.info["settings"]["digest"]
    for words in (digest, "tiny.safetensors", f"l2p {l2p.__version__}", "Chelani", "<dd>4</dd>"):
        assert words in page
    assert "Seed of the line clouds" not in report.report_page(blind).decode()


def test_the_page_has_no_links(found):
    page = report.report_page(replace(found, name="map")).decode()
    named = {word for word in page.split('"') if "://" in word}
    assert all(word.startswith("http://www.w3.org/") for word in named), "names of SVG, which nobody loads"
    assert " src=" not in page and "@import" not in page and "url(http" not in page


def test_large_clouds_are_thinned_and_the_page_says_so(found):
    whole, thinned = (report.report_page(found, None, most).decode() for most in (500, 50))
    assert "The picture shows" not in whole.split("<script")[0]
    assert "The picture shows at most 50 points of each cloud" in thinned
    assert len(thinned) < len(whole)


def test_an_audit_of_a_sphere_cloud_says_that_nothing_tells_the_depth(scene, tmp_path):
    found = l2p.audit(l2p.lift(scene, seed=0, scheme="sphere-50"))
    assert found.recognised["kind"] == "one centre" and not found.calibrated
    l2p.save_report(found, tmp_path / "report")
    assert "lines pass through one point. No probability is stated" in (tmp_path / "report/index.html").read_text()


def test_what_no_attack_was_made_for_is_said(scene):
    few = l2p.Scene(scene.xyz[:100])
    found = l2p.audit(few, method="tomography", fractions=[1.0], schemes=["decoys", "spread-votes"])
    assert found.others is not None
    assert [trial.scheme for trial in found.others.trials] == ["decoys", "spread-votes"]
    assert found.others.trials[0].both is None, "a line hides one point, though two places are looked for"
    note = comparison_table(found, found.others).note
    assert note.endswith("No attack was made for spread-votes: one that knows it may recover more.")
