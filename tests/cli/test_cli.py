"""The command line: what it writes, prints and returns."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import l2p
from l2p.cli.main import main
from l2p.io.line_files import load_lines, save_lines
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_scene, load_truth
from l2p.judging.accuracy import spacing
from l2p.maps.lines import LineCloud

#: The cheapest attack, where any will do.
TOMOGRAPHY = ("--method", "tomography", "--rounds", 0)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """An npz scene of 300 points on the faces of a box, with colours and ids."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, size=(300, 3)) * [4, 3, 2]
    xyz[np.arange(300), rng.integers(0, 3, 300)] = 1.5
    path = tmp_path / "scene.npz"
    np.savez(path, xyz=xyz, rgb=rng.integers(0, 256, (300, 3), dtype=np.uint8), ids=np.arange(300) + 1000)
    return path


@pytest.fixture
def lifted(tmp_path: Path, scene: Path) -> tuple[Path, Path]:
    lines, truth = tmp_path / "lines.npz", tmp_path / "truth.npz"
    assert main(["lift", str(scene), "-o", str(lines), "--truth", str(truth), "--seed", "1"]) == 0
    return lines, truth


@pytest.fixture
def model(tmp_path: Path) -> Path:
    import pycolmap

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D, options.num_frames_per_rig = 120, 3
    (tmp_path / "model").mkdir()
    pycolmap.synthesize_dataset(options).write_binary(str(tmp_path / "model"))
    return tmp_path / "model"


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_lift_puts_each_true_point_on_its_line(scene, lifted):
    lines, truth = load_lines(lifted[0]), load_truth(lifted[1])
    np.testing.assert_allclose(np.cross(truth.xyz, lines.direction), lines.moment, atol=1e-9)
    np.testing.assert_array_equal(truth.xyz, load_scene(scene).xyz[truth.index])
    assert truth.ids is not None
    np.testing.assert_array_equal(truth.ids, truth.index + 1000)
    assert truth.seed == 1
    assert truth.spacing == spacing(load_scene(scene).xyz)
    assert lines.rgb is None


def test_lift_without_seed_is_new_each_time_and_keeps_no_seed(tmp_path, scene):
    for name in ("a", "b"):
        assert run("lift", scene, "-o", tmp_path / f"{name}.npz", "--truth", tmp_path / f"{name}.truth.npz") == 0
    assert (tmp_path / "a.npz").read_bytes() != (tmp_path / "b.npz").read_bytes()
    assert load_truth(tmp_path / "a.truth.npz").seed is None


def test_lift_with_a_seed_gives_the_same_bytes(tmp_path, scene):
    for name in ("a", "b"):
        words = ("--truth", tmp_path / f"{name}.truth.npz", "--seed", 7, "--fraction", 0.5, "--rgb")
        assert run("lift", scene, "-o", tmp_path / f"{name}.npz", *words) == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert (tmp_path / "a.truth.npz").read_bytes() == (tmp_path / "b.truth.npz").read_bytes()
    lines, truth = load_lines(tmp_path / "a.npz"), load_truth(tmp_path / "a.truth.npz")
    assert len(lines) == len(truth) == 150
    colours = load_scene(scene).rgb
    assert colours is not None
    np.testing.assert_array_equal(lines.rgb, colours[truth.index])
    assert truth.spacing == spacing(load_scene(scene).xyz), "of all points, not of the lifted half"


def test_recover_and_evaluate(tmp_path, lifted, capsys):
    out = tmp_path / "out.npz"
    assert run("recover", lifted[0], "-o", out, "--threads", 1) == 0
    said, expected, recovery = capsys.readouterr().out, 100 * load_recovery(out).confidence.mean(), load_recovery(out)
    assert f"About {expected:.0f} % of the points are expected within 1 spacing ({spacing(recovery.xyz):.2g}" in said
    lines, recovery = load_lines(lifted[0]), load_recovery(out)
    np.testing.assert_allclose(np.cross(recovery.xyz, lines.direction), lines.moment, atol=1e-9)
    assert recovery.kept is None
    assert run("evaluate", out, lifted[1], "--metric") == 0
    table = capsys.readouterr().out
    for row in ("lines", "median error (spacings)", "within 1 spacing ", "within 50 cm", "calibration error"):
        assert row in table
    assert run("evaluate", out, lifted[1], "--json", tmp_path / "scores.json") == 0
    capsys.readouterr()
    assert run("evaluate", out, lifted[1], "--json", "-") == 0
    scores = json.loads(capsys.readouterr().out)
    assert scores == json.loads((tmp_path / "scores.json").read_text())
    truth = load_truth(lifted[1])
    assert scores["all"]["median"] == np.median(np.linalg.norm(recovery.xyz - truth.xyz, axis=1))


