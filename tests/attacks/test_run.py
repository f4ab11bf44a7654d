"""The attack gives the same points however the same lines are written, and some point for any line."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import l2p
from l2p.attacks.attack import Attack, Elements, Estimate, locate
from l2p.attacks.heuristic import Heuristic
from l2p.attacks.learned.checkpoint import shipped
from l2p.attacks.named import named_attack
from l2p.attacks.run import recover, run, usable_device
from l2p.errors import InputError
from l2p.geometry.frame import Frame
from l2p.judging.accuracy import errors, spacing
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.schemes.hide import hide
from l2p.work.journal import Journal
from l2p.work.work import ALONE, Work


@pytest.fixture(scope="module")
def truth(on_walls) -> np.ndarray:
    return on_walls(1000)


@pytest.fixture(scope="module")
def direction(truth) -> np.ndarray:
    return np.random.default_rng(1).normal(size=truth.shape)


@pytest.fixture(scope="module")
def recovered(truth, direction) -> Recovery:
    return recover(LineCloud.through(truth, direction), method="heuristic")


def in_double(lines: LineCloud) -> np.ndarray:
    """The attack's points with double precision inside, too."""
    frame = Frame.of(lines)
    with torch.inference_mode():
        elements = Elements.sorted(frame.enter(lines, dtype=torch.float64), frame)
        beta = locate(Heuristic(), elements, ALONE).beta[elements.row.argsort()]
    return lines.at(frame.leave(lines, beta))


@pytest.fixture(scope="module")
def exact(truth, direction) -> np.ndarray:
    return in_double(LineCloud.through(truth, direction))


Back = Callable[[np.ndarray], np.ndarray]


@pytest.fixture
def check_same(truth, recovered, exact) -> Callable[[LineCloud, Back], None]:
    """Check that other lines give the points of the first ones, once ``back`` has undone the difference.

    In double precision they are the same but for a line in a thousand. Rounding in single precision moves a few
    lines to another peak, and each is a neighbour of a hundred others.
    """

    def check(lines: LineCloud, back: Back) -> None:
        unit = spacing(truth)
        double, single = back(in_double(lines)), back(recover(lines, method="heuristic").xyz)
        assert (errors(double, exact) < 1e-4 * unit).mean() >= 0.999
        assert (errors(single, recovered.xyz) < 1e-2 * unit).mean() >= 0.97
        for found, expected in ((double, exact), (single, recovered.xyz)):
            assert np.median(errors(found, truth)) == pytest.approx(np.median(errors(expected, truth)), rel=0.01)

    return check


def test_the_attack_recovers_most_points(truth, recovered):
    error = errors(recovered.xyz, truth) / spacing(truth)
    assert np.median(error) < 1 and (error < 1).mean() > 0.5


def test_points_lie_on_their_lines_at_their_positions(truth, direction, recovered):
    lines = LineCloud.through(truth, direction)
    apart = np.cross(recovered.xyz, lines.direction) - lines.moment
    assert np.linalg.norm(apart, axis=1).max() < 1e-12
    np.testing.assert_array_equal(lines.at(recovered.beta), recovered.xyz)


def test_the_same_lines_give_the_same_bytes(truth, direction, recovered):
    again = recover(LineCloud.through(truth, direction), method="heuristic")
    assert again.xyz.tobytes() == recovered.xyz.tobytes()
    assert again.confidence.tobytes() == recovered.confidence.tobytes()


def test_order_does_not_matter(truth, direction, check_same):
    order = np.random.default_rng(2).permutation(len(truth))
    check_same(LineCloud.through(truth[order], direction[order]), lambda xyz: xyz[np.argsort(order)])


def test_the_sign_of_the_directions_does_not_matter(truth, direction, check_same):
    sign = np.random.default_rng(2).choice([-1.0, 1.0], size=(len(truth), 1))
    check_same(LineCloud.through(truth, sign * direction), lambda xyz: xyz)


def test_where_on_the_line_it_was_given_does_not_matter(truth, direction, check_same):
    slide = 10 * np.random.default_rng(2).normal(size=(len(truth), 1))
    check_same(LineCloud.through(truth + slide * direction, direction), lambda xyz: xyz)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 3e5])
