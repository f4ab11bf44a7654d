"""Landmarks: what a map publishes in place of its points, and how a camera's pose follows from them.

A kind of landmark gives the poses of a minimal sample of matches (by poselib), the residuals of poses, and the
linearised residuals of one. Everything is computed in a frame of the landmarks, their centre and a unit of their size,
so that neither the position nor the scale of a map costs digits.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.geometry.frame import Frame, meeting_point
from l2p.maps.lines import LineCloud
from l2p.utility.queries import Pose

#: Distance of a line's origin from its foot, in units of the frame. poselib's six-point solver drops poses with a point
#: behind the origin of its line, so all points have to be in front of it.
_REACH = 100.0
#: Distance of a line from a common point that counts as rounding, in units of the distance of that point from 0.
_SAME = 1e-12
#: The axis that poselib's upright solvers take for gravity.
_UPRIGHT = np.array([0.0, 1.0, 0.0])

Poses = Float[np.ndarray, "poses 3 4"]


@runtime_checkable
class Landmarks(Protocol):
    """Published landmarks, in the order of a map's rows.

    Attributes
    ----------
    sample, upright_sample : int
        Matches in a minimal sample; fewer are needed where gravity is known.
    """

    sample: ClassVar[int]
    upright_sample: ClassVar[int]

    def __len__(self) -> int: ...

    def poses(
        self, bearing: Float[np.ndarray, "sample 3"], rows: Int[np.ndarray, " sample"], gravity: Gravity | None
    ) -> Poses:
        """Compute all poses under which the landmarks of a minimal sample project to its bearings."""
        ...

    def residuals(
        self, poses: Poses, bearing: Float[np.ndarray, "matches 3"], rows: Int[np.ndarray, " matches"]
    ) -> Float[np.ndarray, "poses matches"]:
        """Compute the angle between each bearing and its landmark, radians (small angles); pi/2 behind the camera."""
        ...

    def linearized(
        self,
        pose: Float[np.ndarray, "3 4"],
        bearing: Float[np.ndarray, "matches 3"],
        rows: Int[np.ndarray, " matches"],
    ) -> tuple[Float[np.ndarray, "matches parts"], Float[np.ndarray, "matches parts 6"]]:
        """Compute signed residuals, radians, and their derivatives by a rotation vector and a translation that are
        applied after the pose: R' = exp(w) R, t' = t + v."""
        ...

    def enter(self, pose: Pose) -> Float[np.ndarray, "3 4"]:
        """Convert a pose of the scene to the frame of the landmarks."""
        ...

    def leave(self, pose: Float[np.ndarray, "3 4"]) -> Pose:
        """Convert a pose of the frame of the landmarks to the scene."""
        ...


class Gravity:
    """The direction of gravity in the camera and in the map, as known from an accelerometer."""

    def __init__(self, camera: Float[np.ndarray, "3"], world: Float[np.ndarray, "3"]) -> None:
        self.camera, self.world = _turn_to(camera, _UPRIGHT), _turn_to(world, _UPRIGHT)

    def found(self, poses: list[Any]) -> Poses:
        """Convert poselib's upright poses to poses."""
        back = self.camera.T
        return np.array([back @ each.Rt @ _extended(self.world) for each in poses]).reshape(-1, 3, 4)


class _InFrame:
    """Conversion of poses between the scene and a frame of a centre and a unit."""

    center: Float[np.ndarray, "3"]
    unit: float

    def enter(self, pose: Pose) -> Float[np.ndarray, "3 4"]:
        """Convert a pose of the scene to the frame."""
        moved = (pose.rotation @ self.center + pose.translation) / self.unit
        return np.column_stack([pose.rotation, moved])

    def leave(self, pose: Float[np.ndarray, "3 4"]) -> Pose:
        """Convert a pose of the frame to the scene."""
        rotation, moved = pose[:, :3], pose[:, 3]
        return Pose(rotation, moved * self.unit - rotation @ self.center)


