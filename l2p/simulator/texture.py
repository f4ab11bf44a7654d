"""Positions of keypoints on surfaces: many small structures (blobs, edges, corners) of very unequal weight.

Detectors respond to print, ornaments and outlines and hardly to paint, and their responses are clustered: a poster on a
wall, a word on the poster, a letter in the word. The structures are a two-level cascade with log-normal sizes and
weights, which gives the heavy-tailed local density of real clouds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.short_repr import short_repr
from l2p.simulator.surfaces import CYLINDER, LEAVES, SQUARE, Shapes, Stage, Texture, Triple, on_shape

#: Structures per patterned patch.
PER_CLUSTER = 14
#: Most tiles along a side of a square with evenly spread keypoints.
MAX_TILES = 24
#: Weight of a regular pattern over that of the rest of its surface.
GRID_SHARE = 0.4
#: Pieces per line segment, of unequal weight.
PIECES = 6


@dataclass(frozen=True)
class Structures:
    """Blobs and segments in the unit frames of their surfaces.

    A keypoint of structure i lies at ``center + u * half + sigma * normal draw`` with u uniform in [-1, 1] for each of
    the two rows of ``half``. ``weight`` is the keypoint rate per unit of image resolution. Structures of one ``spot``
    (sorted, from 0) lie close together; the image resolution is computed once per spot and camera.
    """

    surface: Int[np.ndarray, " structures"]
    spot: Int[np.ndarray, " structures"]
    center: Float[np.ndarray, "structures 3"]
    half: Float[np.ndarray, "structures 2 3"]
    sigma: Float[np.ndarray, "structures 3"]
    weight: Float[np.ndarray, " structures"]
    rgb: Float[np.ndarray, "structures 3"]

    __repr__ = short_repr


def texture_stage(stage: Stage, rng: np.random.Generator) -> Structures:
    """Draw the structures of all surfaces of ``stage``."""
    shapes = stage.surfaces
    scale = np.linalg.norm(shapes.axes, axis=1)  # (surfaces, 3): half-lengths in metres
    parts = [
        _surface(row, int(shapes.shape[row]), scale[row], stage.textures[row], stage.colors[row], rng)
        for row in range(len(shapes.shape))
    ]
    surface, spot, *fields = (np.concatenate(field) for field in zip(*parts, strict=True))
    first = (np.diff(surface, prepend=-1) != 0) | (np.diff(spot, prepend=-1) != 0)
    return Structures(surface, np.cumsum(first) - 1, *fields)


def draw_keypoints(
    structures: Structures,
    pick: Int[np.ndarray, " points"],
    shapes: Shapes,
    relief: Float[np.ndarray, " surfaces"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"], np.ndarray]:
    """Draw a keypoint of each picked structure: positions (metres), unit normals, whether it is on its surface."""
    surface = structures.surface[pick]
    along = rng.uniform(-1, 1, (len(pick), 2, 1))
    unit = structures.center[pick] + (along * structures.half[pick]).sum(axis=1)
    unit = unit + structures.sigma[pick] * rng.standard_normal(unit.shape)
    unit, normal, inside = on_shape(shapes.shape[surface], unit)
    axes = shapes.axes[surface]
    normal = np.einsum("nij,nj->ni", axes, normal / np.maximum((axes**2).sum(axis=1), 1e-18))
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    bump = relief[surface] * np.abs(rng.standard_normal(len(pick)))
    return shapes.center[surface] + np.einsum("nij,nj->ni", axes, unit) + bump[:, None] * normal, normal, inside


def _surface(
    row: int,
    shape: int,
    scale: np.ndarray,
    texture: Texture,
    color: Triple,
    rng: np.random.Generator,
) -> tuple[np.ndarray, ...]:
    """The structures of one surface as the fields of ``Structures``."""
    groups = [(1 - texture.border - texture.dust, _patches(shape, scale, texture, rng))]
    if texture.dust > 0:
        groups.append((texture.dust, _dust(shape, scale)))
    if texture.border > 0 and shape in (SQUARE, CYLINDER):
        groups.append((texture.border, _segments(_outline(shape), scale, rng)))
    if min(texture.grid) > 0:
        groups.append((GRID_SHARE, _segments(_grid(texture.grid), scale, rng)))
    spot, center, half, sigma, weight = (np.concatenate(field) for field in zip(*(g for _, g in groups), strict=True))
    share = np.concatenate([np.full(len(g[4]), s / max(g[4].sum(), 1e-12)) for s, g in groups])
    area = _area(shape, scale)
    rgb = np.asarray(color) * np.exp(0.35 * rng.standard_normal((len(weight), 1)))
    rgb = rgb + 15 * rng.standard_normal((len(weight), 3))
    surface = np.full(len(weight), row)
    return surface, spot, center, half, sigma, weight * share * texture.strength * area, rgb


def _patches(shape: int, scale: np.ndarray, texture: Texture, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Patterned patches, each a cascade of small blobs and short strokes."""
    count = texture.clusters
    middle = np.repeat(_anywhere(shape, count, rng), PER_CLUSTER, axis=0)
    flat = scale[:2] if shape == SQUARE else scale
    radius = texture.size * flat.min() * np.exp(0.6 * rng.standard_normal(count)).repeat(PER_CLUSTER)[:, None]
    center = middle + radius * rng.standard_normal(middle.shape) / scale
    small = 0.2 * radius * np.exp(0.7 * rng.standard_normal(radius.shape))
    stroke = (rng.random(radius.shape) < 0.4) * radius * rng.exponential(0.7, radius.shape)
    axis = np.eye(3)[rng.integers(0, 2 if shape == SQUARE else 3, len(center))]
    half = np.stack([stroke * axis / scale, np.zeros_like(center)], axis=1)
    heavy = np.exp(0.7 * rng.standard_normal(count)).repeat(PER_CLUSTER)
    spot = np.repeat(np.arange(count), PER_CLUSTER)
    return spot, center, half, small / scale, heavy * np.exp(0.5 * rng.standard_normal(len(center)))


