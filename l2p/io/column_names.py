"""Names of columns: what each column of a table holds, from a header or from ``--columns``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from l2p.errors import InputError

#: Groups of columns by their own names.
POINT, END = ("x", "y", "z"), ("x2", "y2", "z2")
DIRECTION, MOMENT, NORMAL = ("dx", "dy", "dz"), ("mx", "my", "mz"), ("nx", "ny", "nz")
RGB = ("r", "g", "b")
#: Fourth homogeneous coordinates of the point and of the end; a column that holds nothing that is used.
POINT_W, END_W, UNUSED = "w", "w2", "-"

#: Other names of a group, without anything but letters and digits; {} is the axis.
_ALIASES = {
    POINT: "{} p{} pt{} pos{} position{} point{} o{} origin{} coord{} center{} centre{} {}coord {}pos {}origin "
    "start{} {}start from{} a{} first{} p1{} {}m foot{}",
    END: "end{} {}end to{} stop{} b{} second{} p2{}",
    DIRECTION: "d{} dir{} direction{} {}dir {}direction v{} vec{} vector{} u{} unit{} ray{} delta{}",
    MOMENT: "m{} mom{} moment{} {}moment",
    NORMAL: "n{} normal{} norm{} {}normal normals{} {}n",
}
_COLOURS = "{} diffuse{} scalar{} color{} colour{} rgb{} {}f {}0255"
_CHANNELS = {"r": ("r", "red"), "g": ("g", "green"), "b": ("b", "blue")}
#: Letters before numbered axes, as in d0 d1 d2.
_NUMBERED = {"p": POINT, "o": POINT, "origin": POINT, "point": POINT, "d": DIRECTION, "dir": DIRECTION, "v": DIRECTION,
             "direction": DIRECTION, "m": MOMENT, "moment": MOMENT, "n": NORMAL, "normal": NORMAL}  # fmt: skip
_FOURTH = {"w": POINT_W, "w1": POINT_W, "pw": POINT_W, "ow": POINT_W, "w2": END_W}


def _named() -> dict[str, str]:
    """Own name of each other name."""
    found = dict(_FOURTH)
    for group, patterns in _ALIASES.items():
        for pattern in patterns.split():
            found |= {pattern.format(axis): own for axis, own in zip("xyz", group, strict=True)}
    for own, words in _CHANNELS.items():
        found |= {pattern.format(word): own for word in words for pattern in _COLOURS.split()}
    return found | dict(zip("ijk", DIRECTION, strict=True))


_NAMED = _named()


@dataclass(frozen=True)
class Layout:
    """What the columns of a table hold.

    Attributes
    ----------
    columns : tuple of str
        Own name of each column, ``UNUSED`` for those that are not used.
    told_by : str
        How that is known, for users; empty if the file or the user names them.
    """

    columns: tuple[str, ...]
    told_by: str = ""

    def has(self, group: tuple[str, ...]) -> bool:
        """Whether all columns of a group are there."""
        return set(group) <= set(self.columns)

    @property
    def are_lines(self) -> bool:
        """Whether the rows are lines; otherwise they are points."""
        return (self.has(POINT) and (self.has(DIRECTION) or self.has(END))) or self.has(DIRECTION + MOMENT)

    @property
    def words(self) -> str:
        """The columns for users, and how they are known."""
        used = list(self.columns)
        while used and used[-1] == UNUSED:
            used.pop()
        names = [["x1", "y1", "z1"][POINT.index(name)] if self.has(END) and name in POINT else name for name in used]
        return f"columns {' '.join(names)}{f', {self.told_by}' if self.told_by else ''}"

    @property
    def content(self) -> str:
        """What the rows are: ``points with colours``, ``lines``."""
        colours = ["colours"] if self.has(RGB) else []
        if self.are_lines:
            return " with ".join(["lines", *colours])
        beside = " and ".join(colours + (["normals"] if self.has(NORMAL) else []))
        return f"points with {beside}" if beside else "points"


def named_layout(names: Sequence[str]) -> Layout | None:
    """Read the names of a header.

    Returns
    -------
    Layout or None
        None unless they name a point, or a direction and a moment.

    Examples
    --------
    >>> named_layout(["Red", "Green", "Blue", "X", "Y", "Z", "quality"]).columns
    ('r', 'g', 'b', 'x', 'y', 'z', '-')
    >>> named_layout(["X1", "Y1", "Z1", "X2", "Y2", "Z2"]).words
    'columns x1 y1 z1 x2 y2 z2'
    """
    plain = [_plain(name) for name in names]
    ends = _numbered_ends(plain)
    own = [ends.get(name) or _of_number(name, plain) or _NAMED.get(name, UNUSED) for name in plain]
    # The first column of a name counts.
    layout = Layout(tuple(name if own.index(name) == row else UNUSED for row, name in enumerate(own)))
    layout = Layout(tuple(name if _complete(name, layout) else UNUSED for name in layout.columns))
    return layout if layout.has(POINT) or layout.are_lines else None


def asked_layout(words: str) -> Layout:
    """Read ``--columns``: names in the order of the columns, comma separated, - for one that is not used.

    Raises
    ------
    InputError
        If a name is unknown, or they name neither points nor lines.

    Examples
    --------
    >>> asked_layout("dx,dy,dz,x,y,z").are_lines, asked_layout("x,y,z,-,r,g,b").content
    (True, 'points with colours')
    """
    names = [name.strip() for name in words.replace(" ", ",").split(",") if name.strip()]
    layout = named_layout(names)
    skipped = {UNUSED, "_", "skip"}
    unused = [] if layout is None else [n for n, own in zip(names, layout.columns, strict=True) if own == UNUSED]
    if layout is None or not skipped.issuperset(unused):
        raise InputError(
            f"got --columns {words}; expected names in the order of the columns, such as x,y,z,dx,dy,dz (a point and a "
            "direction), x1,y1,z1,x2,y2,z2 (two points), dx,dy,dz,mx,my,mz (Plücker), x,y,z,r,g,b or "
            "x,y,z,nx,ny,nz (points), and - for a column that is not used"
        )
    return layout


def _plain(name: str) -> str:
    """
    >>> _plain("Dir_X [m]"), _plain("diffuse_red"), _plain("R(0-255)")
    ('dirx', 'diffusered', 'r')
    """
    return re.sub(r"[^a-z0-9]", "", re.sub(r"[\[(].*", "", name.lower()))


def _numbered_ends(plain: Sequence[str]) -> dict[str, str]:
    """Own names of x0 y0 z0 or x1 y1 z1, and of the point with the next number."""
    numbers = sorted({name[1] for name in plain if re.fullmatch("[xyz][0-9]", name)})
    groups = ((f"{{}}{number}", group) for number, group in zip(numbers, (POINT, END), strict=False))
    found = {form.format(axis): own for form, group in groups for axis, own in zip("xyz", group, strict=True)}
    if len(numbers) == 1 and "x" in plain:  # x y z and x2 y2 z2
        return dict(zip((axis + numbers[0] for axis in "xyz"), END, strict=True))
    return found


def _of_number(name: str, plain: Sequence[str]) -> str | None:
    """Own name of one of d0 d1 d2, or d1 d2 d3."""
    found = re.fullmatch("([a-z]+)([0-3])", name)
    if found is None or found[1] not in _NUMBERED:
        return None
    first = 0 if f"{found[1]}0" in plain else 1
    return _NUMBERED[found[1]][int(found[2]) - first] if 0 <= int(found[2]) - first < 3 else None


def _complete(name: str, layout: Layout) -> bool:
    """Whether the group of a name is there as a whole."""
    groups = [group for group in (POINT, END, DIRECTION, MOMENT, NORMAL, RGB) if name in group]
    return all(layout.has(group) for group in groups)