def test_points_follow_a_similarity(truth, direction, check_same, scale):
    turn, shift = Rotation.from_rotvec([0.7, -1.9, 2.3]).as_matrix(), np.array([3.0, -7, 11])
    moved = LineCloud.through(scale * (truth @ turn.T + shift), direction @ turn.T)
    check_same(moved, lambda xyz: (xyz / scale - shift) @ turn)


def test_far_from_the_origin_the_points_are_the_same(truth, direction, check_same):
    shift = 1e5 * spacing(truth) * np.array([0.6, -0.64, 0.48])
    check_same(LineCloud.through(truth + shift, direction), lambda xyz: xyz - shift)


def test_confidence_follows_the_lines_alone(truth, direction, recovered):
    order = np.random.default_rng(2).permutation(len(truth))
    moved = LineCloud.through(100 + 7 * truth[order], -direction[order])
    apart = np.abs(recover(moved, method="heuristic").confidence - recovered.confidence[order])
    assert (apart < 0.05).mean() >= 0.97


def check_valid(lines: LineCloud, result: Recovery) -> None:
    assert len(result) == len(lines)
    assert np.isfinite(result.xyz).all() and np.isfinite(result.beta).all()
    assert ((result.confidence >= 0) & (result.confidence <= 1)).all()
    size = 1 + np.abs(result.xyz).max()
    assert np.linalg.norm(np.cross(result.xyz, lines.direction) - lines.moment, axis=1).max() < 1e-12 * size
    assert result.neighbors is not None and result.affinity is not None
    assert result.neighbors.shape == result.affinity.shape
    assert (result.neighbors != np.arange(len(lines))[:, None]).all() and (result.neighbors < len(lines)).all()
    assert ((result.affinity >= 0) & (result.affinity <= 1)).all()
    assert (result.affinity[result.neighbors < 0] == 0).all()


@pytest.mark.parametrize(
    ("method", "rounds"), [("heuristic", 0), ("heuristic", 3), ("tomography", 0), ("tomography", 2), ("learned", None)]
)
@pytest.mark.parametrize("count", [1, 2, 3, 10, 60])
def test_few_lines_have_points(count, method, rounds):
    rng = np.random.default_rng(count)
    lines = LineCloud.through(rng.normal(size=(count, 3)), rng.normal(size=(count, 3)))
    check_valid(lines, recover(lines, method=method, rounds=rounds))


def test_one_line_is_placed_somewhere_and_not_trusted():
    result = recover(LineCloud.through(np.array([[1.0, 2, 3]]), np.array([[0.0, 0, 1]])), method="heuristic")
    assert result.confidence.tolist() == [0]


def test_two_lines_meet_where_they_are_nearest():
    lines = LineCloud.through(np.array([[5.0, 0, 0], [0, 5, 2]]), np.array([[1.0, 0, 0], [0, 1, 0]]))
    np.testing.assert_allclose(recover(lines, method="heuristic").xyz, [[0, 0, 0], [0, 0, 2]], atol=1e-6)


@pytest.mark.parametrize("kind", ["parallel", "duplicated", "through one point", "through zero", "in a plane"])
def test_lines_in_special_position_have_points(kind):
    rng = np.random.default_rng(0)
    point, direction = rng.normal(size=(60, 3)), rng.normal(size=(60, 3))
    if kind == "parallel":
        direction[:] = direction[0]
    if kind == "duplicated":
        point[30:], direction[30:] = point[:30], direction[:30]
    if kind == "through one point":
        point[:] = point[0]
    if kind == "through zero":
        point[:] = 0
    if kind == "in a plane":
        point[:, 2] = direction[:, 2] = 0
    lines = LineCloud.through(point, direction)
    result = recover(lines, method="heuristic")
    check_valid(lines, result)
    if kind == "parallel":
        assert (result.confidence == 0).all()
    if kind.startswith("through"):
        np.testing.assert_allclose(result.xyz, point, atol=1e-9)
    if kind.startswith("through"):
        # All through one centre: an attack of its own, which puts them at one distance and trusts none.
        assert "nothing tells how far" in recover(lines).info["sentence"]
    else:
        check_valid(lines, recover(lines, method="learned"))


