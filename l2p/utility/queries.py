"""Queries: the images of a COLMAP model, each with its observations and the pose that the model gives it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from l2p.errors import InputError
from l2p.geometry.camera_rays import camera_rays
from l2p.io.track_means import Features, Seen, keypoint_descriptors, observations
from l2p.maps.short_repr import short_repr

#: Fewest images that must see a point, besides the query, for the point to be in the map.
LEAST_IMAGES = 2
#: Half the width, in pixels, of the square whose rays tell the size of a pixel.
_HALF = 0.5


class Pose(NamedTuple):
    """Pose of a camera, world to camera: y = rotation @ x + translation."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Centre of the camera."""
        return -self.rotation.T @ self.translation


@dataclass(frozen=True, eq=False)
class Query:
    """An image that is to be localized.

    Attributes
    ----------
    name : str
        Name of the image.
    bearing : (keypoints, 3) float64
        Unit vectors towards the keypoints, without distortion, in the camera's axes (x right, y down, z forward).
    pixel : (keypoints,) float64
        Radians in a pixel there, by the camera model: residuals are told in pixels of the image.
    point : (keypoints,) int64
        Row of the point of the map that the keypoint shows; -1 if none.
    pose : Pose
        The pose in the model, the ground truth.
    descriptor : (keypoints, length) or None
        Descriptors of the keypoints.
    """

    name: str
    bearing: Float[np.ndarray, "keypoints 3"]
    pixel: Float[np.ndarray, " keypoints"]
    point: Int[np.ndarray, " keypoints"]
    pose: Pose
    descriptor: Num[np.ndarray, "keypoints length"] | None = None

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.point)


@dataclass(frozen=True, eq=False)
class Queries:
    """All images of a model as queries, one left out at a time.

    Attributes
    ----------
    all : tuple of Query
        In the order of their names.
    points : int
        Points of the map.
    """

    all: tuple[Query, ...]
    points: int

    __repr__ = short_repr

    @cached_property
    def images(self) -> Int[np.ndarray, " points"]:
        """Number of images that see each point."""
        rows = [np.unique(query.point[query.point >= 0]) for query in self.all]
        return np.bincount(np.concatenate(rows), minlength=self.points)

    @cached_property
    def extent(self) -> float:
        """Diagonal of the box around the camera centres, scene units."""
        centers = np.array([query.pose.center for query in self.all])
        return float(np.linalg.norm(np.ptp(centers, axis=0)))

    def map_without(self, query: Query) -> Bool[np.ndarray, " points"]:
        """Points that at least ``LEAST_IMAGES`` other images see: those of a map that was made without the query."""
        images = self.images.copy()
        images[np.unique(query.point[query.point >= 0])] -= 1
        return images >= LEAST_IMAGES

    @cached_property
    def descriptor_sum(self) -> Float[np.ndarray, "points length"]:
        """Sum of the unit descriptors of each point; InputError without descriptors."""
        total = None
        for query in self.all:
            if query.descriptor is None:
                raise InputError("got queries without descriptors; expected features of the images to match by them")
            if total is None:
                total = np.zeros((self.points, query.descriptor.shape[1]), dtype=np.float32)
            seen = query.point >= 0
            np.add.at(total, query.point[seen], unit(query.descriptor[seen]))
        assert total is not None
        return total

    def descriptors_without(self, query: Query, rows: Int[np.ndarray, " some"]) -> Float[np.ndarray, "some length"]:
        """Mean descriptor of some points over their tracks, without the observations of the query; unit vectors."""
        place = np.full(self.points, -1)
        place[rows] = np.arange(len(rows))
        found = self.descriptor_sum[rows]
        own = np.flatnonzero((query.point >= 0) & (place[query.point] >= 0))
        assert query.descriptor is not None
        np.subtract.at(found, place[query.point[own]], unit(query.descriptor[own]))
        return unit(found)


def unit(descriptor: Num[np.ndarray, "rows length"]) -> Float[np.ndarray, "rows length"]:
    """Descriptors of length 1, in single precision."""
    value = descriptor.astype(np.float32)
    return value / np.maximum(np.linalg.norm(value, axis=1, keepdims=True), 1e-12)


