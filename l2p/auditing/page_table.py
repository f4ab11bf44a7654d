"""Tables of an audit's page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

#: Cells of a row of a table; the first is its heading.
Row = Sequence[str]


class Head(NamedTuple):
    """Heading of one column, or of several whose own headings are ``under`` it."""

    text: str
    under: tuple[str, ...] = ()


class Group(NamedTuple):
    """Rows of a table under a heading of their own, which may be empty."""

    heading: str
    rows: Sequence[Row]


@dataclass(frozen=True)
class Table:
    """Table of the page."""

    heading: str
    heads: Sequence[Head]
    groups: Sequence[Group]
    note: str

    @property
    def rows(self) -> list[Row]:
        """Rows of all groups."""
        return [row for group in self.groups for row in group.rows]

    @property
    def columns(self) -> int:
        """Number of columns."""
        return sum(len(head.under) or 1 for head in self.heads)

    @property
    def grouped(self) -> bool:
        """Whether the headings need two rows."""
        return any(head.under for head in self.heads)
