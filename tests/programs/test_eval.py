"""The evaluation program: through the real configs, on tiny scenes."""

from __future__ import annotations

import csv
import json
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("hydra", reason="the evaluation program needs the extra train: pip install 'l2p[train]'")

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

import l2p
from eval.contenders import Trial, contender_of, identity_of
from eval.eval_config import CONFIGS, settings_of
from eval.evaluation import evaluate_all
from l2p.attacks.learned.checkpoint import digest, read, save
from l2p.errors import InputError
from l2p.judging.accuracy import spacing
from l2p.maps.recovery import Recovery
from l2p.programs.scenes import scenes_of

ROOT = Path(__file__).parents[2]
#: Those whose methods see attributes have a test of their own (test_eval_appearance.py).
EXPERIMENTS = [path for path in (CONFIGS / "experiment").glob("*.yaml") if "sees:" not in path.read_text()]
METHODS_OF_README = ["heuristic", "heuristic with sparse counts", "tomography", "learned", "oracle 50", "LOO"]
TINY = ["scenes=[sim:room:120:0]", "fractions=[1.0,0.5]", "threads=1"]

#: A user's method, which counts its calls in a file and can be made to fail.
PLUGIN = """
from pathlib import Path
import numpy as np

here = Path(__file__).parent

def attack(lines, shift=0.0):
    calls = here / "calls"
    count = len(calls.read_text()) if calls.exists() else 0
    fail_at = here / "fail_at"
    if fail_at.exists() and count == int(fail_at.read_text()):
        raise {failure}
    calls.write_text("." * (count + 1))
    return lines.at(np.full(len(lines), shift))

def cut(lines):
    return lines.origin[:-1]

number = 3
"""


def run(folder: Path, *overrides: str) -> int:
    """Compose the real config as the command line does, and run it into ``folder``."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose("eval", [*TINY, *overrides])
    return evaluate_all(settings_of(config), folder, "python -m eval")


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def drawn() -> None:
    """Asked for by tests that look at the figures."""


@pytest.fixture(autouse=True)
def _quick(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests do without figures, which take longer than all the rest."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr("eval.evaluation.draw_figures", lambda rows, knowing: [])


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Write the user's module ``NAME`` into a folder of its own, which is given back."""

    def write(name: str, failure: str = "RuntimeError('broken')") -> Path:
        folder = tmp_path / "plugin"
        folder.mkdir()
        (folder / f"{name}.py").write_text(PLUGIN.replace("{failure}", failure))
        monkeypatch.syspath_prepend(folder)
        return folder

    return write


@pytest.mark.usefixtures("drawn")
def test_every_reference_and_attack_has_a_row_for_each_cell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    methods = "[{name: heuristic}, {name: oracle, k: 10, outliers: 0.5}, {name: candidate_oracle, k: 10}, {name: loo}]"
    docs = tmp_path / "docs" / "results.md"
    assert run(tmp_path / "run", f"methods={methods}", f"docs={docs}") == 0
    rows = rows_of(tmp_path / "run")
    assert [(row["fraction"], row["method"]) for row in rows] == [
        (fraction, method)
        for fraction in ("1.0", "0.5")
        for method in ("heuristic", "oracle 10, 50% outliers", "candidate oracle 10", "LOO")
    ]
    assert {row["lines"] for row in rows} == {"120", "60"}
    assert len({row["spacing"] for row in rows}) == 1, "the spacing is that of the full cloud, also for a fraction"
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert {"commit", "config", "machine", "versions", "command"} <= set(results)
    assert "100 % of the points, 1 scene" in capsys.readouterr().out
    page = docs.read_text()
    assert page.index("python -m eval") < page.index("| heuristic |")
    assert (docs.parent / "images" / "results-error_cdf.svg").is_file()
    assert "](images/results-density.svg)" in page


