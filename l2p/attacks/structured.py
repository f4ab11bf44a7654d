"""Elements of an attack from a line cloud, with the relations that its scheme tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int

from l2p.attacks.structure import NO_STRUCTURE, Structure
from l2p.geometry.frame import Frame
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.schemes.recognition import UNIFORM, Recognition

#: Schemes that attacks with a structure know, besides independent lines.
STRUCTURED = (UNIFORM, "ppl", "rays")


def expanded(lines: LineCloud, scheme: str) -> tuple[LineCloud, Int[np.ndarray, " elements"]]:
    """One line for each point: lines through pairs come twice, with the appearance of one point each.

    Returns
    -------
    LineCloud
        Lines 2i and 2i + 1 are line i of a cloud of pairs; others are as they are.
    (elements,) int64
        Row of each in ``lines``.
    """
    if scheme != "ppl":
        return lines, np.arange(len(lines))
    row = np.repeat(np.arange(len(lines)), 2)
    twice = replace(lines, second=None).rows(row)
    if lines.second is None:
        return twice, row
    both = _alternating(lines.appearance, lines.second)
    return replace(twice, rgb=both.rgb, descriptor=both.descriptor), row


def frame_of(lines: LineCloud, scheme: str, recognition: Recognition) -> Frame:
    """Working frame of lines that are attacked as those of a scheme.

    More than half of the lines may pass through one centre, which then is the point nearest to all lines, at a median
    distance of 0: centres give a frame of their own.
    """
    if scheme != "rays":
        return Frame.of(lines)
    centers = recognition.centers
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    return Frame.about(lines, centers.mean(axis=0), float(apart.max()))


def structure_of(
    lines: LineCloud,
    scheme: str,
    recognition: Recognition,
    frame: Frame,
    device: torch.device | str = "cpu",
) -> Structure:
    """Structure of the expanded lines of a scheme; ``recognition`` has the centres of ``rays``."""
    if scheme == "ppl":
        return Structure(twin=torch.arange(len(lines), device=device) ^ 1)
    if scheme != "rays":
        return NO_STRUCTURE
    center = frame.enter_points(recognition.centers, device)
    return Structure(family=torch.as_tensor(_nearest_center(lines, recognition), device=device), center=center)


def likelier_places(recovery: Recovery) -> Recovery:
    """Keep the more confident of the places that were found on each line, in the order of the lines."""
    order = np.lexsort((-recovery.confidence, recovery.element))
    return recovery.rows(order[np.unique(recovery.element[order], return_index=True)[1]])


def _alternating(first: Appearance, second: Appearance) -> Appearance:
    columns = {
        name: np.stack([getattr(first, name), getattr(second, name)], axis=1).reshape(2 * len(getattr(first, name)), -1)
        for name in first.names
    }
    return Appearance(columns.get("rgb"), columns.get("descriptor"), first.descriptor_kind)


def _nearest_center(lines: LineCloud, recognition: Recognition) -> Int[np.ndarray, " lines"]:
    """Centre of each line; for lines that pass through none, the one that they are nearest to."""
    assert recognition.family is not None
    apart = np.stack(
        [np.linalg.norm(lines.moment - np.cross(center, lines.direction), axis=1) for center in recognition.centers]
    )
    return np.where(recognition.family >= 0, recognition.family, apart.argmin(axis=0))
