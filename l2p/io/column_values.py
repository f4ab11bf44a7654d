"""What columns without names hold, told by their numbers: colours, normals, directions, moments, two points of a line.

Every rule is one that chance does not fulfil; where none decides, the user is asked.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from l2p.checks import in_range
from l2p.errors import InputError
from l2p.io.column_names import DIRECTION, END, END_W, MOMENT, NORMAL, POINT, POINT_W, RGB, UNUSED, Layout
from l2p.maps.lines import LineCloud
from l2p.schemes import meeting
from l2p.schemes.recognition import FEW_CENTRES, FEW_DIRECTIONS, ONE_CENTRE, PARALLEL, direction_statistic, recognise

#: How a layout is known, for users.
BY_VALUES, BY_DEFAULT = "recognised by their values", "assumed, as nothing else tells"
#: Fewer rows than this tell nothing about surfaces or directions.
_FEW = 30
#: The same of colours, and of right angles between points and directions, which a few rows have by chance.
_FEW_COLOURS, _FEW_RIGHT = 10, 6
#: Largest |length - 1| of unit vectors, and |cosine| of right angles, in files with two digits; some rows are worse.
_ROUNDED, _NEARLY_ALL = 0.01, 0.99
#: Rows that are compared with their neighbours in space, and neighbours of each.
_COMPARED, _NEIGHBOURS = 1000, 8
#: Mean |cosine| to the offsets of the neighbours, below which a vector is normal to a surface, and least mean |cosine|
#: between the vectors of neighbours. Measured for normals and for all kinds of lines by
#: ``benchmarks/columns.py``.
_TANGENT, _SMOOTH = 0.47, 0.75
#: The same for vectors that are all the same or one of a few, which only a map of planes has for normals.
_FLAT, _SLANTED = 0.1, 0.3
#: Least ratio of the distances at which lines meet, of two readings of the same rows (right ones:
#: ``benchmarks/columns.py``). Products that are computed for it.
_CLOSER, _MOST_PRODUCTS = 1.05, 200_000_000
#: Directions are not uniform beyond it (:mod:`l2p.schemes.recognition`).
_LARGEST_S = 35.9
#: Lines of which a structure is searched.
_SEARCHED = 1000
#: Kinds of lines that no wrong reading of the columns has.
_STRUCTURES = (ONE_CENTRE, FEW_CENTRES, PARALLEL, FEW_DIRECTIONS)


class UndecidedError(Exception):
    """What the columns could be, as the end of a sentence."""


def recognised_layout(where: str, values: Float[np.ndarray, "rows columns"]) -> Layout:
    """Tell what columns without names hold.

    Parameters
    ----------
    where : str
        The file, for messages.
    values : (rows, columns) float64

    Returns
    -------
    Layout
        ``told_by`` says whether the numbers decide, or a point and a direction are assumed of too few rows.

    Raises
    ------
    InputError
        If nothing decides: it asks for ``--columns``.
    """
    try:
        return _layout(values)
    except UndecidedError as doubt:
        raise InputError(
            f"{where} has {values.shape[1]} columns without names, {doubt}; say what they are with --columns, such as "
            "x,y,z,dx,dy,dz (points and directions) or x,y,z,r,g,b (points with colours), or make the lines with "
            "l2p.LineCloud.through(points, directions) in Python"
        ) from doubt


def plucker_layout(where: str, values: Float[np.ndarray, "rows 6"]) -> Layout:
    """Tell the order of Plücker coordinates: the directions are unit vectors; InputError if that does not tell it."""
    units = _are_unit(values[:, :3]), _are_unit(values[:, 3:])
    if units[0] == units[1]:
        raise InputError(
            f"{where} has six columns of which {'both' if units[0] else 'no'} three are unit vectors, so that nothing "
            "tells directions from moments; write them as two arrays, direction and moment"
        )
    return Layout((*DIRECTION, *MOMENT) if units[0] else (*MOMENT, *DIRECTION), BY_VALUES)


def _layout(values: Float[np.ndarray, "rows columns"]) -> Layout:
    columns = values.shape[1]
    if columns == 3:
        return Layout(POINT)
    values = values[in_range(values).all(axis=1)]  # the reader refuses the others
    if columns == 6 and not len(values):
        return Layout((*POINT, *DIRECTION), BY_DEFAULT)
    plain = _without_fourth(values)
    if plain is not None:
        return plain
    if columns == 6:
        return Layout(*_six(values))
    point, last = values[:, :3], values[:, -3:]
    if columns == 7 and _are_colours(last, point):
        return Layout((*POINT, UNUSED, *RGB), BY_VALUES)  # pts: an intensity before the colours
    if columns == 9:
        middle = values[:, 3:6]
        if _are_colours(last, point):
            six, told = _six(values[:, :6])
            return Layout((*six, *RGB), told)
        if _are_colours(middle, point):
            six, told = _six(np.concatenate((point, last), axis=1))
            return Layout((*six[:3], *RGB, *six[3:]), told)
    raise UndecidedError("which l2p does not know")


def _without_fourth(values: Float[np.ndarray, "rows columns"]) -> Layout | None:
    """Layout of homogeneous points and directions, whose fourth numbers are all 1 or all 0; None if it is none."""
    columns = values.shape[1]
    if columns not in (4, 7, 8) or not len(values) or not (values[:, 3] == 1).all():
        return None
    if columns == 4:
        return Layout((*POINT, POINT_W), BY_VALUES)
    if columns == 7:
        # A fourth number of 1 may be an intensity, too.
        six, told = _six(np.delete(values, 3, axis=1))
        return Layout((*six[:3], POINT_W, *six[3:]), told)
    if (values[:, 7] == 0).all():
        return Layout((*POINT, POINT_W, *DIRECTION, UNUSED), BY_VALUES)
    return Layout((*POINT, POINT_W, *END, END_W), BY_VALUES) if (values[:, 7] == 1).all() else None


def _six(values: Float[np.ndarray, "rows 6"]) -> tuple[tuple[str, ...], str]:
    """Names of six columns, and how they are known."""
    first, second = values[:, :3], values[:, 3:]
    if _are_colours(second, first):
        return (*POINT, *RGB), BY_VALUES
    if _are_colours(first, second) and not _are_whole(second):
        return (*RGB, *POINT), BY_VALUES
    units = _are_unit(first), _are_unit(second)
    if units == (False, True):
        return _unit_last(first, second), BY_VALUES if len(values) >= _FEW else BY_DEFAULT
    if units == (True, False):
        return _unit_first(first, second)
    if _are_whole(values) and (second >= 0).all() and second.max(initial=0) > 1:
        raise UndecidedError("all whole: the last three may be colours or directions")
    if len(values) < _FEW:
        return (*POINT, *DIRECTION), BY_DEFAULT
    if units == (True, True):
        raise UndecidedError("all unit vectors")
    return _without_units(first, second), BY_VALUES


def _unit_last(first: np.ndarray, second: np.ndarray) -> tuple[str, ...]:
    """Points and unit vectors: normals, directions, or directions behind their moments."""
    if _are_normals(first, second):
        return (*POINT, *NORMAL)
    if len(first) >= _FEW_RIGHT and _perpendicular(first, second):
        moments = _moments_or_feet(second, first)
        return (*MOMENT, *DIRECTION) if moments else (*POINT, *DIRECTION)
    return (*POINT, *DIRECTION)


def _unit_first(first: np.ndarray, second: np.ndarray) -> tuple[tuple[str, ...], str]:
    """Unit vectors before something else: directions, of points or of moments, or normals."""
    if len(first) < 3 or (_are_whole(first) and len(first) < _FEW):
        return (*POINT, *DIRECTION), BY_DEFAULT  # points at distance 1 by chance
    if _are_normals(second, first):
        return (*NORMAL, *POINT), BY_VALUES
    if _perpendicular(second, first):
        return (*DIRECTION, *(MOMENT if _moments_or_feet(first, second) else POINT)), BY_VALUES
    return (*DIRECTION, *POINT), BY_VALUES


def _moments_or_feet(direction: np.ndarray, other: np.ndarray) -> bool:
    """Whether vectors perpendicular to directions are moments, or points (the feet of the perpendicular).

    Either makes a line cloud with the other turned by a right angle about each line's own direction; the lines of a
    map come closer to each other than those of such a muddle.
    """
    whole = np.linalg.norm(direction, axis=1) > 0
    direction, other = direction[whole], other[whole]
    as_feet, as_moments = (
        meeting_distance(LineCloud.through(point, direction)) if len(direction) >= _FEW else 1.0
        for point in (other, np.cross(direction, other))
    )
    if max(as_feet, as_moments) < _CLOSER * min(as_feet, as_moments) or as_feet == as_moments:
        raise UndecidedError("directions and, perpendicular to them, either Plücker moments or points")
    return as_moments < as_feet


def meeting_distance(lines: LineCloud) -> float:
    """Median over lines of the least distance, times the sine of the angle, to another, scene units."""
    rng = np.random.default_rng(0)
    cloud = meeting.centred(lines.direction, lines.moment, rng)
    rows = meeting.sample(len(lines), max(_FEW, min(4 * _COMPARED, _MOST_PRODUCTS // len(lines))), rng)
    return float(np.median(meeting.least_products(cloud, rows))) * cloud.unit


def _without_units(first: np.ndarray, second: np.ndarray) -> tuple[str, ...]:
    """A point and a direction, or two points: the reading whose lines are uniform, or have a structure."""
    if _perpendicular(first, second):
        raise UndecidedError("perpendicular and none a unit vector, as of Plücker lines")
    usable = (np.linalg.norm(second, axis=1) > 0) & (np.linalg.norm(second - first, axis=1) > 0)
    if usable.mean() < _NEARLY_ALL:
        raise UndecidedError("often without a direction, as points and directions and as two points")
    first, second = first[usable], second[usable]
    apart = second - first
    if _are_few(apart) or _are_few(second):
        return (*POINT, *DIRECTION)  # away from a few centres, or parallel
    length = np.linalg.norm(apart, axis=1)
    if np.ptp(length) < _ROUNDED * length.mean() and np.ptp(np.linalg.norm(second, axis=1)) > 0.1 * length.mean():
        return (*POINT, *END)  # pieces of one length
    for test in (_is_uniform, _has_structure, _joins_points):
        as_direction, as_end = test(first, second), test(first, apart)
        if as_direction != as_end:
            return (*POINT, *(DIRECTION if as_direction else END))
        if as_direction:
            break
    raise UndecidedError("that may be a point and a direction, two points of a line, or neither")


def _are_few(vector: np.ndarray) -> bool:
    """Whether there are but a few different vectors, up to rounding."""
    step = 1e-5 * float(np.abs(vector).max())
    return len(np.unique(np.round(vector / step), axis=0)) <= 2 * meeting.MOST_CENTRES


def _is_uniform(_: np.ndarray, vector: np.ndarray) -> bool:
    return direction_statistic(vector / np.linalg.norm(vector, axis=1, keepdims=True)) <= _LARGEST_S


def _has_structure(point: np.ndarray, vector: np.ndarray) -> bool:
    """Whether lines are parallel or pass through a few centres."""
    rows = meeting.sample(len(point), _SEARCHED, np.random.default_rng(0))
    return recognise(LineCloud.through(point[rows], vector[rows])).kind in _STRUCTURES


def _joins_points(point: np.ndarray, vector: np.ndarray) -> bool:
    """Whether the vectors lead from points to other points of the file, as of lines through pairs."""
    from scipy.spatial import KDTree

    distance, _ = KDTree(point).query(point + vector)
    return float(np.mean(distance < 1e-5 * np.linalg.norm(point - np.median(point, axis=0), axis=1).mean())) > 0.9


def surface_fit(point: Float[np.ndarray, "rows 3"], vector: Float[np.ndarray, "rows 3"]) -> tuple[float, float] | None:
    """Mean |cosine| between vectors and the offsets of the nearest points, and between the vectors of near points.

    Normals of a surface have a small first and a large second figure. None if all points coincide.
    """
    from scipy.spatial import KDTree

    rows = meeting.sample(len(point), _COMPARED, np.random.default_rng(0))
    _, near = map(np.asarray, KDTree(point).query(point[rows], k=min(_NEIGHBOURS + 1, len(point))))
    near = near[:, 1:]
    offset = point[near] - point[rows][:, None]
    length = np.linalg.norm(offset, axis=2)
    apart = length > 0
    if not apart.any():
        return None
    tangent = np.abs(np.sum(offset * vector[rows][:, None], axis=2))[apart] / length[apart]
    return float(tangent.mean()), float(np.abs(np.sum(vector[near] * vector[rows][:, None], axis=2)).mean())


def _are_normals(point: np.ndarray, vector: np.ndarray) -> bool:
    """Whether unit vectors are perpendicular to the surface on which the points lie, and vary smoothly along it."""
    if len(point) < _FEW:
        return False
    vector = vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-9)
    fit = surface_fit(point, vector)
    if fit is None or fit[1] < _SMOOTH:
        return False
    tangent = fit[0]
    if len(np.unique(np.round(vector * _sign(vector)[:, None], 3), axis=0)) <= meeting.MOST_CENTRES:
        if _FLAT < tangent < _SLANTED:
            raise UndecidedError("the last three one of a few directions: of lines, or normals of planes")
        return tangent <= _FLAT
    return tangent < _TANGENT and not _through_centres(point, vector)


def _through_centres(point: np.ndarray, vector: np.ndarray) -> bool:
    """Whether lines pass through a few centres, from which the points are at different distances."""
    rows = meeting.sample(len(point), _SEARCHED, np.random.default_rng(0))
    rows = rows[np.linalg.norm(vector[rows], axis=1) > 0.5]
    found = recognise(LineCloud.through(point[rows], vector[rows]))
    if found.family is None or np.mean(found.family >= 0) < 0.9:
        return False
    inside = found.family >= 0
    distance = np.linalg.norm(point[rows][inside] - found.centers[found.family[inside]], axis=1)
    return float(np.std(distance)) > 0.02 * float(np.mean(distance))


def _sign(vector: np.ndarray) -> np.ndarray:
    """Sign of the largest component of each vector, 1 or -1."""
    largest = np.abs(np.round(vector, 3)).argmax(axis=1)
    return np.where(vector[np.arange(len(vector)), largest] < 0, -1, 1)


def _are_whole(values: np.ndarray) -> bool:
    return bool((values == np.round(values)).all())


def _are_colours(three: Float[np.ndarray, "rows 3"], point: Float[np.ndarray, "rows 3"]) -> bool:
    """Whether numbers beside points are 8-bit colours, or colours from 0 to 1.

    Vectors never are: no line cloud has three numbers above 0 in each of ten rows by chance.
    """
    if len(three) == 0 or three.min() < 0 or three.max() > 255:
        return False
    if _are_whole(three) and three.max() > 1:
        return len(three) >= _FEW_COLOURS or bool(three.max() > 20 and not _are_whole(point))
    length = np.linalg.norm(three, axis=1)
    if len(three) < _FEW_COLOURS or three.max() > 1 or three.max() < 0.2 or np.ptp(length) < 0.1:
        return False
    steps = 255 * three  # 8 bits, in two decimal places or more
    outside = bool(point.min() < 0 or point.max() > 1)  # else both may be places in a box of size 1
    return outside or float(np.abs(steps - np.round(steps)).mean()) < 0.1


def _are_unit(three: Float[np.ndarray, "rows 3"]) -> bool:
    """Whether nearly all rows are unit vectors, and the others 0, as unknown normals are."""
    length = np.linalg.norm(three, axis=1)
    unit = np.abs(length - 1) < _ROUNDED
    return len(three) > 0 and bool(unit.mean() > 0.9) and bool((unit | (length == 0)).all())


def _perpendicular(first: np.ndarray, second: np.ndarray) -> bool:
    size = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    right = np.abs(np.sum(first * second, axis=1)) <= _ROUNDED * size
    return bool(right.mean() >= _NEARLY_ALL)
