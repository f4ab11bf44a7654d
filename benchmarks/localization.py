"""Where localization in points and in lines breaks, and how it compares with pycolmap on the same matches.

    python benchmarks/localization.py ../shared/maps/val/*

Each figure is over all queries of all models: an image of a model, localized in the map of the others, see
docs/localization.md. Errors of position are relative to the extent of the model's cameras. Intervals of medians contain
the true one with probability 0.95 (sign test) if queries are independent, which those of one map are not wholly.
Seconds are those that the process computes on one core, with matching, except in the comparison with pycolmap.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from harness import print_table

from l2p.schemes.scheme import DEFAULT_SCHEME
from l2p.utility import POINTS
from l2p.utility.landmarks import Gravity, LineLandmarks, PointLandmarks
from l2p.utility.localization import LIMITS
from l2p.utility.matching import Matches, by_tracks
from l2p.utility.queries import Pose, Queries, Query, evenly
from l2p.utility.ransac import RansacConfig, locate
from l2p.utility.releases import LocalizeConfig, Release, localized, read_queries, release_of

WRONG = (0.0, 0.1, 0.3, 0.5, 0.6, 0.7)
SHARES = (1.0, 0.25, 0.1, 0.05, 0.02, 0.01)
SCHEMES = (POINTS, DEFAULT_SCHEME)
TABLES = ("wrong", "gravity", "shares", "pycolmap", "maps")
#: Share of wrong matches of the sweep of shares and of the comparison.
USUAL = 0.3
#: Gravity in the map: any direction will do, as cameras are told it exactly.
WORLD = np.array([0.0, 1.0, 0.0])
#: Focal length of a virtual camera along a line, so large that its pixel does not count, and its distance from the foot
#: of the line, in units of the frame: outside the map.
FOCAL, FAR = 60_000.0, 100.0


class Error(NamedTuple):
    """Errors of one query, and its seconds: position of the cameras' extent, rotation in degrees."""

    position: float
    rotation: float
    seconds: float


NOT_FOUND = (math.inf, math.inf)


@dataclass(frozen=True, eq=False)
class Map:
    """A model to localize in: its queries, and releases by scheme and share."""

    name: str
    queries: Queries
    releases: dict[tuple[str, float], Release]

    @classmethod
    def read(cls, path: Path, seed: int) -> Map:
        """Read a model."""
        scene, queries = read_queries(path)
        releases = {(way, share): release_of(scene, way, share, seed) for way in SCHEMES for share in SHARES}
        return cls(path.name, queries, releases)

    def swept(
        self, way: str, share: float, wrong: float, given: argparse.Namespace, known: bool = False
    ) -> list[Error]:
        """Localize with all matches that a query has; ``known``: with gravity."""
        gravity = (float(WORLD[0]), float(WORLD[1]), float(WORLD[2])) if known else None
        config = LocalizeConfig(wrong=(wrong,), most_queries=given.queries, seed=given.seed, gravity=gravity)
        began = time.process_time()
        (trial,) = localized(self.queries, [self.releases[way, share]], config)
        seconds = (time.process_time() - began) / len(trial.attempts)
        extent = self.queries.extent
        return [Error(each.position / extent, each.rotation, seconds) for each in trial.attempts]


def interval(values: Iterable[float]) -> tuple[float, float]:
    """Interval that contains the median of what the values are drawn from with probability 0.95 (sign test)."""
    ordered = sorted(values)
    count, outside = len(ordered), 0
    while outside < (count - 1) // 2:
        if 2 * sum(math.comb(count, number) for number in range(outside + 2)) / 2**count > 0.05:
            break
        outside += 1
    return ordered[outside], ordered[-1 - outside]


def figures(errors: Sequence[Error]) -> list[str]:
    """Median of position and rotation with their intervals, shares within limits, seconds a query."""
    position, rotation = ([each[number] for each in errors] for number in (0, 1))
    cells = []
    for values, scale, digits in ((position, 100, 3), (rotation, 1, 3)):
        ends = (np.median(values), *interval(values))
        middle, low, high = (f"{scale * end:.{digits}f}" if math.isfinite(end) else "none" for end in ends)
        cells.append(f"{middle} ({low}..{high})")
    cells += [f"{np.mean([each <= limit.position for each in position]):.0%}" for limit in LIMITS]
    return [*cells, f"{np.mean([each.seconds for each in errors]):.2f}"]


