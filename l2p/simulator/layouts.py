"""Layouts: one function per kind of scene builds the stage, the cameras and the quality of the matches."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from l2p.simulator.cameras import Cameras, drone_grid, look, orbit, walk
from l2p.simulator.furniture import (
    CARPET,
    FABRIC,
    METAL,
    PAINT,
    PRINT,
    STATUE,
    WOOD,
    car,
    chair,
    clutter,
    figure,
    house,
    monitor,
    paint,
    pot_plant,
    shelf,
    table,
    tree,
)
from l2p.simulator.observe import Capture
from l2p.simulator.surfaces import Pose, Stage, Texture


class World(NamedTuple):
    """A stage, the cameras that photograph it, and the quality of their matches."""

    stage: Stage
    cameras: Cameras
    capture: Capture


Layout = Callable[[np.random.Generator], World]

BRICK = Texture(0.12, 40, size=0.15, border=0.08, dust=0.4, relief=0.006)
ASPHALT = Texture(0.03, 60, size=0.02, border=0.02, dust=0.5, relief=0.01)
CLOTH = Texture(0.5, 80, size=0.05, border=0.03, dust=0.6, relief=0.002)
MEADOW = Texture(0.06, 80, size=0.03, border=0.02, dust=0.5, relief=0.05)
ORNAMENT = Texture(0.18, 25, size=0.15, border=0.2, dust=0.3, relief=0.015)


def room(rng: np.random.Generator) -> World:
    """A furnished room with a window and a door, filmed on a walk that keeps a desk in view."""
    stage = Stage()
    width, depth, height = rng.uniform(4.5, 7.5), rng.uniform(4.0, 6.0), rng.uniform(2.5, 3.0)
    _walls(stage, width, depth, height, rng)
    desk = Pose(rng.uniform(-0.2, 0.2) * width, depth / 2 - 0.5)
    table(stage, desk, (1.6, 0.75, 0.74), rng)
    monitor(stage, desk.moved(rng.uniform(-0.3, 0.3), 0.12, 0.74))
    clutter(stage, desk.moved(0, 0, 0.74), (1.4, 0.6), 9, rng)
    chair(stage, desk.moved(rng.uniform(-0.3, 0.3), -0.7, 0, rng.uniform(2, 4)), rng)
    middle = Pose(rng.uniform(-0.1, 0.1) * width, rng.uniform(-0.15, 0) * depth, 0, rng.uniform(0, 3))
    table(stage, middle, (1.1, 0.8, 0.6), rng)
    clutter(stage, middle.moved(0, 0, 0.6), (0.9, 0.6), 6, rng)
    figure(stage, middle.moved(0, 0, 0.6), rng.uniform(0.25, 0.5), rng)
    stage.sheet(middle.moved(0, 0, 0, 0.1), (0, 0, 0.01), (2.4, 1.7), FABRIC, paint(rng))
    for _ in range(2):
        chair(stage, middle.moved(rng.uniform(-1.2, 1.2), rng.uniform(-1.2, 1.2), 0, rng.uniform(0, 6)), rng)
    shelf(stage, Pose(-width / 2 + 0.2, rng.uniform(-0.2, 0.2) * depth, 0, np.pi / 2), rng.uniform(0.8, 1.8), 5, rng)
    pot_plant(stage, Pose(width / 2 - 0.5, depth / 2 - 0.5), rng.uniform(0.8, 1.5), rng)
    _sofa(stage, Pose(width / 2 - 0.5, -0.1 * depth, 0, -np.pi / 2), rng)
    return World(stage, _room_walk(width, depth, desk, rng), _capture(rng, noise=1.0, angle=0.25))


def _walls(stage: Stage, width: float, depth: float, height: float, rng: np.random.Generator) -> None:
    """Floor, ceiling, walls with posters, a door and a window, and the view through the window."""
    w, d, h = width / 2, depth / 2, height / 2
    color = paint(rng, 150, 200)
    stage.rect((0, 0, 0), (w, 0, 0), (0, d, 0), CARPET, paint(rng, 80, 150))
    stage.rect((0, 0, height), (0, d, 0), (w, 0, 0), PAINT, color)
    stage.rect((-w, 0, h), (0, d, 0), (0, 0, h), PAINT, color)
    stage.rect((0, -d, h), (-w, 0, 0), (0, 0, h), PAINT, color)
    stage.rect((0, d, h), (w, 0, 0), (0, 0, h), PAINT, color)
    gap = rng.uniform(0.3, 0.5) * d  # half-width of the window in the wall at +x
    for low, high in ((0.0, 0.9), (height - 0.35, height)):
        stage.rect((w, 0, (low + high) / 2), (0, -d, 0), (0, 0, (high - low) / 2), PAINT, color)
    for side in (-1, 1):
        stage.rect((w, side * (gap + d) / 2, h), (0, (gap - d) / 2, 0), (0, 0, h), PAINT, color)
        stage.box(Pose(w, side * gap), (0, 0, 0.9), (0.08, 0.08, height - 1.25), METAL, (200, 200, 200))
    house(stage, Pose(w + rng.uniform(10, 18), rng.uniform(-5, 5), -6, np.pi / 2), (22, 8, 14), rng)
    tree(stage, Pose(w + rng.uniform(6, 10), rng.uniform(-3, 3), -5), 7, rng)
    for yaw, reach, span in ((0.0, d, w), (np.pi / 2, w, d), (np.pi, d, w)):
        for _ in range(rng.integers(1, 4)):
            spot = (rng.uniform(-0.8, 0.8) * span, reach - 0.01, rng.uniform(1.3, 1.8))
            stage.panel(Pose(yaw=yaw), spot, (rng.uniform(0.3, 1.0), rng.uniform(0.3, 0.8)), PRINT, paint(rng))
    door = (rng.uniform(-0.5, 0.5) * w, d - 0.005, 1.0)
    stage.panel(Pose(yaw=np.pi), door, (0.9, 2.0), METAL, paint(rng, 120, 190))


def _sofa(stage: Stage, pose: Pose, rng: np.random.Generator) -> None:
    """A sofa with cushions."""
    color = paint(rng)
    stage.box(pose, (0, 0, 0), (1.9, 0.8, 0.42), FABRIC, color)
    stage.box(pose, (0, 0.35, 0.42), (1.9, 0.18, 0.4), FABRIC, color)
    for x in (-0.5, 0.1, 0.6):
        stage.ellipsoid(pose, (x, 0.18, 0.6), (0.22, 0.1, 0.2), STATUE, paint(rng))


def _room_walk(width: float, depth: float, desk: Pose, rng: np.random.Generator) -> Cameras:
    """Cameras of a phone that is carried through the room and mostly looks at the desk and the table."""
    way = np.array([[-0.35, -0.1], [-0.2, -0.4], [0.1, -0.42], [0.3, -0.25], [0.2, 0.05]]) * (width, depth)
    way = np.column_stack([way, rng.uniform(1.3, 1.7, len(way))])
    steps = int(rng.integers(60, 100))
    center = walk(way, steps, 0.04, rng)
    goals = np.array(
        [[desk.x, desk.y, 0.8], [0, 0, 0.6], [-width / 2, 0, 1.0], [width / 2, 0.1, 1.1], [desk.x, desk.y, 1]]
    )
    target = walk(goals[rng.permutation(5)], steps, 0.1, rng)
    return look(center, target, rng.uniform(1100, 1400), rng)


def tabletop(rng: np.random.Generator) -> World:
    """A few objects on a table in a room, photographed from all around."""
    stage = Stage()
    width, depth = rng.uniform(3.4, 6.0), rng.uniform(3.2, 5.0)
    _walls(stage, width, depth, 2.7, rng)
    desk = Pose(rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), 0, rng.uniform(0, 3))
    table(stage, desk, (rng.uniform(1.0, 1.6), rng.uniform(0.7, 0.9), 0.74), rng)
    top = desk.moved(0, 0, 0.74)
    height = rng.uniform(0.2, 0.4)
    figure(stage, top, height, rng)
    stage.sheet(top, (0, 0, 0.002), (rng.uniform(0.5, 1.2), rng.uniform(0.4, 0.8)), CLOTH, paint(rng))
    clutter(stage, top, (1.0, 0.7), int(rng.integers(2, 7)), rng)
    shelf(stage, Pose(0, depth / 2 - 0.2), rng.uniform(0.6, 1.8), 5, rng)
    monitor(stage, Pose(width / 2 - 0.4, 0.5, 0.74, -np.pi / 2))
    chair(stage, desk.moved(0.2, -0.9), rng)
    chair(stage, Pose(-width / 2 + 0.4, 0.9, 0, 1.0), rng)
    start, middle = rng.uniform(0, 6), top.apply((0, 0, 0.45 * height))
    turn = rng.uniform(3.5, 2 * np.pi)
    low = rng.uniform(0.25, 0.5)
    rings = [orbit(middle, r, z, (start, start + turn), n, rng) for r, z, n in ((0.7, low, 40), (0.55, low + 0.25, 30))]
    center = np.concatenate(rings)
    target = middle + 0.05 * rng.standard_normal(center.shape)
    cameras = look(center, target, rng.uniform(1300, 1700), rng)
    return World(stage, cameras, _capture(rng, noise=1.1, wrong=0.02))


def facade(rng: np.random.Generator) -> World:
    """An ornate front of a building with wings, photographed on foot from the square in front of it."""
    stage = Stage()
    width, height = rng.uniform(18, 35), rng.uniform(8, 14)
    stage.rect((0, -20, 0), (60, 0, 0), (0, 30, 0), ASPHALT, (120, 115, 105))
    stone = paint(rng, 120, 180)
    columns, storeys = int(width / 3.2), max(2, int(height / 3.8))
    front = Texture(0.3, 300, size=0.03, border=0.01, dust=0.45, relief=0.008, grid=(storeys, columns))
    stage.box(Pose(), (0, 4, 0), (width, 8, height), front, stone)
    for level in range(1, storeys + 1):
        stage.box(Pose(), (0, -0.15, height * level / storeys - 0.3), (width + 0.4, 0.5, 0.3), BRICK, stone)
    for column in range(columns + 1):
        stage.box(Pose(), ((column / columns - 0.5) * width, -0.12, 0), (0.4, 0.3, height), BRICK, stone)
    _portal(stage, height, stone, rng)
    for side in (-1, 1):
        wing = Pose(side * (width / 2 + 5), -rng.uniform(0, 3))
        house(stage, wing, (9, 10, rng.uniform(0.6, 1.1) * height), rng)
        tree(stage, Pose(side * rng.uniform(0.5, 0.7) * width, -rng.uniform(2, 5)), rng.uniform(4, 8), rng)
    for _ in range(5):
        bush = Pose(rng.uniform(-0.5, 0.5) * width, -rng.uniform(0.6, 1.5))
        stage.leaves(bush, (0, 0, 0.4), rng.uniform(0.3, 0.9, 3), Texture(0.08, 20, border=0.0, dust=0.4), (60, 80, 45))
    steps = int(rng.integers(14, 45))
    near, arc = rng.uniform(9, 15), rng.uniform(0.5, 1.1)
    center = orbit(np.array([0, 0, 0.0]), near, 1.7, (-np.pi / 2 - arc, -np.pi / 2 + arc), steps, rng)
    target = center * (0.45, 0, 0) + np.array([0, 0, 0.4 * height]) + 0.4 * rng.standard_normal(center.shape)
    cameras = look(center, target, rng.uniform(1200, 1600), rng)
    return World(stage, cameras, _capture(rng, noise=0.9, wrong=0.012))


def _portal(stage: Stage, height: float, stone, rng: np.random.Generator) -> None:
    """The entrance: a stepped frame with columns and sculptures."""
    for step in range(4):
        size = 2.2 + 0.5 * step
        for side in (-1, 1):
            stage.box(Pose(), (side * size, -0.4 - 0.25 * step, 0), (0.45, 0.5, 0.45 * height), ORNAMENT, stone)
        stage.box(Pose(), (0, -0.4 - 0.25 * step, 0.45 * height + 0.4 * step), (2 * size, 0.5, 0.4), ORNAMENT, stone)
    for side in (-1, 1):
        stage.cylinder(Pose(side * 4.4, -1.2), (0, 0, 0), 0.35, 0.5 * height, ORNAMENT, stone)
        figure(stage, Pose(side * 4.4, -1.2, 0.5 * height), 1.6, rng)


def street(rng: np.random.Generator) -> World:
    """A street with houses, parked cars and trees, filmed from a moving car."""
    stage = Stage()
    length, half = rng.uniform(60, 110), rng.uniform(7, 11)
    stage.rect((length / 2 + 40, 0, 0), (length, 0, 0), (0, 40, 0), ASPHALT, (95, 95, 95))
    for lane in (-0.3, 0.0, 0.3):
        stage.sheet(Pose(), (length / 2, lane * half, 0.01), (length, 0.15), WOOD, (190, 190, 185))
    for side in (-1, 1):
        at = -5.0
        while at < length + 40:
            width = rng.uniform(8, 20)
            if rng.random() < 0.85:
                size = (width, 10.0, rng.uniform(5, 16))
                house(stage, Pose(at + width / 2, side * (half + 5 + rng.exponential(1.5)), 0), size, rng)
            at += width + rng.exponential(2.0)
        for x in np.arange(3, length + 20, 9.0):
            draw = rng.random()
            spot = Pose(x + rng.uniform(-2, 2), side * (half - 2.5), 0, 0.05 * rng.standard_normal())
            if draw < 0.5:
                car(stage, spot, rng)
            elif draw < 0.8:
                tree(stage, spot.moved(0, side * 1.5), rng.uniform(4, 9), rng)
            else:
                stage.cylinder(spot, (0, side * 1.5, 0), 0.08, 6, METAL, (100, 100, 100))
                stage.panel(spot.moved(0, side * 1.5, 0, -np.pi / 2), (0, -0.1, 2.5), (0.7, 0.7), PRINT, (150, 60, 50))
    steps = int(rng.integers(50, 90))
    way = np.array([[0, 0, 1.5], [0.3 * length, 0.5, 1.5], [0.6 * length, 0, 1.5]])
    center = walk(way, steps, 0.03, rng)
    target = center + np.array([10, 0, 0.5]) + 0.3 * rng.standard_normal(center.shape)
    cameras = look(center, target, rng.uniform(1100, 1400), rng, 1600, 900)
    return World(stage, cameras, _capture(rng, noise=1.5, angle=0.1, wrong=0.05))


def terrain(rng: np.random.Generator) -> World:
    """Fields, hills, houses and trees, photographed by a drone in a grid."""
    stage = Stage()
    altitude, shape = rng.uniform(50, 90), (int(rng.integers(8, 12)), int(rng.integers(6, 9)))
    step = rng.uniform(0.13, 0.24) * altitude
    size = step * shape[0] + 0.5 * altitude
    stage.rect((0, 0, 0), (size, 0, 0), (0, size, 0), MEADOW, (110, 110, 80))
    for _ in range(rng.integers(8, 20)):
        spot = _spot(size, rng, 3.0)
        extent = rng.uniform(10, 50, 2)
        texture = Texture(rng.uniform(0.02, 0.3), 40, size=0.06, border=0.15, dust=0.4, relief=0.1)
        stage.sheet(spot, (0, 0, rng.uniform(0.05, 0.2)), (extent[0], extent[1]), texture, paint(rng, 70, 150))
    for x in (-0.2, 0.25):
        stage.sheet(Pose(0, x * size, 0, rng.uniform(-0.3, 0.3)), (0, 0, 0.3), (2 * size, 5), WOOD, (130, 130, 125))
    for _ in range(rng.integers(2, 6)):
        radius = rng.uniform(15, 50)
        stage.ellipsoid(
            _spot(size, rng, 3.0),
            (0, 0, 0),
            (radius, 0.7 * radius, rng.uniform(0.08, 0.2) * radius),
            MEADOW,
            (100, 105, 75),
        )
    for _ in range(rng.integers(6, 25)):
        spot = _spot(size, rng, 0.4)
        house(stage, spot, (rng.uniform(8, 20), rng.uniform(7, 14), rng.uniform(3, 12)), rng)
    for _ in range(rng.integers(8, 20)):
        tree(stage, _spot(size, rng, 3.0), rng.uniform(4, 12), rng)
    center = drone_grid((step * (shape[0] - 1), step * (shape[1] - 1)), altitude, shape, rng)
    target = center * (1, 1, 0) + rng.uniform(0, 0.4) * altitude * np.array([0.3, 1, 0])
    cameras = look(center, target, rng.uniform(1100, 1300), rng)
    return World(stage, cameras, _capture(rng, angle=0.4, wrong=0.015))


def _spot(size: float, rng: np.random.Generator, turn: float) -> Pose:
    """A random pose on a square field of ``size`` metres, turned by up to ``turn`` radians."""
    return Pose(rng.uniform(-0.5, 0.5) * size, rng.uniform(-0.5, 0.5) * size, 0, rng.uniform(0, turn))


def _capture(rng: np.random.Generator, noise: float = 0.9, angle: float = 0.3, wrong: float = 0.015) -> Capture:
    """A capture with qualities drawn at random around the given ones."""
    return Capture(
        pixel_noise=noise * rng.uniform(0.6, 1.5),
        match_angle=angle * rng.uniform(0.6, 1.4),
        repeatability=rng.uniform(0.35, 0.55),
        wrong_matches=wrong * rng.uniform(0.3, 2.0),
    )


LAYOUTS: dict[str, Layout] = {
    "room": room,
    "object": tabletop,
    "facade": facade,
    "street": street,
    "terrain": terrain,
}
