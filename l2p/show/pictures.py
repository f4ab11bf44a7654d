"""The picture that explains the attack: the map, its line cloud and the recovered points, from one camera."""

from __future__ import annotations

import io
from dataclasses import dataclass
from itertools import combinations, product
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, UInt8

from l2p.maps.lines import LineCloud
from l2p.maps.scene import Scene
from l2p.maps.short_repr import short_repr
from l2p.show.colors import error_bar, error_colors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BACKGROUND = "#0b0e14"
TEXT = "#e8ebf0"
FAINT = "#98a2b3"
FRAME = "#4a5568"
LINE_DARK, LINE_LIGHT = np.array([[0.18, 0.32, 0.62], [0.85, 0.93, 1.0]])

#: Azimuth and elevation of the camera, radians: above the corner of largest x and least y, to show the opposite walls.
VIEW = (np.radians(-52), np.radians(36))
#: Distance of the camera / diagonal of the box: large enough for a mild perspective.
DISTANCE = 1.5
#: Diameter of a point in the middle of the box, in typographic points (1/72 inch).
POINT_SIZE = 2.1


@dataclass(frozen=True)
class Box:
    """An upright box: opposite corners ``low`` and ``high``, scene units."""

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]

    __repr__ = short_repr

    @classmethod
    def of_room(cls, scene: Scene) -> Box:
        """Box of the filmed room, without the view through its windows; needs z up.

        Notes
        -----
        Walls and floor are the outermost slabs with many points, at most ``reach`` from the cameras. Ceilings have few
        points and drop out, which opens the view from above.
        """
        slab, share, reach = 0.1, 0.004, 4.0
        eyes = scene.xyz if scene.camera_centers is None else scene.camera_centers
        xyz = scene.xyz[_inside(scene.xyz, eyes.min(axis=0) - reach, eyes.max(axis=0) + reach)]
        ends = []
        for value in xyz.T:
            count, edge = np.histogram(value, bins=np.arange(value.min(), value.max() + 2 * slab, slab))
            full = np.flatnonzero(count >= share * len(xyz))
            full = full if len(full) else np.array([0, len(count) - 1])
            ends.append((edge[full[0]], edge[full[-1] + 1]))
        low, high = np.array(ends).T
        return cls(low, high)

    def contains(self, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
        """Whether each point is in the box."""
        return _inside(points, self.low, self.high)

    def segments(self, lines: LineCloud) -> Float[np.ndarray, "segments 2 3"]:
        """Return the segments of the lines inside the box; lines that miss it are left out."""
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low = (self.low - lines.origin) / lines.direction
            to_high = (self.high - lines.origin) / lines.direction
        # A line within a face gives 0 / 0, which fmin and fmax ignore.
        enter = np.fmin(to_low, to_high).max(axis=1)
        leave = np.fmax(to_low, to_high).min(axis=1)
        hit = enter < leave
        ends = [lines.origin[hit] + at[hit, None] * lines.direction[hit] for at in (enter, leave)]
        return np.stack(ends, axis=1)

    def edges(self) -> Float[np.ndarray, "edges 2 3"]:
        """Return the edges of the floor and of the two walls that the camera sees from inside."""
        corners = np.array(list(product((0, 1), repeat=3)))
        pairs = [(a, b) for a, b in combinations(corners, 2) if np.abs(a - b).sum() == 1]
        seen = [pair for pair in pairs if _on_seen_face(*pair)]
        return np.where(np.array(seen) == 1, self.high, self.low)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; the rows of ``axes`` are right, up and forward."""

    eye: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]

    __repr__ = short_repr

    @classmethod
    def above(cls, box: Box) -> Camera:
        """Place a camera that looks into the box from above."""
        azimuth, elevation = VIEW
        across = np.cos(elevation)
        forward = -np.array([np.cos(azimuth) * across, np.sin(azimuth) * across, np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        eye = (box.low + box.high) / 2 - DISTANCE * float(np.linalg.norm(box.high - box.low)) * forward
        return cls(eye, np.stack([right, np.cross(right, forward), forward]))

    def project(
        self, points: Float[np.ndarray, "*many 3"]
    ) -> tuple[Float[np.ndarray, "*many 2"], Float[np.ndarray, "*many"]]:
        """Project points to the image plane at distance 1; return positions and depths (scene units)."""
        seen = (points - self.eye) @ self.axes.T
        return seen[..., :2] / seen[..., 2:], seen[..., 2]


@dataclass(frozen=True)
class Captions:
    """Texts of the picture: title, heading and sentence of each panel, label of the errors."""

    title: str
    map: tuple[str, str]
    lines: tuple[str, str]
    recovered: tuple[str, str]
    error: str


def draw_attack(
    scene: Scene,
    lines: LineCloud,
    recovered: Float[np.ndarray, "lines 3"],
    error: Float[np.ndarray, " lines"],
    captions: Captions,
) -> bytes:
    """Draw three panels as a PNG file: the map in its colours, the line cloud, the recovered points by error.

    Parameters
    ----------
    recovered : (lines, 3)
        Scene units.
    error : (lines,)
        Spacings.

    Notes
    -----
    All panels show the room only; figures in the captions are of all points.
    """
    box = Box.of_room(scene)
    camera = Camera.above(box)
    figure, panels = _panels(captions, camera.project(box.edges())[0])
    rgb = np.full(scene.xyz.shape, 200, np.uint8) if scene.rgb is None else scene.rgb
    kept = box.contains(scene.xyz)
    draw_points(panels[0], camera, scene.xyz[kept], _brightened(rgb[kept]))
    _draw_lines(panels[1], camera.project(box.segments(lines))[0])
    kept = box.contains(recovered)
    draw_points(panels[2], camera, recovered[kept], error_colors(error[kept], dark=True))
    _draw_scale(figure, captions.error)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100, facecolor=BACKGROUND)
    return file.getvalue()


def _panels(captions: Captions, edges: Float[np.ndarray, "edges 2 2"]) -> tuple[Figure, list[Axes]]:
    """Create a figure with three titled panels that show the edges of the room."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(19.2, 7.6))
    FigureCanvasAgg(figure)
    figure.text(0.5, 0.945, captions.title, color=TEXT, fontsize=25, weight="bold", ha="center", va="center")
    low, high = edges.reshape(-1, 2).min(axis=0), edges.reshape(-1, 2).max(axis=0)
    margin = 0.02 * (high - low)
    panels = []
    for column, (heading, sentence) in enumerate((captions.map, captions.lines, captions.recovered)):
        left = 0.008 + column * 0.331
        middle = left + 0.161
        figure.text(middle, 0.865, heading, color=TEXT, fontsize=19, weight="bold", ha="center", va="center")
        figure.text(middle, 0.835, sentence, color=FAINT, fontsize=14, ha="center", va="top", linespacing=1.35)
        panel = figure.add_axes((left, 0.10, 0.322, 0.66))
        panel.set_axis_off()
        panel.set_aspect("equal")
        panel.set_xlim(low[0] - margin[0], high[0] + margin[0])
        panel.set_ylim(low[1] - margin[1], high[1] + margin[1])
        panel.add_collection(LineCollection(list(edges), colors=FRAME, linewidths=1.0, zorder=0))
        panels.append(panel)
    return figure, panels


def draw_points(
    panel: Axes, camera: Camera, points: Float[np.ndarray, "points 3"], color: np.ndarray, size: float = POINT_SIZE
) -> None:
    """Draw dots from far to near, larger when nearer; ``size`` is the diameter at the median depth, in points."""
    position, depth = camera.project(points)
    order = np.argsort(-depth)
    middle = float(np.median(depth)) if len(depth) else 1.0
    area = (size * middle / depth[order]) ** 2
    panel.scatter(*position[order].T, s=area, c=color[order], linewidths=0, zorder=1)


def _draw_lines(panel: Axes, segments: Float[np.ndarray, "segments 2 2"]) -> None:
    """Draw thin lines, more transparent the more there are; seven shades make dense lines distinguishable."""
    from matplotlib.collections import LineCollection

    shade = np.linspace(0, 1, 7)[np.arange(len(segments)) % 7, None]
    alpha = np.full((len(segments), 1), np.clip(1500 / max(len(segments), 1), 0.04, 0.6))
    color = np.hstack([(1 - shade) * LINE_DARK + shade * LINE_LIGHT, alpha])
    panel.add_collection(LineCollection(list(segments), colors=color, linewidths=0.4, zorder=1))


def _draw_scale(figure: Figure, label: str) -> None:
    """Add the colour bar of the errors, under the third panel."""
    place = figure.add_axes((0.735, 0.085, 0.19, 0.018))
    bar = error_bar(figure, label, dark=True, cax=place, orientation="horizontal")
    bar.ax.tick_params(colors=FAINT, labelsize=11.5, length=0)
    bar.ax.xaxis.label.set(color=FAINT, fontsize=12)


def _brightened(rgb: UInt8[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Brighten colours for a dark background."""
    return (rgb / 255) ** 0.65


def _inside(
    points: Float[np.ndarray, "points 3"], low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " points"]:
    return np.all((points >= low) & (points <= high), axis=1)


def _on_seen_face(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether an edge belongs to the floor, the wall of least x or the wall of largest y."""
    return bool((a[2] == b[2] == 0) or (a[0] == b[0] == 0) or (a[1] == b[1] == 1))
