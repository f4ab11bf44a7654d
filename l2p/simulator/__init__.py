"""A procedural Structure-from-Motion simulator: scenes without data.

A layout builds textured surfaces and a camera path; keypoints are detected, matched, triangulated and filtered as in an
SfM program. ``docs/simulator.md`` compares the result with real models.
"""

from __future__ import annotations

import numpy as np

from l2p.errors import InputError
from l2p.maps.scene import Scene
from l2p.simulator.layouts import LAYOUTS
from l2p.simulator.model import SimulatedModel
from l2p.simulator.observe import Observer, Sightings
from l2p.simulator.texture import texture_stage
from l2p.simulator.triangulate import Tracks, triangulate

__all__ = ["KINDS", "MAX_POINTS", "MIN_POINTS", "SimulatedModel", "simulate", "simulate_model"]

#: Kinds of scene.
KINDS = tuple(LAYOUTS)
#: Fewest points of a scene.
MIN_POINTS = 100
#: Most points; time and memory are linear in them.
MAX_POINTS = 10_000_000
#: Candidate keypoints per batch; bounds memory (about 150 MB).
BATCH = 10_000
#: The simulation gives up after this many batches, plus ten times those in ``points``; layouts stay far below.
PATIENCE = 60


def simulate(kind: str = "room", points: int = 20_000, seed: int = 0) -> Scene:
    """Simulate the sparse points of an SfM model.

    Parameters
    ----------
    kind : {"room", "object", "facade", "street", "terrain"}
    points : int
        Exact number of points, at least 100 and at most 10 million.
    seed : int
        Determines layout, cameras, texture and noise; more ``points`` sample the same world more densely.

    Returns
    -------
    Scene
        In metres, z up; ids are 1 to ``points``, in no spatial order.

    Raises
    ------
    InputError
        If the kind is unknown, or ``points`` or ``seed`` is not a whole number in range.

    Notes
    -----
    Time is linear in ``points``: about 2 s for 20 000, a minute for 10^6 (one core, under 1 GB).

    Examples
    --------
    >>> simulate("facade", points=500, seed=1).xyz.shape
    (500, 3)
    """
    return simulate_model(kind, points, seed).scene


def simulate_model(kind: str = "room", points: int = 20_000, seed: int = 0) -> SimulatedModel:
    """Simulate an SfM model with cameras and observations; arguments and errors are those of ``simulate``."""
    _check(kind, points, seed)
    # Independent streams: the world of a seed does not depend on the number of points.
    world, views = (np.random.default_rng([seed, KINDS.index(kind), stream]) for stream in range(2))
    stage, cameras, capture = LAYOUTS[kind](world)
    observer = Observer(stage, texture_stage(stage, world), cameras, capture)
    tracks: list[Tracks] = []
    while sum(len(batch.xyz) for batch in tracks) < points:
        if len(tracks) > PATIENCE + 10 * points // BATCH:
            raise RuntimeError(f"the {kind} of seed {seed} shows too few points to its cameras")
        sightings = observer.sight(min(BATCH, 4 * points), views)
        tracks.append(triangulate(sightings, cameras, capture.pixel_noise, views))
    return _assemble(tracks, points, cameras)


def _assemble(tracks: list[Tracks], points: int, cameras) -> SimulatedModel:
    """Join the batches to one model of the first ``points`` points."""
    start = np.concatenate([[0], np.cumsum([len(batch.xyz) for batch in tracks])])
    sightings: list[Sightings] = [batch.sightings for batch in tracks]
    point = np.concatenate([batch.point + first for batch, first in zip(sightings, start[:-1], strict=True)])
    views = np.searchsorted(point, points)
    length = np.concatenate([batch.length for batch in tracks])[:points]
    rgb = np.concatenate([batch.rgb for batch in sightings])[:points]
    scene = Scene(
        xyz=np.concatenate([batch.xyz for batch in tracks])[:points],
        rgb=np.clip(np.rint(rgb), 0, 255).astype(np.uint8),
        error=np.concatenate([batch.error for batch in tracks])[:points].astype(np.float32),
        track_length=length.astype(np.int32),
        ids=np.arange(1, points + 1),
        camera_centers=cameras.center,
        up=np.array([0.0, 0.0, 1.0]),
    )
    return SimulatedModel(
        scene,
        cameras,
        true_xyz=np.concatenate([batch.xyz for batch in sightings])[:points],
        wrong=np.concatenate([batch.wrong for batch in sightings])[:points],
        view_point=point[:views],
        view_camera=np.concatenate([batch.camera for batch in sightings])[:views],
        view_pixel=np.concatenate([batch.pixel for batch in tracks])[:views],
    )


def _check(kind: object, points: object, seed: object) -> None:
    """Raise InputError for arguments out of range."""
    if kind not in KINDS:
        raise InputError(f"got kind {kind!r}; expected one of {', '.join(KINDS)}")
    whole = isinstance(points, (int, np.integer)) and not isinstance(points, bool)
    if not whole or not MIN_POINTS <= points <= MAX_POINTS:  # type: ignore[operator]
        raise InputError(
            f"got {points!r} points; expected a whole number of at least {MIN_POINTS}, at most {MAX_POINTS}"
        )
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"got seed {seed!r}; expected a whole number of at least 0")
