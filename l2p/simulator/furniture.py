"""Furniture, plants, cars and houses of simulated scenes, and their textures; sizes in metres."""

from __future__ import annotations

import numpy as np

from l2p.simulator.surfaces import Number, Pose, Stage, Texture, Triple

PAINT = Texture(0.004, 3, size=0.05, border=0.3, dust=0.3, relief=0.003)
PRINT = Texture(1.0, 30, size=0.10, border=0.1, dust=0.05, relief=0.001)
WOOD = Texture(0.10, 12, size=0.10, border=0.35, dust=0.3, relief=0.001)
METAL = Texture(0.06, 4, size=0.06, border=0.6, dust=0.1, relief=0.001)
FABRIC = Texture(0.10, 15, size=0.15, border=0.1, dust=0.4, relief=0.015)
CARPET = Texture(0.10, 40, size=0.04, border=0.02, dust=0.5, relief=0.004)
PLANT = Texture(0.25, 25, size=0.10, border=0.0, dust=0.4)
BOOKS = Texture(0.8, 20, size=0.06, border=0.1, dust=0.05, grid=(1, 22), relief=0.01)
SCREEN = Texture(0.15, 4, size=0.05, border=0.7, dust=0.05)
KEYS = Texture(1.0, 2, size=0.05, border=0.1, dust=0.05, grid=(5, 14), relief=0.002)
STATUE = Texture(0.6, 40, size=0.10, border=0.05, dust=0.3, relief=0.004)


def paint(rng: np.random.Generator, low: Number = 40, high: Number = 190) -> Triple:
    """A random colour with little saturation."""
    r, g, b = rng.uniform(low, high) + 12 * rng.standard_normal(3)
    return float(r), float(g), float(b)


def table(stage: Stage, pose: Pose, size: Triple, rng: np.random.Generator) -> None:
    """A table of (width, depth, height)."""
    width, depth, height = size
    color = paint(rng, 90, 170)
    stage.box(pose, (0, 0, height - 0.04), (width, depth, 0.04), METAL, color, top=WOOD)
    for x in (-1, 1):
        for y in (-1, 1):
            stage.box(
                pose, (x * (width / 2 - 0.05), y * (depth / 2 - 0.05), 0), (0.05, 0.05, height - 0.04), METAL, color
            )


def chair(stage: Stage, pose: Pose, rng: np.random.Generator) -> None:
    """A chair with seat, back and a foot."""
    color = paint(rng)
    stage.box(pose, (0, 0, 0.43), (0.46, 0.46, 0.06), FABRIC, color)
    stage.box(pose, (0, 0.22, 0.5), (0.44, 0.05, 0.5), FABRIC, color)
    stage.cylinder(pose, (0, 0, 0.05), 0.03, 0.38, METAL, (60, 60, 60))
    for angle in np.arange(5) * 2 * np.pi / 5:
        stage.box(pose.moved(0, 0, 0, angle), (0.15, 0, 0.02), (0.3, 0.04, 0.04), METAL, (50, 50, 50))


def shelf(stage: Stage, pose: Pose, width: Number, rows: int, rng: np.random.Generator) -> None:
    """A bookcase whose boards carry books, boxes or nothing."""
    color = paint(rng, 80, 180)
    stage.box(pose, (0, 0.15, 0), (width, 0.02, 0.36 * rows), PAINT, color)
    for side in (-1, 1):
        stage.box(pose, (side * width / 2, 0, 0), (0.02, 0.3, 0.36 * rows), WOOD, color)
    for row in range(rows):
        stage.box(pose, (0, 0, 0.36 * row), (width, 0.3, 0.02), METAL, color)
        start = -width / 2 + 0.03
        while start < width / 2 - 0.15:
            length = min(rng.uniform(0.15, 0.5), width / 2 - 0.03 - start)
            size = (length, rng.uniform(0.15, 0.24), rng.uniform(0.18, 0.31))
            if rng.random() < 0.7:
                texture = BOOKS if rng.random() < 0.7 else PRINT
                stage.box(pose, (start + length / 2, 0.02, 0.36 * row + 0.02), size, texture, paint(rng))
            start += length + rng.exponential(0.1)


def monitor(stage: Stage, pose: Pose) -> None:
    """A screen on a foot, with a keyboard and a mouse in front of it."""
    stage.box(pose, (0, 0, 0), (0.2, 0.18, 0.015), METAL, (50, 50, 55))
    stage.box(pose, (0, 0.03, 0.0), (0.05, 0.03, 0.2), METAL, (50, 50, 55))
    stage.box(pose, (0, 0, 0.14), (0.55, 0.03, 0.33), SCREEN, (45, 50, 60))
    stage.box(pose, (0, -0.3, 0), (0.43, 0.13, 0.02), METAL, (60, 60, 60), top=KEYS)
    stage.ellipsoid(pose, (0.32, -0.3, 0.015), (0.03, 0.05, 0.02), METAL, (50, 50, 50))


