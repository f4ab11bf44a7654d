"""What a line cloud is, told by the lines alone: are the directions uniform, do lines meet, are they parallel or the
same?

An attack that was made for uniform lines is confidently wrong about others, parallel ones above all
(``docs/recognition.md``). So the lines are looked at first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.errors import InputError
from l2p.maps.lines import LineCloud
from l2p.maps.short_repr import short_repr
from l2p.schemes import meeting

UNIFORM = "uniform"
FEW_LINES = "few lines"
REPEATED = "repeated lines"
ONE_CENTRE = "one centre"
FEW_CENTRES = "few centres"
PARALLEL = "parallel bundles"
FEW_DIRECTIONS = "few directions"
NOT_UNIFORM = "directions not uniform"
RELEASES = "several releases"
PAIRS = "pairs"
DECLARED = "declared scheme"

UNKNOWN = "unknown"
#: Lines of one point that meet in false places, too, and the schemes that draw them: nothing but the file tells.
FALSE_PLACES = "false places"
_WITH_FALSE_PLACES = ("decoys", "through-dense")
#: Added to the sentence where a recovery is reported.
NOT_STATED = "The confidence only ranks points: the attack was not calibrated on such lines. No probability is stated."
#: Fewer lines than this are called few: only gross departures from uniform lines show.
FEW = 100
#: Directions are not uniform beyond this value of S, which uniform directions exceed once in a million clouds: the
#: 1 - 1e-6 quantile of chi-squared with 5 degrees of freedom.
_LARGEST_S = 35.9
#: Median distance of lines from a place, as a share of its own from the origin, that may be rounding to single
#: precision or to some seven digits.
_SINGLE = 2e-7
#: Distance of nearly all lines from one centre, over their median, if both are rounding.
_ROUNDINGS = 10.0
#: Least share of the lines that are the same as, or parallel to, another: a few do no harm.
_LEAST_REPEATED = 0.01
#: Share of the lines in centres, or in bundles, from which the sentence speaks of all lines.
_NEARLY_ALL = 0.9
#: Lines compared with all others in the search of several releases, and most products that this takes.
_COMPARED, _MOST_PRODUCTS = 2000, 100_000_000
#: Least lines for it. A partner is exact if chance gives fewer than ``_EXACT`` lines as near. By chance ``_EXACT`` of
#: the lines have one, in uniform clouds of real maps, which have points twice, up to 0.11 (the 17 of
#: ``shared/maps/train``); ``_LEAST_PARTNERED`` of the compared lines, and some more, are evidence.
_LEAST_COMPARED, _EXACT, _LEAST_PARTNERED, _SOME_MORE = 30, 0.02, 0.25, 8


@dataclass(frozen=True, eq=False)
class Recognition:
    """What a line cloud was recognised as.

    Attributes
    ----------
    kind : str
        One of the constants of this module.
    sentence : str
        What was found, with figures, as one or two plain sentences.
    scheme : str
        Scheme whose attack fits: ``uniform``, ``rays`` (lines through a few centres), ``sphere`` (one centre), ``ppl``
        (pairs of points), ``false places`` (if the file says so), or ``unknown``.
    centers : (centers, 3) float64
        Points through which many lines pass, scene units; none unless the kind is one or few centres.
    family : (lines,) int64 or None
        Centre of each line, -1 for none; None without centres.
    expected : bool
        True for uniform lines only, independent of each other and one a point, as far as the lines can tell: the
        confidence of the learned attack was calibrated on these.
    """

    kind: str
    sentence: str
    scheme: str
    centers: Float[np.ndarray, "centers 3"]
    family: Int[np.ndarray, " lines"] | None
    expected: bool

    __repr__ = short_repr

    def as_dict(self) -> dict[str, Any]:
        """Plain values, without the centres: an entry of ``Recovery.info``."""
        return {"kind": self.kind, "sentence": self.sentence, "scheme": self.scheme, "expected": self.expected}


#: What was found of the clouds in memory, which do not change: the choice of an attack asks, and the attack again.
_RECOGNISED: WeakKeyDictionary[LineCloud, Recognition] = WeakKeyDictionary()


def recognise(lines: LineCloud) -> Recognition:
    """Recognise how the lines of a cloud were drawn.

    Parameters
    ----------
    lines : LineCloud
        Its scheme and a second appearance are taken into account only where geometry cannot tell.

    Returns
    -------
    Recognition
        The first of these that the lines show: parallel bundles or few directions, one or a few centres, repeated
        lines, directions that are not uniform (or pairs, if the file says so), several releases; otherwise uniform,
        or, of fewer than ``FEW`` lines, few lines.

    Raises
    ------
    InputError
        If there are no lines.

    Notes
    -----
    Directions: with T the mean of d d^T, S = 7.5 N (tr T^2 - 1/3) is chi-squared with 5 degrees of freedom for uniform
    directions (Bingham's test of uniformity); beyond 35.9 they are not, one uniform cloud in a million excepted.

    Several releases of one map: each line has a partner that meets it in their common point, far more exactly than any
    of N random lines does (:func:`l2p.schemes.meeting.chance_meetings`).

    Lines through nothing (fakes) among uniform lines cannot be told by any of this, nor directions that are uniform
    and yet chosen. Clouds of more than some thousand lines are sampled, with fixed random numbers.

    Examples
    --------
    >>> import numpy as np, l2p
    >>> points = np.random.default_rng(1).normal(size=(500, 3))
    >>> recognise(l2p.lift(points, seed=0)).sentence
    'The directions of the 500 lines are uniform, and no lines meet or repeat more than chance allows.'
    >>> recognise(l2p.LineCloud.through(points, points - [1.0, 2, 3])).sentence
    'All 500 lines pass through one point.'
    """
    if lines not in _RECOGNISED:
        _RECOGNISED[lines] = _recognised(lines)
    return _RECOGNISED[lines]


def _recognised(lines: LineCloud) -> Recognition:
    if len(lines) == 0:
        raise InputError("got a line cloud without lines; expected at least one line")
    rng = np.random.default_rng(0x5EE)
    cloud = meeting.centred(lines.direction, lines.moment, rng)
    repeated = meeting.repeats(cloud, rng)
    distinct = cloud.rows(~repeated)
    found = (
        _bundled(distinct, len(lines), rng)
        or _roughly_centred(lines, cloud)
        or _centred(cloud, ~repeated, rng)
        or _repeated(repeated)
        or _partly_parallel(cloud, rng)
        or _directed(lines)
        or _released(cloud, rng)
        or _unsuspected(lines)
    )
    return _beside_the_file(found, lines)


def direction_statistic(direction: Float[np.ndarray, "lines 3"]) -> float:
    """Compute S = 7.5 N (tr T^2 - 1/3), about 5 for uniform directions; the sign of a direction does not matter."""
    tensor = direction.T @ direction / len(direction)
    return float(7.5 * len(direction) * (np.sum(tensor**2) - 1 / 3))


def _plain(kind: str, sentence: str, scheme: str = UNKNOWN, *, expected: bool = False) -> Recognition:
    """Recognition without centres."""
    return Recognition(kind, sentence, scheme, np.zeros((0, 3)), None, expected)


def _bundled(distinct: meeting.Centred, count: int, rng: np.random.Generator) -> Recognition | None:
    """Nearly all lines, repeated ones counted once, in a few bundles of parallel lines."""
    parallel = meeting.with_equal(meeting.tensors(distinct.direction), rng)[0].sum()
    if parallel < max(2, _NEARLY_ALL * len(distinct.direction)):
        return None
    sizes = meeting.bundles(distinct.direction, rng)
    if sizes.sum() < _NEARLY_ALL * len(distinct.direction):
        return None
    inside = _of(count - len(distinct.direction) + int(sizes.sum()), count)
    if len(sizes) == 1:
        return _plain(PARALLEL, f"{inside} lines are parallel.")
    return _plain(FEW_DIRECTIONS, f"{inside} lines have one of {len(sizes)} directions.")


def _repeated(repeated: Bool[np.ndarray, " lines"]) -> Recognition | None:
    """Lines that are in the file more than once."""
    again, count = int(repeated.sum()), len(repeated)
    if again < max(1, _LEAST_REPEATED * count):
        return None
    return _plain(REPEATED, f"{_of(again, count)} lines repeat another line of the file.")


def _partly_parallel(cloud: meeting.Centred, rng: np.random.Generator) -> Recognition | None:
    """Lines that are parallel to another, though not all of them are."""
    parallel, count = int(meeting.with_equal(meeting.tensors(cloud.direction), rng)[0].sum()), len(cloud.direction)
    if parallel < max(2, _LEAST_REPEATED * count):
        return None
    return _plain(PARALLEL, f"{_of(parallel, count)} lines are parallel to another.")


def _centred(
    cloud: meeting.Centred, distinct: Bool[np.ndarray, " lines"], rng: np.random.Generator
) -> Recognition | None:
    """One or a few points through which many different lines pass."""
    count, family = len(distinct), np.full(len(distinct), -1)
    if distinct.sum() < 3:  # Two lines have a meeting point by themselves.
        return None
    if cloud.unit:
        points, family[distinct] = meeting.centres(cloud.rows(distinct), rng)
    else:
        points, family[distinct] = cloud.place[None], 0
    if len(points) == 0:
        return None
    for number, point in enumerate((points - cloud.place) / (cloud.unit or 1.0)):
        family[~distinct & (family < 0) & (meeting.distance(cloud, point) < meeting.THROUGH)] = number
    through = int((family >= 0).sum())
    where = "one point" if len(points) == 1 else f"one of {len(points)} points"
    sentence = f"{_of(through, count)} lines pass through {where}."
    scheme = UNKNOWN if through < _NEARLY_ALL * count else "sphere" if len(points) == 1 else "rays"
    kind = ONE_CENTRE if len(points) == 1 else FEW_CENTRES
    return Recognition(kind, sentence, scheme, points, family, expected=False)


def _roughly_centred(lines: LineCloud, cloud: meeting.Centred) -> Recognition | None:
    """Lines through one point but for the rounding of a text file or of single precision.

    Among such lines, centres and repeats would be those of rounding. A small map far from the origin has lines as near
    to each other, but of uniform directions.
    """
    near = 0 < cloud.unit <= _SINGLE * np.linalg.norm(cloud.place)
    # Of two centres, half of the lines may be as near to one, and the others are not.
    near = near and np.quantile(np.linalg.norm(cloud.moment, axis=1), _NEARLY_ALL) <= _ROUNDINGS
    if not near or direction_statistic(lines.direction) <= _LARGEST_S:
        return None
    family = np.zeros(len(lines), dtype=np.int64)
    sentence = f"The {_number(len(lines))} lines pass through one point, up to rounding."
    return Recognition(ONE_CENTRE, sentence, "sphere", cloud.place[None], family, expected=False)


def _directed(lines: LineCloud) -> Recognition | None:
    """Directions that are not uniform."""
    if direction_statistic(lines.direction) <= _LARGEST_S:
        return None
    if _pairs(lines):
        return _of_pairs(lines)
    count = _number(len(lines))
    return _plain(NOT_UNIFORM, f"The directions of the {count} lines are not uniform; no centre or bundle explains it.")


def _released(cloud: meeting.Centred, rng: np.random.Generator) -> Recognition | None:
    count = len(cloud.direction)
    if count < _LEAST_COMPARED:
        return None
    rows = meeting.sample(count, min(_COMPARED, max(_LEAST_COMPARED, _MOST_PRODUCTS // count)), rng)
    partnered = int((meeting.chance_meetings(cloud, rows, rng) < _EXACT).sum())
    if partnered < _LEAST_PARTNERED * len(rows) + _SOME_MORE:
        return None
    compared = "" if len(rows) == count else f" that were compared with all {_number(count)}"
    return _plain(
        RELEASES,
        f"{_of(partnered, len(rows))} lines{compared} meet another far more exactly than chance allows: the file seems "
        "to hold several releases of one map, which give its points away.",
        UNIFORM,
    )


def _unsuspected(lines: LineCloud) -> Recognition:
    """Lines in which nothing was found; what geometry cannot tell, the file may."""
    count = _number(len(lines))
    if _pairs(lines):
        return _of_pairs(lines)
    if lines.scheme != UNIFORM:
        return _plain(DECLARED, f"The directions of the {count} lines look uniform.")
    if len(lines) < FEW:
        some = "1 line is" if len(lines) == 1 else f"{count} lines are"
        return _plain(
            FEW_LINES, f"{some} too few to tell; nothing speaks against uniform lines.", UNIFORM, expected=True
        )
    sentence = f"The directions of the {count} lines are uniform, and no lines meet or repeat more than chance allows."
    return _plain(UNIFORM, sentence, UNIFORM, expected=True)


def _pairs(lines: LineCloud) -> bool:
    """Whether the file says that lines pass through pairs of points."""
    return lines.second is not None or lines.scheme.startswith("ppl")


def _of_pairs(lines: LineCloud) -> Recognition:
    says = "two appearances for each line" if lines.second is not None else f"the scheme {lines.scheme}"
    return _plain(PAIRS, f"The {_number(len(lines))} lines pass through pairs of points: the file has {says}.", "ppl")


def _beside_the_file(found: Recognition, lines: LineCloud) -> Recognition:
    """Add the scheme that the file names, if it is another one; where lines show nothing else, take its attack."""
    named = lines.scheme
    if named in _WITH_FALSE_PLACES and found.kind in (NOT_UNIFORM, DECLARED):
        found = replace(found, scheme=FALSE_PLACES)
    if named == UNIFORM or found.kind == PAIRS or named.startswith(found.scheme):
        return found
    return replace(found, sentence=f"{found.sentence} The file names the scheme {named}.")


def _of(some: int, count: int) -> str:
    """
    >>> _of(8000, 8000), _of(7988, 8000), _of(100, 8000)
    ('All 8,000', 'All but 12 of 8,000', '100 of 8,000')
    """
    if some == count:
        return f"All {_number(count)}"
    return f"{'All but ' + _number(count - some) if some > 0.9 * count else _number(some)} of {_number(count)}"


def _number(value: int) -> str:
    return f"{value:,}"