def test_the_learned_attack_is_the_default_and_names_its_checkpoint(truth, direction):
    lines = LineCloud.through(truth[:200], direction[:200])
    result = recover(lines)
    check_valid(lines, result)
    assert result.info["method"] == "learned"
    assert result.info["settings"]["checkpoint"] == "learned.safetensors"
    assert result.info["settings"]["digest"] == hashlib.sha256(shipped().read_bytes()).hexdigest()[:12]
    again = recover(lines)
    assert again.xyz.tobytes() == result.xyz.tobytes() and again.confidence.tobytes() == result.confidence.tobytes()


def test_another_checkpoint_is_used_and_named(truth, direction, tiny_checkpoint):
    lines = LineCloud.through(truth[:200], direction[:200])
    result = recover(lines, checkpoint=tiny_checkpoint)
    settings = result.info["settings"]
    assert (settings["checkpoint"], settings["rounds"], settings["candidates"]) == ("tiny.safetensors", 2, 16)
    assert settings["digest"] == hashlib.sha256(tiny_checkpoint.read_bytes()).hexdigest()[:12]
    assert str(tiny_checkpoint.parent) not in repr(result.info), "folders may name their user"
    assert not np.array_equal(result.xyz, recover(lines, checkpoint=tiny_checkpoint, rounds=1).xyz)


def test_every_candidate_of_the_learned_attack_is_there_once_with_its_affinity(truth, direction, tiny_checkpoint):
    lines = LineCloud.through(truth[:200], direction[:200])
    result = recover(lines, checkpoint=tiny_checkpoint)
    assert result.neighbors is not None and result.affinity is not None
    assert result.neighbors.shape == (200, 16)
    assert all(len(set(row)) == 16 for row in result.neighbors.tolist())
    assert len(np.unique(result.affinity)) > 1000, "of each pair its own"


def test_the_learned_attack_starts_where_the_tomography_ends(truth, direction, tiny_checkpoint):
    lines = LineCloud.through(truth[:200], direction[:200])
    result = recover(lines, checkpoint=tiny_checkpoint, rounds=0)
    np.testing.assert_array_equal(result.xyz, recover(lines, method="tomography", rounds=0).xyz)


def test_a_fraction_lowers_the_learned_confidence_and_moves_no_point(truth, direction, tiny_checkpoint):
    lines = LineCloud.through(truth[:200], direction[:200])
    full, told, sparse = (recover(lines, checkpoint=tiny_checkpoint, fraction=share) for share in (None, 1.0, 0.1))
    assert told.confidence.tobytes() == full.confidence.tobytes()
    assert sparse.xyz.tobytes() == full.xyz.tobytes()
    assert (sparse.confidence <= full.confidence).all() and sparse.confidence.mean() < full.confidence.mean()


def test_an_installation_without_weights_says_so(truth, direction, monkeypatch, tmp_path):
    monkeypatch.setattr("l2p.attacks.learned.checkpoint.files", lambda package: tmp_path)
    lines = LineCloud.through(truth[:5], direction[:5])
    with pytest.raises(FileNotFoundError, match=r"learned\.safetensors is missing from this installation; install l2p"):
        recover(lines)
    assert len(recover(lines, method="tomography")) == 5


