"""The world of a simulated scene: surfaces that carry texture and solids that hide what lies behind them.

Every surface and solid is the affine image of a unit shape, so that one piece of code samples and intersects them all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.short_repr import short_repr

#: Metres, radians or shares; an int is as good as a float.
Number = float | int
#: Red, green, blue (0 to 255), or x, y, z (metres).
Triple = tuple[Number, Number, Number]

#: Unit shapes: the square |x|, |y| <= 1 at z = 0, the sphere, the side of the cylinder |z| <= 1, the cube, and a ball
#: of leaves (a volume that carries keypoints and hides nothing).
SQUARE, SPHERE, CYLINDER, CUBE, LEAVES = range(5)


@dataclass(frozen=True)
class Texture:
    """Texture of a surface, as a keypoint detector responds to it.

    Attributes
    ----------
    strength : float
        Keypoints per square pixel, relative to a printed page (1).
    clusters : int
        Number of patterned patches.
    size : float
        Radius of a patch, as a share of the smaller side.
    border, dust : float
        Share of the keypoints on the outline of the surface, and share of those spread evenly over it.
    grid : (int, int)
        Rows and columns of a regular pattern (windows, tiles, books); 0 for none.
    relief : float
        Roughness along the normal, in metres.
    """

    strength: Number
    clusters: int
    size: Number = 0.15
    border: Number = 0.15
    dust: Number = 0.1
    grid: tuple[int, int] = (0, 0)
    relief: Number = 0.002


@dataclass(frozen=True)
class Pose:
    """Position (metres) and heading about the vertical (radians) of an object."""

    x: Number = 0.0
    y: Number = 0.0
    z: Number = 0.0
    yaw: Number = 0.0

    def apply(self, offset: Triple) -> np.ndarray:
        """Transform a local position into the world, (3,)."""
        return np.array([self.x, self.y, self.z]) + self.rotation @ np.asarray(offset, dtype=np.float64)

    def moved(self, x: Number, y: Number, z: Number = 0.0, yaw: Number = 0.0) -> Pose:
        """The pose at (x, y, z) in this frame, turned by ``yaw``."""
        position = self.apply((x, y, z))
        return Pose(float(position[0]), float(position[1]), float(position[2]), self.yaw + yaw)

    @property
    def rotation(self) -> np.ndarray:
        """The (3, 3) rotation about the vertical."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Shapes:
    """Affine images of unit shapes, one row each: ``world = center + axes @ unit``.

    ``axes`` has orthogonal columns; the third column of a square is its unit normal. ``solid`` is the row of the solid
    that a surface belongs to (-1 for none).
    """

    shape: Int[np.ndarray, " shapes"]
    center: Float[np.ndarray, "shapes 3"]
    axes: Float[np.ndarray, "shapes 3 3"]
    solid: Int[np.ndarray, " shapes"]

    __repr__ = short_repr