def test_rows_are_what_the_measures_say_of_the_saved_prediction(tmp_path: Path) -> None:
    run(tmp_path, "methods=[{name: oracle, k: 10}]")
    row = rows_of(tmp_path)[1]
    points = l2p.simulate("room", 120, 0).xyz
    index = l2p.hide(points, 0, 0.5).truth.index
    recovery = l2p.load(tmp_path / "predictions" / "sim-room-120-0_50_0_oracle-10.npz", Recovery)
    scores = l2p.evaluate(recovery, points[index], spacing(points))
    assert float(row["median_spacings"]) == pytest.approx(scores.median_spacings)
    assert float(row["within_1"]) == pytest.approx(scores.within_spacings["1"])
    assert float(row["neighbor_precision"]) == 1


def test_an_interrupted_run_continues_with_the_rest(tmp_path: Path, plugin: Callable[..., Path]) -> None:
    folder = plugin("interrupted", "KeyboardInterrupt")
    (folder / "fail_at").write_text("1")
    arguments = ("methods=[{name: call, path: 'interrupted:attack'}]", "seeds=[0,1]")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "run", *arguments)
    assert len(list((tmp_path / "run" / "predictions").glob("*.npz"))) == 1
    run(tmp_path / "run", *arguments, "steps=[score]")
    assert len(rows_of(tmp_path / "run")) == 1, "what is there can be looked at"
    (folder / "fail_at").unlink()
    assert run(tmp_path / "run", *arguments) == 0
    assert len((folder / "calls").read_text()) == 4
    assert run(tmp_path / "run", *arguments) == 0
    assert len((folder / "calls").read_text()) == 4, "a finished run computes nothing"
    assert len(rows_of(tmp_path / "run")) == 4


def test_a_cell_that_fails_does_not_stop_the_others(tmp_path: Path, plugin: Callable[..., Path]) -> None:
    folder = plugin("failing")
    (folder / "fail_at").write_text("0")
    methods = "methods=[{name: call, path: 'failing:attack'}, {name: oracle, k: 10}]"
    assert run(tmp_path / "run", methods) == 2
    assert {row["method"] for row in rows_of(tmp_path / "run")} == {"oracle 10"}
    (folder / "fail_at").unlink()
    assert run(tmp_path / "run", methods) == 0
    assert len(rows_of(tmp_path / "run")) == 4


def test_predictions_of_other_settings_are_not_mixed_in(tmp_path: Path) -> None:
    run(tmp_path, "methods=[{name: oracle, k: 10, label: mine}]")
    with pytest.raises(InputError, match=r"was made with method .*'k': 10.*not .*'k': 20"):
        run(tmp_path, "methods=[{name: oracle, k: 20, label: mine}]")
    with pytest.raises(InputError, match="was made with kind indoor, not outdoor"):
        run(tmp_path, "methods=[{name: oracle, k: 10, label: mine}]", "+kinds={sim-room-120-0: outdoor}")
    assert run(tmp_path, "methods=[{name: oracle, k: 10, label: mine}, {name: oracle, k: 20}]") == 0


def test_the_learned_attack_is_run_and_scored(tmp_path: Path, tiny_checkpoint: Path) -> None:
    methods = f"[{{name: learned}}, {{name: learned, checkpoint: {tiny_checkpoint}, rounds: 1, label: tiny}}]"
    assert run(tmp_path, f"methods={methods}") == 0
    rows = rows_of(tmp_path)
    assert [row["method"] for row in rows] == ["learned", "tiny"] * 2
    for row in rows:
        assert 0 < float(row["neighbor_precision"]) <= 1
        assert 0 <= float(row["calibration_error"]) <= 1
    assert float(rows[1]["neighbors_used"]) == 16, "all candidates, each weighted by its affinity"
    record = json.loads((tmp_path / "predictions" / "sim-room-120-0_50_0_tiny.json").read_text())
    settings = record["info"]["settings"]
    assert (settings["checkpoint"], settings["rounds"], settings["fraction"]) == ("tiny.safetensors", 1, 0.5)


