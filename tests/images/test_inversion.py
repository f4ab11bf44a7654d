"""The inversion network and its inputs: projection, pyramid, filling, files, similarity."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from l2p.errors import InputError
from l2p.images.filling import gaussian_fill
from l2p.images.inversion import Inversion, InversionConfig, filled, pyramid
from l2p.images.inversion_file import halved, load_inversion, save_inversion
from l2p.images.picture import draw
from l2p.images.picture_points import PicturePoints
from l2p.images.projection import BEHIND, CELL, Marks, sighted
from l2p.images.similarity import likeness, ssim
from l2p.images.views import placed_view
from l2p.maps.appearance import Appearance


def small(seed: int = 0) -> Inversion:
    """A network with random weights in all layers, also the last, which starts at 0."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Inversion(InversionConfig(features=8, widths=(8, 8, 8)))
        torch.nn.init.normal_(network.last.weight, std=0.1)
    return network.eval().requires_grad_(False)


def some_marks(rng: np.random.Generator, count: int, pixels: int) -> Marks:
    return Marks(
        torch.from_numpy(rng.integers(pixels, size=count)),
        torch.from_numpy(rng.random((count, 3), dtype=np.float32)),
        torch.ones(count, dtype=torch.bool),
        torch.from_numpy(rng.random((count, 128), dtype=np.float32)),
        torch.ones(count, dtype=torch.bool),
        torch.from_numpy(rng.random(count, dtype=np.float32)),
        torch.from_numpy(rng.random(count, dtype=np.float32)),
    )


@pytest.fixture
def view():
    return placed_view(np.zeros(3), np.array([0, 0, 1.0]), np.array([0, -1.0, 0]), width=64, height=48)


@pytest.fixture
def points(rng) -> PicturePoints:
    xyz = rng.normal(size=(400, 3)) * [1, 1, 2] + [0, 0, 5]
    colors = rng.integers(256, size=(400, 3), dtype=np.uint8)
    descriptor = rng.integers(100, size=(400, 128), dtype=np.uint8)
    return PicturePoints(xyz, rng.random(400, dtype=np.float32), Appearance(colors, descriptor, "sift"))