def test_the_same_recovery_gives_the_same_bytes(tmp_path, lifted):
    for name in ("a.npz", "b.npz"):
        assert run("recover", lifted[0], "-o", tmp_path / name) == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_stats_say_what_was_run(tmp_path, lifted, capsys):
    stats = tmp_path / "stats.json"
    words = ("--method", "heuristic", "--rounds", 0, "--seed", 5)
    assert run("recover", lifted[0], "-o", tmp_path / "out.npz", *words, "--json", stats) == 0
    figures = json.loads(stats.read_text())
    assert figures["method"] == "heuristic"
    assert figures["settings"]["rounds"] == 0
    assert figures["seed"] == 5
    assert figures["lines"] == figures["kept"] == 300
    assert figures["seconds"] > 0
    capsys.readouterr()
    assert run("recover", lifted[0], "-o", tmp_path / "b.npz", *TOMOGRAPHY, "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["lines"] == 300


def test_filters_mark_points_in_npz_and_drop_them_from_ply(tmp_path, lifted, capsys):
    assert run("recover", lifted[0], "-o", tmp_path / "all.npz", *TOMOGRAPHY) == 0
    middle = float(np.median(load_recovery(tmp_path / "all.npz").confidence))
    words = (*TOMOGRAPHY, "--min-confidence", middle, "--clean")
    assert run("recover", lifted[0], "-o", tmp_path / "out.npz", *words) == 0
    assert run("recover", lifted[0], "-o", tmp_path / "out.ply", *words) == 0
    recovery = load_recovery(tmp_path / "out.npz")
    assert recovery.kept is not None
    assert len(recovery) == 300
    assert 0 < recovery.kept.sum() < (recovery.confidence >= middle).sum() < 300
    assert recovery.confidence[recovery.kept].min() >= middle
    kept = recovery.xyz[recovery.kept]
    np.testing.assert_array_equal(load_scene(tmp_path / "out.ply").xyz, kept.astype(np.float32))
    capsys.readouterr()
    assert run("evaluate", tmp_path / "out.npz", lifted[1], "--json", "-") == 0
    scores = json.loads(capsys.readouterr().out)
    assert scores["kept"]["lines"] == recovery.kept.sum()


def test_a_colmap_model_comes_back_with_its_points_moved(tmp_path, model):
    import pycolmap

    lines, truth, out = tmp_path / "lines.npz", tmp_path / "truth.npz", tmp_path / "out"
    assert run("lift", model, "-o", lines, "--truth", truth, "--fraction", 0.5) == 0
    words = (*TOMOGRAPHY, "--model", model, "--truth", truth)
    assert run("recover", lines, "-o", out, *words) == 0
    assert run("recover", lines, "-o", tmp_path / "out.npz", *TOMOGRAPHY) == 0
    moved, ids = pycolmap.Reconstruction(str(out)), load_truth(truth).ids
    assert ids is not None
    assert set(moved.point3D_ids()) == set(ids.tolist())
    for row, key in enumerate(ids.tolist()):
        np.testing.assert_array_equal(moved.points3D[key].xyz, load_recovery(tmp_path / "out.npz").xyz[row])
    assert run("recover", lines, "-o", out, *words) == 2
    assert run("recover", lines, "-o", out, *words, "--force") == 0
    assert run("recover", lines, "-o", model, *words, "--force") == 2


def test_a_checkpoint_of_ones_own_is_used_and_named(tmp_path, lifted, tiny_checkpoint, capsys):
    out, stats = tmp_path / "out.npz", tmp_path / "stats.json"
    words = ("--checkpoint", tiny_checkpoint, "--rounds", 1, "--fraction", 0.5)
    assert run("recover", lifted[0], "-o", out, *words, "--json", stats) == 0
    settings = json.loads(stats.read_text())["settings"]
    assert settings["checkpoint"] == "tiny.safetensors"
    assert (settings["rounds"], settings["fraction"], settings["candidates"]) == (1, 0.5, 16)
    capsys.readouterr()
    assert run("info", out) == 0
    assert f"tiny.safetensors ({settings['digest']})" in capsys.readouterr().out
    assert run("info", tiny_checkpoint) == 0
    assert settings["digest"] in capsys.readouterr().out


def test_info_says_how_a_checkpoint_was_trained(tiny_checkpoint, capsys):
    from l2p.attacks.learned.checkpoint import read

    parameters = sum(value.numel() for value in read(tiny_checkpoint).network.parameters())
    assert run("info", tiny_checkpoint) == 0
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in capsys.readouterr().out.splitlines()]
    for row in (
        ["parameters", str(parameters)],
        ["width, layers, heads", "8, 1, 2"],
        ["rounds", "2"],
        ["candidates", "16"],
        ["trained at commit", "0123abcd"],
        ["seed", "11"],
        ["training steps", "1234"],
        ["training minutes", "56.7"],
        ["training scenes", "3"],
        ["[b]ell", "5%", "700", "-", "0.412 0.331", "58.0% 66.4%", "89.5%", "0.021"],
    ):
        assert row in rows