HEADS = ["position, % (95 %)", "rotation, deg (95 %)", *(f"<= {limit}" for limit in LIMITS), "s / query"]


# Against pycolmap


def same_matches(each: Map, way: str, query: Query, number: int, count: int) -> tuple[Matches, np.random.Generator]:
    """At most so many matches by tracks of a query, and the generator that goes on."""
    rng = np.random.default_rng([1, number])
    landmark_of = np.where(each.queries.map_without(query), each.releases[way, 1.0].landmark_of, -1)
    matches = by_tracks(query, landmark_of, 0.0, rng)
    some = rng.permutation(len(matches))[:count]
    # The wrong ones are drawn among those that are kept, so that their share is exact.
    kept = replace(
        query, bearing=query.bearing[matches.keypoint[some]], pixel=query.pixel[matches.keypoint[some]],
        point=query.point[matches.keypoint[some]], descriptor=None,
    )  # fmt: skip
    wrong = by_tracks(kept, landmark_of, USUAL, rng)
    return Matches(matches.keypoint[some][wrong.keypoint], wrong.landmark, wrong.right), rng


def by_l2p(release: Release, query: Query, matches: Matches, rng: np.random.Generator, gravity: Any) -> Pose | None:
    """Pose by l2p."""
    keypoint, config = matches.keypoint, RansacConfig()
    bearing, pixel = query.bearing[keypoint], query.pixel[keypoint]
    found = locate(release.landmarks, bearing, pixel, matches.landmark, config, rng, gravity)
    return None if found is None else found.pose


def by_pycolmap(release: Release, query: Query, matches: Matches) -> Pose | None:
    """Pose by pycolmap with its own settings, but our threshold; bearings are seen by a pinhole of the same pixel."""
    pycolmap.set_random_seed(0)
    bearing, landmarks = query.bearing[matches.keypoint], release.landmarks
    focal = 1 / float(np.median(query.pixel))
    pinhole = pycolmap.Camera(model="PINHOLE", width=1600, height=1200, params=[focal, focal, 800, 600])
    pixels = np.array([pinhole.img_from_cam(each[:, None]) for each in bearing]).reshape(-1, 2)
    if isinstance(landmarks, PointLandmarks):
        absolute = pycolmap.AbsolutePoseEstimationOptions()
        absolute.ransac.max_error = RansacConfig().threshold
        xyz = landmarks.xyz[matches.landmark] * landmarks.unit + landmarks.center
        found = pycolmap.estimate_and_refine_absolute_pose(pixels, xyz, pinhole, absolute)
        pose = None if found is None else found["cam_from_world"]
        return None if pose is None else Pose(pose.rotation.matrix(), pose.translation)
    assert isinstance(landmarks, LineLandmarks)
    options = pycolmap.RANSACOptions()
    options.max_error, options.confidence = RansacConfig().threshold, RansacConfig().confidence
    options.min_num_trials = 200  # its own least number, 1,000, takes seconds a query
    along = pycolmap.Camera(model="PINHOLE", width=1000, height=1000, params=[FOCAL, FOCAL, 500, 500])
    poses = [along_line(landmarks.direction[row], landmarks.moment[row]) for row in matches.landmark]
    count = len(matches)
    found = pycolmap.estimate_generalized_relative_pose(
        np.full((count, 2), 500.0), pixels, list(range(count)), [count] * count,
        [*poses, pycolmap.Rigid3d()], [along] * count + [pinhole], options,
    )  # fmt: skip
    if found is None:
        return None
    pose = found["rig2_from_rig1"]
    return landmarks.leave(np.column_stack([pose.rotation.matrix(), pose.translation]))


def along_line(direction: np.ndarray, moment: np.ndarray) -> Any:
    """Pose of a virtual camera on a line, looking along it."""
    right = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(direction, right), direction])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ (np.cross(direction, moment) - FAR * direction))