def test_predictions_of_other_weights_are_not_mixed_in(tmp_path: Path, tiny_checkpoint: Path) -> None:
    mine = tmp_path / "mine.safetensors"
    mine.write_bytes(tiny_checkpoint.read_bytes())
    entry = f"{{name: learned, checkpoint: {mine}, rounds: 0}}"
    run(tmp_path / "run", f"methods=[{entry}]")
    save(mine, replace(read(mine), facts={"seed": 12}), overwrite=True)
    with pytest.raises(InputError, match=r"was made with method .*'digest': "):
        run(tmp_path / "run", f"methods=[{entry}]")
    oracle = {"name": "candidate_oracle", "attack": {"name": "learned", "checkpoint": str(mine)}}
    assert identity_of(contender_of(oracle), "cloud")["digest"] == digest(mine)
    assert "digest" not in identity_of(contender_of({"name": "tomography"}), "cloud")


def test_the_learned_attack_knows_the_fraction_and_nothing_of_the_truth(
    tiny_checkpoint: Path, scene_points: np.ndarray
) -> None:
    hidden = l2p.hide(scene_points, 0, 0.25)
    lines, index = hidden.map, hidden.truth.index
    contender: Any = contender_of({"name": "learned", "checkpoint": str(tiny_checkpoint)})
    found = [
        contender.recover(Trial("key", lines, truth, kind, 0.25, 0, "cpu"))
        for truth, kind in ((scene_points[index], "indoor"), (np.zeros((len(lines), 3)), "outdoor"))
    ]
    expected = l2p.recover(lines, checkpoint=tiny_checkpoint, fraction=0.25)
    for recovery in found:
        np.testing.assert_array_equal(recovery.xyz, expected.xyz)
        np.testing.assert_array_equal(recovery.confidence, expected.confidence)
    assert not contender.knows_truth


def test_a_changed_scene_file_is_not_mixed_in(tmp_path: Path, scene_points: np.ndarray) -> None:
    overrides = (f"scenes=[{tmp_path / 'mine.npz'}]", "methods=[{name: oracle, k: 10}]")
    np.savez(tmp_path / "mine.npz", xyz=scene_points)
    run(tmp_path / "run", *overrides)
    np.savez(tmp_path / "mine.npz", xyz=scene_points[:-1])
    with pytest.raises(InputError, match="was made with points"):
        run(tmp_path / "run", *overrides)


def test_an_edited_callable_is_run_again_and_no_other(tmp_path: Path, plugin: Callable[..., Path]) -> None:
    folder = plugin("edited")
    method = "methods=[{name: call, path: edited:attack, label: own}, {name: oracle, k: 10}]"
    assert run(tmp_path / "run", method) == 0
    calls = len((folder / "calls").read_text())
    oracle = {file: file.stat().st_mtime_ns for file in (tmp_path / "run" / "predictions").glob("*oracle*.npz")}
    assert run(tmp_path / "run", method) == 0
    assert calls and len((folder / "calls").read_text()) == calls
    (folder / "edited.py").write_text((folder / "edited.py").read_text() + "# another word\n")
    assert run(tmp_path / "run", method) == 0
    assert len((folder / "calls").read_text()) == 2 * calls
    assert all(file.stat().st_mtime_ns == made for file, made in oracle.items())