@pytest.mark.parametrize(
    "facts", [{}, {"results": []}, {"results": 7, "scenes": 3}, {"results": [{"median": ["x", None]}, 5]}]
)
def test_info_of_a_checkpoint_needs_no_facts(tmp_path, tiny_checkpoint, facts, capsys):
    from l2p.attacks.learned.checkpoint import read, save

    path = tmp_path / "other.safetensors"
    save(path, replace(read(tiny_checkpoint), facts=facts))
    assert run("info", path) == 0
    assert "unknown" in capsys.readouterr().out


def test_info_knows_every_kind(tmp_path, scene, lifted, model, tiny_checkpoint, capsys):
    assert run("recover", lifted[0], "-o", tmp_path / "out.npz", *TOMOGRAPHY) == 0
    assert run("recover", lifted[0], "-o", tmp_path / "out.ply", *TOMOGRAPHY) == 0
    (tmp_path / "braces.txt").write_text("# a text{}\n1 2 3 0 0 1\n")
    (tmp_path / "lines.csv").write_text("1,2,3,0,0,1\n")
    for path, kind in (
        (scene, "a scene (npz)"),
        (lifted[0], "a line cloud (npz)"),
        (lifted[1], "a truth (npz)"),
        (tmp_path / "out.npz", "a recovery (npz)"),
        (tmp_path / "out.ply", "a point cloud (PLY)"),
        (model, "a COLMAP model"),
        (tmp_path / "lines.csv", "a line cloud (text)"),
        (tmp_path / "braces.txt", "a line cloud (text)"),
        (tiny_checkpoint, "a checkpoint (safetensors)"),
    ):
        capsys.readouterr()
        assert run("info", path) == 0
        assert kind in capsys.readouterr().out