def test_colours_and_settings_come_along(truth):
    rgb = np.random.default_rng(0).integers(0, 256, size=(200, 3)).astype(np.uint8)
    hidden = hide(truth[:200], seed=1, rgb=rgb)
    lines, index = hidden.map, hidden.truth.index
    result = recover(lines, method="heuristic", rounds=1, scene_kind="outdoor", fraction=0.05)
    np.testing.assert_array_equal(result.rgb, rgb[index])
    assert result.info["method"] == "heuristic" and result.info["device"] == "cpu"
    settings = result.info["settings"]
    assert (settings["rounds"], settings["coarse"], settings["fine"]) == (1, 100, 50)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "magic"}, "got method 'magic'; expected one of .*heuristic"),
        ({"method": "heuristic", "device": "cuda:99"}, "got device 'cuda:99'; expected one of cpu"),
        ({"method": "heuristic", "rounds": -1}, "got -1 rounds; expected 0"),
        ({"method": "heuristic", "fraction": 0.0}, r"got fraction 0.0; expected a number in \(0, 1\]"),
        ({"method": "heuristic", "scene_kind": "sea"}, "got scene kind 'sea'; expected one of indoor, outdoor"),
        ({"method": "tomography", "scene_kind": "indoor"}, "got a scene kind for method 'tomography'; expected"),
        (
            {"method": "tomography", "fraction": 0.5},
            "a fraction for .*; .* with method 'learned' or 'heuristic'",
        ),
        ({"method": "tomography", "checkpoint": "a"}, "a checkpoint for method 'tomography'; .* method 'learned' only"),
        ({"method": "heuristic", "checkpoint": "a"}, "got a checkpoint for method 'heuristic'"),
        ({"scene_kind": "indoor"}, "got a scene kind for method 'learned'; expected it with method 'heuristic' only"),
        ({"fraction": 1.5}, r"got fraction 1.5; expected a number in \(0, 1\]"),
        ({"fraction": float("nan")}, "got fraction nan"),
        ({"rounds": -1}, "got -1 rounds; expected 0 to"),
        ({"rounds": 100}, "got 100 rounds; expected 0 to .*, those that .*learned.safetensors was trained for"),
        ({"checkpoint": Path(__file__)}, "test_run.py is no safetensors file"),
    ],
)
def test_what_cannot_be_run_is_refused(truth, direction, arguments, message):
    with pytest.raises(InputError, match=message):
        recover(LineCloud.through(truth[:5], direction[:5]), **arguments)


def test_a_checkpoint_that_is_not_there_is_named(truth, direction, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.safetensors does not exist; expected a checkpoint"):
        recover(LineCloud.through(truth[:5], direction[:5]), checkpoint=tmp_path / "none.safetensors")


def test_no_lines_are_refused(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(InputError, match="got a line cloud without lines; expected at least one line"):
        recover(LineCloud(np.zeros((0, 3)), np.zeros((0, 3))), method="heuristic")


def test_the_processor_is_always_there():
    assert usable_device("cpu").type == "cpu"


class Twice(Attack):
    """Places two points on every other line, in any order, and none on the others."""

    def finish(self, state: Elements, work: Work) -> Estimate:
        element = torch.arange(0, len(state), 2).repeat(2).flip(0)
        beta = torch.linspace(-1, 1, len(element))
        near = element[:, None]
        return Estimate(beta, torch.ones_like(beta), near, torch.ones(len(beta), 1), element)


def test_an_attack_may_place_two_points_on_a_line_or_none(truth, direction):
    lines = LineCloud.through(truth, direction)
    found = run(lines, Twice())
    assert len(found) == len(lines) and not found.one_each
    assert (np.diff(found.element) >= 0).all() and set(np.bincount(found.element, minlength=len(lines))) == {0, 2}
    off = np.cross(found.xyz, lines.direction[found.element]) - lines.moment[found.element]
    assert np.abs(off).max() < 1e-9
    assert found.neighbors is not None and np.array_equal(found.neighbors[:, 0], found.element)
    scores = l2p.evaluate(found, l2p.Truth(truth, np.arange(len(truth)), spacing=1.0))
    assert scores.lines == len(truth)


def test_own_attacks_do_not_make_the_working_folder_importable(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    named_attack("tomography")
    assert str(tmp_path) not in sys.path, "a file there could stand in for a library that is loaded later"


def test_a_run_to_resume_is_that_of_its_method_whatever_the_lines_publish(truth):
    class Remembering(Journal):
        def begin(self, about):
            self.about = about

    journals = []
    for rgb in (None, np.zeros((len(truth), 3), np.uint8)):
        journals.append(Remembering())
        lines = l2p.lift(truth, seed=0, rgb=rgb)
        run(lines, named_attack("tomography", rounds=0), work=Work(journal=journals[-1]), name="mine")
    assert [journal.about["method"] for journal in journals] == ["mine", "mine"]
    assert journals[0].about["lines"] != journals[1].about["lines"]