def test_a_users_points_and_recoveries_are_scored(tmp_path: Path, plugin: Callable[..., Path]) -> None:
    plugin("own")
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    for percent in (100, 50):
        lines = l2p.hide(l2p.simulate("room", 120, 0).xyz, 0, percent / 100).map
        zero = np.zeros(len(lines))
        l2p.save(
            Recovery(lines.at(zero + 0.5), np.ones(len(lines), np.float32), zero + 0.5),
            folder / f"sim-room-120-0_{percent}_0.npz",
        )
    call = "{name: call, path: 'own:attack', arguments: {shift: 0.5}, label: own}"
    assert run(tmp_path / "run", f"methods=[{call}, {{name: folder, path: {folder}}}]") == 0
    rows = rows_of(tmp_path / "run")
    assert [row["method"] for row in rows[:2]] == ["own", "elsewhere"]
    assert rows[0]["median"] == rows[1]["median"]
    assert float(rows[0]["seconds"]) > 0 and rows[1]["seconds"] == "", "the time of reading is not that of the method"
    assert rows[0]["neighbor_precision"] == "" and rows[0]["confidence_auc"] == "", "nothing is made up"
    lines = l2p.hide(l2p.simulate("room", 120, 0).xyz, 0).map
    bare = tmp_path / "bare"
    bare.mkdir()
    np.savez(bare / "sim-room-120-0_100_0.npz", xyz=lines.at(np.full(len(lines), 0.5)))
    assert run(tmp_path / "other", f"methods=[{{name: folder, path: {bare}}}]", "fractions=[1.0]") == 0
    assert rows_of(tmp_path / "other")[0]["median"] == rows[0]["median"], "points alone are enough"
    (folder / "sim-room-120-0_50_0.npz").write_bytes((folder / "sim-room-120-0_100_0.npz").read_bytes())
    with pytest.raises(InputError, match=r"_50_0_elsewhere.npz was made with method .*'digest': "):
        run(tmp_path / "run", f"methods=[{call}, {{name: folder, path: {folder}}}]")


CLAIMING = """
import numpy as np
import l2p

def attack(lines, says):
    beta = np.zeros(len(lines))
    return l2p.Recovery(lines.at(beta), np.linspace(0, 1, len(lines), dtype=np.float32), beta, calibrated=says)
"""


def test_a_calibration_is_that_of_recoveries_that_claim_a_probability(tmp_path: Path, tiny_checkpoint: Path) -> None:
    (tmp_path / "claiming.py").write_text(CLAIMING)
    sys.path.insert(0, str(tmp_path))
    call = "name: call, path: 'claiming:attack'"
    claims = {
        "learned": f"{call}, arguments: {{says: false}}",
        "heuristic": f"{call}, arguments: {{says: true}}",
        "raised": f"{call}, arguments: {{says: false}}, calibrated: true",
        "lowered": f"{call}, arguments: {{says: true}}, calibrated: false",
        "tiny": f"name: learned, checkpoint: {tiny_checkpoint}",
        "heuristic with sparse counts": "name: heuristic, fraction: 0.05",
        "bound": "name: loo",
    }
    methods = ", ".join(f"{{{entry}, label: {label}}}" for label, entry in claims.items())
    assert run(tmp_path / "run", f"methods=[{methods}]", "fractions=[1.0]") == 0
    expected = dict.fromkeys(claims, False) | dict.fromkeys(("heuristic", "raised", "tiny"), True)
    assert {row["method"]: row["calibration_error"] != "" for row in rows_of(tmp_path / "run")} == expected
    curves = {
        row["method"]: row["curves"] for row in json.loads((tmp_path / "run" / "results.json").read_text())["rows"]
    }
    assert {label: curves[label]["reliability"] is not None for label in claims} == expected
    for label, claim in expected.items():
        file = f"sim-room-120-0_100_0_{label.replace(' ', '-')}.npz"
        assert l2p.load(tmp_path / "run" / "predictions" / file, Recovery).calibrated is claim
    with pytest.raises(InputError, match=r"was made with method .*'calibrated': True"):
        run(tmp_path / "run", f"methods=[{{{call}, arguments: {{says: false}}, label: raised}}]", "fractions=[1.0]")


