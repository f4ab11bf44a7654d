"""What there is to look at, where the view stands, and the data that the view's script reads."""

from __future__ import annotations

import base64

import numpy as np
import pytest

import l2p
from l2p.show.exhibit import Exhibit
from l2p.show.page.view import LEVELS, view_data
from l2p.show.stance import Stance


@pytest.fixture
def exhibit(scene_points, rng) -> Exhibit:
    hidden = l2p.hide(scene_points, seed=0)
    lines, index = hidden.map, hidden.truth.index
    return Exhibit(
        points=scene_points[index],
        lines=lines,
        recovered=scene_points[index] + 0.01,
        rgb=rng.integers(0, 256, (400, 3), dtype=np.uint8),
        confidence=rng.uniform(size=400).astype(np.float32),
        calibrated=True,
        error=rng.uniform(0, 3, size=400),
    )


def floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 3)


def test_every_kind_of_file_can_be_looked_at(tmp_path, scene_points, tiny_checkpoint):
    hidden = l2p.hide(scene_points, seed=0)
    lines, index = hidden.map, hidden.truth.index
    l2p.save(lines, tmp_path / "lines.npz")
    l2p.save(l2p.Truth(scene_points[index], index, 1.0), tmp_path / "truth.npz")
    recovery = l2p.recover(lines, "tomography")
    l2p.save(recovery, tmp_path / "out.npz")
    l2p.save(recovery, tmp_path / "out.ply")
    layers = {
        "lines.npz": ("lines", lines.direction),
        "truth.npz": ("points", scene_points[index]),
        "out.npz": ("recovered", recovery.xyz),
        "out.ply": ("points", recovery.xyz),
    }
    for name, (layer, values) in layers.items():
        loaded = Exhibit.load(tmp_path / name)
        assert len(loaded) == 400
        value = getattr(loaded, layer)
        # A PLY has 32 bits.
        np.testing.assert_allclose(value.direction if layer == "lines" else value, values, rtol=1e-6)
    with pytest.raises(l2p.InputError, match="expected a scene, a line cloud or a recovery"):
        Exhibit.load(tiny_checkpoint)


def test_the_view_holds_most_points_and_keeps_their_shape(exhibit):
    stance = Stance.before(exhibit)
    seen = stance.enter(exhibit.points)
    assert (np.linalg.norm(seen, axis=1) <= 1).mean() > 0.8
    np.testing.assert_allclose(stance.axes @ stance.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(stance.axes) == pytest.approx(1)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.3, -0.8, 0.5)])
def test_up_is_across_the_cameras(up, rng):
    up = np.array(up) / np.linalg.norm(up)
    level = rng.normal(size=(200, 3))
    level -= (level @ up)[:, None] * up
    stance = Stance.before(Exhibit(points=rng.normal(size=(300, 3)), camera_centers=level))
    np.testing.assert_allclose(stance.axes[2], up, atol=1e-6)


def test_chords_lie_on_their_lines_and_in_the_ball(exhibit):
    stance = Stance.before(exhibit)
    chords = stance.chords(exhibit.lines, reach=50.0)
    assert len(chords) == 400
    ends = stance.leave(chords)
    for end in (0, 1):
        np.testing.assert_allclose(np.linalg.norm(chords[:, end], axis=1), 50.0)
        np.testing.assert_allclose(np.cross(ends[:, end], exhibit.lines.direction), exhibit.lines.moment, atol=1e-6)
    assert len(stance.chords(exhibit.lines, reach=0.01)) < 400


def test_lines_alone_have_a_stance(exhibit):
    alone = Exhibit(lines=exhibit.lines)
    assert len(Stance.before(alone).chords(exhibit.lines)) > 350


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.ones((5, 3)), np.array([[0.0, 0, 0], [1, 2, 3]])])
def test_degenerate_clouds_can_be_shown(points):
    data = view_data([("all", Exhibit(points=points))])
    assert np.isfinite(floats(data["clouds"][0]["points"])).all()


def test_counts_are_those_of_all_points(exhibit):
    cloud = view_data([("all", exhibit)], most_points=30)["clouds"][0]
    assert (cloud["count"], cloud["shown"]) == (400, 30)
    for level in (0, 1, 37, 80, LEVELS):
        kept = exhibit.confidence >= level / LEVELS
        assert cloud["kept"][level] == kept.sum()
        assert cloud["right"][level] == (kept & (exhibit.error <= 1)).sum()
    assert cloud["measured"]


def test_without_truth_the_counts_are_expected_ones(exhibit):
    blind = Exhibit(recovered=exhibit.recovered, confidence=exhibit.confidence, calibrated=True)
    cloud = view_data([("all", blind)])["clouds"][0]
    assert not cloud["measured"]
    assert cloud["right"][0] == round(float(exhibit.confidence.sum(dtype=float)))
    ranked = Exhibit(recovered=exhibit.recovered, confidence=exhibit.confidence)
    assert view_data([("all", ranked)])["clouds"][0]["right"] is None


def test_all_layers_are_thinned_to_the_same_rows(exhibit):
    cloud = view_data([("all", exhibit)], most_points=40)["clouds"][0]
    points, recovered = floats(cloud["points"]), floats(cloud["recovered"])
    shift = np.full(3, 0.01) @ Stance.before(exhibit).axes.T / Stance.before(exhibit).radius
    np.testing.assert_allclose(recovered - points, np.broadcast_to(shift, (40, 3)), atol=1e-5)
    level = np.frombuffer(base64.b64decode(cloud["level"]), np.uint8)
    assert len(level) == len(points) == 40


def test_a_step_of_the_slider_keeps_the_same_points_in_picture_and_count(exhibit):
    cloud = view_data([("all", exhibit)])["clouds"][0]
    level = np.frombuffer(base64.b64decode(cloud["level"]), np.uint8)
    assert [(level >= step).sum() for step in range(LEVELS + 1)] == cloud["kept"]
