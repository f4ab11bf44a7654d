"""The contract of an attack: its inputs, its result, and the rounds in between.

:mod:`l2p.attacks.run` drives every attack through the same loop::

    state = attack.begin(elements, saved, work)
    for each round that is not saved yet:
        state = attack.step(state, work)       # and attack.saved(state) is saved
    estimate = attack.finish(state, work)

Resuming, distribution over processes and progress are done by this loop, so no attack implements them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.structure import NO_STRUCTURE, Structure
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.maps.appearance import NO_APPEARANCE, Appearance
from l2p.maps.short_repr import short_repr
from l2p.schemes.recognition import UNIFORM
from l2p.work.work import Work


@dataclass(frozen=True, eq=False)
class Elements:
    """The input of an attack: lines as tensors in the working frame, sorted by their coordinates.

    Sums and choices between equal values depend on the order of the lines; sorting makes the points independent of the
    order in the map (:mod:`l2p.geometry.frame`).

    Attributes
    ----------
    lines : Lines
        In the working frame.
    row : (lines,) int64
        Row of each line in the map.
    frame : Frame
        Converts to scene units, for references that know the truth.
    attributes : mapping
        Data published with the lines, one row per line: ``rgb`` (lines, 3) in [0, 1], ``descriptor`` (lines, length)
        float32.
    descriptor_kind : str or None
        What computed the descriptors.
    structure : Structure
        Relations of the lines that the scheme tells.
    """

    lines: Lines
    row: Int[Tensor, " lines"]
    frame: Frame
    attributes: Mapping[str, Any] = field(default_factory=dict)
    descriptor_kind: str | None = None
    structure: Structure = NO_STRUCTURE

    __repr__ = short_repr

    @classmethod
    def sorted(
        cls,
        lines: Lines,
        frame: Frame,
        appearance: Appearance = NO_APPEARANCE,
        structure: Structure = NO_STRUCTURE,
    ) -> Elements:
        """Sort lines, given in the order of the map, by their coordinates."""
        key = torch.cat([lines.direction, lines.moment], dim=1).cpu().numpy()
        row = torch.as_tensor(np.lexsort(key.T), device=lines.direction.device)
        published = attributes_of(appearance, lines.direction.device)
        attributes = {name: value[row] for name, value in published.items()}
        return cls(lines.rows(row), row, frame, attributes, appearance.descriptor_kind, structure.sorted(row))

    def __len__(self) -> int:
        return len(self.row)


def attributes_of(appearance: Appearance, device: torch.device) -> dict[str, Float[Tensor, "lines width"]]:
    """Colours, from 0 to 1, and descriptors as tensors."""
    attributes = {}
    if appearance.rgb is not None:
        attributes["rgb"] = torch.as_tensor(appearance.rgb / np.float32(255), device=device)
    if appearance.descriptor is not None:
        attributes["descriptor"] = torch.as_tensor(appearance.numbers(), device=device)
    return attributes


class Estimate(NamedTuple):
    """Positions on the lines of this process, in the working frame, with the neighbours that voted for them.

    ``confidence`` is in [0, 1], 0 where a line had no vote: its point is at the foot. ``neighbors`` is -1 and
    ``affinity`` 0 where a line has fewer than k neighbours. ``element`` is the line of each position, for attacks that
    place several points or none on a line; None: one point per line, in order. ``logits``, if an attack has them, are
    those that the error is within each of its radii: from them follows the confidence for another spacing.
    """

    beta: Float[Tensor, " points"]
    confidence: Float[Tensor, " points"]
    neighbors: Int[Tensor, "points k"]
    affinity: Float[Tensor, "points k"]
    element: Int[Tensor, " points"] | None = None
    logits: Float[Tensor, "points radii"] | None = None


class Attack:
    """Base class of all attacks, references and users' own methods; one without rounds needs only ``finish``.

    Attributes
    ----------
    rounds : int
        Number of calls of ``step``.
    calibrated : bool
        True: the confidence is the probability of lying within 1 spacing; False: it only ranks.
    line_bytes : float or None
        Bytes held per line, without the temporaries of blocks; None: memory is not bounded.
    columns : mapping
        Name of each tensor that is saved after a round, with its shape per line.
    schemes : tuple of str
        Schemes whose structure the attack uses (:mod:`l2p.attacks.structured`); lines of others are attacked as if
        they were uniform.
    scheme : str
        Scheme that its confidence was calibrated on.
    by_part : bool
        True: parts of a map that lie far apart (:mod:`l2p.geometry.parts`) are attacked one by one, each as if it were
        a map. False: the attack gets all lines at once, as a reference must that knows the point of each.
    """

    rounds: int = 0
    calibrated: bool = False
    line_bytes: float | None = None
    columns: Mapping[str, tuple[int, ...]] = {}
    schemes: tuple[str, ...] = (UNIFORM,)
    scheme: str = UNIFORM
    by_part: bool = False

    def for_scheme(self, scheme: str) -> Attack:
        """Return the attack on lines of one of ``schemes``; the same one by default."""
        return self

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return the names of the published attributes that the attack uses: none, if it uses geometry alone."""
        return ()

    def rounds_of(self, elements: Elements) -> int:
        """Return the number of calls of ``step`` for these lines; ``rounds`` by default."""
        return self.rounds

    def begin(self, elements: Elements, saved: Mapping[str, Tensor] | None, work: Work) -> Any:
        """Return the state before the first round, or after the last saved one.

        Parameters
        ----------
        elements : Elements
            All lines, also if several processes share the work.
        saved : mapping or None
            Tensors of all lines, by the names in ``columns``; None for a fresh run.
        """
        return elements

    def step(self, state: Any, work: Work) -> Any:
        """Return the state after one more round."""
        raise NotImplementedError

    def saved(self, state: Any) -> Mapping[str, Tensor]:
        """Return the tensors of all lines that ``begin`` needs to continue; entries of the state by default."""
        return {name: getattr(state, name) for name in self.columns}

    def finish(self, state: Any, work: Work) -> Estimate:
        """Place the points of this process's lines, ``work.own``."""
        raise NotImplementedError

    def within(self, estimate: Estimate, ratio: float) -> Float[Tensor, " points"]:
        """Return the confidence of lying within ``ratio`` spacings, where that of the estimate is for 1 spacing.

        By default in proportion to the ratio, if it is below 1: enough to rank the points of a part of a map that is
        less dense than the others.
        """
        return estimate.confidence * min(1.0, ratio)

    def settings(self) -> dict[str, Any]:
        """Return the settings of the attack as plain values, for the record."""
        return {}


def locate(attack: Attack, elements: Elements, work: Work) -> Estimate:
    """Run an attack from its last saved round to its end."""
    rounds, saved = work.resumed(attack.columns, elements.lines.direction[:, 0])
    state = attack.begin(elements, saved, work)
    for number in range(rounds, attack.rounds_of(elements)):
        state = attack.step(state, work)
        work.save(number + 1, attack.saved(state))
    return attack.finish(state, work)
