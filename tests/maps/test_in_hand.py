"""What users have in hand: paths, scenes, arrays; what is none of these gets a sentence; the text of each is short."""

from __future__ import annotations

import dataclasses
import importlib
import os
import pkgutil
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import l2p
from l2p.attacks.settings import METHODS, MethodName
from l2p.io.given import given_recovery, given_scene, given_truth
from l2p.io.given_map import given_map
from l2p.maps import ATTRIBUTES, AttributeName
from l2p.maps.short_repr import short, short_repr
from l2p.schemes.scheme import SCHEMES, SchemeName

ROOT = Path(__file__).parents[2]


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(60, 3))


def test_names_as_types_are_those_of_the_tables() -> None:
    assert get_args(MethodName) == METHODS
    assert get_args(SchemeName) == tuple(SCHEMES)
    assert get_args(AttributeName) == ATTRIBUTES


def test_paths_do_as_well_as_what_is_in_the_files(tmp_path: Path, points: np.ndarray) -> None:
    np.savez(tmp_path / "scene.npz", xyz=points)
    hidden = l2p.hide(tmp_path / "scene.npz", seed=0)
    np.testing.assert_array_equal(hidden.truth.xyz, points[hidden.truth.index])
    np.testing.assert_array_equal(l2p.lift(str(tmp_path / "scene.npz"), seed=0).moment, hidden.map.moment)
    l2p.save(hidden.map, tmp_path / "lines.npz")
    truth = dataclasses.replace(hidden.truth, spacing=0.5)
    l2p.save(truth, tmp_path / "truth.npz")
    lines = given_map(tmp_path / "lines.npz")
    assert isinstance(lines, l2p.LineCloud)
    np.testing.assert_array_equal(lines.direction, hidden.map.direction)
    assert given_map(lines) is lines
    recovery = l2p.recover(str(tmp_path / "lines.npz"), method="tomography", rounds=0)
    np.testing.assert_array_equal(recovery.xyz, l2p.recover(hidden.map, method="tomography", rounds=0).xyz)
    l2p.save(recovery, tmp_path / "out.npz")
    scores = l2p.evaluate(tmp_path / "out.npz", str(tmp_path / "truth.npz")).as_dict()
    assert scores == l2p.evaluate(recovery, truth).as_dict()
    assert scores["median"] == l2p.evaluate(recovery.xyz, l2p.Hiding(hidden.map, truth)).median
    assert isinstance(given_scene(tmp_path / "scene.npz"), l2p.Scene)
    assert isinstance(given_scene(tmp_path / "lines.npz"), l2p.LineCloud)
    assert isinstance(given_scene(points), l2p.Scene)
    assert given_truth(truth) is truth and given_recovery(recovery) is recovery


