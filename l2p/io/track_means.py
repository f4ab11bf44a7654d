"""Descriptors of the points of a COLMAP model: means over their tracks, from the features of its images."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from l2p.errors import InputError
from l2p.maps.short_repr import short_repr

#: Largest distance, in pixels, of a keypoint of the model from the same one in the file of features.
SAME_PLACE = 0.05
#: Largest difference from 1 of the lengths of unit descriptors, which may be stored in half precision.
UNIT = 0.01
#: Means of floating-point descriptors are rounded to the largest number of all descriptors over 2^BITS to 2^(BITS + 1).
BITS = 9

# Rows of the means that are finished at a time.
_BLOCK = 1 << 14
# Least correlation of the coordinates of keypoints in model and file; undistortion and scaling keep it.
_CORRELATION = 0.9
# Largest coordinate of a keypoint, pixels.
_FARTHEST = 1e9
# Fewest keypoints of an image to judge the correlation by.
_FEW = 8


@dataclass(frozen=True)
class ImageFeatures:
    """Descriptors of the keypoints of one image, and their places in pixels, if known."""

    descriptor: Num[np.ndarray, "keypoints length"]
    xy: Num[np.ndarray, "keypoints 2"] | None

    __repr__ = short_repr


@runtime_checkable
class Features(Protocol):
    """A file of features of images."""

    @property
    def path(self) -> str | PathLike[str]:
        """Where it is, for messages."""
        ...

    def of_image(self, name: str) -> ImageFeatures | None:
        """Read the features of the image of this name; None if the file has none."""
        ...


@dataclass(frozen=True)
class Seen:
    """Observations in one image of a model.

    Attributes
    ----------
    name : str
        Name of the image.
    keypoints : int
        Number of keypoints of the image in the model, also of those without a point.
    point : (observations,) int64
        Row of each observed point.
    keypoint : (observations,) int64
        Index of its keypoint in the model.
    xy : (observations, 2) float64
        Place of its keypoint, pixels.
    """

    name: str
    keypoints: int
    point: Int[np.ndarray, " observations"]
    keypoint: Int[np.ndarray, " observations"]
    xy: Float[np.ndarray, "observations 2"]

    __repr__ = short_repr


def mean_over_tracks(
    model: Any, ids: Int[np.ndarray, " points"], features: Features
) -> Num[np.ndarray, "points length"]:
    """Average the descriptors of the keypoints in the track of each point.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Its images are found in the features by name, its keypoints by index. Where the model has dropped keypoints, so
        that counts differ, they are found by place; of several keypoints at one place none counts, unless the point has
        no other observation.
    ids : (points,) int64
        ``point3D_id`` of each point.
    features : Features
        Features of the images.

    Returns
    -------
    (points, length) uint8 or float32
        uint8 if the descriptors are: rounded, not normalised again. Means of floating-point descriptors are normalised
        if the descriptors are, and rounded to about ``BITS`` bits.

    Raises
    ------
    InputError
        If the features are not those of the model, or a point has no descriptor.

    Notes
    -----
    A mean of n whole numbers is a multiple of 1/n, whose fraction tells n, the length of the track. Rounded to even
    numbers, means of two tell themselves by their many even numbers. Halves are therefore rounded up.

    100,000 points with 5 observations each take 4.3 s on one core. Memory: the means in 32 bits, and one image's
    features.
    """
    means = _Means(len(ids), features.path)
    images = observations(model, ids)
    if _add_all(means, images, features, np.ones(len(ids), dtype=bool), certain=True) == 0:
        raise InputError(
            f"{features.path} has descriptors of none of the {len(images)} images of the model; give the file that the "
            "model was made from"
        )
    left = means.count == 0
    if left.any():
        _add_all(means, images, features, left, certain=False)
    missing = int((means.count == 0).sum())
    if missing:
        raise InputError(
            f"{features.path} has no descriptor of {missing} of the {len(ids)} points; give the file that the model "
            "was made from"
        )
    return means.rounded()


def observations(model: Any, ids: Int[np.ndarray, " points"]) -> list[Seen]:
    """Collect the observations of points by image; InputError if the model lacks a point."""
    points = model.points3D
    rows: list[tuple[int, int, int]] = []
    for row, key in enumerate(ids.tolist()):
        if key not in points:
            raise InputError(f"the model lacks the point {key} of the scene; give the model of this scene")
        rows += [(row, element.image_id, element.point2D_idx) for element in points[key].track.elements]
    table = np.array(rows, dtype=np.int64).reshape(-1, 3)
    table = table[np.argsort(table[:, 1], kind="stable")]
    image_ids, starts = np.unique(table[:, 1], return_index=True)
    seen = []
    for image_id, part in zip(image_ids.tolist(), np.split(table, starts)[1:], strict=True):
        image = model.images[image_id]
        keypoints = image.points2D
        xy = np.array([keypoints[index].xy for index in part[:, 2].tolist()], dtype=np.float64)
        seen.append(Seen(image.name, len(keypoints), part[:, 0], part[:, 2], xy.reshape(-1, 2)))
    return seen


def keypoint_descriptors(seen: Seen, features: Features) -> tuple[Num[np.ndarray, "rows length"], bool] | None:
    """Descriptors of one image, each by itself.

    Returns
    -------
    (rows, length) and bool, or None
        Descriptors of all keypoints of the image in the model, and True; where the model has dropped keypoints that the
        features have, those of the observations, and False. None if the features lack the image.

    Raises
    ------
    InputError
        If the features are not those of the model.
    """
    found = features.of_image(seen.name)
    if found is None:
        return None
    keypoint, _ = _keypoints(seen, found, features.path)
    whole = keypoint is seen.keypoint
    return (found.descriptor if whole else found.descriptor[keypoint]), whole


def _add_all(
    means: _Means, images: list[Seen], features: Features, wanted: Bool[np.ndarray, " points"], *, certain: bool
) -> int:
    """Add the observations of the wanted points whose keypoint is certain, or those whose is not.

    Returns
    -------
    int
        Number of images that the features have.
    """
    found = 0
    for seen in images:
        of_image = features.of_image(seen.name)
        if of_image is None:
            continue
        found += 1
        keypoint, alone = _keypoints(seen, of_image, features.path)
        use = wanted[seen.point] & (alone == certain)
        means.add(seen.point[use], of_image.descriptor[keypoint[use]])
    return found


def _keypoints(
    seen: Seen, found: ImageFeatures, path: str | PathLike[str]
) -> tuple[Int[np.ndarray, " observations"], Bool[np.ndarray, " observations"]]:
    """Return the row of the features for each observation, and whether it is the only one at its place."""
    count = len(found.descriptor)
    with np.errstate(invalid="ignore"):
        if found.xy is not None and not (np.abs(found.xy.astype(np.float64)) <= _FARTHEST).all():
            raise InputError(f"{path} has keypoints of {seen.name} that are NaN or no pixels; extract features again")
    if count == seen.keypoints and (found.xy is None or _alike(seen.xy, found.xy[seen.keypoint])):
        return seen.keypoint, np.ones(len(seen.point), dtype=bool)
    if found.xy is not None and count:
        for xy in _places(found.xy):
            distance, row = _two_nearest(xy, seen.xy)
            if (distance[:, 0] <= SAME_PLACE).all():
                return row[:, 0].astype(np.int64), distance[:, 1] > SAME_PLACE
    raise InputError(
        f"{path} has {count} keypoints of {seen.name}, other ones than the {seen.keypoints} of the model; give the "
        "file that the model was made from"
    )


def _places(xy: Num[np.ndarray, "keypoints 2"]) -> list[Float[np.ndarray, "keypoints 2"]]:
    """Places that COLMAP may have for keypoints: hloc adds 0.5 to its own, in their precision."""
    half = xy + xy.dtype.type(0.5) if xy.dtype.kind == "f" else xy + 0.5
    return [each.astype(np.float64) for each in (xy, half)]


def _two_nearest(
    xy: Float[np.ndarray, "keypoints 2"], wanted: Float[np.ndarray, "observations 2"]
) -> tuple[Float[np.ndarray, "observations 2"], Int[np.ndarray, "observations 2"]]:
    """Distances and rows of the two keypoints nearest to each place; the second is infinitely far if there is none."""
    from scipy.spatial import KDTree

    distance, row = KDTree(xy).query(wanted, k=2)
    return np.asarray(distance), np.asarray(row)


def _alike(one: Float[np.ndarray, "rows 2"], other: Num[np.ndarray, "rows 2"]) -> bool:
    """Whether keypoints may be the same ones, also undistorted or scaled: other ones are not correlated."""
    if len(one) < _FEW:
        return True
    one, other = one - one.mean(axis=0), other - other.astype(np.float64).mean(axis=0)
    size = np.sqrt((one**2).sum(axis=0) * (other**2).sum(axis=0))
    return bool(((one * other).sum(axis=0) >= _CORRELATION * size).all())


class _Means:
    """Sums of descriptors by point."""

    def __init__(self, points: int, path: str | PathLike[str]) -> None:
        self.count = np.zeros(points, dtype=np.int64)
        self._path = path
        self._total: np.ndarray | None = None
        self._dtype: np.dtype[Any] = np.dtype(np.uint8)
        self._whole, self._unit, self._largest = True, True, 0.0

    def add(self, point: Int[np.ndarray, " rows"], descriptor: Num[np.ndarray, "rows length"]) -> None:
        """Add a descriptor to each point; a point may occur more than once."""
        if self._total is None:
            self._dtype = np.dtype(np.uint8 if descriptor.dtype == np.uint8 else np.float32)
            kind = np.uint32 if self._dtype == np.uint8 else np.float32
            self._total = np.zeros((len(self.count), descriptor.shape[1]), dtype=kind)
        if descriptor.shape[1] != self._total.shape[1] or (descriptor.dtype == np.uint8) != (self._dtype == np.uint8):
            raise InputError(f"{self._path} has descriptors of several lengths or types; expected one kind")
        if self._dtype != np.uint8:
            with np.errstate(over="ignore", invalid="ignore"):  # what is NaN or becomes infinite is refused
                descriptor = descriptor.astype(np.float32)
                self._look_at(descriptor)
        while len(point):
            # An index that repeats would be added once only.
            once, first = np.unique(point, return_index=True)
            self._total[once] += descriptor[first]
            self.count[once] += 1
            point, descriptor = np.delete(point, first), np.delete(descriptor, first, axis=0)

    def rounded(self) -> Num[np.ndarray, "points length"]:
        """Divide, and round as :func:`mean_over_tracks` says."""
        assert self._total is not None
        unit = self._unit and self._dtype != np.uint8
        whole = (self._whole and not unit) or self._largest == 0
        step = 1.0 if whole else 2.0 ** (np.floor(np.log2(self._largest)) - BITS)
        means = np.empty(self._total.shape, dtype=self._dtype)
        for start in range(0, len(means), _BLOCK):
            rows = slice(start, start + _BLOCK)
            mean = self._total[rows] / self.count[rows, None]
            if unit:
                mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), np.finfo(np.float32).tiny)
            means[rows] = np.floor(mean / step + 0.5) * step
        return means

    def _look_at(self, descriptor: Float[np.ndarray, "rows length"]) -> None:
        """Find out whether all descriptors are whole numbers or unit vectors, and their largest number."""
        largest = float(np.abs(descriptor).max(initial=0))
        if not largest < 1e30:
            raise InputError(f"{self._path} has descriptors that are NaN, infinite or beyond 1e30; extract them again")
        self._largest = max(self._largest, largest)
        self._whole = self._whole and np.array_equal(descriptor, np.rint(descriptor))
        length = np.linalg.norm(descriptor.astype(np.float64), axis=1)
        self._unit = self._unit and bool((np.abs(length - 1) <= UNIT).all())
