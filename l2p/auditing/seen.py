"""What attackers see: pictures of some views of the map, from its points and from recovered ones."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from l2p.auditing import MOST_VIEWS
from l2p.auditing.attackers import Attacker
from l2p.auditing.trial import Trial
from l2p.errors import InputError
from l2p.images.inversion import Inversion
from l2p.images.inversion_file import load_inversion
from l2p.images.photographs import folder_beside, photograph
from l2p.images.picture import draw
from l2p.images.picture_points import PicturePoints, points_of
from l2p.images.similarity import Likeness, likeness
from l2p.images.views import View, view_of
from l2p.maps import ATTRIBUTES
from l2p.maps.scene import Scene
from l2p.maps.short_repr import short_repr
from l2p.work.progress import NO_PROGRESS, Progress


@dataclass(frozen=True, eq=False)
class Place:
    """A view of the map, and its photograph if there is one."""

    view: View
    photograph: UInt8[np.ndarray, "height width 3"] | None

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture of a view.

    Attributes
    ----------
    fraction : float or None
        Fraction of the points that were published; None for the true points.
    used : tuple of str
        Attributes that the attacker used, or that the true points have.
    image : (height, width, 3) uint8
    like : Likeness or None
        How like the photograph it is.
    """

    fraction: float | None
    used: Attacker
    image: UInt8[np.ndarray, "height width 3"]
    like: Likeness | None

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Seen:
    """The pictures of a view: of the true points first, then of each attack in the order of the trials."""

    place: Place
    shots: tuple[Shot, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values: the figures of the pictures, without these."""
        return {
            "view": self.place.view.name,
            "pictures": [
                {
                    "fraction": shot.fraction,
                    "attributes": list(shot.used),
                    **({} if shot.like is None else shot.like._asdict()),
                }
                for shot in self.shots
            ],
        }


def places_of(
    model_path: str | PathLike[str], most: int, photographs: str | PathLike[str] | None = None
) -> list[Place]:
    """Choose views of a COLMAP model, evenly spread over its images, and read their photographs.

    Parameters
    ----------
    most : int
        Most views; 0 for none.
    photographs : path, optional
        Folder of the model's photographs; default: ``images`` or ``thumbs`` beside the model. Views whose photograph
        is missing there are shown without.

    Raises
    ------
    FileNotFoundError, InputError
        If ``most`` is out of range, the model cannot be read, or a folder that was given lacks a photograph.
    """
    if not 0 <= most <= MOST_VIEWS:
        raise InputError(f"got {most} views; expected 0 to {MOST_VIEWS}")
    if most == 0:
        return []
    from l2p.io.colmap import read_model

    model = read_model(model_path)
    names = sorted(image.name for image in model.images.values() if image.has_pose)
    # Not the first and last image: sequences begin and end beside the scene.
    chosen = [names[int((place + 0.5) * len(names) / most)] for place in range(most)] if names else []
    folder = folder_beside(model_path) if photographs is None else Path(photographs)
    found = []
    for name in dict.fromkeys(chosen):
        view = view_of(model, name)
        known = folder is not None and (photographs is not None or (folder / name).is_file())
        found.append(Place(view, photograph(folder, view) if known and folder is not None else None))
    return found


def pictures_of(
    trials: Sequence[Trial],
    scene: Scene,
    places: Sequence[Place],
    *,
    ignored: Collection[str] = (),
    drop: Bool[np.ndarray, " points"] | None = None,
    progress: Progress = NO_PROGRESS,
) -> tuple[Seen, ...]:
    """Draw what attackers see of some places, and what the points of the map itself show there.

    Parameters
    ----------
    trials : sequence of Trial
        Attacks of an audit on the scene, whose points are known.
    scene : Scene
    ignored : collection of str
        Attributes that are not published.
    drop : (points,) bool, optional
        Points that are not published.

    Returns
    -------
    tuple of Seen
        For :attr:`l2p.Audit.pictures`.
    """
    if not places:
        return ()
    network, _ = load_inversion()
    whole = scene if drop is None else scene.rows(~drop)
    everything = tuple(name for name in whole.appearance.names if name not in ignored)
    clouds = [(None, everything, points_of(whole))]
    clouds += [(trial.fraction, trial.used, _recovered(trial, scene)) for trial in trials]
    seen = []
    with progress.task("pictures", total=len(places) * len(clouds)) as advance:
        for place in places:
            shots = []
            for fraction, used, points in clouds:
                shots.append(_shot(network, points, fraction, used, place))
                advance(1)
            seen.append(Seen(place, tuple(shots)))
    return tuple(seen)


def _recovered(trial: Trial, scene: Scene) -> PicturePoints:
    """Recovered points of an attack, with the appearance of the points behind their lines."""
    assert trial.truth is not None
    row = np.zeros(len(trial.lines), dtype=np.int64)
    row[trial.truth.element] = trial.truth.index
    recovery = trial.recovery
    return PicturePoints(recovery.xyz, recovery.confidence, scene.appearance.rows(row[recovery.element]))


def _shot(network: Inversion, points: PicturePoints, fraction: float | None, used: Attacker, place: Place) -> Shot:
    hidden = [name for name in ATTRIBUTES if name not in used]
    image = draw(network, points._replace(appearance=points.appearance.without(hidden)), place.view)
    like = None if place.photograph is None else likeness(image, place.photograph)
    return Shot(fraction, used, image, like)