#: Calls that a user may try, each with some words of what it says. They run without the checks of types of the tests.
WRONG = """
l2p.recover(None) :: got None; expected a LineCloud, or the path of its file
l2p.recover(7) :: got 7; expected a LineCloud
l2p.recover(points) :: got an array of shape (60, 3); .*points are hidden first, l2p.lift(points)
l2p.recover(np.hstack([points, points])) :: shape (60, 6); .*LineCloud.through(points, directions)
l2p.recover((points, points)) :: got a tuple of 2; .*LineCloud(directions, moments)
l2p.recover(scene) :: got a Scene; .*hide it first: l2p.lift(scene)
l2p.recover(l2p.hide(scene)) :: got a Hiding; .*give its map, hiding.map
l2p.recover([lines, lines]) :: got a list of 2; .*l2p.recover_releases
l2p.recover(lines, method=None) :: got method None
l2p.recover(lines, method=7) :: got method 7; expected a name
l2p.recover(lines, method="magic") :: got method 'magic'; expected one of learned
l2p.recover(lines, rounds="three") :: got rounds 'three' for method 'learned'; expected a whole number
l2p.recover(lines, fraction="half") :: got fraction 'half' for method 'learned'; expected a number
l2p.recover(lines, checkpoint=7) :: got checkpoint 7 for method 'learned'; expected a text
l2p.recover(lines, method="tomography", memory="much") :: got a memory of much GiB
l2p.recover(lines, method="tomography", device=None) :: got device 'None'
l2p.recover(lines, nonsense=1) :: got a nonsense for method 'learned'
l2p.recover_releases(lines) :: got a LineCloud; expected a list of two or more
l2p.recover_releases("lines.npz") :: got 'lines.npz'; expected a list
l2p.recover_releases([lines, None]) :: got None; expected a LineCloud
l2p.lift(None) :: got None; expected a Scene, points of shape
l2p.lift(points[:, :2]) :: got points of shape (60, 2); expected
l2p.lift([[1, 2, 3], [4, 5]]) :: rows of different lengths
l2p.lift([["a", "b", "c"]]) :: got points of type
l2p.lift(points, seed=-1) :: got seed -1; expected a whole number
l2p.lift(points, seed="x") :: got seed 'x'
l2p.lift(points, fraction="half") :: got fraction 'half'; expected a number in (0, 1]
l2p.lift(points, fraction=None) :: got fraction None
l2p.lift(points, scheme=7) :: got scheme 7; expected one of uniform
l2p.lift(points, scheme=["rays"]) :: got scheme
l2p.lift(points, rgb=[[1, 2, 3]]) :: got rgb of type int64
l2p.lift(points, drop=[1, 2]) :: got points to drop of type int64
l2p.lift(points, scheme="rays-voxel", cell="a") :: got cell a; expected
l2p.evaluate(None, points) :: got None for a recovery
l2p.evaluate(points, None) :: got None for the truth
l2p.evaluate(points, scene) :: got a Scene for the truth, whose points are in another order
l2p.evaluate(points, points[:5]) :: got 60 recovered and 5 true points
l2p.evaluate(points, points, spacing=0) :: got spacing 0; expected a length above 0
l2p.evaluate(points, points, spacing="x") :: got spacing 'x'
l2p.audit(None) :: got None; expected a Scene
l2p.audit(points[0]) :: got points of shape (3,)
l2p.audit(points, fractions="half") :: got fraction 'h'
l2p.audit(points, fractions=7) :: got fraction 7
l2p.audit(points, seed="x") :: got seed 'x'
l2p.audit(points, releases="two") :: got 'two' releases
l2p.audit(points, schemes="nonsense") :: got scheme 'nonsense'
l2p.audit(points, ignore="nonsense") :: got attribute 'nonsense'
l2p.audit(points, region=[1]) :: got a region
l2p.load(None) :: got None; expected the path
l2p.load(7) :: got 7; expected the path
l2p.simulate(7) :: got kind 7
l2p.simulate("room", points="many") :: got 'many' points
l2p.Scene(None) :: got xyz of type object
l2p.Scene(points, ids=np.arange(3)) :: got ids of shape (3,)
l2p.Recovery(points, 0, 0) :: got confidence of shape ()
l2p.Truth(None, None) :: got xyz of type object
l2p.LineCloud(None, None) :: got direction of type object
"""


def test_wrong_things_get_a_sentence() -> None:
    """In an interpreter of its own, as a user's is."""
    program = """
        import re, sys
        import numpy as np
        import l2p
        points = np.random.default_rng(0).normal(size=(60, 3))
        scene, lines = l2p.Scene(points), l2p.lift(points, seed=0)
        for row in sys.argv[1].strip().splitlines():
            call, said = row.split(" :: ")
            wanted = re.escape(said).replace(re.escape(".*"), ".*")
            try:
                eval(call)
                print(call, "is taken")
            except l2p.InputError as error:
                if not re.search(wanted, str(error)) or chr(10) in str(error):
                    print(call, "says:", error)
            except Exception as error:
                print(call, "raises", type(error).__name__, error)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program), WRONG],
        capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_text_of_a_map_is_short(points: np.ndarray) -> None:
    rgb = np.zeros((60, 3), dtype=np.uint8)
    assert repr(l2p.Scene(points, rgb)) == "Scene(xyz=float64 (60, 3), rgb=uint8 (60, 3))"
    hidden = l2p.hide(points, seed=0)
    assert repr(hidden.map) == "LineCloud(direction=float64 (60, 3), moment=float64 (60, 3))"
    recovery = l2p.recover(hidden.map, method="tomography", rounds=0)
    assert "xyz=float64 (60, 3)" in repr(recovery) and "info={method, settings, used, ...}" in repr(recovery)
    for thing in (hidden, hidden.truth, recovery, l2p.evaluate(recovery, hidden)):
        assert len(repr(thing)) < 420 and "\n" not in repr(thing)
    assert short([points] * 5) == "5 x ndarray" and short({"a": 1}) == "{a}" and short("x" * 99).endswith("...")


def test_everything_that_holds_arrays_has_such_a_text() -> None:
    long = []
    for found in pkgutil.walk_packages(l2p.__path__, "l2p."):
        if found.name.endswith("__main__"):
            continue
        module = importlib.import_module(found.name)
        for kind in vars(module).values():
            if isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == found.name:
                held = " ".join(str(entry.type) for entry in dataclasses.fields(kind))
                if re.search(r"ndarray|Tensor\b", held) and kind.__repr__ is not short_repr:
                    long.append(f"{found.name}.{kind.__name__}")
    assert not long
