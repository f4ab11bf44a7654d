"""The pictures of an audit's page: each view as a table of attackers and fractions."""

from __future__ import annotations

import base64
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from l2p.auditing.attackers import named, seen_by
from l2p.auditing.audit import Audit
from l2p.auditing.seen import Seen, Shot
from l2p.images.similarity import Likeness
from l2p.io.image_files import image_bytes
from l2p.show.page.numbers import fraction


class Cell(NamedTuple):
    """A picture: its data as an address, its text for those who do not see it, and its caption."""

    source: str
    alternative: str
    caption: str


class PictureRow(NamedTuple):
    """The pictures of one attacker, the largest fraction first."""

    heading: str
    cells: list[Cell]


class PictureTable(NamedTuple):
    """One view: what it looks like, and what attackers see of it.

    Attributes
    ----------
    name : str
    width : int
        Of the pictures, pixels.
    first : list of Cell
        The photograph, if there is one, and the picture of the true points.
    rows : list of PictureRow
    """

    name: str
    width: int
    first: list[Cell]
    rows: list[PictureRow]


def picture_tables(audit: Audit) -> list[PictureTable]:
    """Arrange the pictures of an audit."""
    return [_table(audit, seen) for seen in audit.pictures]


def _table(audit: Audit, seen: Seen) -> PictureTable:
    name, photograph = seen.place.view.name, seen.place.photograph
    first = [] if photograph is None else [Cell(_address(photograph), f"Photograph {name}", "Photograph")]
    true, *attacks = seen.shots
    first.append(_cell(true, f"{name} from the true points", f"From the true points{_with(true)}"))
    rows = []
    for attacker in audit.attackers:
        own = [shot for shot in attacks if shot.used == attacker]
        cells = [_cell(shot, f"{name} as seen with {seen_by(attacker)}", _published(shot)) for shot in own]
        rows.append(PictureRow(f"Attacker sees {seen_by(attacker)}", cells))
    return PictureTable(name, seen.place.view.width, first, rows)


def _published(shot: Shot) -> str:
    assert shot.fraction is not None
    return f"{fraction(shot.fraction)} published"


def _with(shot: Shot) -> str:
    return f", with {named(shot.used)}" if shot.used else ""


def _cell(shot: Shot, alternative: str, caption: str) -> Cell:
    return Cell(_address(shot.image), alternative, caption + ("" if shot.like is None else f": {_likeness(shot.like)}"))


def _likeness(like: Likeness) -> str:
    return f"SSIM {like.ssim:.2f}, {like.psnr:.1f} dB"


def _address(image: UInt8[np.ndarray, "height width 3"]) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(image_bytes(image, ".jpg")).decode()
