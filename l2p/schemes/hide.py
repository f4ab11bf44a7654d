"""Hiding: the points of a scene become a map that does not show them, and the secret truth."""

from __future__ import annotations

import os
import pkgutil
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from l2p.checks import check_fraction, check_seed, finite_rows, named, point_rows
from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.region import kept_rows
from l2p.maps.scene import Scene
from l2p.maps.truth import Hiding
from l2p.schemes.scheme import DEFAULT_SCHEME, SchemeName, scheme_of

_STREAM = 0x11FE
#: Reads a scene from its path.
_READER = "l2p.io.scene_files:load_scene"


def hide(
    points: Float[np.ndarray, "points 3"] | Scene | str | PathLike[str],
    seed: int | None = None,
    fraction: float = 1.0,
    scheme: SchemeName | str = DEFAULT_SCHEME,
    rgb: UInt8[np.ndarray, "points 3"] | bool | None = None,
    descriptor: np.ndarray | bool | None = None,
    descriptor_kind: str | None = None,
    drop: Bool[np.ndarray, " points"] | None = None,
    cell: float | None = None,
) -> Hiding:
    """Hide points in a line cloud (or planes, or permuted points), and return it with the truth.

    Parameters
    ----------
    points : (points, 3) float, Scene or path
        Points in scene units, or a scene, whose ids are copied to the truth, or the path of its file.
    seed : int, optional
        Seed of directions and subset. None draws one from the system. Hide a map for publication without a seed: anyone
        who guesses it can redraw the directions in the order of the points.
    fraction : float
        Fraction of the points that is hidden, in (0, 1]; at least one point. The scheme sees only these.
    scheme : str
        A name of :data:`l2p.schemes.scheme.SCHEMES` (``docs/schemes.md``). ``uniform``: a line of random direction
        through each point (Speciale et al., CVPR 2019). Schemes of planes give a :class:`l2p.PlaneCloud`, ``permuted``
        a :class:`l2p.PermutedCloud`, all others a :class:`l2p.LineCloud`.
    rgb : (points, 3) uint8 or bool, optional
        Colours to store with the lines; True stores those of the scene. They help an attacker; leave them out of a
        published map.
    descriptor : (points, length) uint8 or float32, or bool, optional
        Descriptors to store with the lines; True stores those of the scene. Cameras are localized by them, and they
        help an attacker more than colours do.
    descriptor_kind : str, optional
        What computed given descriptors (:class:`l2p.maps.appearance.Appearance`).
    drop : (points,) bool, optional
        True for each point to leave out, before the fraction is drawn: the lines are those of a scene that never had
        it. Masks of boxes: ``Box((x0, y0, z0), (x1, y1, z1)).contains(xyz)`` (:mod:`l2p.maps.region`).
    cell : float, optional
        Side of the cells of ``rays-voxel``, scene units (:class:`l2p.schemes.rays_voxel.RaysVoxel`).

    Returns
    -------
    Hiding
        The map and the truth: ``truth.xyz[i]`` lies behind line (plane, stored point) ``truth.element[i]``. Points that
        the scheme left out have no row, those in several planes have several. Its spacing is not measured.

    Raises
    ------
    FileNotFoundError
        If there is nothing at the path.
    InputError
        If there are no points, a point is not finite, the fraction is outside (0, 1], the scheme is unknown or needs
        more points, colours or descriptors are not those of the points, or none or all of the points are dropped.

    Notes
    -----
    Information that could reveal a point, and its removal:

    - *Order*: SfM models store neighbours side by side. Lines are sorted by their direction where it is independent of
      the points, and in random order otherwise.
    - *Sign and origin*: the direction is turned into one half-space (but for spheres, whose scheme publishes the sign),
      and the moment does not depend on the position.
    - *Rounding*: points that were once stored with few digits (single precision, text) lie on a lattice, and a line
      in double precision passes close to one lattice point only: its own. Each point is therefore moved within its
      lattice cell before it is lifted (:func:`l2p.schemes.rounding.lattice_step`); the shift is below the precision of
      the input.
    - *Colours and descriptors* are in the order of the lines, those of points that are left out are not stored, and the
      sign of a zero is dropped. Their values are stored as they are.

    Examples
    --------
    >>> import numpy as np, l2p
    >>> points = np.random.default_rng(1).normal(size=(200, 3))
    >>> hidden = l2p.hide(points, seed=0, fraction=0.5)
    >>> len(hidden.map), hidden.truth.xyz.shape
    (100, (100, 3))
    >>> bool((points[hidden.truth.index] == hidden.truth.xyz).all())
    True
    """
    scene = _scene_of(points)
    xyz = finite_rows("points", scene.xyz)
    if len(xyz) == 0:
        raise InputError("got a scene without points; expected at least one point to lift")
    check_fraction(fraction)
    check_seed(seed)
    way, appearance = scheme_of(scheme, cell), _published(scene, rgb, descriptor, descriptor_kind)
    kept = np.arange(len(xyz)) if drop is None else kept_rows(drop, len(xyz))
    if drop is not None:
        # Before anything is computed, also the lattice of rounded coordinates.
        xyz, appearance = xyz[kept], appearance.rows(kept)
    # A separate stream: default_rng(seed) may have drawn the points, and would draw the same numbers as directions.
    rng = np.random.default_rng(None if seed is None else [seed, _STREAM])
    hidden = way.hide(xyz, _subset(len(xyz), fraction, rng), rng, appearance)
    index = kept[hidden.truth.index]
    ids = None if scene.ids is None else scene.ids[index]
    return replace(hidden, truth=replace(hidden.truth, index=index, ids=ids, seed=seed))


