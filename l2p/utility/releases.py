"""Localization of a model's own images in a release of its map: how useful the release still is."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from jaxtyping import Float, Int

from l2p.checks import check_fraction
from l2p.errors import InputError
from l2p.io.colmap import read_model
from l2p.io.descriptors import opened_features
from l2p.io.kinds import Kind, kind_of
from l2p.io.scene_files import load_scene
from l2p.maps.lines import LineCloud
from l2p.maps.scene import Scene
from l2p.maps.short_repr import short_repr
from l2p.maps.truth import Hiding
from l2p.schemes.hide import hide
from l2p.schemes.scheme import DEFAULT_SCHEME, SCHEMES, published_by
from l2p.utility import BY_DESCRIPTORS, BY_TRACKS, FRACTIONS, MATCHING, POINTS, WRONG
from l2p.utility.landmarks import Gravity, Landmarks, LineLandmarks, PointLandmarks, poselib
from l2p.utility.localization import Attempt, Localization, Localized
from l2p.utility.matching import by_descriptors, by_tracks
from l2p.utility.queries import Queries, Query, evenly, queries_of
from l2p.utility.ransac import RansacConfig, locate
from l2p.work.progress import NO_PROGRESS, Progress


@dataclass(frozen=True, eq=False)
class Release:
    """Landmarks that are published of a map.

    Attributes
    ----------
    scheme : str
        ``points``, or the scheme that hid them.
    fraction : float
        Share of the map's points.
    landmarks : Landmarks
    landmark_of : (points,) int64
        Landmark of each point of the map, -1 of those that are not published.
    """

    scheme: str
    fraction: float
    landmarks: Landmarks
    landmark_of: Int[np.ndarray, " points"]

    __repr__ = short_repr

    @classmethod
    def of_lines(cls, hidden: Hiding, fraction: float, points: int) -> Release:
        """Publish the lines of a hidden map; both points of a pair have the same landmark, and fakes have none.

        Raises
        ------
        InputError
            If the map has no lines, or all of them meet in one point.
        """
        if not isinstance(hidden.map, LineCloud):
            raise InputError(_no_lines(hidden.map.scheme))
        place = np.full(points, -1)
        place[hidden.truth.index] = hidden.truth.element
        return cls(hidden.map.scheme, fraction, LineLandmarks(hidden.map), place)

    @classmethod
    def of_points(cls, hidden: Hiding, fraction: float, points: int) -> Release:
        """Publish, as they are, the points that are hidden in ``hidden``."""
        place = np.full(points, -1)
        place[hidden.truth.index] = np.arange(len(hidden.truth))
        return cls(POINTS, fraction, PointLandmarks(hidden.truth.xyz), place)


@dataclass(frozen=True)
class LocalizeConfig:
    """Settings of a localization.

    Attributes
    ----------
    matching : str
        ``tracks`` or ``descriptors`` (:mod:`l2p.utility.matching`).
    wrong : tuple of float
        Shares of wrong matches, for matches by tracks; each is a trial.
    most_queries : int or None
        Most images that are localized, evenly spread over their names; None: all.
    gravity : (float, float, float) or None
        Direction of gravity in the map, if the cameras know it; here they know it exactly.
    seed : int
        Seed of wrong matches and samples.
    ransac : RansacConfig
    """

    matching: str = BY_TRACKS
    wrong: tuple[float, ...] = (WRONG,)
    most_queries: int | None = None
    gravity: tuple[float, float, float] | None = None
    seed: int = 0
    ransac: RansacConfig = RansacConfig()

    def __post_init__(self) -> None:
        if self.matching not in MATCHING:
            raise InputError(f"got matches by {self.matching!r}; expected one of {', '.join(MATCHING)}")
        if not self.wrong:
            raise InputError("got no share of wrong matches; expected at least one, a number in [0, 1)")
        for share in self.wrong:
            if not 0 <= share < 1:
                raise InputError(f"got {share:g} as a share of wrong matches; expected a number in [0, 1)")
        if self.most_queries is not None and self.most_queries < 1:
            raise InputError(f"got {self.most_queries} queries; expected at least 1")
        if self.seed < 0:
            raise InputError(f"got seed {self.seed}; expected 0 or more")
        if self.gravity is not None and not 0 < math.hypot(*self.gravity) < math.inf:
            raise InputError(f"got gravity {self.gravity}; expected the direction of gravity in the map, three numbers")


def localize(
    model: str | PathLike[str],
    schemes: Sequence[str] = (POINTS, DEFAULT_SCHEME),
    fractions: Sequence[float] = FRACTIONS,
    *,
    matching: str = BY_TRACKS,
    wrong: Sequence[float] = (WRONG,),
    features: str | PathLike[str] | None = None,
    most_queries: int | None = None,
    gravity: tuple[float, float, float] | None = None,
    metric: bool = False,
    seed: int = 0,
    ransac: RansacConfig | None = None,
    progress: Progress = NO_PROGRESS,
    name: str = "map",
) -> Localization:
    """Localize the images of a COLMAP model in releases of its map, each in the map of the others.

    Parameters
    ----------
    model : path
        COLMAP model folder with images and observations. Photographs are not needed.
    schemes : sequence of str
        Ways to publish: ``points`` as they are, and names of :data:`l2p.schemes.scheme.SCHEMES`.
    fractions : sequence of float
        Shares of the points to publish, in (0, 1]; at one share all ways publish the same points.
    matching : {"tracks", "descriptors"}
        By tracks, matches are those of the model, with a share of ``wrong`` ones; by descriptors they are the nearest
        ones of ``features``, the wrong ones among them included.
    wrong : sequence of float
        Shares of wrong matches by tracks, in [0, 1).
    features : path, optional
        COLMAP's ``database.db`` or hloc's features, for matches by descriptors.
    most_queries : int, optional
        Most images to localize; default: all.
    gravity : (3,) float, optional
        Direction of gravity in the map, if cameras know it: fewer matches then make a sample.
    metric : bool
        The map is in metres.
    seed : int
        Seed of the releases, of wrong matches and of samples.
    ransac : RansacConfig, optional
    progress : Progress
    name : str
        Name of the map, for tables.

    Returns
    -------
    Localization

    Raises
    ------
    FileNotFoundError
        If the model or the features do not exist.
    InputError
        If the model cannot be localized in (no images, fewer than three, no observations, cameras that cannot be
        undistorted), a scheme publishes no lines (planes, permuted points) or only lines that meet in one point
        (spheres), a setting is out of range, or poselib is not installed.

    Notes
    -----
    For each query, the map is that of the other images: points that fewer than two of them see are left out of the
    release. The positions of the other points, and the poses that errors are measured against, are those of the whole
    model, so this is the best that queries of the same day and camera would reach.
    """
    poselib()
    config = LocalizeConfig(
        matching, tuple(wrong), most_queries, gravity, seed, RansacConfig() if ransac is None else ransac
    )
    if features is not None and matching != BY_DESCRIPTORS:
        raise InputError(
            f"got features {features} for matches by {matching}; expected them with matches by descriptors"
        )
    if not fractions:
        raise InputError("got no share of the points; expected at least one, a number in (0, 1]")
    for share in fractions:
        check_fraction(share)
    known = (POINTS, *SCHEMES)
    if not schemes:
        raise InputError(f"got no way to publish; expected at least one of {', '.join(known)}")
    for scheme in schemes:
        if scheme not in known:
            raise InputError(f"got scheme {scheme!r}; expected some of {', '.join(known)}")
        if scheme != POINTS and published_by(scheme) is not LineCloud:
            raise InputError(_no_lines(scheme))
    scene, queries = read_queries(model, features, matching == BY_DESCRIPTORS)
    releases = []
    for share in sorted(set(fractions), reverse=True):
        for scheme in dict.fromkeys(schemes):
            releases.append(release_of(scene, scheme, share, seed))
    return _localization(queries, releases, config, metric, progress, name)


def localize_hidden(
    queries: Queries,
    hidden: Mapping[float, Hiding],
    config: LocalizeConfig,
    metric: bool = False,
    progress: Progress = NO_PROGRESS,
    name: str = "map",
    others: Mapping[tuple[str, float], Hiding] | None = None,
) -> Localization:
    """Localize queries in hidden maps, by fraction, in their points as they are, and in the lines of ``others``.

    Other maps are given by scheme and fraction.
    """
    poselib()
    releases = [
        make(each, fraction, queries.points)
        for fraction, each in hidden.items()
        for make in (Release.of_points, Release.of_lines)
    ]
    for (_, fraction), each in (others or {}).items():
        releases.append(Release.of_lines(each, fraction, queries.points))
    return _localization(queries, releases, config, metric, progress, name)


def _localization(
    queries: Queries, releases: Sequence[Release], config: LocalizeConfig, metric: bool, progress: Progress, name: str
) -> Localization:
    """Localize the queries in each release."""
    trials = localized(queries, releases, config, progress)
    upright = config.gravity is not None
    return Localization(name, queries.points, queries.extent, metric, config.matching, upright, config.seed, trials)


def localizes(hidden: Hiding) -> bool:
    """Whether cameras can be localized in a hidden map: it has lines, which do not all meet in one point."""
    if published_by(hidden.map.scheme) is not LineCloud:
        return False
    try:
        LineLandmarks(hidden.map)
    except InputError:
        return False
    return True


def read_queries(
    model: str | PathLike[str], features: str | PathLike[str] | None = None, described: bool = False
) -> tuple[Scene, Queries]:
    """Read the points of a COLMAP model and its images as queries; with ``described``, their descriptors, too.

    Raises
    ------
    FileNotFoundError, InputError
        As :func:`localize`.
    """
    if kind_of(model) is not Kind.SCENE_MODEL:
        raise InputError(f"{model} is no COLMAP model; expected one, since its images are what is localized")
    scene = load_scene(model)
    return scene, queries_at(model, scene, features, described)


def queries_at(
    model: str | PathLike[str],
    scene: Scene,
    features: str | PathLike[str] | None = None,
    described: bool = False,
) -> Queries:
    """Read the images of a COLMAP model as queries, with the points of a scene of it; errors as :func:`localize`.

    With ``described``, also the descriptors of their keypoints, from ``features`` or found beside the model.
    """
    if scene.ids is None:
        raise InputError("got a scene without point ids; expected that of a COLMAP model")
    read = read_model(model)
    if not described:
        return queries_of(read, scene.ids)
    with opened_features(model, features) as found:
        return queries_of(read, scene.ids, found)


def _no_lines(scheme: str) -> str:
    return (
        f"got scheme {scheme}; expected one that publishes points or lines, since cameras are localized in these only"
    )


def release_of(scene: Scene, scheme: str, fraction: float, seed: int) -> Release:
    """Publish a share of the points, as they are or hidden by a scheme; the same points for all schemes."""
    if scheme == POINTS:
        return Release.of_points(hide(scene.xyz, seed, fraction), fraction, len(scene))
    return Release.of_lines(hide(scene.xyz, seed, fraction, scheme), fraction, len(scene))


def localized(
    queries: Queries, releases: Sequence[Release], config: LocalizeConfig, progress: Progress = NO_PROGRESS
) -> tuple[Localized, ...]:
    """Localize the queries in each release, once for each share of wrong matches."""
    chosen = evenly(queries.all, config.most_queries)
    shares = config.wrong if config.matching == BY_TRACKS else (None,)
    trials = []
    with progress.task("queries localized", len(chosen) * len(releases) * len(shares)) as advance:
        for release in releases:
            for wrong in shares:
                attempts = []
                for number, query in enumerate(chosen):
                    rng = np.random.default_rng([config.seed, number])
                    attempts.append(_attempt(queries, query, release, config, wrong, rng))
                    advance(1)
                trials.append(Localized(release.scheme, release.fraction, wrong, tuple(attempts)))
    return tuple(trials)


def _attempt(
    queries: Queries,
    query: Query,
    release: Release,
    config: LocalizeConfig,
    wrong: float | None,
    rng: np.random.Generator,
) -> Attempt:
    """Match and localize one query."""
    began = time.perf_counter()
    landmark_of = np.where(queries.map_without(query), release.landmark_of, -1)
    if wrong is None:
        matches = by_descriptors(queries, query, landmark_of)
    else:
        matches = by_tracks(query, landmark_of, wrong, rng)
    keypoint = matches.keypoint
    gravity = None
    if config.gravity is not None:
        world = np.asarray(config.gravity, dtype=np.float64)
        gravity = Gravity(query.pose.rotation @ world, world)
    found = locate(
        release.landmarks,
        query.bearing[keypoint],
        query.pixel[keypoint],
        matches.landmark,
        config.ransac,
        rng,
        gravity,
    )
    seconds = time.perf_counter() - began
    attempt = Attempt(query.name, len(matches), int(matches.right.sum()), seconds=seconds)
    if found is None:
        return attempt
    apart = found.pose.rotation @ query.pose.rotation.T
    return replace(
        attempt,
        position=float(np.linalg.norm(found.pose.center - query.pose.center)),
        rotation=_angle(apart),
        inliers=int(found.inliers.sum()),
        samples=found.samples,
    )


def _angle(rotation: Float[np.ndarray, "3 3"]) -> float:
    """Angle of a rotation, degrees; exact for small ones, too."""
    from scipy.spatial.transform import Rotation

    return math.degrees(Rotation.from_matrix(rotation).magnitude())