def error_of(pose: Pose | None, query: Query, extent: float, seconds: float) -> Error:
    """Errors of a pose."""
    if pose is None:
        return Error(*NOT_FOUND, seconds)
    turn = pycolmap.Rotation3d(pose.rotation @ query.pose.rotation.T)
    angle = 2 * math.degrees(math.asin(min(float(np.linalg.norm(turn.quat[:3])), 1)))
    return Error(float(np.linalg.norm(pose.center - query.pose.center)) / extent, angle, seconds)


def compared(maps: Sequence[Map], way: str, most: int, count: int) -> dict[str, list[Error]]:
    """Errors by estimator on the same matches."""
    found: dict[str, list[Error]] = {name: [] for name in ("l2p", "l2p, gravity known", "pycolmap")}
    for each in maps:
        release = each.releases[way, 1.0]
        for number, query in enumerate(evenly(each.queries.all, most)):
            matches, rng = same_matches(each, way, query, number, count)
            for name in found:
                began = time.process_time()
                if name == "pycolmap":
                    pose = by_pycolmap(release, query, matches)
                else:
                    gravity = Gravity(query.pose.rotation @ WORLD, WORLD) if "gravity" in name else None
                    pose = by_l2p(release, query, matches, rng, gravity)
                found[name].append(error_of(pose, query, each.queries.extent, time.process_time() - began))
    return found


def swept(
    maps: Sequence[Map],
    title: str,
    name: str,
    settings: Sequence[tuple[float, float]],
    given: argparse.Namespace,
    known: bool = False,
) -> None:
    """Print a table of a sweep: pairs of the share that is published and that of wrong matches."""

    def rows() -> Iterator[list[str]]:
        for way in SCHEMES:
            for share, wrong in settings:
                errors = [error for each in maps for error in each.swept(way, share, wrong, given, known)]
                yield [way, f"{wrong if name == 'wrong matches' else share:.0%}", *figures(errors)]

    print_table(title, ["published as", name, *HEADS], rows())


def by_map(maps: Sequence[Map], given: argparse.Namespace) -> None:
    """Print the medians of each map."""
    rows = []
    for each in maps:
        row = [each.name, str(round(np.median([len(query) for query in each.queries.all])))]
        for way in SCHEMES:
            errors = each.swept(way, 1.0, USUAL, given)
            row += [f"{100 * np.median([e.position for e in errors]):.3f}"]
            row += [f"{np.median([e.rotation for e in errors]):.3f}"]
        rows.append(row)
    heads = ["map", "points an image sees"]
    heads += [f"{way}: {what}" for way in SCHEMES for what in ("position, %", "rotation, deg")]
    print_table(f"each map, all points published, {USUAL:.0%} of matches wrong", heads, rows)


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL", help="COLMAP models with observations")
    parser.add_argument("--queries", type=int, default=12, help="most queries of a model (default: %(default)s)")
    parser.add_argument("--matches", type=int, default=400, help="most matches of the comparison")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=TABLES, help="(default: all)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    maps = [Map.read(path, given.seed) for path in given.models]
    total = sum(min(given.queries, len(each.queries.all)) for each in maps)
    about = f"{total} queries of {len(maps)} maps"
    if "wrong" in given.tables:
        title = f"{about}, all points published, by the share of wrong matches"
        swept(maps, title, "wrong matches", [(1.0, wrong) for wrong in WRONG], given)
    if "gravity" in given.tables:
        title = f"{about}, all points published, gravity known, by the share of wrong matches"
        swept(maps, title, "wrong matches", [(1.0, wrong) for wrong in WRONG], given, known=True)
    if "shares" in given.tables:
        title = f"{about}, {USUAL:.0%} of matches wrong, by the share of the points"
        swept(maps, title, "points", [(share, USUAL) for share in SHARES], given)
    if "pycolmap" in given.tables:
        rows = []
        for way in SCHEMES:
            found = compared(maps, way, given.queries, given.matches)
            rows += [[way, name, *figures(errors)] for name, errors in found.items()]
        title = f"{about}, the same matches, at most {given.matches}, {USUAL:.0%} of them wrong"
        print_table(title, ["published as", "estimator", *HEADS], rows)
    if "maps" in given.tables:
        by_map(maps, given)
    return 0


if __name__ == "__main__":
    sys.exit(main())
