"""A confidence is a probability where the attack says so: every command reads the recovery, not its name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import l2p
from l2p.attacks.attack import Attack, Elements, Estimate
from l2p.attacks.heuristic import Heuristic
from l2p.attacks.run import run
from l2p.attacks.settings import METHODS
from l2p.cli.main import main
from l2p.judging.references import LeaveOneOut, Oracle
from l2p.show.exhibit import Exhibit
from l2p.work.work import Work

RANKS = "ranks points and is no probability"


class Feet(Attack):
    """A user's own attack, which says nothing of its confidence."""

    def finish(self, state: Elements, work: Work) -> Estimate:
        beta = torch.zeros_like(state.lines.direction[:, 0])
        nobody = beta.new_empty(len(beta), 0)
        return Estimate(beta, torch.linspace(0, 1, len(beta)), nobody.long(), nobody)


class CalibratedFeet(Feet):
    """One that claims a probability."""

    calibrated = True


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    return l2p.simulate("room", points=120, seed=0)


def claims(recovery: l2p.Recovery, truth: l2p.Truth, folder: Path, capsys: pytest.CaptureFixture[str]) -> list[bool]:
    """Whether each command takes the confidence for a probability."""
    l2p.save(recovery, folder / "out.npz")
    l2p.save(truth, folder / "truth.npz")
    words = ["evaluate", str(folder / "out.npz"), str(folder / "truth.npz")]
    assert main(words) == 0
    table = capsys.readouterr().out
    assert main([*words, "--json", "-"]) == 0
    figures = json.loads(capsys.readouterr().out)["all"]
    assert main(["view", str(folder / "out.npz"), "-o", str(folder / "view.html")]) == 0
    capsys.readouterr()
    return [
        l2p.load(folder / "out.npz", l2p.Recovery).calibrated,
        Exhibit.load(folder / "out.npz").calibrated,
        RANKS not in (folder / "view.html").read_text(encoding="utf-8"),
        "calibration error" in table,
        figures["calibration_error"] is not None,
        l2p.evaluate(recovery, truth).calibration_error is not None,
    ]


@pytest.mark.parametrize("name", ["", "learned", "heuristic", "heuristic with sparse counts", "LOO"])
@pytest.mark.parametrize("method", [Heuristic(), Feet(), CalibratedFeet()], ids=lambda method: type(method).__name__)
def test_names_do_not_matter(
    method: Attack, name: str, scene: l2p.Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hidden = l2p.hide(scene, seed=0)
    found = claims(run(hidden.map, method, name=name), replace(hidden.truth, spacing=0.5), tmp_path, capsys)
    assert found == [isinstance(method, CalibratedFeet)] * len(found)


def test_references_claim_nothing(scene: l2p.Scene) -> None:
    lines = l2p.lift(scene.xyz, seed=0)
    for reference in (Oracle(scene.xyz), LeaveOneOut(scene.xyz)):
        assert run(lines, reference, name="learned").calibrated is False


@pytest.mark.parametrize("method", [name for name in METHODS if name != "published"])  # not for uniform lines
def test_an_audit_claims_what_the_other_commands_claim(
    method: str, scene: l2p.Scene, tmp_path: Path, tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = tiny_checkpoint if method == "learned" else None
    audit = l2p.audit(scene, [1], method=method, checkpoint=checkpoint)
    trial = audit.trials[0]
    assert trial.truth is not None and trial.scores is not None
    l2p.save_report(audit, tmp_path / "report")
    figures = json.loads((tmp_path / "report" / "audit.json").read_text())["trials"][0]
    page = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    found = claims(trial.recovery, trial.truth, tmp_path, capsys)
    found += [
        audit.calibrated,
        RANKS not in page,
        figures["prediction"] is not None,
        bool(figures["curves"]["claimed"]),
        figures["scores"]["calibration_error"] is not None,
    ]
    assert found == [method == "learned"] * len(found)
