"""Side by side: the true points of a scene and the recovered points of each method, seen by one camera."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from eval.cells import Cell, Store
from eval.eval_config import Pictures
from eval.figures import Drawing, empty_panels
from eval.scoring import Row
from l2p.errors import InputError
from l2p.io.recovery_files import load_recovery
from l2p.judging.accuracy import compare
from l2p.maps.scene import Scene
from l2p.programs.scenes import SceneSource, scene_at
from l2p.show.colors import error_bar, error_colors
from l2p.show.exhibit import Exhibit
from l2p.show.pictures import Box, Camera, draw_points
from l2p.show.stance import Stance

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Colour of points that have none of their own.
PLAIN = "#3d4a5c"
#: Share of points ignored at either end of each axis, and margin of the box around the others, in lengths of their
#: extent: far background would shrink everything else.
TAIL, REACH = 0.1, 0.3
#: Gamma for rgb points on white, which may be pale.
DARKER = 1.6
#: Least and greatest height of a panel, in units of its width.
HEIGHTS = (0.45, 1.2)
#: Diameter of a point in a cloud of 10,000, and its limits, in typographic points; fewer points are larger.
SIZE, SIZES = 1.2, (0.6, 3.0)


@dataclass(frozen=True, eq=False)
class View:
    """View of a scene: turned by ``turn`` so that z is up, its main part in a box, a camera above the box."""

    turn: Float[np.ndarray, "3 3"]
    box: Box
    camera: Camera

    @classmethod
    def of(cls, scene: Scene, upright: bool) -> View:
        """Choose the view of a scene; if ``upright``, its z is up, else up is guessed as on pages."""
        exhibit = Exhibit(points=scene.xyz, camera_centers=scene.camera_centers, up=scene.up)
        turn = np.eye(3) if upright else Stance.before(exhibit).axes
        xyz = scene.xyz @ turn.T
        low, high = np.quantile(xyz, (TAIL, 1 - TAIL), axis=0)
        beyond = REACH * (high - low)
        box = Box(np.maximum(low - beyond, xyz.min(axis=0)), np.minimum(high + beyond, xyz.max(axis=0)))
        return cls(turn, box, Camera.above(box))

    def shown(self, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
        """Mask of the points in the box."""
        return self.box.contains(points @ self.turn.T)


def check_pictures(pictures: Pictures, scenes: Sequence[SceneSource]) -> None:
    """Refuse, before any work, scenes that are not in the run."""
    names = [scene.name for scene in scenes]
    for name in pictures.scenes:
        if name not in names:
            raise InputError(f"got picture scene {name}, which is no scene of this run; expected some of {names}")


def draw_pictures(cells: Sequence[Cell], rows: Sequence[Row], store: Store, pictures: Pictures) -> list[Drawing]:
    """Draw every picture of the config that has a prediction, for the first seed."""
    row_of = {(row["scene"], row["fraction"], row["seed"], row["method"]): row for row in rows}
    drawn = []
    for name in pictures.scenes:
        for fraction in pictures.fractions:
            own = [cell for cell in cells if (cell.scene.name, cell.fraction) == (name, fraction)]
            own = [cell for cell in own if cell.seed == own[0].seed and store.done(cell)]
            if own:
                of = [row_of[name, fraction, cell.seed, cell.contender.label] for cell in own]
                drawn.append(_picture(own, of, store, pictures.color))
    return drawn


def _picture(cells: Sequence[Cell], rows: Sequence[Row], store: Store, color: str) -> Drawing:
    """Draw one scene at one fraction: the truth, then one panel per method."""
    source, fraction = cells[0].scene, cells[0].fraction
    scene = scene_at(source.source)
    view = View.of(scene, upright=source.source.startswith("sim:"))
    behind = cells[0].hidden().truth
    truth, index = behind.xyz, behind.index
    by_rgb = color == "rgb" and scene.rgb is not None
    paint = np.full((len(index), 3), _rgb(PLAIN)) if scene.rgb is None else (scene.rgb[index] / 255) ** DARKER
    size = float(np.clip(SIZE * np.sqrt(10_000 / len(truth)), *SIZES))
    limits = _limits(view, truth)
    across, upward = limits[1] - limits[0]
    count, height = len(cells) + 1, float(np.clip(upward / across, *HEIGHTS))
    columns = count if count < 5 else 3 if count < 7 else 4
    figure, panels = empty_panels(count, columns, (4.2, 4.2 * height + 0.5), 0.7)
    _draw(panels[0], view, truth, paint, size, limits, f"true points\n{len(truth)} of {len(scene)}")
    for panel, cell, row in zip(panels[1:], cells, rows, strict=True):
        found = compare(load_recovery(store.prediction(cell)), behind)
        points = found.recovery.xyz
        shade = paint if by_rgb else error_colors(found.spacings, dark=False)
        heading = f"{cell.contender.label}\nmedian {row['median_spacings']:.2f}, {row['within_1']:.0%} within 1 spacing"
        _draw(panel, view, points, shade, size, limits, heading)
    if not by_rgb:
        place = {"location": "bottom", "shrink": 0.4, "aspect": 40, "pad": 0.02}
        error_bar(figure, "error (spacings)", dark=False, ax=panels, **place)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110, facecolor="white", metadata={"Software": None})
    said = "in the colours of the true points" if by_rgb else "coloured by error"
    caption = (
        f"{source.name} at {100 * fraction:g} %: main part of the true points, and what each method puts there, {said}"
    )
    return Drawing(f"{source.name}_{100 * fraction:g}.png", caption, file.getvalue())


def _draw(
    panel: Axes,
    view: View,
    points: Float[np.ndarray, "points 3"],
    color: np.ndarray,
    size: float,
    limits: Float[np.ndarray, "2 2"],
    heading: str,
) -> None:
    kept = view.shown(points)
    draw_points(panel, view.camera, points[kept] @ view.turn.T, color[kept], size)
    panel.set_title(heading, fontsize=10)
    panel.set(aspect="equal", xlim=limits[:, 0], ylim=limits[:, 1])
    panel.set_axis_off()


def _limits(view: View, truth: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "2 2"]:
    """Low and high corner of the image: the extent of the true points in the box."""
    place, _ = view.camera.project(truth[view.shown(truth)] @ view.turn.T)
    low, high = (place.min(axis=0), place.max(axis=0)) if len(place) else (-np.ones(2), np.ones(2))
    return np.stack([low, high]) + 0.03 * (high - low) * [[-1], [1]]


def _rgb(name: str) -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    return to_rgb(name)