def test_lift_stores_what_it_is_asked_to_and_info_says_it(tmp_path, scene, capsys):
    descriptor = np.random.default_rng(1).integers(0, 256, (300, 128), dtype=np.uint8)
    with np.load(scene) as arrays:
        np.savez(tmp_path / "rich.npz", **arrays, descriptor=descriptor, descriptor_kind=np.array("sift"))
    np.savez(tmp_path / "other.npz", point3D_id=np.arange(300)[::-1] + 1000, descriptor=descriptor[::-1] // 2)
    truth = ("--truth", tmp_path / "rich.truth.npz", "--force")
    for words, rgb, factor, says in (
        ([], False, None, "the lines alone"),
        (["--rgb"], True, None, "the lines; an attacker also uses the colours"),
        (["--descriptors"], False, 1, "the lines; an attacker also uses the descriptors"),
        (["--descriptors", tmp_path / "other.npz", "--rgb"], True, 2, "also uses the colours and descriptors"),
    ):
        assert run("lift", tmp_path / "rich.npz", "-o", tmp_path / "rich.lines.npz", *truth, *words) == 0
        out = capsys.readouterr().out
        assert ("sift, 128 x uint8" in out) == (factor is not None)
        lines, index = load_lines(tmp_path / "rich.lines.npz"), load_truth(tmp_path / "rich.truth.npz").index
        assert (lines.rgb is not None) == rgb
        if factor is None:
            assert lines.descriptor is None
        else:
            np.testing.assert_array_equal(lines.descriptor, descriptor[index] // factor)
        assert run("info", tmp_path / "rich.lines.npz") == 0
        out = capsys.readouterr().out
        assert says in out and ("sift, 128 x uint8" in out) == (factor is not None)
    assert run("info", tmp_path / "rich.npz") == 0
    assert "sift, 128 x uint8" in capsys.readouterr().out


def test_info_names_the_descriptors_beside_a_model(model, capsys):
    from l2p.io.colmap import read_model

    assert run("info", model) == 0
    assert "no" in said_beside(capsys.readouterr().out)
    ids = np.array(list(read_model(model).point3D_ids()))
    np.savez(model / "descriptors.npz", point3D_id=ids, descriptor=np.ones((len(ids), 32), dtype=np.float32))
    assert run("info", model) == 0
    assert "descriptors.npz" in said_beside(capsys.readouterr().out)
    assert run("lift", model, "-o", model.parent / "lines.npz", "--descriptors") == 0
    assert f"descriptors of {model / 'descriptors.npz'}: unknown, 32 x float32" in capsys.readouterr().out
    (model / "descriptors.npz").unlink()
    (model.parent / "database.db").write_bytes(b"SQLite format 3\0 but nothing else")
    assert run("info", model) == 0, "a damaged file beside it does not hide the model"
    assert "damaged" in said_beside(capsys.readouterr().out)


def said_beside(table: str) -> str:
    return next(row for row in table.splitlines() if "descriptors beside it" in row)


def test_lines_that_are_not_uniform_get_a_warning_and_no_probability(tmp_path, scene, lifted, tiny_checkpoint, capsys):
    """In the terminal, in the figures, and in the file."""
    points = load_scene(scene).xyz
    save_lines(LineCloud.through(points, points - [1.0, 0, 0]), tmp_path / "rays.npz")
    for lines, expected in ((lifted[0], True), (tmp_path / "rays.npz", False)):
        words = (
            "-o",
            tmp_path / "out.npz",
            "--checkpoint",
            tiny_checkpoint,
            "--json",
            tmp_path / "out.json",
            "--force",
        )
        assert run("recover", lines, *words) == 0
        warned, stats = capsys.readouterr().err, json.loads((tmp_path / "out.json").read_text())
        assert ("All 300 lines pass through one point. The confidence only ranks points" in warned) == (not expected)
        assert (stats["median_confidence"] is None) == (not expected)
        written = load_recovery(tmp_path / "out.npz")
        assert written.calibrated == expected and written.info["recognised"] == stats["recognised"]
        assert run("info", lines) == run("info", tmp_path / "out.npz") == 0
        out = capsys.readouterr().out
        assert out.count("uniform, and no lines meet" if expected else "All 300 lines pass through one point.") == 2
        assert ("ranks only" in out) == (not expected)


def test_demo_hands_its_flags_on(tmp_path, monkeypatch):
    calls = []
    demo = importlib.import_module("l2p.cli.demo")
    monkeypatch.setattr(demo, "run", lambda *words, overwrite: calls.append((*words[:3], overwrite)))
    assert run("demo", "-o", tmp_path / "demo", "--points", 50, "--seed", 3, "--force") == 0
    assert calls == [(str(tmp_path / "demo"), 50, 3, True)]


def test_help_loads_nothing_heavy():
    program = textwrap.dedent(
        """
        import sys
        from l2p.cli.main import main
        try:
            main(sys.argv[1:])
        except SystemExit as error:
            assert error.code == 0
        heavy = {"numpy", "torch", "rich", "jaxtyping", "scipy", "open3d", "pycolmap", "plyfile", "matplotlib"}
        assert not heavy & set(sys.modules), heavy & set(sys.modules)
        """
    )
    for words in (["--help"], ["lift", "--help"], ["recover", "--help"], ["--version"]):
        subprocess.run([sys.executable, "-c", program, *words], check=True, stdout=subprocess.DEVNULL)


def test_commands_load_only_what_they_use(scene):
    program = textwrap.dedent(
        """
        import sys
        from l2p.cli.main import main
        assert main(sys.argv[1:]) == 0
        heavy = {"torch", "scipy", "open3d", "pycolmap", "plyfile", "matplotlib", "lightning", "hydra"}
        assert not heavy & set(sys.modules), heavy & set(sys.modules)
        """
    )
    subprocess.run([sys.executable, "-c", program, "info", str(scene)], check=True, stdout=subprocess.DEVNULL)


def test_every_flag_with_a_default_says_so(capsys):
    for command, flags in {
        "lift": ["--fraction", "--scheme"],
        "recover": ["--method", "--checkpoint", "--device", "--fraction", "--rounds"],
    }.items():
        with pytest.raises(SystemExit):
            main([command, "--help"])
        text = " ".join(capsys.readouterr().out.split())
        for flag in flags:
            assert "(default: " in text.split(f" {flag} ")[-1][:400]


def test_python_m_l2p_is_the_command(scene):
    done = subprocess.run([sys.executable, "-m", "l2p", "info", str(scene)], capture_output=True, text=True, check=True)
    assert "a scene (npz)" in done.stdout
    assert done.stderr == ""


def test_nothing_but_errors_is_on_stderr_without_a_terminal(tmp_path, lifted, capfd):
    assert run("recover", lifted[0], "-o", tmp_path / "out.npz", "--rounds", 1) == 0
    assert capfd.readouterr().err == ""


def test_ctrl_c_is_one_line_and_leaves_nothing(tmp_path, lifted):
    """A real SIGINT, while the attack works."""
    program = textwrap.dedent(
        """
        import importlib, signal, sys, time
        # Jobs in the background of a shell start with SIGINT ignored.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        def slow(*words, **flags):
            print("working", flush=True)
            time.sleep(60)
        importlib.import_module("l2p.attacks.run").run = slow
        from l2p.cli.main import main
        sys.exit(main(sys.argv[1:]))
        """
    )
    before = sorted(os.listdir(tmp_path))
    words = ["recover", str(lifted[0]), "-o", str(tmp_path / "out.npz"), "--json", str(tmp_path / "stats.json")]
    command = [sys.executable, "-c", program, *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "working\n"
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors == "l2p: interrupted; nothing was written\n"
    assert sorted(os.listdir(tmp_path)) == before


def test_ctrl_c_between_two_outputs_leaves_neither(tmp_path, lifted, monkeypatch, capsys):
    def interrupted(*words, **flags):
        raise KeyboardInterrupt

    monkeypatch.setattr("l2p.io.recovery_files.npz_bytes", interrupted)
    before = sorted(os.listdir(tmp_path))
    words = (*TOMOGRAPHY, "--json", tmp_path / "stats.json")
    assert run("recover", lifted[0], "-o", tmp_path / "out.npz", *words) == 130
    assert capsys.readouterr().err == "l2p: interrupted; nothing was written\n"
    assert sorted(os.listdir(tmp_path)) == before


def test_a_bug_is_not_hidden(tmp_path, lifted, monkeypatch):
    def broken(*words, **flags):
        raise ZeroDivisionError

    monkeypatch.setattr(importlib.import_module("l2p.attacks.run"), "run", broken)
    with pytest.raises(ZeroDivisionError):
        run("recover", lifted[0], "-o", tmp_path / "out.npz")


def test_kills_at_random_moments_leave_nothing_half_done():
    """A few of those of tests/stress/kill_runs.py."""
    script = Path(__file__).parents[1] / "stress" / "kill_runs.py"
    command = [sys.executable, str(script), "--programs", "recover", "--kills", "3", "--chain", "2", "--seed", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "nothing wrong" in done.stdout and "| l2p recover | 3 |" in done.stdout


@pytest.mark.parametrize("command", ["recover", "info", "view", "audit"])
def test_columns_are_what_the_user_says(command, scene, tmp_path, capsys):
    """Direction first, of no length that would tell it: the command line says which is which."""
    hidden = l2p.hide(load_scene(scene).xyz[:200], seed=1)
    lines = hidden.map
    np.savetxt(tmp_path / "rows.txt", np.hstack([3 * lines.direction, hidden.truth.xyz]))
    outputs = {"recover": "points.npz", "view": "page.html", "audit": "report"}
    words = [command, tmp_path / "rows.txt", "--columns", "dx,dy,dz,x,y,z"]
    words += ["-o", tmp_path / outputs[command]] if command in outputs else []
    words += ["--method", "tomography"] if command in ("recover", "audit") else []
    assert run(*words) == 0
    if command != "view":
        assert "200 lines (columns dx dy dz x y z)" in " ".join(capsys.readouterr().out.split())
    if command == "recover":
        found = load_recovery(tmp_path / "points.npz").xyz
        np.testing.assert_allclose(np.cross(found, lines.direction), lines.moment, atol=1e-6)


def test_columns_that_do_not_fit_are_refused(tmp_path, capsys):
    np.savetxt(tmp_path / "rows.txt", np.ones((3, 6)))
    for columns, says in (("x,y,z", "6 columns"), ("x,y,z,dx,dy,what", "what")):
        assert run("info", tmp_path / "rows.txt", "--columns", columns) == 2
        assert says in capsys.readouterr().err