def test_hidden_points_are_those_of_a_plain_loop(points, view):
    found = sighted(points.xyz, points.confidence, view)
    pixel, distance = view.seen(points.xyz)
    rows = [row for row in range(400) if np.isfinite(pixel[row, 0])]
    median = np.median(points.confidence[rows])
    kept = []
    for row in rows:
        cell = pixel[row] // CELL
        others = [
            distance[other]
            for other in rows
            if points.confidence[other] >= median and (pixel[other] // CELL == cell).all()
        ]
        if not others or distance[row] <= BEHIND * min(others):
            kept.append(row)
    assert 0 < len(kept) < len(rows)
    np.testing.assert_array_equal(found.row, kept)
    np.testing.assert_array_equal(found.place, [int(pixel[row, 1]) * view.width + int(pixel[row, 0]) for row in kept])
    assert np.median(found.nearness) == pytest.approx(1, abs=0.01)


def test_the_unit_of_a_scene_does_not_matter(points, view):
    near = sighted(points.xyz, points.confidence, view)
    far = sighted(points.xyz * 1024, points.confidence, view)
    np.testing.assert_array_equal(near.row, far.row)
    np.testing.assert_allclose(near.nearness, far.nearness, rtol=1e-6)


def test_a_doubtful_point_before_the_camera_hides_nothing(points, view):
    near = np.array([[0.0, 0, 0.01]])
    xyz, confidence = np.concatenate([points.xyz, near]), np.append(points.confidence, np.float32(0))
    before = set(sighted(points.xyz, points.confidence, view).row)
    after = set(sighted(xyz, confidence, view).row) - {400}
    assert len(before - after) <= 0.02 * len(before)


def test_a_view_without_points_is_empty(view):
    behind = np.array([[0.0, 0, -1]])
    assert len(sighted(behind, np.ones(1, np.float32), view).row) == 0
    nothing = PicturePoints(behind, np.ones(1, np.float32), Appearance())
    assert draw(small(), nothing, view).shape == (48, 64, 3)


def test_the_pyramid_averages_points_as_a_plain_loop_does(rng):
    marks = some_marks(rng, 30, 2 * 8 * 8)
    feature, weight = torch.from_numpy(rng.random((30, 4), dtype=np.float32)), marks.confidence + 0.1
    levels = pyramid(feature, weight, marks, (2, 8, 8), 3)
    for number, level in enumerate(levels):
        size = 8 >> number
        assert level.mean.shape == (2, 4, size, size)
        for picture in range(2):
            for row in range(size):
                for column in range(size):
                    place = marks.place.numpy()
                    inside = (
                        (place // 64 == picture)
                        & ((place % 64 // 8) >> number == row)
                        & ((place % 8) >> number == column)
                    )
                    total = float(weight[inside].sum())
                    assert float(level.weight[picture, 0, row, column]) == pytest.approx(total, abs=1e-5)
                    if total:
                        mean = (feature[inside] * weight[inside, None]).sum(0) / total
                        torch.testing.assert_close(level.mean[picture, :, row, column], mean)


def test_filling_keeps_one_colour_and_strong_points(rng):
    marks = some_marks(rng, 12, 64)._replace(place=torch.arange(0, 60, 5))
    one = torch.tensor([0.2, 0.6, 0.9]).expand(12, 3)
    flat = filled(pyramid(one, torch.full((12,), 0.3), marks, (1, 8, 8), 4))
    torch.testing.assert_close(flat, torch.tensor([0.2, 0.6, 0.9]).view(1, 3, 1, 1).expand(1, 3, 8, 8))
    colors = marks.color
    sure = filled(pyramid(colors, torch.full((12,), 2.0), marks, (1, 8, 8), 4))
    torch.testing.assert_close(sure.flatten(2)[0, :, marks.place].T, colors)


def test_an_untrained_network_gives_the_filling(rng):
    marks = some_marks(rng, 50, 32 * 32)
    network = Inversion(InversionConfig(features=8, widths=(8, 8, 8))).eval()
    with torch.inference_mode():
        feature, weight = network.points(marks)
        torch.testing.assert_close(network(marks, (1, 32, 32)), filled(pyramid(feature, weight, marks, (1, 32, 32), 3)))


def test_pictures_of_a_batch_do_not_see_each_other(rng):
    network, one, two = small(), some_marks(rng, 40, 256), some_marks(rng, 60, 256)
    both = Marks(*(torch.cat(pair) for pair in zip(one, two._replace(place=two.place + 256), strict=True)))
    together = network(both, (2, 16, 16))
    torch.testing.assert_close(together[:1], network(one, (1, 16, 16)), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(together[1:], network(two, (1, 16, 16)), atol=1e-5, rtol=1e-4)


def test_what_is_unknown_does_not_count(rng):
    """Absent is a state of its own: whatever stands in its place is not read."""
    network, marks = small(), some_marks(rng, 40, 256)
    for flag, value in (("colored", "color"), ("described", "descriptor")):
        unknown = marks._replace(**{flag: torch.zeros(40, dtype=torch.bool)})
        other = unknown._replace(**{value: torch.zeros_like(getattr(marks, value))})
        if value == "color":  # l2p.images.projection.marks gives 0 for it
            unknown = other
        assert torch.equal(network(unknown, (1, 16, 16)), network(other, (1, 16, 16)))
        assert not torch.allclose(network(unknown, (1, 16, 16)), network(marks, (1, 16, 16)))


def test_descriptors_of_other_kinds_are_not_read(points, view):
    network, appearance = small(), points.appearance
    other = Appearance(appearance.rgb, appearance.descriptor, "superpoint")
    alone = Appearance(appearance.rgb)
    np.testing.assert_array_equal(
        draw(network, points._replace(appearance=other), view), draw(network, points._replace(appearance=alone), view)
    )
    assert (draw(network, points, view) != draw(network, points._replace(appearance=alone), view)).any()


def test_a_file_gives_the_same_pictures(points, view, tmp_path):
    network, path = halved(small()), tmp_path / "net.safetensors"
    save_inversion(path, network, {"seed": 3})
    again, facts = load_inversion(path)
    assert facts == {"seed": 3}
    np.testing.assert_array_equal(draw(network, points, view), draw(again, points, view))


def test_other_files_are_refused(tmp_path, tiny_checkpoint):
    with pytest.raises(FileNotFoundError, match="does not exist; give the weights of an inversion network"):
        load_inversion(tmp_path / "none.safetensors")
    with pytest.raises(InputError, match="has format none of inversion networks"):
        load_inversion(tiny_checkpoint)
    (tmp_path / "text.safetensors").write_text("hello")
    with pytest.raises(InputError, match="is no safetensors file, or is damaged"):
        load_inversion(tmp_path / "text.safetensors")


def test_gaussian_filling_is_a_weighted_mean(points, view):
    picture = gaussian_fill(points, view)
    assert picture.shape == (48, 64, 3)
    one = Appearance(np.full((400, 3), 77, dtype=np.uint8))
    assert (gaussian_fill(points._replace(appearance=one), view) == 77).all()
    with pytest.raises(InputError, match="got points without colours"):
        gaussian_fill(points._replace(appearance=Appearance()), view)


def test_similarity_of_pictures(rng):
    one = rng.integers(256, size=(20, 24, 3), dtype=np.uint8)
    same = likeness(one, one)
    assert same.psnr == math.inf and same.ssim == pytest.approx(1)
    other = np.clip(one.astype(int) + 10, 0, 255).astype(np.uint8)
    error = ((one.astype(float) - other) ** 2).mean() / 255**2
    assert likeness(one, other).psnr == pytest.approx(-10 * math.log10(error), abs=1e-4)
    noise = rng.integers(256, size=one.shape, dtype=np.uint8)
    assert likeness(one, noise).ssim < 0.1 < 0.9 < likeness(one, other).ssim


def test_ssim_is_that_of_a_plain_loop(rng):
    """Wang et al. 2004: Gaussian window of 11 pixels, sigma 1.5; windows inside of the picture."""
    one, other = rng.random((2, 3, 14, 13))
    at = np.arange(-5, 6)
    window = np.exp(-(at[:, None] ** 2 + at**2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for channel in range(3):
        for row in range(4):
            for column in range(3):
                a, b = (each[channel, row : row + 11, column : column + 11] for each in (one, other))
                ma, mb = (window * a).sum(), (window * b).sum()
                va, vb = (window * a * a).sum() - ma**2, (window * b * b).sum() - mb**2
                cov = (window * a * b).sum() - ma * mb
                c1, c2 = 0.01**2, 0.03**2
                values.append((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    found = ssim(torch.from_numpy(one)[None], torch.from_numpy(other)[None])
    assert float(found) == pytest.approx(np.mean(values), abs=1e-9)