def lift(
    points: Float[np.ndarray, "points 3"] | Scene | str | PathLike[str],
    seed: int | None = None,
    fraction: float = 1.0,
    scheme: SchemeName | str = DEFAULT_SCHEME,
    rgb: UInt8[np.ndarray, "points 3"] | bool | None = None,
    descriptor: np.ndarray | bool | None = None,
    descriptor_kind: str | None = None,
    drop: Bool[np.ndarray, " points"] | None = None,
    cell: float | None = None,
) -> Any:
    """Return the map of :func:`hide`, without the truth: a line cloud, or what else the scheme publishes.

    >>> import numpy as np
    >>> len(lift(np.zeros((4, 3)), seed=0))
    4
    """
    return hide(points, seed, fraction, scheme, rgb, descriptor, descriptor_kind, drop, cell).map


def _scene_of(points: object) -> Scene:
    """The scene of points, or of a file."""
    if isinstance(points, Scene):
        return points
    if isinstance(points, str | os.PathLike):
        # By name, as schemes are found: reading is on a higher floor.
        return pkgutil.resolve_name(_READER)(points)
    if hasattr(points, "shape") or isinstance(points, list | tuple):
        return Scene(point_rows("points", points))
    raise InputError(f"got {named(points)}; expected a Scene, points of shape (points, 3), or the path of a scene")


def _subset(count: int, fraction: float, rng: np.random.Generator) -> Int[np.ndarray, " chosen"]:
    if fraction == 1:
        return np.arange(count)
    return rng.choice(count, size=max(1, round(count * fraction)), replace=False)


def _published(
    scene: Scene,
    rgb: UInt8[np.ndarray, "points 3"] | bool | None,
    descriptor: np.ndarray | bool | None,
    kind: str | None,
) -> Appearance:
    """Colours and descriptors to store: those given, or those of the scene for True."""
    if descriptor is True:
        kind = scene.descriptor_kind if kind is None else kind
    colours = _own(rgb, scene.rgb, "rgb=True", "colours")
    appearance = Appearance(colours, _own(descriptor, scene.descriptor, "descriptor=True", "descriptors"), kind)
    appearance.check_rows(len(scene), "points")
    if appearance.descriptor is None or appearance.descriptor.dtype == np.uint8:
        return appearance
    # The sum with 0 has no negative zeros.
    return replace(appearance, descriptor=appearance.descriptor + np.float32(0))


def _own(value: np.ndarray | bool | None, of_scene: np.ndarray | None, flag: str, what: str) -> np.ndarray | None:
    if value is None or value is False:
        return None
    if value is not True:
        return value
    if of_scene is None:
        raise InputError(f"got {flag} for points without {what}; leave it out, or give the {what}")
    return of_scene