def queries_of(model: Any, ids: Int[np.ndarray, " points"], features: Features | None = None) -> Queries:
    """Make queries of all images of a model.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    ids : (points,) int64
        ``point3D_id`` of each point of the map; observations of other points do not count.
    features : Features, optional
        Features of the images, for matches by descriptors. All keypoints of an image are then in its query, also those
        of no point, unless the model has dropped keypoints that the features have.

    Raises
    ------
    InputError
        If fewer than three images have a pose and observations (a query, and the two that a map needs), all are at one
        place, a camera cannot be undistorted, or the features are not those of the model.
    """
    posed = {image.name: image for image in model.images.values() if _is_posed(image)}
    seen = [each for each in observations(model, ids) if each.name in posed]
    if len(seen) <= LEAST_IMAGES:
        raise InputError(
            f"got a model with {len(seen)} image(s) of known pose that see points; expected at least "
            f"{LEAST_IMAGES + 1}: each is left out and localized in the map of the others"
        )
    queries = [_query(model, posed[each.name], each, features) for each in sorted(seen, key=lambda each: each.name)]
    found = Queries(tuple(queries), len(ids))
    if found.extent == 0:
        raise InputError("got a model whose cameras are all at one place; expected cameras that moved")
    return found


def _is_posed(image: Any) -> bool:
    """Whether an image has a pose of finite numbers."""
    return bool(image.has_pose and np.isfinite(image.projection_center()).all())


def _query(model: Any, image: Any, seen: Seen, features: Features | None) -> Query:
    keypoint, xy, descriptor = seen.keypoint, seen.xy, None
    point = seen.point
    if features is not None:
        found = keypoint_descriptors(seen, features)
        if found is None:
            raise InputError(f"{features.path} lacks the image {seen.name}; give the file that the model is from")
        descriptor, whole = found
        if whole:  # of all keypoints, also of those without a point
            xy = np.array([each.xy for each in image.points2D], dtype=np.float64).reshape(-1, 2)
            point = np.full(seen.keypoints, -1)
            point[keypoint] = seen.point
    camera = model.cameras[image.camera_id]
    bearing, pixel = rays_of(camera, xy)
    usable = np.isfinite(bearing).all(axis=1)
    if not usable.any():
        raise InputError(
            f"got camera {image.camera_id} ({camera.model_name}) of {seen.name}, which pycolmap cannot undistort; "
            "check its parameters"
        )
    pose = image.cam_from_world()
    return Query(
        seen.name,
        bearing[usable],
        pixel[usable],
        point[usable],
        Pose(np.asarray(pose.rotation.matrix()), np.asarray(pose.translation)),
        None if descriptor is None else descriptor[usable],
    )


def rays_of(
    camera: Any, xy: Float[np.ndarray, "keypoints 2"]
) -> tuple[Float[np.ndarray, "keypoints 3"], Float[np.ndarray, " keypoints"]]:
    """Return the unit rays of pixels, NaN where pycolmap finds none, and the radians in a pixel there.

    The latter is the square root of the solid angle of a pixel, so that it is defined for all camera models; where it
    cannot be computed, at the edge of an image, it is that of the centre: 1 over the focal length, or a full turn over
    the width of a spherical image, which has no focal length.
    """
    ray = camera_rays(camera, xy)
    right, below = _HALF * np.eye(2)
    across = camera_rays(camera, xy + right) - camera_rays(camera, xy - right)
    down = camera_rays(camera, xy + below) - camera_rays(camera, xy - below)
    with np.errstate(invalid="ignore"):
        pixel = np.sqrt(np.linalg.norm(np.cross(across, down), axis=1)) / (2 * _HALF)
    focal = camera.mean_focal_length()
    central = 1 / focal if focal > 0 else 2 * np.pi / camera.width
    return ray, np.where(np.isfinite(pixel) & (pixel > 0), pixel, central)


def evenly(queries: Sequence[Query], most: int | None) -> list[Query]:
    """At most so many of the queries, evenly spread over their order."""
    if most is None or most >= len(queries):
        return list(queries)
    return [queries[row] for row in np.linspace(0, len(queries) - 1, most).round().astype(int)]