def clutter(stage: Stage, pose: Pose, area: tuple[Number, Number], count: int, rng: np.random.Generator) -> None:
    """``count`` small things spread over (width, depth) of a table: cups, books, boxes, papers, bottles."""
    for _ in range(count):
        spot = pose.moved(rng.uniform(-0.5, 0.5) * area[0], rng.uniform(-0.5, 0.5) * area[1], 0, rng.uniform(0, 3))
        color, size = paint(rng, 50, 210), rng.uniform(0.6, 1.4)
        kind = rng.integers(5)
        if kind == 0:
            stage.cylinder(spot, (0, 0, 0), 0.04 * size, 0.1 * size, PRINT, color)
        elif kind == 1:
            stage.box(spot, (0, 0, 0), (0.16 * size, 0.22 * size, rng.uniform(0.01, 0.08)), PRINT, color)
        elif kind == 2:
            stage.box(spot, (0, 0, 0), (0.14 * size, 0.1 * size, 0.15 * size), PRINT, color)
        elif kind == 3:
            stage.sheet(spot, (0, 0, 0.002), (0.21 * size, 0.3 * size), PRINT, (200, 200, 195))
        else:
            stage.cylinder(spot, (0, 0, 0), 0.035 * size, 0.17 * size, PRINT, color)
            stage.cylinder(spot, (0, 0, 0.17 * size), 0.013 * size, 0.07 * size, METAL, color)


def figure(stage: Stage, pose: Pose, height: Number, rng: np.random.Generator) -> None:
    """A statuette: a body of ellipsoids on a base."""
    h, color = height, paint(rng, 70, 170)
    stage.cylinder(pose, (0, 0, 0), 0.22 * h, 0.08 * h, STATUE, color)
    stage.ellipsoid(pose, (0, 0, 0.38 * h), (0.17 * h, 0.13 * h, 0.3 * h), STATUE, color)
    stage.ellipsoid(pose, (0, 0, 0.82 * h), (0.12 * h, 0.12 * h, 0.15 * h), STATUE, paint(rng, 80, 190))
    for side in (-1, 1):
        arm = pose.moved(side * 0.2 * h, 0, 0, side * rng.uniform(0, 1))
        stage.ellipsoid(arm, (0, -0.04 * h, 0.5 * h), (0.05 * h, 0.12 * h, 0.06 * h), STATUE, color)
        stage.ellipsoid(pose, (side * 0.08 * h, -0.1 * h, 0.14 * h), (0.06 * h, 0.12 * h, 0.07 * h), STATUE, color)
        stage.ellipsoid(pose, (side * 0.1 * h, 0, 0.98 * h), (0.04 * h, 0.02 * h, 0.06 * h), STATUE, color)


def pot_plant(stage: Stage, pose: Pose, height: Number, rng: np.random.Generator) -> None:
    """A plant in a pot, with a few clumps of leaves."""
    stage.cylinder(pose, (0, 0, 0), 0.15 * height, 0.3 * height, FABRIC, paint(rng, 80, 170))
    for _ in range(5):
        x, y = 0.15 * height * rng.standard_normal(2)
        z = rng.uniform(0.45, 0.9) * height
        radii = 0.13 * height * np.exp(0.3 * rng.standard_normal(3))
        stage.leaves(pose, (x, y, z), radii, PLANT, (50, 85, 35))


def tree(stage: Stage, pose: Pose, height: Number, rng: np.random.Generator) -> None:
    """A trunk with a crown of clumps."""
    bark, crown = Texture(0.3, 8, border=0.1, relief=0.03), Texture(0.06, 25, size=0.12, border=0.0, dust=0.5)
    stage.cylinder(pose, (0, 0, 0), 0.03 * height, 0.5 * height, bark, (80, 65, 50))
    for _ in range(6):
        x, y = 0.16 * height * rng.standard_normal(2)
        radii = 0.15 * height * np.exp(0.3 * rng.standard_normal(3))
        stage.leaves(pose, (x, y, rng.uniform(0.5, 0.95) * height), radii, crown, (60, 80, 40))


def car(stage: Stage, pose: Pose, rng: np.random.Generator) -> None:
    """A parked car."""
    color, body = paint(rng, 40, 200), Texture(0.4, 10, size=0.08, border=0.4, dust=0.05, relief=0.01)
    stage.box(pose, (0, 0, 0.3), (4.3, 1.75, 0.6), body, color)
    stage.box(pose, (-0.2, 0, 0.9), (2.3, 1.55, 0.55), body, (60, 65, 75))
    for x in (-1.35, 1.35):
        for y in (-0.8, 0.8):
            stage.ellipsoid(pose, (x, y, 0.32), (0.32, 0.12, 0.32), STATUE, (45, 45, 45))


def house(stage: Stage, pose: Pose, size: Triple, rng: np.random.Generator) -> None:
    """A building of (width, depth, height) with rows of windows, a ledge, and boxes on its roof."""
    width, depth, height = size
    wall = Texture(
        0.09,
        15,
        size=0.05,
        border=0.1,
        dust=0.08,
        relief=0.01,
        grid=(max(1, round(height / 3)), max(1, round(width / 3))),
    )
    roof = Texture(0.08, 12, size=0.06, border=0.3, dust=0.3, relief=0.05)
    color = paint(rng, 90, 190)
    stage.box(pose, (0, 0, 0), size, wall, color, top=roof)
    stage.box(pose, (0, 0, height), (width + 0.3, depth + 0.3, 0.25), METAL, color, top=roof)
    for _ in range(rng.integers(1, 4)):
        x, y = rng.uniform(-0.35, 0.35, 2) * (width, depth)
        stage.box(pose, (x, y, height + 0.25), rng.uniform(0.8, 2.5, 3), STATUE, paint(rng))
