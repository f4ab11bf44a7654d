"""``l2p audit`` and ``l2p view``: what they write, print, refuse and return."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import socket
import subprocess
import sys
import textwrap
import webbrowser
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from toy import SEES, telling_scene

import l2p
from l2p.auditing import FRACTIONS
from l2p.cli.main import main
from l2p.judging import clean
from l2p.show import window
from l2p.show.exhibit import Exhibit

#: The cheapest attack, where any will do.
CHEAP = ("--method", "tomography", "--fractions", 1, 0.5, "--queries", 2)


@pytest.fixture(scope="module")
def files(tmp_path_factory, tiny_checkpoint) -> Path:
    """A folder with a scene, a line cloud, a recovery and a COLMAP model."""
    folder = tmp_path_factory.mktemp("files")
    from l2p.simulator import simulate_model

    model = simulate_model("room", 300, 2)
    model.save_colmap(folder / "model")
    assert model.scene.rgb is not None
    np.savez(folder / "scene.npz", xyz=model.scene.xyz, rgb=model.scene.rgb)
    lines = l2p.lift(model.scene.xyz, seed=0)
    l2p.save(lines, folder / "lines.npz")
    l2p.save(l2p.recover(lines, "tomography"), folder / "out.npz")
    return folder


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_a_report_is_written_and_told(files, tmp_path, capsys):
    assert run("audit", files / "scene.npz", "-o", tmp_path / "report", *CHEAP, "--json", tmp_path / "copy.json") == 0
    told = capsys.readouterr()
    assert "most confident half" in told.out and str(tmp_path / "report" / "index.html") in told.out
    assert told.err == ""
    figures = json.loads((tmp_path / "report" / "audit.json").read_text())
    assert figures == json.loads((tmp_path / "copy.json").read_text())
    assert [trial["fraction"] for trial in figures["trials"]] == [1.0, 0.5]
    assert "--fractions 1 0.5" in figures["command"] and "--checkpoint" not in figures["command"]


def test_a_report_is_opened_where_that_was_asked_for_and_there_is_a_display(files, tmp_path, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.chdir(tmp_path)
    words = ("audit", files / "scene.npz", "-o", "report", *CHEAP, "--force")
    assert run(*words, "--open") == 0
    assert opened == [], "no display"
    monkeypatch.setenv("DISPLAY", ":99")
    assert run(*words) == 0
    assert opened == []
    assert run(*words, "--open") == 0
    assert opened == [(tmp_path / "report" / "index.html").as_uri()]


def test_only_a_confidence_that_claims_to_be_a_probability_has_a_calibration_error(
    files, tmp_path, tiny_checkpoint, capsys
):
    np.savez(tmp_path / "few.npz", xyz=np.random.default_rng(0).normal(size=(120, 3)))
    for number, words in enumerate((("--method", "tomography"), ("--checkpoint", tiny_checkpoint))):
        assert run("audit", tmp_path / "few.npz", "-o", tmp_path / str(number), "--fractions", 1, *words) == 0
        assert ("calibration error" in capsys.readouterr().out) == bool(number)


def test_a_map_of_few_points_has_lengths_and_counts_and_no_shares_of_spacings(tmp_path, tiny_checkpoint, capsys):
    rng = np.random.default_rng(0)
    np.savez(tmp_path / "few.npz", xyz=rng.normal(size=(60, 3)), rgb=rng.integers(0, 256, (60, 3), dtype=np.uint8))
    words = ("--checkpoint", tiny_checkpoint, "--fractions", 1, 0.1, "--metric")
    assert run("audit", tmp_path / "few.npz", "-o", tmp_path / "report", *words) == 0
    said, page = capsys.readouterr().out, (tmp_path / "report" / "index.html").read_text()
    assert "median error (scene units)" in said and "of 6" in said and "too few to measure by a spacing" in said
    for each in ("within 1 spacing", "calibration error", "Leaving out", "of the points are recovered"):
        assert each not in said
    assert "Median error (scene units)" in page and "Recovered within … spacings" not in page
    assert "Recovered within … cm" in page, "as in the terminal"


def test_the_command_in_the_report_gives_it_again(files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("--seed", 3, "--metric", "--threads", 1)
    assert run("audit", files / "model", "-o", "a b", *CHEAP, *words) == 0
    first = json.loads(Path("a b/audit.json").read_text())
    assert first["seed"] == 3 and first["metric"] and first["machine"]["threads"] == 1
    program, *again = shlex.split(first["command"])
    assert program == "l2p"
    assert run(*again, "--force") == 0
    second = json.loads(Path("a b/audit.json").read_text())
    assert [trial["scores"] for trial in first["trials"]] == [trial["scores"] for trial in second["trials"]]


def test_machines_get_json_and_nothing_else(files, tmp_path, capsys):
    assert run("audit", files / "scene.npz", "-o", tmp_path / "report", *CHEAP, "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["points"] == 300


def test_a_line_cloud_is_audited_as_it_is(files, tmp_path, tiny_checkpoint, capsys):
    words = ("-o", tmp_path / "report", "--checkpoint", tiny_checkpoint)
    assert run("audit", files / "lines.npz", *words) == 0
    assert "are expected to be recovered" in capsys.readouterr().out
    figures = json.loads((tmp_path / "report" / "audit.json").read_text())
    assert not figures["truth_known"] and figures["trials"][0]["scores"] is None
    assert "--seed" not in figures["command"]
    assert run("audit", files / "lines.npz", *words, "--force", "--fractions", 1) == 2
    assert "attacked as it is" in capsys.readouterr().err


SHARES = "points within 1 spacing"


def test_attackers_are_compared_in_words_and_a_table(tmp_path, capsys):
    scene = telling_scene()
    assert scene.rgb is not None and scene.descriptor is not None
    np.savez(tmp_path / "scene.npz", xyz=scene.xyz, rgb=scene.rgb, descriptor=scene.descriptor, descriptor_kind="toy")
    words = ("audit", tmp_path / "scene.npz", "--method", SEES, "--fractions", 1, 0.5, "-o")
    assert run(*words, tmp_path / "all") == 0
    told = capsys.readouterr().out
    assert "From the lines alone" in told and "Leaving out both would save" in told
    assert SHARES in told and told.count("lines + descriptors") == 1
    assert run(*words, tmp_path / "some", "--ignore", "descriptor") == 0
    told = capsys.readouterr().out
    assert SHARES in told and "the descriptors" not in told
    figures = json.loads((tmp_path / "some" / "audit.json").read_text())
    assert [trial["used"] for trial in figures["trials"]] == [["rgb"], []] * 2
    assert figures["ignored"] == ["descriptor"] and "--ignore descriptor --seed" in figures["command"]
    assert run(*words, tmp_path / "none", "--ignore", "descriptor, rgb") == 0
    told = capsys.readouterr().out
    assert SHARES not in told and "alone" not in told
    command = json.loads((tmp_path / "none" / "audit.json").read_text())["command"]
    assert run(*shlex.split(command)[1:], "--force") == 0


def test_descriptors_come_from_a_file_or_from_beside_the_model(files, tmp_path, monkeypatch, capsys):
    model = tmp_path / "model"
    shutil.copytree(files / "model", model)
    ids = l2p.load(model, l2p.Scene).ids
    assert ids is not None
    np.savez(tmp_path / "own.npz", point3D_id=ids, descriptor=np.ones((len(ids), 3), np.float32))
    words = ("audit", model, "--method", SEES, "--fractions", 1, "--queries", 2, "--force", "-o", tmp_path / "report")
    assert run(*words, "--descriptors") == 2
    assert "has no descriptors in its folder or two above" in capsys.readouterr().err
    shutil.copy(tmp_path / "own.npz", model / "descriptors.npz")
    for given, used in (((), ["rgb"]), (("--descriptors",), ["rgb", "descriptor"])):
        assert run(*words, *given) == 0
        figures = json.loads((tmp_path / "report" / "audit.json").read_text())
        assert figures["trials"][0]["used"] == used and (" --descriptors " in figures["command"]) == bool(given)
    assert run(*words, "--descriptors", tmp_path / "own.npz") == 0
    figures = json.loads((tmp_path / "report" / "audit.json").read_text())
    assert figures["trials"][0]["used"] == ["rgb", "descriptor"] and "own.npz" in figures["command"]
    assert run("audit", files / "lines.npz", "-o", tmp_path / "no", "--descriptors", tmp_path / "own.npz") == 2
    assert "got --descriptors for a line cloud" in capsys.readouterr().err and not (tmp_path / "no").exists()


def test_recover_leaves_out_ignored_attributes(tmp_path, capsys):
    l2p.save(l2p.lift(telling_scene(), seed=0, rgb=True, descriptor=True), tmp_path / "lines.npz")
    words = ("recover", tmp_path / "lines.npz", "--method", SEES, "--json", "-", "-o")
    points = []
    for number, (ignore, used) in enumerate(
        (("", ["rgb", "descriptor"]), ("rgb", ["descriptor"]), ("rgb,descriptor", []), ("descriptor", ["rgb"]))
    ):
        assert run(*words, tmp_path / f"{number}.npz", *(("--ignore", ignore) if ignore else ())) == 0
        assert json.loads(capsys.readouterr().out)["used"] == used
        points.append(l2p.load(tmp_path / f"{number}.npz", l2p.Recovery).xyz)
    assert not any(np.array_equal(points[0], each) for each in points[1:])
    l2p.save(l2p.lift(telling_scene(), seed=0), tmp_path / "bare.npz")
    assert run("recover", tmp_path / "bare.npz", *words[2:], tmp_path / "bare-out.npz", "--ignore", "rgb") == 0
    np.testing.assert_array_equal(l2p.load(tmp_path / "bare-out.npz", l2p.Recovery).xyz, points[2])
    with pytest.raises(SystemExit):
        run(*words, tmp_path / "x.npz", "--ignore", "rgb;descriptor")
    assert "expected some of rgb, descriptor, comma separated" in capsys.readouterr().err


def test_a_name_that_is_no_text_is_shown_as_far_as_it_can_be(files, tmp_path):
    path = os.fsdecode(os.fsencode(tmp_path) + b"/sc\xffne.npz")
    try:
        os.symlink(files / "scene.npz", path)
    except OSError:
        pytest.skip("names of files must be text here")
    assert main(["audit", path, "-o", str(tmp_path / "report"), *map(str, CHEAP)]) == 0
    assert "sc\N{REPLACEMENT CHARACTER}ne.npz" in (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    assert main(["view", path, "-o", str(tmp_path / "view.html")]) == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--fractions", 0), "got fraction 0.0; expected a number in (0, 1]"),
        (("--fractions", "many"), "invalid float value"),
        (("--threads", 0), "got --threads 0; expected at least 1"),
        (("--max-view-points", 0), "got --max-view-points 0; expected at least 1"),
        (("--method", "tomography", "--checkpoint", "x"), "expected it with method 'learned' only"),
        (("--checkpoint", "absent.safetensors"), "absent.safetensors does not exist"),
        (("--json", "there/x.json"), "is in"),
        (("--ignore", "colour"), "got 'colour'; expected some of rgb, descriptor, comma separated"),
        (("--ignore", ""), "got ''; expected some of rgb, descriptor"),
        (("--descriptors", "absent.npz"), "for a scene without point ids"),
    ],
)
def test_errors_are_one_sentence_and_leave_nothing(files, tmp_path, monkeypatch, capsys, words, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    try:
        code = run("audit", files / "scene.npz", "-o", "there", "--force", *words)
    except SystemExit as stop:
        code = stop.code
    told = capsys.readouterr()
    assert code == 2 and sentence in told.err and told.err.count("\n") == 1
    assert os.listdir(tmp_path) == ["there"] and os.listdir("there") == []


def test_reports_and_inputs_are_not_replaced(files, tmp_path, capsys):
    scene = files / "scene.npz"
    assert run("audit", scene, "-o", files, *CHEAP, "--force") == 2
    assert run("audit", scene, "-o", scene, *CHEAP, "--force") == 2
    (tmp_path / "report").mkdir()
    assert run("audit", scene, "-o", tmp_path / "report", *CHEAP) == 2
    assert "exists" in capsys.readouterr().err
    assert run("audit", files / "out.npz", "-o", tmp_path / "absent" / "report", *CHEAP) == 2
    assert run("audit", tmp_path / "absent.npz", "-o", tmp_path / "new", *CHEAP) == 2
    assert not (tmp_path / "new").exists()


def test_ctrl_c_leaves_nothing(files, tmp_path, monkeypatch, capsys):
    def interrupted(*words):
        raise KeyboardInterrupt

    monkeypatch.setattr("l2p.auditing.report.report_page", interrupted)
    words = ("-o", tmp_path / "report", *CHEAP, "--json", tmp_path / "copy.json")
    assert run("audit", files / "scene.npz", *words) == 130
    assert capsys.readouterr().err == "l2p: interrupted; nothing was written\n"
    assert os.listdir(tmp_path) == []


def test_help_says_the_defaults(capsys):
    with pytest.raises(SystemExit):
        run("audit", "--help")
    text = " ".join(capsys.readouterr().out.split())
    assert f"(default: {' '.join(f'{share:g}' for share in FRACTIONS)})" in text


def test_commands_load_only_what_they_use(files, tmp_path):
    program = textwrap.dedent(
        """
        import sys
        from l2p.cli.main import main
        heavy = {"torch", "open3d", "pycolmap", "plyfile", "matplotlib", *sys.argv[1].split()}
        try:
            assert main(sys.argv[2:]) == 0
        except SystemExit as stop:
            assert not stop.code
        assert not heavy & set(sys.modules), heavy & set(sys.modules)
        """
    )
    view = ["view", str(files / "scene.npz"), "-o", str(tmp_path / "view.html")]
    for heavy, words in (("numpy jinja2", ["audit", "--help"]), ("", view)):
        subprocess.run([sys.executable, "-c", program, heavy, *words], check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("name", ["scene.npz", "lines.npz", "out.npz", "model"])
def test_view_writes_a_page(files, tmp_path, capsys, name):
    page = tmp_path / "view.html"
    assert run("view", files / name, "-o", page) == 0
    assert capsys.readouterr().out == f"{page}\n"
    assert page.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert run("view", files / name, "-o", page) == 2
    assert run("view", files / name, "-o", page, "--force") == 0


def test_view_opens_a_page_of_its_own_where_there_is_a_display(files, tmp_path, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert run("view", files / "lines.npz") == 0
    page = Path(capsys.readouterr().out.strip())
    assert page.is_file() and page.is_relative_to(tmp_path)
    assert opened == []
    monkeypatch.setenv("DISPLAY", ":99")
    assert run("view", files / "lines.npz") == 0
    assert opened == [Path(capsys.readouterr().out.strip()).as_uri()]
    assert run("view", files / "lines.npz", "-o", tmp_path / "own.html") == 0
    assert len(opened) == 1, "who names a file opens it"
    assert run("view", files / "lines.npz", "-o", tmp_path / "own.html", "--force", "--open") == 0
    assert len(opened) == 2


def test_view_refuses_what_it_cannot_show(files, tmp_path, tiny_checkpoint, capsys):
    assert run("view", tiny_checkpoint) == 2
    assert "expected a scene, a line cloud or a recovery" in capsys.readouterr().err
    assert run("view", tmp_path / "absent.npz") == 2
    assert run("view", files / "lines.npz", "--window", "-o", tmp_path / "x.html") == 2
    assert "expected one of them" in capsys.readouterr().err


def test_a_window_needs_a_display_and_open3d(files, monkeypatch, capsys):
    assert run("view", files / "lines.npz", "--window") == 2
    assert "there is no display for --window" in capsys.readouterr().err
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(window, "_answers", lambda: True)
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert run("view", files / "lines.npz", "--window") == 2
    told = capsys.readouterr().err
    assert "or leave out --window" in told and told.count("\n") == 1


def test_a_system_library_that_is_missing_is_named_with_its_package(files, monkeypatch, capsys):
    class Without:
        def find_spec(self, name, path=None, target=None):
            if name == "open3d":
                raise OSError("libGL.so.1: cannot open shared object file: No such file or directory")

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(window, "_answers", lambda: True)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Without(), *sys.meta_path])
    assert run("view", files / "lines.npz", "--window") == 2
    told = capsys.readouterr().err
    assert "libGL.so.1" in told and "libgl1" in told and told.count("\n") == 1


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="displays have no names there")
def test_a_display_that_does_not_answer_is_refused(files, tmp_path, monkeypatch, capsys):
    for name in (":4711", "localhost:4711.0", "nonsense"):
        monkeypatch.setenv("DISPLAY", name)
        assert run("view", files / "lines.npz", "--window") == 2
        assert f"the display {name} does not answer" in capsys.readouterr().err
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert not window._answers()
    with socket.socket() as listener:
        listener.bind(("localhost", 0))
        listener.listen()
        port = listener.getsockname()[1]
        if port < 6000:
            pytest.skip("the system gave a port below those of displays")
        monkeypatch.delenv("WAYLAND_DISPLAY")
        monkeypatch.setenv("DISPLAY", f"localhost:{port - 6000}.0")
        assert window._answers()


class FakeWindow:
    """Stands for Open3D's window: keeps what it is given."""

    works = True
    shown: list = []  # noqa: RUF012

    def create_window(self, *words):
        return self.works

    def add_geometry(self, geometry):
        self.shown.append(geometry)

    def get_view_control(self):
        return Mock()

    def run(self):
        pass

    def destroy_window(self):
        pass


def test_a_window_shows_points_or_lines(files, monkeypatch, capsys):
    try:
        open3d = clean.load_open3d()
    except l2p.InputError as error:
        pytest.skip(str(error))
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(window, "_answers", lambda: True)
    monkeypatch.setattr(open3d.visualization, "Visualizer", FakeWindow)
    for name in ("scene.npz", "out.npz", "lines.npz"):
        assert run("view", files / name, "--window") == 0
    scene, recovered, lines = FakeWindow.shown
    np.testing.assert_array_equal(np.asarray(scene.points), Exhibit.load(files / "scene.npz").points)
    assert len({tuple(colour) for colour in np.asarray(recovered.colors)}) > 10, "the confidences"
    assert len(lines.lines) > 200
    monkeypatch.setattr(FakeWindow, "works", False)
    assert run("view", files / "lines.npz", "--window") == 2
    assert "refused a window" in capsys.readouterr().err
    assert window.has_display()
