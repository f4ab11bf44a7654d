"""Rows of numbers with or without names of the columns: text of any usual separator, and npy arrays."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError
from l2p.io.npz import read_npy
from l2p.maps.short_repr import short_repr

#: Lines from which separators and decimal commas are told, and most columns of a table.
_LOOKED_AT, _MOST_COLUMNS = 200, 64
#: Beginnings of comments in a line of their own: CloudCompare writes its header after //.
_COMMENTS = ("#", "//", "%", "!")
_SEPARATORS = str.maketrans(",;", "  ", "\"'")
_DECIMAL_COMMAS = str.maketrans(",;", ". ", "\"'")
_WHOLE_OR_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?")


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of numbers.

    Attributes
    ----------
    values : (rows, columns) float64
    headers : tuple of tuple of str
        Rows of names that may be the header, the likeliest first: each has a name for every column. Empty without.
    """

    values: Float[np.ndarray, "rows columns"]
    headers: tuple[tuple[str, ...], ...] = ()

    __repr__ = short_repr


def read_table(path: str | PathLike[str]) -> Table:
    """Read the rows of a text file or of a two-dimensional npy array.

    Separators are blanks, tabs, commas or semicolons, numbers may have decimal commas and be in quotes. ``#``, ``//``,
    ``%`` and ``!`` begin comments. A first line with nothing but the number of rows is skipped (pts).

    Raises
    ------
    InputError
        For the first row that is malformed, and if there is none.
    """
    with open(path, "rb") as file:
        content = file.read()
    if content.startswith(b"\x93NUMPY"):
        return Table(_array(path))
    rows = _text(path, content).splitlines()
    comments, written = _parted(rows)
    commas = _has_decimal_commas([row for _, row in itertools.islice(written, _LOOKED_AT)])
    table = _DECIMAL_COMMAS if commas else _SEPARATORS
    head = None
    if written and all(_number(word) is None for word in written[0][1].translate(table).split()):
        head, written = _names(written[0][1]), written[1:]
    if len(written) > 1 and _is_count(written[0][1], len(written) - 1):
        written = written[1:]
    if not written:
        raise InputError(f"{path} has no rows of numbers; expected at least one point or line")
    values = _values(path, [(number, row.translate(table)) for number, row in written])
    heads = _fitting(head, [_names(comment) for comment in reversed(comments)], values.shape[1])
    return Table(values, tuple(map(tuple, heads)))


def _array(path: str | PathLike[str]) -> Float[np.ndarray, "rows columns"]:
    array = read_npy(path)
    if array.ndim != 2 or array.dtype.kind not in "fiu" or not 0 < array.shape[1] <= _MOST_COLUMNS or not len(array):
        raise InputError(
            f"{path} is an npy array of type {array.dtype}, shape {array.shape}; expected numbers of shape (N, 3) for "
            "points, (N, 6) for lines, or an npz with named arrays (numpy.savez)"
        )
    return array.astype(np.float64)


def _text(path: str | PathLike[str], content: bytes) -> str:
    """The text in UTF-8, in UTF-16 with its mark, or in the code page of Western Windows."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")) and len(content) % 2 == 0:
        return content.decode("utf-16", errors="replace")
    if b"\0" in content:
        raise InputError(f"{path} is neither npz, PLY, OBJ nor text; expected one of these")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")


def _parted(rows: list[str]) -> tuple[list[str], list[tuple[int, str]]]:
    """Comments before the first row, without their mark, and the number (from 1) and text of each row that is none."""
    comments: list[str] = []
    written: list[tuple[int, str]] = []
    for number, row in enumerate(rows, start=1):
        row = row.strip()
        mark = next((mark for mark in _COMMENTS if row.startswith(mark)), None)
        if mark is not None:
            if not written:
                comments.append(row.lstrip("#/%! \t"))
            continue
        row = row.split("#", 1)[0].rstrip()
        if row.translate(_SEPARATORS).strip():
            written.append((number, row))
    return comments, written


def _has_decimal_commas(rows: list[str]) -> bool:
    """Whether commas are decimal: every cell between blanks or semicolons is a number then, and some have a comma."""
    some = False
    for row in rows[1:] or rows:  # the first may be the header
        words = row.replace(";", " ").replace('"', "").split()
        if not all(map(_WHOLE_OR_COMMA.fullmatch, words)) or ("," in row and len(words) < 3):
            return False
        some = some or "," in row
    return some


def _is_count(row: str, rows: int) -> bool:
    return row.strip().isdecimal() and int(row) == rows


def _values(path: str | PathLike[str], rows: list[tuple[int, str]]) -> Float[np.ndarray, "rows columns"]:
    """The numbers of the rows, all as many as the first."""
    columns = len(rows[0][1].split())
    if columns > _MOST_COLUMNS:
        raise InputError(
            f"{path} line {rows[0][0]} has {columns} columns; expected at most {_MOST_COLUMNS}: a point or line a row"
        )
    named = _number(rows[0][1].split()[0]) is None and columns > 1
    if not named:
        try:
            # Fast, but tells the line of no error.
            values = np.loadtxt(io.StringIO("\n".join(row for _, row in rows)), comments=None, ndmin=2)
            if values.shape == (len(rows), columns):
                return values.astype(np.float64)
        except ValueError:
            pass
    return np.array(list(_slowly(path, rows, columns, named)), dtype=np.float64).reshape(len(rows), -1)


def _slowly(path: str | PathLike[str], rows: list[tuple[int, str]], columns: int, named: bool) -> Iterator[list[float]]:
    """The numbers of each row, without the names that R writes before each; InputError for the first wrong row."""
    for number, row in rows:
        words = row.split()
        values = [_number(word) for word in words[1 if named else 0 :]]
        if len(words) != columns or None in values or not values:
            like = "" if number == rows[0][0] else ", as in the first row"
            expected = f"{_WORDS.get(columns, columns)} numbers{like}"
            raise InputError(f"{path} line {number}: got {shown(words)}; expected {expected}")
        yield values  # type: ignore[misc]


def _names(row: str) -> list[str]:
    """The names in a header, which may hold blanks if they are separated otherwise."""
    row = row.replace('"', "").replace("'", "")
    separator = next((each for each in ("\t", ";", ",") if row.count(each) >= 2), None)
    return [name.strip() for name in (row.split() if separator is None else row.split(separator))]


def _fitting(head: list[str] | None, comments: list[list[str]], columns: int) -> Iterator[list[str]]:
    """The headers with a name for each column: of a comment also the last names, behind words such as "columns:"."""
    for names in ([] if head is None else [head]) + comments:
        if len(names) == columns or (len(names) > columns and names is not head):
            yield names[-columns:]
        elif len(names) == columns - 1 and names is head:
            yield ["", *names]  # R's and pandas' numbers of the rows
        elif len(names) == columns + 1 and names is head:
            yield names[1:]  # R's names of the rows, which are no column here


def shown(words: list[str]) -> str:
    """Words of a file in an error, shortened."""
    line = " ".join(words)
    return repr(line if len(line) <= 60 else line[:57] + "...")


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


_WORDS = {3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight", 9: "nine"}