class PointLandmarks(_InFrame):
    """Points: three matches give a pose (p3p), two with gravity.

    Parameters
    ----------
    xyz : (points, 3) float64
        Scene units.
    """

    sample: ClassVar[int] = 3
    upright_sample: ClassVar[int] = 2

    def __init__(self, xyz: Float[np.ndarray, "points 3"]) -> None:
        self.center = np.median(xyz, axis=0)
        self.unit = float(np.median(np.linalg.norm(xyz - self.center, axis=1))) or 1.0
        self.xyz = (xyz - self.center) / self.unit

    def __len__(self) -> int:
        return len(self.xyz)

    def poses(
        self, bearing: Float[np.ndarray, "sample 3"], rows: Int[np.ndarray, " sample"], gravity: Gravity | None
    ) -> Poses:
        """Solve by poselib's ``p3p``, or ``up2p``."""
        solvers, xyz = poselib(), self.xyz[rows]
        if gravity is None:
            return _stacked(solvers.p3p(bearing, xyz))
        return gravity.found(solvers.up2p(bearing @ gravity.camera.T, xyz @ gravity.world.T))

    def residuals(
        self, poses: Poses, bearing: Float[np.ndarray, "matches 3"], rows: Int[np.ndarray, " matches"]
    ) -> Float[np.ndarray, "poses matches"]:
        """Compute the angle between the bearing and the ray to the point."""
        place = poses[:, :, :3] @ self.xyz[rows].T + poses[:, :, 3:]
        apart = place / np.linalg.norm(place, axis=1, keepdims=True) - bearing.T
        distance2 = np.einsum("pim,pim->pm", apart, apart)
        # Beyond a right angle the chord is above sqrt 2.
        return np.where(distance2 < 2, np.sqrt(distance2), np.pi / 2)

    def linearized(
        self,
        pose: Float[np.ndarray, "3 4"],
        bearing: Float[np.ndarray, "matches 3"],
        rows: Int[np.ndarray, " matches"],
    ) -> tuple[Float[np.ndarray, "matches parts"], Float[np.ndarray, "matches parts 6"]]:
        """Linearise the two components of the ray across the bearing."""
        turned = self.xyz[rows] @ pose[:, :3].T
        place = turned + pose[:, 3]
        far = np.linalg.norm(place, axis=1)
        ray = place / far[:, None]
        across = _across(bearing)
        # d ray = (I - ray ray^T) / far * d place
        by_place = (across - (across @ ray[:, :, None]) * ray[:, None]) / far[:, None, None]
        by_rotation = np.cross(turned[:, None], by_place)
        return (across @ ray[:, :, None])[..., 0], np.concatenate([by_rotation, by_place], axis=2)


