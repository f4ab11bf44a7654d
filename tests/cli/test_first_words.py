"""The first words with the command: its help, its completion, its last line, and errors that need no torch."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import l2p
from l2p.cli.completion import _WORDS, SHELLS, completion_script
from l2p.cli.expectation import expectation, expected_within, map_spacing
from l2p.cli.help_words import EXAMPLES
from l2p.cli.main import _parser, main
from l2p.judging.accuracy import spacing
from l2p.maps.recovery import Recovery

ROOT = Path(__file__).parents[2]
COMMANDS = next(action for action in _parser()._actions if isinstance(action, argparse._SubParsersAction)).choices


def test_a_bare_command_shows_the_help(capsys):
    assert main([]) == 0
    assert "usage: l2p" in (said := capsys.readouterr().out) and all(name in said for name in COMMANDS)


def test_every_help_has_an_example_that_can_be_typed_and_a_page_that_exists(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert set(EXAMPLES) == set(COMMANDS)
    for name, (example, _, page) in EXAMPLES.items():
        _parser().parse_args(example.split(" > ")[0].split()[1:])
        assert (ROOT / "docs" / page).is_file()
        with pytest.raises(SystemExit) as stop:
            main([name, "--help"])
        said = capsys.readouterr().out
        assert stop.value.code == 0 and example in said and f"docs/{page}" in said
        assert max(map(len, said.splitlines())) <= 80, name


@pytest.mark.parametrize("shell", SHELLS)
def test_completion_knows_every_command_and_flag(shell, capsys):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert script == completion_script(_parser(), shell)
    flags = {flag for command in COMMANDS.values() for action in command._actions for flag in action.option_strings}
    assert all(word in script for word in (*COMMANDS, *flags))
    assert set(_WORDS) <= flags


def completed(*words: str) -> list[str]:
    """What bash offers for the last of these words."""
    script = f"{completion_script(_parser(), 'bash')}\nCOMP_WORDS=({' '.join(words)} ''); COMP_CWORD={len(words) - 1}\n"
    script = script.replace(" '');", ");") if words[-1] != "''" else script.replace("'' ''", "''")
    done = subprocess.run(
        ["bash", "-c", f'{script}_l2p; printf "%s\\n" "${{COMPREPLY[@]}}"'], capture_output=True, text=True, check=True
    )
    assert not done.stderr
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_flags_and_their_words():
    assert completed("l2p", "re") == ["recover"]
    assert completed("l2p", "recover", "--meth") == ["--method"]
    assert completed("l2p", "recover", "lines.npz", "--method", "''") == list(_WORDS["--method"])
    assert completed("l2p", "audit", "map", "--schemes", "ppl", "rays-") == ["rays-voxel"]
    assert completed("l2p", "recover", "''") == [], "names of files, which bash adds"
    assert completed("l2p", "completion", "''") == list(SHELLS)


@pytest.mark.skipif(shutil.which("zsh") is None, reason="needs zsh")
def test_zsh_reads_the_script(tmp_path):
    (tmp_path / "_l2p").write_text(completion_script(_parser(), "zsh"))
    subprocess.run(["zsh", "-n", str(tmp_path / "_l2p")], check=True)


def recovery_of(calibrated: bool, **info: object) -> Recovery:
    lines = l2p.lift(np.random.default_rng(0).normal(size=(80, 3)), seed=0)
    confidence = np.linspace(0, 1, 80, dtype=np.float32)
    return Recovery(lines.at(np.ones(80)), confidence, np.ones(80), calibrated=calibrated, info=dict(info))


def test_the_last_line_is_the_mean_confidence_of_what_is_kept_or_why_none_is_stated():
    sure = recovery_of(True, method="learned")
    assert expected_within(sure) == pytest.approx(0.5)
    assert expectation(sure, 0.25) == "About 50 % of the points are expected within 1 spacing (0.25 units)."
    some = l2p.Recovery(sure.xyz, sure.confidence, sure.beta, kept=sure.confidence > 0.5, calibrated=True)
    assert "About 75 % of the kept points" in expectation(some, None)
    told = recovery_of(False, method="learned", recognised={"expected": False})
    assert expected_within(told) is None and "was not calibrated on such lines" in expectation(told, None)
    assert "the confidence of tomography is no probability" in expectation(recovery_of(False, method="tomography"), 1.0)


def test_the_spacing_is_that_of_the_map_and_not_of_its_share():
    recovery = recovery_of(True, settings={"fraction": 0.1})
    assert map_spacing(recovery_of(True)) == spacing(recovery.xyz)
    ratio = (map_spacing(recovery) or 0) / spacing(recovery.xyz)
    assert ratio == pytest.approx(0.1 ** (1 / 1.9))
    same = Recovery(np.ones((3, 3)), np.ones(3, dtype=np.float32), np.ones(3), calibrated=True)
    assert map_spacing(same) is None


def test_trivial_errors_do_not_wait_for_torch(tmp_path):
    """Each kind of them, in one interpreter."""
    np.savez(tmp_path / "scene.npz", xyz=np.random.default_rng(0).normal(size=(60, 3)))
    l2p.save(l2p.lift(l2p.load(tmp_path / "scene.npz"), seed=0), tmp_path / "lines.npz")
    (tmp_path / "there.npz").write_text("x")
    recover, audit = ["recover", "lines.npz", "-o", "out.npz"], ["audit", "scene.npz", "-o", "report"]
    wrong = [
        ["recover", "missing.npz", "-o", "out.npz"],
        ["recover", "scene.npz", "-o", "out.npz"],
        ["recover", "lines.npz", "-o", "there.npz"],
        ["recover", "lines.npz", "-o", "out.pcd"],
        [*recover, "--method", "nonsense"],
        [*recover, "--method", "tomography", "--scene-kind", "indoor"],
        [*recover, "--checkpoint", "missing.safetensors"],
        [*recover, "--fraction", "2"],
        [*recover, "--threads", "0"],
        [*recover, "--processes", "0"],
        [*recover, "--scheme", "nonsense"],
        ["audit", "missing.npz", "-o", "report"],
        ["audit", "scene.npz", "-o", "there.npz"],
        [*audit, "--method", "nonsense"],
        [*audit, "--fractions", "7"],
        ["evaluate", "missing.npz", "truth.npz"],
        ["lift", "missing.npz", "-o", "out.npz"],
        ["lift", "scene.npz", "-o", "there.npz"],
        ["lift", "scene.npz", "-o", "out.npz", "--fraction", "2"],
        ["localize", "missing"],
        ["view", "missing.npz"],
        ["info", "missing.npz"],
        ["demo", "-o", "there.npz"],
    ]
    program = textwrap.dedent(
        """
        import json, sys
        from l2p.cli.main import main
        for words in json.loads(sys.argv[1]):
            try:
                code = main(words)
            except SystemExit as stop:
                code = stop.code
            assert code == 2, words
            assert "torch" not in sys.modules, words
        """
    )
    done = subprocess.run(
        [sys.executable, "-c", program, json.dumps(wrong)],
        capture_output=True, text=True, check=False, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("l2p: error: ") == len(wrong)
