"""Published colours and descriptors tell what they are, and nothing else of the points, not even in the bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l2p.io.line_files import save_lines
from l2p.io.track_means import ImageFeatures, mean_over_tracks
from l2p.maps.scene import Scene
from l2p.schemes.hide import hide
from l2p.schemes.uniform import Uniform


class Drawn(np.random.Generator):
    """A generator that draws the given directions: so each point keeps its own in any order of the points."""

    def __init__(self, direction: np.ndarray) -> None:
        super().__init__(np.random.PCG64(0))
        self.direction = direction

    def normal(self, *_: Any, **__: Any) -> np.ndarray:
        return self.direction


def bytes_of(folder: Path, lines: Any) -> bytes:
    save_lines(lines, folder / "lines.npz", overwrite=True)
    return (folder / "lines.npz").read_bytes()


@pytest.fixture(params=[np.uint8, np.float32])
def scene(request: pytest.FixtureRequest) -> Any:
    rng = np.random.default_rng(8)
    descriptor = rng.integers(0, 256, (200, 128)).astype(np.uint8)
    if request.param == np.float32:
        descriptor = (rng.normal(size=(200, 64)) * (rng.random((200, 64)) < 0.7)).astype(np.float32)
    rgb = rng.integers(0, 256, (200, 3), dtype=np.uint8)
    return Scene(rng.normal(size=(200, 3)), rgb, descriptor=descriptor, descriptor_kind="own")


def test_any_order_of_the_points_gives_the_same_bytes(tmp_path, scene, rng):
    direction = rng.normal(size=(200, 3))
    files = set()
    for _ in range(5):
        order = rng.permutation(200)
        hidden = Uniform().hide(scene.xyz[order], np.arange(200), Drawn(direction[order]), scene.appearance.rows(order))
        files.add(bytes_of(tmp_path, hidden.map))
    assert len(files) == 1


def in_memory(array: np.ndarray, way: str) -> np.ndarray:
    """The same numbers, stored in another way."""
    if way == "columns":
        return np.asfortranarray(array)
    if way == "strided":
        return np.repeat(np.repeat(array, 2, axis=0), 3, axis=1)[::2, ::3]
    if way == "reversed":
        return np.ascontiguousarray(array[::-1])[::-1]
    if way == "part of more":
        return np.concatenate([array, array])[: len(array)]
    if way == "big-endian":
        return array.astype(array.dtype.newbyteorder(">"))
    return np.where(array == 0, -np.zeros_like(array), array) if array.dtype.kind == "f" else array.copy()


@pytest.mark.parametrize("fraction", [1.0, 0.3])
def test_the_place_in_memory_is_not_published(tmp_path, scene, fraction):
    plain = bytes_of(tmp_path, hide(scene, 1, fraction, rgb=True, descriptor=True).map)
    for way in ("columns", "strided", "reversed", "part of more", "big-endian", "negative zeros"):
        other: Any = Scene(
            scene.xyz,
            in_memory(scene.rgb, way),
            descriptor=in_memory(scene.descriptor, way),
            descriptor_kind=" OWN",
        )
        assert bytes_of(tmp_path, hide(other, 1, fraction, rgb=True, descriptor=True).map) == plain, way
        given = hide(scene.xyz, 1, fraction, rgb=other.rgb, descriptor=other.descriptor, descriptor_kind="own")
        assert bytes_of(tmp_path, given.map) == plain, way


@pytest.mark.parametrize("way", ["columns", "strided"])
def test_lines_that_are_saved_without_hiding_have_no_memory_order_either(tmp_path, scene, way):
    lines = hide(scene, 1, rgb=True, descriptor=True).map
    plain = bytes_of(tmp_path, lines)
    other = [in_memory(np.asarray(value), way) for value in (lines.rgb, lines.descriptor)]
    again = type(lines)(lines.direction, lines.moment, other[0], lines.scheme, other[1], lines.descriptor_kind)
    assert bytes_of(tmp_path, again) == plain


def test_double_precision_is_not_published(tmp_path, scene):
    """What a double has beyond single precision, such as the division by the length of a track, is cut off."""
    if scene.descriptor.dtype == np.uint8:
        pytest.skip("whole numbers have one type")
    plain = bytes_of(tmp_path, hide(scene, 1, descriptor=True).map)
    for seed in range(3):
        finer = scene.descriptor * (1 + 1e-9 * np.random.default_rng(seed).random(scene.descriptor.shape))
        other = Scene(scene.xyz, descriptor=finer, descriptor_kind="own")
        assert bytes_of(tmp_path, hide(other, 1, descriptor=True).map) == plain


def test_points_that_are_left_out_leave_nothing(tmp_path, scene, rng):
    hidden = hide(scene, 4, 0.3, rgb=True, descriptor=True)
    out = np.setdiff1d(np.arange(200), hidden.truth.index)
    rgb, descriptor = scene.rgb.copy(), scene.descriptor.copy()
    rgb[out], descriptor[out] = 7, rng.integers(0, 200, (len(out), descriptor.shape[1]))
    other = Scene(scene.xyz, rgb, descriptor=descriptor, descriptor_kind="own")
    again = hide(other, 4, 0.3, rgb=True, descriptor=True)
    assert bytes_of(tmp_path, again.map) == bytes_of(tmp_path, hidden.map)
    assert again.map.descriptor is not None and again.map.descriptor.shape[0] == len(again.map) == 60


def test_rows_are_in_the_order_of_the_lines(scene):
    hidden = hide(scene, 4, 0.5, rgb=True, descriptor=True)
    np.testing.assert_array_equal(hidden.map.descriptor, scene.descriptor[hidden.truth.index])
    np.testing.assert_array_equal(hidden.map.rgb, scene.rgb[hidden.truth.index])
    np.testing.assert_array_equal(np.lexsort(hidden.map.direction.T), np.arange(100))


def test_nothing_is_published_unasked(tmp_path, scene):
    bare = bytes_of(tmp_path, hide(Scene(scene.xyz), 2).map)
    assert bytes_of(tmp_path, hide(scene, 2).map) == bare
    assert hide(scene, 2, rgb=True).map.appearance.names == ("rgb",)
    assert hide(scene, 2, descriptor=True).map.appearance.names == ("descriptor",)


# The length of the track, from the mean


class Tracks:
    """A model of points seen by 2 to 8 images, and the features of the images."""

    path = "features"

    def __init__(self, make: Any, points: int = 4000) -> None:
        rng = np.random.default_rng(11)
        self.length = rng.integers(2, 9, points)
        track = [[_Element(int(image), point) for image in range(n)] for point, n in enumerate(self.length)]
        self.points3D = {point: _Point(_Track(elements)) for point, elements in enumerate(track)}
        self.images = {image: _Image(str(image), [_Keypoint()] * points) for image in range(8)}
        true = make(rng, (points, 64))
        self.observed = [make.observe(true, rng) for _ in range(8)]

    def of_image(self, name: str) -> ImageFeatures:
        return ImageFeatures(self.observed[int(name)], None)

    def means(self) -> np.ndarray:
        """Without rounding, in double precision."""
        total = np.cumsum(np.array(self.observed, dtype=np.float64), axis=0)
        return total[self.length - 1, np.arange(len(self.length))] / self.length[:, None]

    def published(self) -> np.ndarray:
        return mean_over_tracks(self, np.arange(len(self.length)), self)


class _Element:
    def __init__(self, image: int, keypoint: int) -> None:
        self.image_id, self.point2D_idx = image, keypoint


class _Track:
    def __init__(self, elements: list[_Element]) -> None:
        self.elements = elements


class _Point:
    def __init__(self, track: _Track) -> None:
        self.track = track


class _Keypoint:
    xy = np.zeros(2)


class _Image:
    def __init__(self, name: str, keypoints: list[_Keypoint]) -> None:
        self.name, self.points2D = name, keypoints


class Bytes:
    """SIFT of COLMAP."""

    def __call__(self, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        return rng.uniform(20, 200, shape)

    def observe(self, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.rint(true + rng.uniform(-15, 15, true.shape)).astype(np.uint8)


class Whole(Bytes):
    """SIFT of OpenCV: whole numbers as floats."""

    def observe(self, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return super().observe(true, rng).astype(np.float32)


class Half(Bytes):
    """Half precision, of any length."""

    def __call__(self, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        return rng.normal(size=shape)

    def observe(self, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return (true + rng.normal(scale=0.1, size=true.shape)).astype(np.float16)


class Unit(Half):
    """Half precision and of unit length, as hloc stores SuperPoint."""

    def observe(self, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        vector = true + rng.normal(scale=0.3, size=true.shape)
        return (vector / np.linalg.norm(vector, axis=1, keepdims=True)).astype(np.float16)


def tells(values: np.ndarray, step: float, length: np.ndarray) -> float:
    """Largest correlation of a trace of division with short, even and odd tracks: what a thief would try first.

    Traces: shares of numbers that are multiples of 1, 2, 3, 4, 5 steps, and the mean fraction of 2 to 8 times them.
    """
    multiple = values.astype(np.float64) / step
    traces = [(np.abs(multiple / k - np.rint(multiple / k)) < 1e-3).mean(axis=1) for k in range(1, 6)]
    traces += [np.abs(multiple * k - np.rint(multiple * k)).mean(axis=1) for k in range(2, 9)]
    asked = [length, length == 2, length % 2 == 0, length == 4, np.isin(length, (2, 4, 8)), length % 3 == 0]
    found = [
        abs(np.corrcoef(trace, what.astype(float))[0, 1]) for trace in traces if trace.std() > 1e-9 for what in asked
    ]
    return max(found, default=0.0)


@pytest.mark.parametrize(("make", "step"), [(Bytes(), 1), (Whole(), 1), (Half(), 2.0**-14), (Unit(), 2.0**-14)])
def test_the_rounding_of_a_mean_does_not_tell_the_length_of_its_track(make, step):
    tracks = Tracks(make)
    published = tracks.published()
    limit = 5 / np.sqrt(len(published))
    for each in (step, published_step(published)):
        assert tells(published, each, tracks.length) < limit
    # The test can fail: means as they are tell it, and so do whole numbers rounded to even ones.
    if make.__class__ in (Bytes, Whole):
        assert tells(tracks.means(), 1, tracks.length) > 0.4
        assert tells(np.rint(tracks.means()), 1, tracks.length) > 0.4
    else:
        assert tells(tracks.means(), 2.0**-11, tracks.length) > limit


def published_step(values: np.ndarray) -> float:
    """The step that all numbers are multiples of."""
    step = 2.0
    while (values / step != np.rint(values / step)).any():
        step /= 2
    return step


def test_float_means_have_few_bits():
    for make in (Half(), Unit()):
        published = Tracks(make).published()
        assert np.abs(published).max() / published_step(published) <= 2**10


def test_the_length_of_unit_means_does_not_tell_how_much_they_differ():
    tracks = Tracks(Unit())
    published = np.linalg.norm(tracks.published(), axis=1)
    assert abs(np.corrcoef(published, tracks.length)[0, 1]) < 5 / np.sqrt(len(published))
    assert abs(np.corrcoef(np.linalg.norm(tracks.means(), axis=1), tracks.length)[0, 1]) > 0.5