class LineLandmarks(_InFrame):
    """Lines: six matches give a pose, four with gravity.

    A camera that sees points of known lines is a generalized relative pose problem with one bearing a line: p6L of
    Speciale et al. (CVPR 2019) is the six-point problem of Stewénius et al. (2005).

    Parameters
    ----------
    lines : LineCloud

    Raises
    ------
    InputError
        If all lines meet in one point: a camera then sees the same from any distance to it.
    """

    sample: ClassVar[int] = 6
    upright_sample: ClassVar[int] = 4

    def __init__(self, lines: LineCloud) -> None:
        if _meet(lines):
            raise InputError(
                f"got {len(lines)} lines that all meet in one point; expected others, since the distance of a camera "
                "from that point does not follow from them"
            )
        frame = Frame.of(lines)
        self.center, self.unit = frame.center, frame.unit
        self.direction = lines.direction
        self.moment = (lines.moment - np.cross(self.center, lines.direction)) / self.unit
        # poselib wants points of the lines; the sign of a direction has no meaning.
        self.foot = np.cross(self.direction, self.moment)
        self.origin = self.foot - _REACH * self.direction

    def __len__(self) -> int:
        return len(self.direction)

    def poses(
        self, bearing: Float[np.ndarray, "sample 3"], rows: Int[np.ndarray, " sample"], gravity: Gravity | None
    ) -> Poses:
        """Solve by poselib's ``gen_relpose_6pt``, or ``up4pl``."""
        solvers, direction = poselib(), self.direction[rows]
        if gravity is None:
            return _stacked(solvers.gen_relpose_6pt(self.origin[rows], direction, np.zeros((len(rows), 3)), bearing))
        world = gravity.world.T
        return gravity.found(solvers.up4pl(bearing @ gravity.camera.T, self.foot[rows] @ world, direction @ world))

    def residuals(
        self, poses: Poses, bearing: Float[np.ndarray, "matches 3"], rows: Int[np.ndarray, " matches"]
    ) -> Float[np.ndarray, "poses matches"]:
        """Compute the angle between the bearing and the plane through the camera and the line; the bearing must also
        meet the line in front of the camera."""
        # In the axes of the map, where a pose is the camera's centre and the turned bearings.
        moment, direction, foot = self.moment[rows], self.direction[rows], self.foot[rows]
        center = -(poses[:, None, :, 3] @ poses[:, :, :3])
        ray = bearing @ poses[:, :, :3]
        normal = moment - direction @ _cross_matrix(center[:, 0]).swapaxes(1, 2)
        sine = np.abs(_dot(ray, normal)) / np.sqrt(np.maximum(_dot(normal, normal), np.finfo(float).tiny))
        # The ray meets the line in front of the camera if it is on the side of the point nearest to the camera.
        near = foot - center + (center @ direction.T).swapaxes(1, 2) * direction
        ahead = _dot(ray, near) > 0
        return np.where(ahead, sine, np.pi / 2)

    def linearized(
        self,
        pose: Float[np.ndarray, "3 4"],
        bearing: Float[np.ndarray, "matches 3"],
        rows: Int[np.ndarray, " matches"],
    ) -> tuple[Float[np.ndarray, "matches parts"], Float[np.ndarray, "matches parts 6"]]:
        """Linearise n . x / |n|, with the plane's normal n = R m + t x R d and the bearing x."""
        moment, direction = self.moment[rows] @ pose[:, :3].T, self.direction[rows] @ pose[:, :3].T
        normal = moment + np.cross(pose[:, 3], direction)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        sine = np.sum(normal * bearing, axis=1, keepdims=True) / length
        by_normal = (bearing - sine * normal / length) / length
        by_rotation = np.cross(moment, by_normal) + np.cross(direction, np.cross(by_normal, pose[:, 3]))
        by_translation = np.cross(direction, by_normal)
        return sine, np.concatenate([by_rotation, by_translation], axis=1)[:, None]


def poselib() -> Any:
    """Load poselib, the minimal solvers; InputError if it is not installed."""
    try:
        import poselib as solvers
    except ImportError as error:
        raise InputError("localization needs the package poselib; install it: pip install 'l2p[utility]'") from error
    return solvers


def _meet(lines: LineCloud) -> bool:
    """Whether all lines, three or more, meet in one point, up to rounding."""
    if len(lines) < 3:
        return False
    foot, direction = lines.origin, lines.direction
    common = meeting_point(direction, foot, np.ones(len(lines)))
    off = common - foot - np.sum((common - foot) * direction, axis=1, keepdims=True) * direction
    return bool(np.abs(off).max() <= _SAME * np.abs(common).max())


def _stacked(poses: list[Any]) -> Poses:
    return np.array([each.Rt for each in poses]).reshape(-1, 3, 4)


def _dot(
    one: Float[np.ndarray, "poses matches 3"], other: Float[np.ndarray, "poses matches 3"]
) -> Float[np.ndarray, "poses matches"]:
    return np.einsum("pmi,pmi->pm", one, other)


def _cross_matrix(vector: Float[np.ndarray, "poses 3"]) -> Float[np.ndarray, "poses 3 3"]:
    """Matrices M with M y = vector x y."""
    matrix = np.zeros((len(vector), 3, 3))
    for row, (first, second) in enumerate(((1, 2), (2, 0), (0, 1))):
        matrix[:, first, second], matrix[:, second, first] = -vector[:, row], vector[:, row]
    return matrix


def _across(bearing: Float[np.ndarray, "matches 3"]) -> Float[np.ndarray, "matches 2 3"]:
    """Two unit vectors across each bearing."""
    least = np.eye(3)[np.abs(bearing).argmin(axis=1)]
    first = np.cross(bearing, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(bearing, first)], axis=1)


def _turn_to(vector: Float[np.ndarray, "3"], to: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """A rotation that turns a unit vector to another one."""
    frames = []
    for each in (vector, to):
        first, second = _across(each[None] / np.linalg.norm(each))[0]
        frames.append(np.column_stack([each / np.linalg.norm(each), first, second]))
    return frames[1] @ frames[0].T


def _extended(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
    extended = np.eye(4)
    extended[:3, :3] = rotation
    return extended
