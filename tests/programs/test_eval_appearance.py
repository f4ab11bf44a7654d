"""Methods that see colours and descriptors: what they get, where they are left out, and the tables of what it gives."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("hydra", reason="the evaluation program needs the extra train: pip install 'l2p[train]'")

from hydra import compose, initialize_config_dir
from test_eval import rows_of
from test_eval_tables import row
from tiny import learned, seeing

import l2p
from eval.appearance_table import appearance_tables
from eval.cells import Cell
from eval.contenders import contender_of, contenders_of, identity_of, lines_alone
from eval.eval_config import CONFIGS, settings_of
from eval.evaluation import evaluate_all
from eval.result_tables import overview
from eval.targets import References, target_table
from l2p.attacks.learned.checkpoint import Checkpoint, digest, save
from l2p.errors import InputError
from l2p.programs.scenes import SceneSource, load, scenes_of

#: A user's method that places points by the colours and descriptors that it is given, and notes them.
PLUGIN = """
from pathlib import Path
import numpy as np

def attack(lines):
    names = " ".join(lines.appearance.names)
    with (Path(__file__).parent / "calls").open("a") as file:
        file.write(f"{len(lines)} {names} {lines.descriptor_kind}\\n")
    return lines.at(np.zeros(len(lines)))
"""


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eval.evaluation.draw_figures", lambda rows, knowing: [])


@pytest.fixture(scope="module")
def sighted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint with random weights whose network uses appearance."""
    attack, path = seeing(length=16), tmp_path_factory.mktemp("checkpoint") / "sighted.safetensors"
    save(path, Checkpoint(attack.network, attack.config, attack.calibration))
    return path


@pytest.fixture
def scenes(tmp_path: Path, scene_points: np.ndarray) -> Path:
    """A folder of three scenes: with everything, with colours, with nothing."""
    folder, rng = tmp_path / "scenes", np.random.default_rng(0)
    folder.mkdir()
    xyz = scene_points[::4]
    rgb = rng.integers(0, 256, (len(xyz), 3)).astype(np.uint8)
    descriptor = rng.integers(0, 256, (len(xyz), 16)).astype(np.uint8)
    np.savez(folder / "all.npz", xyz=xyz, rgb=rgb, descriptor=descriptor, descriptor_kind="sift")
    np.savez(folder / "coloured.npz", xyz=xyz, rgb=rgb)
    np.savez(folder / "bare.npz", xyz=xyz)
    np.savez(folder / "all.desc.npz", desc=descriptor)
    return folder


def run(folder: Path, methods: str, *overrides: str) -> int:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose("eval", [f"methods=[{methods}]", "fractions=[1.0]", "threads=1", *overrides])
    return evaluate_all(settings_of(config), folder, "python -m eval")


def kept(path: Path) -> dict[str, Any]:
    """Arrays of a file."""
    with np.load(path) as file:
        return dict(file)


# What a method gets


