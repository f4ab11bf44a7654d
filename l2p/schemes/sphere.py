"""Sphere cloud: the directions in which the points lie from their mean, also among fakes (Moon et al., BMVC 2024)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.maps.truth import Hiding, Truth
from l2p.schemes.centers import moved_points
from l2p.schemes.rounding import directions

#: Standard deviation of each component of the noise that makes a fake of a unit vector.
_NOISE = 0.1


class Sphere:
    """Scheme with one line per point, all through the mean c of the points, along (X - c) / abs(X - c).

    The direction has the sign of the point's side. By design the map tells the centre and what a camera there would
    see, a picture of all points; only the distances are hidden.
    """

    name = "sphere"
    answers = 1
    #: Fakes for each true ray.
    fakes = 0

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Draw the true rays, the points that are left out and the fakes that carry their appearance.

        Raises
        ------
        InputError
            If all points are the same, or there are too few for one true ray.
        """
        rays = len(chosen) // (1 + self.fakes)
        if rays == 0:
            raise InputError(f"got {len(chosen)} point(s) for {self.name}; expected at least {1 + self.fakes}")
        moved = moved_points(points, chosen, rng)
        center = np.broadcast_to(moved.mean(axis=0), moved.shape)
        order = rng.permutation(len(chosen))[: rays * (1 + self.fakes)]
        true, recycled = order[:rays], order[rays:]
        direction = directions(moved[true], center[true], rng)
        fake = np.repeat(direction, self.fakes, axis=0)
        fake = fake + rng.normal(scale=_NOISE, size=fake.shape)
        fake /= np.linalg.norm(fake, axis=1, keepdims=True)
        place = rng.permutation(len(order))
        back = np.argsort(place)
        own = appearance.rows(chosen[np.concatenate([true, recycled])[back]])
        lines = LineCloud.through(center[: len(order)], np.concatenate([direction, fake])[back], own, self.name)
        return Hiding(lines, Truth(points[chosen[true]], chosen[true], element=place[:rays]))


class Sphere50(Sphere):
    """Sphere cloud in which every second ray is a fake.

    As many rays as points are published, up to less than one share: of the points, half are left out at random, and
    their places are taken by fakes, each the direction of a true ray with normal noise of 0.1, normalised. A fake
    carries the colour and the descriptor of a point that was left out, each such point once, so that no appearance is
    there twice. By design fakes lie near the rays that they were made of.
    """

    name = "sphere-50"
    fakes = 1


class Sphere33(Sphere):
    """Sphere cloud with two fakes for each true ray (:class:`Sphere50`)."""

    name = "sphere-33"
    fakes = 2


class Sphere25(Sphere):
    """Sphere cloud with three fakes for each true ray (:class:`Sphere50`)."""

    name = "sphere-25"
    fakes = 3