class Stage:
    """Collects surfaces and solids while a layout builds them."""

    def __init__(self) -> None:
        self.textures: list[Texture] = []
        self.colors: list[Triple] = []
        self._surfaces: list[tuple[int, np.ndarray, np.ndarray, int]] = []
        self._solids: list[tuple[int, np.ndarray, np.ndarray, int]] = []

    @property
    def surfaces(self) -> Shapes:
        """All surfaces, in the order of ``textures`` and ``colors``."""
        return _stack(self._surfaces)

    @property
    def solids(self) -> Shapes:
        """All solids: they hide what lies behind them."""
        return _stack(self._solids)

    def rect(self, center, u, v, texture: Texture, color, hides: bool = True) -> None:
        """A rectangle with half-sides ``u`` and ``v``; the side that u x v points to is textured."""
        u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
        normal = np.cross(u, v)
        axes = np.stack([u, v, normal / np.linalg.norm(normal)], axis=1)
        solid = self._solid(SQUARE, np.asarray(center, dtype=np.float64), axes) if hides else -1
        self._surface(SQUARE, np.asarray(center, dtype=np.float64), axes, solid, texture, color)

    def panel(self, pose: Pose, offset, size: tuple[Number, Number], texture: Texture, color) -> None:
        """A thin upright sheet of (width, height) that faces the pose's -y axis and hides nothing."""
        right, up = pose.rotation[:, 0] * size[0] / 2, np.array([0.0, 0.0, size[1] / 2])
        self.rect(pose.apply(offset), right, up, texture, color, hides=False)

    def sheet(self, pose: Pose, offset, size: tuple[Number, Number], texture: Texture, color) -> None:
        """A thin level sheet of (width, depth) that faces up and hides nothing."""
        turn = pose.rotation
        self.rect(pose.apply(offset), turn[:, 0] * size[0] / 2, turn[:, 1] * size[1] / 2, texture, color, hides=False)

    def box(self, pose: Pose, offset, size, texture: Texture, color, top: Texture | None = None) -> None:
        """A box of ``size`` whose bottom face is centred at ``offset``; its bottom carries no texture."""
        half = np.asarray(size, dtype=np.float64) / 2
        center = pose.apply((offset[0], offset[1], offset[2] + half[2]))
        x, y, z = (pose.rotation * half).T
        solid = self._solid(CUBE, center, np.stack([x, y, z], axis=1))
        for normal, u, v in ((x, y, z), (-x, -y, z), (y, -x, z), (-y, x, z), (z, x, y)):
            axes = np.stack([u, v, normal / np.linalg.norm(normal)], axis=1)
            face = top if top is not None and normal is z else texture
            self._surface(SQUARE, center + normal, axes, solid, face, color)

    def ellipsoid(self, pose: Pose, center, radii, texture: Texture, color) -> None:
        """An ellipsoid with ``radii`` along the axes of ``pose``."""
        middle, axes = pose.apply(center), pose.rotation * np.asarray(radii, dtype=np.float64)
        self._surface(SPHERE, middle, axes, self._solid(SPHERE, middle, axes), texture, color)

    def cylinder(self, pose: Pose, offset, radius: Number, height: Number, texture: Texture, color) -> None:
        """The side of an upright cylinder whose foot is centred at ``offset``."""
        middle = pose.apply((offset[0], offset[1], offset[2] + height / 2))
        axes = np.diag([radius, radius, height / 2])
        self._surface(CYLINDER, middle, axes, self._solid(CYLINDER, middle, axes), texture, color)

    def leaves(self, pose: Pose, center, radii, texture: Texture, color) -> None:
        """An ellipsoid of leaves, with keypoints inside it."""
        self._surface(LEAVES, pose.apply(center), pose.rotation * np.asarray(radii, float), -1, texture, color)

    def _surface(self, shape: int, center, axes, solid: int, texture: Texture, color) -> None:
        self._surfaces.append((shape, center, axes, solid))
        self.textures.append(texture)
        self.colors.append(color)

    def _solid(self, shape: int, center: np.ndarray, axes: np.ndarray) -> int:
        self._solids.append((shape, center, axes, len(self._solids)))
        return len(self._solids) - 1


def on_shape(
    shape: Int[np.ndarray, " points"], unit: Float[np.ndarray, "points 3"]
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"], np.ndarray]:
    """Project points of unit space onto their shapes: positions, normals, and whether they are within the shape."""
    position, normal = unit.copy(), unit.copy()
    square, cylinder, sphere = shape == SQUARE, shape == CYLINDER, shape == SPHERE
    position[square, 2] = 0.0
    normal[square] = (0.0, 0.0, 1.0)
    normal[cylinder, 2] = 0.0
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    normal = normal / length
    position[cylinder, :2] = normal[cylinder, :2]
    position[sphere] = normal[sphere]
    inside = np.abs(position).max(axis=1) <= 1.0 + 1e-9
    inside[shape == LEAVES] = length[shape == LEAVES, 0] <= 1.0
    return position, normal, inside


def _stack(rows: list[tuple[int, np.ndarray, np.ndarray, int]]) -> Shapes:
    shape, center, axes, solid = zip(*rows, strict=True)
    return Shapes(np.array(shape), np.stack(center), np.stack(axes), np.array(solid))