def _dust(shape: int, scale: np.ndarray) -> tuple[np.ndarray, ...]:
    """Keypoints spread evenly; squares in tiles (about 2 m), since cameras resolve them unequally."""
    if shape != SQUARE:
        half, sigma = np.zeros((1, 2, 3)), np.full((1, 3), 0.6)
        if shape == CYLINDER:
            half[0, 0, 2], sigma[0, 2] = 1.0, 0.0
        return np.zeros(1, dtype=np.int64), np.zeros((1, 3)), half, sigma, np.ones(1)
    tiles = np.clip(np.ceil(scale[:2]), 1, MAX_TILES).astype(int)
    x, y = np.meshgrid(*((np.arange(n) + 0.5) / n * 2 - 1 for n in tiles))
    center = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    half = np.zeros((x.size, 2, 3))
    half[:, 0, 0], half[:, 1, 1] = 1 / tiles
    return np.arange(x.size), center, half, np.zeros_like(center), np.ones(x.size)


def _segments(ends: np.ndarray, scale: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Cut line segments (n, 2, 3) into pieces of unequal weight; their ends are tight blobs."""
    cut = np.sort(rng.uniform(-1, 1, (len(ends), PIECES, 2)), axis=2)
    middle, reach = ends.mean(axis=1)[:, None], (ends[:, 1] - ends[:, 0])[:, None] / 2
    center = middle + cut.mean(axis=2)[..., None] * reach  # (segments, pieces, 3)
    along = (cut[..., 1] - cut[..., 0])[..., None] / 2 * reach
    size = 2 * np.linalg.norm(along * scale, axis=2)
    center = np.concatenate([center, ends], axis=1).reshape(-1, 3)
    half = np.zeros((len(ends), PIECES + 2, 2, 3))
    half[:, :PIECES, 0] = along
    corner = np.full((len(ends), 2), 0.6 * size.mean() + 1e-9)
    weight = np.concatenate([size, corner], axis=1).ravel()
    weight = weight * np.exp(0.8 * rng.standard_normal(len(weight)))
    width = (
        0.01 * np.linalg.norm(2 * reach * scale, axis=2).mean() * np.exp(0.5 * rng.standard_normal((len(weight), 1)))
    )
    spot = np.repeat(np.arange(len(ends)), PIECES + 2)
    return spot, center, half.reshape(-1, 2, 3), width / scale, weight


def _outline(shape: int) -> np.ndarray:
    """The border of the unit square, or the rims of the cylinder in chords, as segments (n, 2, 3)."""
    if shape == SQUARE:
        corner = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.995
        return np.stack([corner, np.roll(corner, -1, axis=0)], axis=1)
    angle = np.arange(12) * (2 * np.pi / 12)
    low, high = (np.stack([np.cos(angle), np.sin(angle), np.full(12, z)], axis=1) for z in (-0.99, 0.99))
    return np.concatenate([np.stack([rim, np.roll(rim, -1, axis=0)], axis=1) for rim in (low, high)])


def _grid(shape: tuple[int, int]) -> np.ndarray:
    """The outlines of a regular pattern of cells on the unit square, (4 * cells, 2, 3)."""
    x = (np.arange(shape[1]) + 0.5) / shape[1] * 2 - 1
    y = (np.arange(shape[0]) + 0.5) / shape[0] * 2 - 1
    center = np.stack([*(a.ravel() for a in np.meshgrid(x, y)), np.zeros(x.size * y.size)], axis=1)
    cell = _outline(SQUARE) * np.array([0.6 / shape[1], 0.7 / shape[0], 0])
    return (center[:, None, None] + cell[None]).reshape(-1, 2, 3)


def _anywhere(shape: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random positions on a unit shape, (count, 3)."""
    if shape == SQUARE:
        return rng.uniform(-1, 1, (count, 3)) * (1, 1, 0)
    position = rng.standard_normal((count, 3))
    if shape == CYLINDER:
        position[:, :2] /= np.linalg.norm(position[:, :2], axis=1, keepdims=True)
        position[:, 2] = rng.uniform(-1, 1, count)
        return position
    position /= np.linalg.norm(position, axis=1, keepdims=True)
    return position * rng.random((count, 1)) ** (1 / 3) if shape == LEAVES else position


def _area(shape: int, scale: np.ndarray) -> float:
    """Rough area of a shape with half-lengths ``scale``, in square metres."""
    if shape == SQUARE:
        return float(4 * scale[0] * scale[1])
    if shape == CYLINDER:
        return float(4 * np.pi * scale[0] * scale[2])
    return float(4 * np.pi * np.prod(scale) ** (2 / 3))