def test_a_method_gets_what_it_sees_and_no_more(tmp_path: Path, scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "looking.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    call = "{name: call, path: 'looking:attack'"
    methods = f"{call}}}, {call}, sees: [rgb]}}, {call}, sees: [descriptor]}}, {call}, sees: [descriptor, rgb]}}"
    assert run(tmp_path / "run", methods, f"scenes=[{scenes / 'all.npz'}]") == 0
    assert [row["method"] for row in rows_of(tmp_path / "run")] == [
        *("attack", "attack + rgb", "attack + descriptor", "attack + rgb + descriptor")
    ]
    assert (tmp_path / "calls").read_text().splitlines() == [
        *("100  None", "100 rgb None", "100 descriptor sift", "100 rgb descriptor sift")
    ]


@pytest.mark.parametrize("fraction", [1.0, 0.5])
def test_attributes_are_those_of_the_points_behind_the_lines(scenes: Path, fraction: float) -> None:
    source = SceneSource("all", str(scenes / "all.npz"), "indoor")
    both = contender_of({"name": "call", "path": "numpy:array", "sees": ["rgb", "descriptor"]})
    cell = Cell(source, fraction, 3, both, "cpu")
    lines, truth, scene = cell.trial().lines, cell.hidden().truth, l2p.load(scenes / "all.npz", l2p.Scene)
    assert scene.rgb is not None and scene.descriptor is not None
    np.testing.assert_array_equal(lines.rgb, scene.rgb[truth.index])
    np.testing.assert_array_equal(lines.descriptor, scene.descriptor[truth.index])
    alone = Cell(source, fraction, 3, contender_of({"name": "loo"}), "cpu").trial()
    bare = l2p.hide(scene.xyz, 3, fraction).map
    assert alone.lines.appearance.names == ()
    for name in ("direction", "moment"):
        np.testing.assert_array_equal(getattr(alone.lines, name), getattr(bare, name))
        np.testing.assert_array_equal(getattr(lines, name), getattr(bare, name))


def test_methods_that_see_differ_from_those_that_do_not(tmp_path: Path, scenes: Path, sighted: Path) -> None:
    mine, loo = f"{{name: learned, checkpoint: {sighted}", "{name: loo"
    methods = f"{mine}}}, {mine}, sees: [rgb, descriptor]}}, {loo}}}, {loo}, sees: [rgb], checkpoint: {sighted}}}"
    assert run(tmp_path / "run", methods, f"scenes=[{scenes / 'all.npz'}]") == 0
    names = ("learned", "learned-rgb-descriptor", "loo", "loo-rgb")
    files = {name: tmp_path / "run" / "predictions" / f"all_100_0_{name}.npz" for name in names}
    found = {name: kept(file) for name, file in files.items()}
    for alone, other in (names[:2], names[2:]):
        assert not np.array_equal(found[alone]["xyz"], found[other]["xyz"])
        assert "rgb" not in found[alone] and "rgb" in found[other]
    records = {name: json.loads(file.with_suffix(".json").read_text()) for name, file in files.items()}
    assert [record["info"]["used"] for record in records.values()] == [[], ["rgb", "descriptor"], [], ["rgb"]]
    assert records["loo-rgb"]["info"]["settings"]["checkpoint"] == "sighted.safetensors"
    assert records["loo-rgb"]["identity"]["method"]["digest"] == digest(sighted)
    assert set(records["learned-rgb-descriptor"]["identity"]["attributes"]) == {"rgb", "descriptor"}
    assert "attributes" not in records["learned"]["identity"]
    page = (tmp_path / "run" / "results.md").read_text()
    assert "| learned + rgb + descriptor | 100 % | 1 |" in page and "| wrong / lines alone |" in page


def test_lines_alone_give_the_cells_of_a_scene_without_attributes(tmp_path: Path, scenes: Path, sighted: Path) -> None:
    methods = f"{{name: learned, checkpoint: {sighted}}}, {{name: loo}}, {{name: oracle, k: 10, rule: least_squares}}"
    assert run(tmp_path / "run", methods, f"scenes=[{scenes}]") == 0
    predictions = tmp_path / "run" / "predictions"
    for method in ("learned", "loo", "oracle-10-least-squares"):
        one, *others = (kept(predictions / f"{name}_100_0_{method}.npz") for name in ("bare", "coloured", "all"))
        for other in others:
            assert set(one) == set(other)
            for name in {*one} - {"info"}:
                np.testing.assert_array_equal(one[name], other[name])
    assert "appearance" not in (tmp_path / "run" / "results.md").read_text()


def test_a_model_with_descriptors_beside_it_is_seen(tmp_path: Path, shared: Path) -> None:
    attack, file = seeing(), tmp_path / "sighted.safetensors"
    save(file, Checkpoint(attack.network, attack.config, attack.calibration))
    methods = f"{{name: loo}}, {{name: loo, sees: [rgb, descriptor], checkpoint: {file}}}"
    place = shared / "maps" / "val" / "office_lounge"
    if not place.is_dir():
        pytest.skip(f"needs {place}, which is absent here")
    assert run(tmp_path / "run", methods, f"scenes=[{place}]", "fractions=[0.05]") == 0
    assert [row["method"] for row in rows_of(tmp_path / "run")] == ["LOO", "LOO + rgb + descriptor"]


# Where a method is left out


def test_scenes_that_lack_what_a_method_sees_are_left_out(
    tmp_path: Path, scenes: Path, sighted: Path, caplog: pytest.LogCaptureFixture
) -> None:
    loo = f"{{name: loo, checkpoint: {sighted}, sees: "
    methods = f"{{name: loo}}, {loo}[rgb]}}, {loo}[rgb, descriptor]}}"
    assert run(tmp_path / "run", methods, f"scenes=[{scenes}]", "fractions=[1.0,0.5]") == 0
    rows = rows_of(tmp_path / "run")
    assert len({row["fraction"] for row in rows}) == 2
    assert {(row["scene"], row["method"]) for row in rows} == {
        *(("all", method) for method in ("LOO", "LOO + rgb", "LOO + rgb + descriptor")),
        *(("coloured", method) for method in ("LOO", "LOO + rgb")),
        ("bare", "LOO"),
    }
    left = [record.getMessage() for record in caplog.records if "left out" in record.getMessage()]
    assert left == [
        "LOO + rgb is left out on bare: the scene has no rgb",
        "LOO + rgb + descriptor is left out on bare: the scene has no rgb and no descriptor",
        "LOO + rgb + descriptor is left out on coloured: the scene has no descriptor",
    ]
    assert "LOO + rgb + descriptor (1 of 3 scenes)" in (tmp_path / "run" / "results.md").read_text()


def test_descriptors_of_another_kind_are_not_seen(tmp_path: Path, scenes: Path, sighted: Path) -> None:
    np.savez(scenes / "orb.npz", **{**kept(scenes / "all.npz"), "descriptor_kind": np.array("orb")})
    both = f"{{name: loo, checkpoint: {sighted}, sees: [rgb, descriptor]}}"
    sentence = r"no scene that has what .* \(the method cannot use descriptor of kind orb\)"
    with pytest.raises(InputError, match=sentence):
        run(tmp_path / "run", both, f"scenes=[{scenes / 'orb.npz'}]")
    assert run(tmp_path / "run", f"{both}, {{name: loo}}", f"scenes=[{scenes / 'orb.npz'}]") == 0
    assert [row["method"] for row in rows_of(tmp_path / "run")] == ["LOO"]


def test_descriptors_beside_scenes_are_no_scenes_and_two_scenes_of_one_name_are_refused(scenes: Path) -> None:
    assert [scene.name for scene in scenes_of((str(scenes),), {})] == ["all", "bare", "coloured"]
    (scenes / "more").mkdir()
    np.savez(scenes / "more" / "all.npz", xyz=np.eye(3))
    with pytest.raises(InputError, match="got 2 scenes named all; rename one of the files"):
        scenes_of((str(scenes), str(scenes / "more")), {})


def test_descriptors_beside_real_scenes_are_no_scenes(shared: Path) -> None:
    names = [scene.name for scene in scenes_of((str(shared / "scenes" / "val"),), {})]
    assert "strecha_castle_p30" in names and not any("desc" in name for name in names)


# Records


def test_records_of_earlier_versions_are_those_of_lines_alone() -> None:
    method = {"class": "OracleContender", "label": "oracle 50", "k": 50, "outliers": 0.0}
    assert identity_of(contender_of({"name": "oracle"}), "cloud") == method
    assert identity_of(contender_of({"name": "loo", "sees": []}), "cloud") == {
        "class": "LeaveOneOutContender", "label": "LOO", "k": 128,
    }  # fmt: skip
    heuristic = {"class": "AttackContender", "label": "heuristic", "name": "heuristic", "settings": {}}
    assert identity_of(contender_of({"name": "heuristic"}), "cloud") == heuristic
    call = {"class": "CallContender", "label": "array", "path": "numpy:array", "arguments": {}}
    assert identity_of(contender_of({"name": "call", "path": "numpy:array"}), "cloud") == call


def test_changed_attributes_are_not_mixed_in(tmp_path: Path, scenes: Path, sighted: Path) -> None:
    seen = f"{{name: loo, sees: [descriptor], checkpoint: {sighted}}}"
    one = f"scenes=[{scenes / 'all.npz'}]"
    assert run(tmp_path / "run", f"{seen}, {{name: loo}}", one) == 0
    scene = kept(scenes / "all.npz")
    np.savez(scenes / "all.npz", **{**scene, "rgb": 255 - scene["rgb"]})
    assert run(tmp_path / "run", f"{seen}, {{name: loo}}", one) == 0, "nothing sees the colours"
    np.savez(scenes / "all.npz", **{**scene, "descriptor": 255 - scene["descriptor"]})
    assert run(tmp_path / "run", "{name: loo}", one) == 0
    with pytest.raises(InputError, match="was made with attributes"):
        run(tmp_path / "run", seen, one)
    np.savez(scenes / "all.npz", **{**scene, "descriptor_kind": np.array("orb")})
    load.cache_clear()
    assert load(str(scenes / "all.npz")).attributes["descriptor"].startswith("orb ")


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"name": "heuristic", "sees": ["rgb"]}, r"sees \['rgb'\] for heuristic \+ rgb, which uses lines alone"),
        ({"name": "tomography", "sees": ["rgb"]}, "tomography .*uses lines alone; leave it out"),
        ({"name": "oracle", "sees": ["rgb"]}, "oracle 50 .*uses lines alone; leave it out"),
        ({"name": "candidate_oracle", "sees": ["rgb"]}, "heuristic .*uses lines alone; leave it out"),
        (
            {"name": "candidate_oracle", "attack": {"name": "learned", "sees": []}},
            "expected it beside candidate_oracle",
        ),
        ({"name": "learned", "sees": "rgb"}, "got sees 'rgb' for learned; expected a list of some of rgb, descriptor"),
        ({"name": "learned", "sees": ["colour"]}, r"got sees \['colour'\] for learned; expected a list of some of"),
        ({"name": "loo", "sees": ["rgb", "rgb"]}, r"got sees \['rgb', 'rgb'\] for LOO"),
        ({"name": "loo", "checkpoint": "some.file"}, "got a checkpoint for LOO, which sees nothing by it"),
        ({"name": "oracle", "rule": "mode"}, "got rule 'mode' of the oracle; expected peak or least_squares"),
        ({"name": "oracle", "outliers": 2}, "got outliers = 2.0; expected a share"),
    ],
)
def test_a_wrong_sight_is_explained(entry: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        contender_of(entry)


@pytest.mark.parametrize("name", ["learned", "loo"])
def test_a_checkpoint_that_uses_lines_alone_sees_nothing(name: str, tmp_path: Path) -> None:
    attack, file = learned(), tmp_path / "blind.safetensors"
    save(file, Checkpoint(attack.network, attack.config, attack.calibration))
    with pytest.raises(
        InputError, match=r"blind.safetensors uses lines alone; give a checkpoint with the input likeness"
    ):
        contender_of({"name": name, "sees": ["rgb"], "checkpoint": str(file)})


# Tables


def test_a_method_is_compared_with_itself_on_lines_alone(sighted: Path) -> None:
    file = str(sighted)
    entries: list[dict[str, Any]] = [
        {"name": "learned", "checkpoint": file, "rounds": 1, "label": "other"},
        {"name": "learned", "checkpoint": file},
        {"name": "learned", "checkpoint": file, "sees": ["rgb"]},
        {"name": "loo"},
        {"name": "loo", "sees": ["rgb"], "checkpoint": file, "label": "bound"},
        {"name": "loo", "k": 9, "sees": ["descriptor"], "checkpoint": file},
    ]
    methods = contenders_of(entries)
    alone = [lines_alone(method, methods) for method in methods]
    assert alone == [methods[0], methods[1], methods[1], methods[3], methods[3], None]
    assert References.of(methods) == References(
        heuristic=None,
        loo="LOO",
        knowing=frozenset({"LOO", "bound", "LOO + descriptor"}),
        seeing={"learned + rgb": "bound", "bound": "bound", "LOO + descriptor": "LOO + descriptor"},
        alone={"learned + rgb": "learned", "bound": "LOO", "LOO + descriptor": None},
    )


SEEN = References(
    heuristic=None,
    loo="LOO",
    knowing=frozenset({"LOO", "LOO + rgb"}),
    seeing={"m + rgb": "LOO + rgb", "LOO + rgb": "LOO + rgb"},
    alone={"m + rgb": "m", "LOO + rgb": "LOO"},
)


def test_the_table_of_appearance_has_ratios_on_the_same_line_cloud() -> None:
    rows = [
        row("m", "a", within_1=0.8, median_spacings=0.1),
        row("m", "b", within_1=0.5, median_spacings=1.0),
        row("m + rgb", "a", within_1=0.9, median_spacings=0.08, confident_half=0.99),
        row("m + rgb", "b", within_1=0.9, median_spacings=0.2, confident_half=0.97),
        row("LOO", "a", within_1=0.5),
        row("LOO + rgb", "a", within_1=0.95),
        row("LOO + rgb", "b", within_1=0.85),
    ]
    table, scenes = appearance_tables(rows, SEEN)
    assert (table.name, scenes.name) == ("appearance", "appearance-scenes")
    assert len(set(table.head)) == len(table.head)
    mine, bound = (dict(zip(table.head, line, strict=True)) for line in table.body)
    assert (mine["method"], mine["points"], mine["scenes"]) == ("m + rgb", "100 %", "2")
    # Wrong: 0.1 of 0.2, and 0.1 of 0.5; median: 0.8 and 0.2.
    assert mine["wrong / lines alone"] == f"{(0.5 * 0.2) ** 0.5:.3f}"
    assert mine["wrong, worst scene"] == "0.500"
    assert mine["median / lines alone"] == "0.400"
    assert mine["median, worst scene"] == "0.800"
    assert (mine["share within 1 - LOO's"], mine["share - LOO's, worst scene"]) == ("+0.0", "-5.0")
    assert mine["most confident half within 1"] == "98.0 %"
    assert bound["wrong / lines alone"] == "0.100", "of the one scene that has both"
    assert bound["share within 1 - LOO's"] == "-", "it is the bound"
    assert scenes.head == ["scene", "points", "m + rgb", "LOO + rgb"]
    assert scenes.body == [["a", "100 %", "0.50 / 0.80", "0.10 / 1.00"], ["b", "100 %", "0.20 / 0.20", "- / -"]]


def test_calibration_is_in_the_table_of_appearance_if_any_method_claims_it() -> None:
    sure = {"reliability": [[1.0], [0.8], [0.6]]}
    rows = [row("m"), row("m + rgb", "a", curves=sure, calibration_error=0.2)]
    rows.append(row("m + rgb", "b", curves=sure, calibration_error=0.3))
    table = appearance_tables(rows, SEEN)[0]
    found = dict(zip(table.head, table.body[0], strict=True))
    assert (found["calibration error"], found["calibration error, worst scene"]) == ("0.200", "0.300")
    assert "calibration error" not in appearance_tables([row("m + rgb")], SEEN)[0].head
    assert appearance_tables([row("m"), row("LOO")], SEEN) == [], "nothing sees anything"


def test_targets_are_against_the_bound_that_sees_the_same() -> None:
    rows = [row("m", within_1=0.4), row("m + rgb", within_1=0.6), row("LOO", within_1=0.5)]
    rows.append(row("LOO + rgb", within_1=0.8))
    table = target_table(rows, SEEN)
    assert table is not None
    column = table.head.index("share within 1 / LOO's")
    assert [(line[0], line[column]) for line in table.body] == [("m", "0.800"), ("m + rgb", "0.750")]


def test_the_overview_says_where_scenes_are_missing() -> None:
    rows = [row("m", "a"), row("m", "b"), row("m + rgb", "a")]
    assert [line[0] for line in overview(rows, [1.0]).body] == ["m", "m + rgb (1 of 2 scenes)"]


# Experiments


@pytest.mark.parametrize(
    "name",
    sorted(
        path.stem
        for path in (CONFIGS / "experiment").glob("*.yaml")
        if "sees:" in path.read_text() and path.stem != "schemes"
    ),
)
def test_experiments_that_see_run_on_a_tiny_scene(
    tmp_path: Path, scenes: Path, sighted: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr("l2p.attacks.learned.checkpoint.shipped", lambda scheme="uniform": sighted)
    readme = tmp_path / "README.md"
    readme.write_text(f"<!-- eval:{name}:appearance -->\n<!-- /eval -->\n")
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        tiny = [f"scenes=[{scenes / 'all.npz'}]", "fractions=[0.5]", "docs=null", f"update=[{readme}]"]
        config = compose("eval", [f"experiment={name}", *tiny])
    settings = settings_of(config)
    assert evaluate_all(settings, tmp_path / "run", "python -m eval") == 0
    assert [row["method"] for row in rows_of(tmp_path / "run")] == [method.label for method in settings.methods]
    seeing = next(method.label for method in settings.methods if method.sees)
    assert f"| {seeing} | 50 % | 1 |" in readme.read_text()


def test_schemes_are_compared_on_a_tiny_scene(
    tmp_path: Path, scenes: Path, sighted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("l2p.attacks.learned.checkpoint.shipped", lambda scheme="uniform": sighted)
    readme, page = tmp_path / "README.md", tmp_path / "schemes.md"
    readme.write_text("<!-- eval:schemes:schemes -->\n<!-- /eval -->\n")
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        tiny = [f"scenes=[{scenes / 'all.npz'}]", "fractions=[1.0]", f"docs={page}", f"update=[{readme}]"]
        tiny.append("methods=[{name: learned},{name: learned,sees: [rgb]},{name: published}]")
        config = compose("eval", ["experiment=schemes", *tiny])
    settings = settings_of(config)
    assert evaluate_all(settings, tmp_path / "run", "python -m eval") == 0
    rows = rows_of(tmp_path / "run")
    assert {row["scheme"] for row in rows} == set(settings.schemes)
    own = [row for row in rows if row["method"].endswith(": published")]
    assert {row["scheme"] for row in own} == {"ppl", "rays", "half-space"}, "attacks run on what they are made for"
    pairs, spheres = (next(row for row in rows if row["scheme"] == name) for name in ("ppl", "sphere-50"))
    assert pairs["both_within_1"] and not pairs["fakes_auc"]
    assert spheres["fakes_auc"] and not spheres["both_within_1"]
    assert "| rays | published |" in readme.read_text() and "schemes.svg" in page.read_text()
    assert (tmp_path / "images" / "schemes-schemes.svg").is_file()