def test_a_users_answer_of_the_wrong_length_is_refused(
    tmp_path: Path, plugin: Callable[..., Path], caplog: pytest.LogCaptureFixture
) -> None:
    plugin("short")
    assert run(tmp_path / "run", "methods=[{name: call, path: 'short:cut'}]") == 2
    assert "got 119 points of short:cut for 120 lines" in caplog.text


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"name": "orakel"}, "got method 'orakel'; expected a name of learned, tomography, heuristic"),
        ({"name": "learned", "round": 2}, "method learned: Key 'round' not in"),
        ({"name": "learned", "rounds": 100}, "got 100 rounds; expected 0 to"),
        ({"name": "learned", "checkpoint": __file__}, "test_eval.py is no safetensors file"),
        ({}, "got method None"),
        ({"name": "oracle", "K": 5}, "method oracle: Key 'K' not in"),
        ({"name": "oracle", "k": "many"}, "method oracle: Value 'many'"),
        ({"name": "call"}, "method call: .*missing mandatory value: path"),
        ({"name": "call", "path": "nowhere_at_all:attack"}, "expected package.module:callable, but No module named"),
        ({"name": "call", "path": "numpy:no_such_thing"}, "has no attribute 'no_such_thing'"),
        ({"name": "call", "path": "numpy:pi"}, "is a float; expected a callable"),
        ({"name": "call", "path": "attack"}, "expected package.module:callable"),
    ],
)
def test_a_wrong_method_is_explained(entry: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        contender_of(entry)


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("fractions=[0.0]", r"got fraction 0.0; expected a number in \(0, 1\]"),
        ("seeds=[]", "got no seeds"),
        ("seeds=[1,1]", "expected each of them once"),
        ("seeds=[-1]", "got seed -1"),
        ("processes=0", "got processes 0"),
        ("pictures.color=depth", "got color 'depth' of the pictures; expected error or rgb"),
        ("pictures.scenes=[castle]", "got picture scene castle, which is no scene of this run"),
        ("pictures.fractions=[0.2]", "got fraction 0.2 of the pictures; expected some of the run's"),
        ("steps=[scoer]", "expected some of predict, score"),
        ("scenes=['sim:castle:100:0']", "expected sim:KIND:POINTS:SEED"),
        ("+kinds={elsewhere: indoor}", "got a kind for elsewhere"),
        ("+kinds={sim-room-120-0: cosy}", "got kind 'cosy'"),
        ("methods=[{name: loo}, {name: loo, k: 9}]", "2 methods with the label 'LOO'"),
        ("methods=[{name: loo, label: a b}, {name: loo, label: a-b}]", "expected them to differ in letters"),
    ],
)
def test_a_wrong_value_is_explained_before_any_work(tmp_path: Path, override: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        run(tmp_path, override)
    assert not (tmp_path / "predictions").exists() or not list((tmp_path / "predictions").iterdir())


def test_a_missing_checkpoint_is_named_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.safetensors does not exist; expected a checkpoint"):
        run(tmp_path / "run", f"methods=[{{name: learned, checkpoint: {tmp_path / 'none.safetensors'}}}]")
    assert not (tmp_path / "run").exists()


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere does not exist; give"):
        run(tmp_path, f"scenes=[{tmp_path / 'nowhere'}]")


@pytest.mark.parametrize("override", ["fraction=[1.0]", "processes=many", "pictures.colour=rgb", "methods=7"])
def test_unknown_keys_and_other_types_are_errors(tmp_path: Path, override: str) -> None:
    with pytest.raises((HydraException, OmegaConfBaseException)):
        run(tmp_path, override)


@pytest.mark.parametrize("name", sorted(path.stem for path in EXPERIMENTS if "methods:" in path.read_text()))
def test_experiments_run_on_a_tiny_scene(tmp_path: Path, name: str) -> None:
    small = ("fractions=[1.0]", "seeds=[0]", "pictures.scenes=[]", "docs=null", "update=[]")
    assert run(tmp_path, f"experiment={name}", *small) == 0
    assert rows_of(tmp_path)


@pytest.mark.usefixtures("drawn")
def test_the_tables_and_figures_of_the_docs_are_made_by_one_command(tmp_path: Path) -> None:
    docs = tmp_path / "docs" / "results.md"
    readme = tmp_path / "README.md"
    readme.write_text("# Mine\n\n<!-- eval:readme:overview -->\nold\n<!-- /eval -->\n\nThe end.\n")
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        tiny = ["scenes=[sim:room:400:1]", "pictures.scenes=[sim-room-400-1]", f"docs={docs}", f"update=[{readme}]"]
        config = compose("eval", ["experiment=readme", *tiny])
    assert evaluate_all(settings_of(config), tmp_path / "run", "python -m eval") == 0
    rows = rows_of(tmp_path / "run")
    assert list(dict.fromkeys(row["method"] for row in rows)) == METHODS_OF_README
    assert [row["fraction"] for row in rows[:: len(METHODS_OF_README)]] == ["1.0", "0.5", "0.1", "0.05"]
    figures = ["error_cdf", "error_sparsity", "density", "risk_coverage", "calibration", "neighbors"]
    for name in [*(f"{figure}.svg" for figure in figures), "sim-room-400-1_100.png"]:
        assert (tmp_path / "run" / "figures" / name).is_file()
        assert (docs.parent / "images" / f"results-{name}").is_file()
        assert f"](images/results-{name})" in docs.read_text()
    assert "| method | points | median / heuristic's |" in docs.read_text()
    assert readme.read_text().startswith(
        "# Mine\n\n<!-- eval:readme:overview -->\n\n| fraction of the points | 100 % |"
    )
    assert readme.read_text().endswith("\n\n<!-- /eval -->\n\nThe end.\n") and "old" not in readme.read_text()


def test_the_docs_need_the_real_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose("eval", ["experiment=readme", "update=[]"])
    with pytest.raises(FileNotFoundError, match=r"shared/scenes/val does not exist; give scenes=\[FOLDER\]"):
        evaluate_all(settings_of(config), tmp_path / "run", "python -m eval")


def test_kinds_come_from_the_table_beside_the_scenes(tmp_path: Path, scene_points: np.ndarray) -> None:
    (tmp_path / "val").mkdir()
    for name in ("church", "wood", "cup", "other"):
        np.savez(tmp_path / "val" / f"{name}.npz", xyz=scene_points)
    np.savez(tmp_path / "val" / "cup.desc.npz", desc=np.zeros((4, 128), np.uint8))
    (tmp_path / "SOURCES.md").write_text(
        "# Scenes\n\n| part | scene | N | kind |\n|---|---|---|---|\n| val | church | 400 | indoor hall |\n"
        "| val | wood | 400 | aerial |\n| val | cup | 400 | object (indoor) |\n"
    )
    scenes = scenes_of((str(tmp_path / "val"), "sim:street:100:0"), {})
    assert {scene.name: scene.kind for scene in scenes} == {
        "church": "indoor", "wood": "outdoor", "cup": "object", "other": "indoor", "sim-street-100-0": "outdoor",
    }  # fmt: skip
    assert scenes_of((str(tmp_path / "val"),), {"other": "outdoor"})[2].kind == "outdoor"


def test_real_scenes_have_the_kinds_of_their_table(shared: Path) -> None:
    kinds = {scene.name: scene.kind for scene in scenes_of((str(shared / "scenes" / "val"),), {})}
    assert len(kinds) == 12
    assert kinds["aerial_city"] == "outdoor" and kinds["church_interior"] == "indoor"
    assert kinds["tabletop_posters"] == "object"


def test_the_program_runs_from_the_command_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "eval", *TINY, f"run={tmp_path}", "methods=[{name: oracle, k: 10}]"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "oracle 10" in done.stdout
    assert shlex.join(["python", *command[1:]]) in (tmp_path / "results.md").read_text()
    assert (tmp_path / "config.yaml").is_file() and (tmp_path / "eval.log").is_file()
    wrong = subprocess.run([*command, "fractions=[2]"], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert wrong.returncode == 2
    assert wrong.stderr.startswith("eval: got fraction 2.0") and wrong.stderr.count("\n") == 1
