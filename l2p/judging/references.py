"""References that know the true points: results with perfect neighbours, or with all other points of the scene.

They bound an attack from three sides (``docs/how-it-works.md``, "Bounds") and have its interface, so that a table can
compare them. None of them is an attack: each is built from the true points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.attack import Attack, Elements, Estimate
from l2p.attacks.learned.learned import Learned
from l2p.attacks.structured import STRUCTURED
from l2p.attacks.votes import least_squares, member, vote
from l2p.checks import finite_rows
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.nearest import Nearest, nearest_points_to_lines
from l2p.geometry.pairs import feet
from l2p.geometry.points import nearest_neighbors
from l2p.judging.accuracy import SPACING_NEIGHBOR
from l2p.maps.appearance import Appearance
from l2p.work.shards import BLOCK
from l2p.work.work import Work

#: Kernel widths tried by the leave-one-out bound, in spacings.
BANDWIDTHS = (0.125, 0.25, 0.5, 1.0)
#: Powers of the likelihood ratio tried by the leave-one-out bound that sees appearance: the ratio is an estimate, and
#: may be too bold or too timid.
POWERS = (0.7, 1.0, 1.4, 2.0)
#: Rules by which the oracle places a point among its neighbours' votes.
RULES = ("peak", "least_squares")


class Oracle(Attack):
    """Votes of the k true nearest neighbours of each point, a share replaced by random lines (paper, figure 4).

    Parameters
    ----------
    points : (lines, 3)
        The true points in the order of the lines.
    k : int
        Neighbours per line.
    outliers : float
        Share of the k neighbours that is replaced by random lines, in [0, 1].
    seed : int
        Seed of the outliers.
    rule : str
        ``peak``: the peak of the votes, as in the attacks of l2p. ``least_squares``: the point of the line with the
        least squared distance to the neighbours' lines, the rule of Chelani et al. (3DV 2025), which finds neighbours
        by descriptors: an oracle of 25 or 100 neighbours, some of them wrong, stands for it.

    Notes
    -----
    It is not an upper bound for attacks: the nearest neighbours of a point reveal something about the point itself. Of
    lines through centres, only neighbours of other families vote, fewer than k.
    """

    schemes = STRUCTURED

    def __init__(
        self,
        points: Float[np.ndarray, "lines 3"],
        k: int = 50,
        outliers: float = 0.0,
        seed: int = 0,
        rule: str = RULES[0],
    ) -> None:
        check_oracle(k, outliers, rule)
        self.points, self.k, self.outliers, self.seed = finite_rows("points", points), k, outliers, seed
        self.rule = rule

    def neighbors(self) -> Int[np.ndarray, "lines k"]:
        """Choose the neighbours, true ones and outliers."""
        neighbors = nearest_neighbors(self.points, self.k).index
        wrong = round(self.outliers * neighbors.shape[1])
        if wrong:
            rng = np.random.default_rng(self.seed)
            # Drawn from the other lines: shifting past the own index keeps the draw uniform.
            drawn = rng.integers(0, len(neighbors) - 1, size=(len(neighbors), wrong))
            drawn += drawn >= np.arange(len(neighbors))[:, None]
            # Outliers replace neighbours at random ranks, not the farthest first.
            place = np.argsort(rng.random(neighbors.shape), axis=1)[:, :wrong]
            np.put_along_axis(neighbors, place, drawn, axis=1)
        return neighbors

    def finish(self, state: Elements, work: Work) -> Estimate:
        """Vote once with the true neighbours."""
        _check_count(state, self.points)
        neighbors = _in_order(self.neighbors(), state)[work.own(len(state))]
        family = state.structure.family
        if family is not None:
            neighbors = neighbors.masked_fill(family[neighbors] == family[work.own(len(state)), None], -1)
        if self.rule == "least_squares":
            return least_squares(state.lines, neighbors, work)
        return vote(state.lines, neighbors, work=work)

    def settings(self) -> dict[str, Any]:
        """Return k, share of outliers, seed and rule."""
        return {"k": self.k, "outliers": self.outliers, "seed": self.seed, "rule": self.rule}


class CandidateOracle(Attack):
    """Votes of the true neighbours among the candidates of an attack: the loss due to its choice of candidates.

    Parameters
    ----------
    points : (lines, 3)
        The true points in the order of the lines.
    attack : Attack
        The attack whose final estimates determine the candidates.
    k : int
        A candidate counts as true if it is among the k nearest points.
    candidates : int
        Size of N_pl around the attack's estimates.
    """

    def __init__(
        self, points: Float[np.ndarray, "lines 3"], attack: Attack, k: int = 50, candidates: int = 200
    ) -> None:
        _check_number("k", k)
        _check_number("candidates", candidates)
        self.points, self.attack = finite_rows("points", points), attack
        self.k, self.candidates = k, candidates
        self.columns, self.line_bytes = attack.columns, attack.line_bytes

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return the attributes that the attack uses."""
        return self.attack.uses(appearance)

    def rounds_of(self, elements: Elements) -> int:
        """Return the rounds of the attack."""
        return self.attack.rounds_of(elements)

    def begin(self, elements: Elements, saved: Mapping[str, Tensor] | None, work: Work) -> tuple[Elements, Any]:
        """Begin the attack."""
        _check_count(elements, self.points)
        return elements, self.attack.begin(elements, saved, work)

    def step(self, state: tuple[Elements, Any], work: Work) -> tuple[Elements, Any]:
        """Do a round of the attack."""
        return state[0], self.attack.step(state[1], work)

    def saved(self, state: tuple[Elements, Any]) -> Mapping[str, Tensor]:
        """Return the tensors of the attack."""
        return self.attack.saved(state[1])

    def finish(self, state: tuple[Elements, Any], work: Work) -> Estimate:
        """Vote with the true neighbours among the attack's candidates; lines without any keep the attack's estimate."""
        elements, lines = state[0], state[0].lines
        before = self.attack.finish(state[1], work)
        beta = work.gather(before.beta, len(elements))
        near = nearest_points_to_lines(lines, lines.at(beta), self.candidates, work=work).index
        true = _in_order(nearest_neighbors(self.points, self.k).index, elements)[work.own(len(elements))]
        estimate = vote(lines, near.masked_fill(~member(near, true.to(near.dtype)), -1), work=work)
        none = (estimate.neighbors >= 0).sum(dim=1) == 0
        return estimate._replace(beta=torch.where(none, before.beta, estimate.beta))

    def settings(self) -> dict[str, Any]:
        """Return k, candidates, and the attack's own settings."""
        return {"k": self.k, "candidates": self.candidates, "attack": self.attack.settings()}


class LeaveOneOut(Attack):
    """Leave-one-out bound: each point is placed where the density of all other true points along its line is greatest.

    The density is that of a Gaussian kernel with one width for the scene, the one of ``BANDWIDTHS`` with the least
    median error against the true points. It is a yardstick for attacks by geometry alone: only a better prior
    (surfaces, edges, local scale) can beat it.

    With ``sees``, it is a yardstick for attacks that see appearance, too: the kernel of point j is multiplied by
    exp(power s_ij), where s_ij is the log likelihood ratio that i and j, as they look, are neighbours
    (:mod:`l2p.attacks.learned.embedding`). The power is one of ``POWERS``, chosen together with the width. Where
    nothing is published that ``sees`` knows, the bound is that of geometry.

    Parameters
    ----------
    points : (lines, 3)
        The true points in the order of the lines.
    k : int
        Number of points nearest to the line that enter the density; farther ones have no effect in practice.
    sees : Learned, optional
        The learned attack whose embedding gives the likelihood ratio; default: geometry alone.

    Raises
    ------
    InputError
        If the network of ``sees`` does not use appearance.
    """

    schemes = STRUCTURED

    def __init__(self, points: Float[np.ndarray, "lines 3"], k: int = 128, sees: Learned | None = None) -> None:
        _check_number("k", k)
        if sees is not None and not sees.network.config.appearance:
            raise InputError(
                f"got a bound that sees appearance by {sees.source.get('checkpoint', 'a network')}, which uses lines "
                "alone; expected a checkpoint with the input likeness"
            )
        self.points, self.k, self.sees = finite_rows("points", points), k, sees

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return the attributes that the embedding knows: colours, and descriptors of its kind."""
        return () if self.sees is None else known_at_sight(self.sees, appearance)

    def finish(self, state: Elements, work: Work) -> Estimate:
        """Find the mode of the density along each line, for the best of the kernel widths and powers."""
        _check_count(state, self.points)
        lines, frame = state.lines, state.frame
        points = self.points[state.row.cpu().numpy()]
        truth = frame.enter_points(points, lines.direction.device, lines.direction.dtype)
        near = nearest_points_to_lines(lines, truth, self.k, work=work)
        true_beta = ((truth - lines.foot) * lines.direction).sum(dim=1)
        if state.structure.twin is not None:
            near = _without_partner(near, lines, truth, true_beta[state.structure.twin], work)
        unit = nearest_neighbors(points, SPACING_NEIGHBOR).distance[:, -1:]
        # One line, or points that coincide, have no scale: use the unit of the frame.
        scale = (float(np.median(unit)) / frame.unit if unit.size else 0.0) or 1.0
        likeness, own = self._likeness(state, near.index, work), work.own(len(state))
        best, least = None, torch.inf
        with work.task("leave-one-out density", len(near.index) * len(BANDWIDTHS)) as advance:
            for width in BANDWIDTHS:
                for estimate in _modes(lines.rows(own), truth, near, likeness, width * scale, advance):
                    beta = work.gather(estimate.beta, len(state))
                    error = float((beta - true_beta).abs().median())
                    if error < least or best is None:
                        best, least = estimate, error
        assert best is not None
        return best

    def _likeness(self, state: Elements, index: Int[Tensor, "own k"], work: Work) -> Float[Tensor, "own k"] | None:
        """Log likelihood ratios s_ij of this process's lines and the points near them; None if nothing is seen."""
        if self.sees is None:
            return None
        self.sees.network.eval().to(state.row.device)
        appearances: Any = self.sees.seen(state)[0].attributes.get("appearance")
        if appearances is None:
            return None
        row = torch.arange(len(state), device=index.device)[work.own(len(state))]
        blocks = zip(row.split(BLOCK), index.clamp_min(0).split(BLOCK), strict=True)
        return torch.cat([appearances.likeness(rows, others) for rows, others in blocks])

    def settings(self) -> dict[str, Any]:
        """Return points per line and kernel widths; and powers and the file of the embedding, if it sees anything."""
        seen = {} if self.sees is None else {"powers": list(POWERS), **self.sees.source}
        return {"k": self.k, "bandwidths": list(BANDWIDTHS), **seen}


def _without_partner(
    near: Nearest,
    lines: Lines,
    truth: Float[Tensor, "points 3"],
    partner: Float[Tensor, " lines"],
    work: Work,
) -> Nearest:
    """Leave out the points around the other point of each line, whose place is known, too: half of those that are near
    the line, the nearest to it."""
    own = work.own(len(partner))
    apart = (feet(lines.rows(own), truth, near.index).beta - partner[own, None]).abs()
    far = apart > apart.median(dim=1, keepdim=True).values
    return Nearest(near.index, near.distance.masked_fill(~far, torch.inf))


def known_at_sight(attack: Learned, appearance: Appearance) -> tuple[str, ...]:
    """Attributes of a map that the embedding of a learned attack knows from its training, before it sees the map."""
    known = {"rgb": True, "descriptor": appearance.descriptor_kind == attack.network.config.kind}
    return tuple(name for name in appearance.names if known[name])


def _modes(
    lines: Lines,
    truth: Float[Tensor, "points 3"],
    near: Nearest,
    likeness: Float[Tensor, "lines k"] | None,
    width: float,
    advance: Callable[[int], None],
) -> list[Estimate]:
    """Modes of the density along each line for a kernel width: one estimate for each of ``POWERS``, or a single one."""
    count, k = near.index.shape
    weights = _weights(near.distance, likeness, width)
    beta, share = (lines.direction.new_zeros(len(weights), count) for _ in range(2))
    rows = max(1, (1 << 18) // max(k * k, 1))
    for begin in range(0, count, rows):
        here = slice(begin, min(begin + rows, count))
        position = feet(lines.rows(here), truth, near.index[here]).beta
        if k:
            apart = (position[:, :, None] - position[:, None, :]) / width
            # Denormal numbers are slow: the kernel is at least e^-40.
            kernel = torch.exp((-0.5 * apart.square()).clamp_min_(-40))
            for number, weight in enumerate(weights):
                beta[number, here], share[number, here] = _mode(position, kernel, weight[here], width)
        advance(here.stop - here.start)
    return [Estimate(beta[i], share[i], near.index, weight) for i, weight in enumerate(weights)]


def _weights(
    distance: Float[Tensor, "lines k"], likeness: Float[Tensor, "lines k"] | None, width: float
) -> list[Float[Tensor, "lines k"]]:
    """Kernels of the distances from the line; with a likeness, times exp(power likeness) up to a factor a line."""
    level = -0.5 * (distance / width).square()
    if likeness is None or not distance.shape[1]:
        return [torch.exp(level)]
    # The factor makes the largest weight 1: exp(power likeness) itself may overflow.
    levels = [level + power * likeness for power in POWERS]
    return [torch.exp(some - some.amax(dim=1, keepdim=True)).nan_to_num(nan=0.0) for some in levels]


def _mode(
    position: Float[Tensor, "lines k"],
    kernel: Float[Tensor, "lines k k"],
    weight: Float[Tensor, "lines k"],
    width: float,
) -> tuple[Float[Tensor, " lines"], Float[Tensor, " lines"]]:
    """Mode of the weighted kernel density, by mean shift from the densest position; and its share of the weight."""
    density = torch.bmm(kernel, weight[:, :, None]).squeeze(-1)
    highest, top = density.max(dim=1)
    beta = torch.gather(position, 1, top[:, None])
    for _ in range(5):
        pull = weight * torch.exp(-0.5 * ((position - beta) / width).square())
        total = pull.sum(dim=1, keepdim=True)
        beta = torch.where(total > 0, (pull * position).sum(dim=1, keepdim=True) / total.clamp_min(1e-30), beta)
    return beta[:, 0], (highest / weight.sum(dim=1).clamp_min(1e-30)).clamp(0, 1)


def _in_order(neighbors: Int[np.ndarray, "lines k"], elements: Elements) -> Int[Tensor, "lines k"]:
    """Convert neighbours by rows of the map to neighbours in the order of the elements."""
    index = torch.as_tensor(neighbors, device=elements.row.device)
    return elements.row.argsort()[index[elements.row]]


def check_oracle(k: int, outliers: float, rule: str) -> None:
    """Refuse parameters that no :class:`Oracle` has."""
    _check_number("k", k)
    if not 0 <= outliers <= 1:
        raise InputError(f"got outliers = {outliers}; expected a share in [0, 1]")
    if rule not in RULES:
        raise InputError(f"got rule {rule!r} of the oracle; expected {' or '.join(RULES)}")


def _check_number(name: str, count: int) -> None:
    if count < 1:
        raise InputError(f"got {name} = {count}; expected at least 1 neighbour")


def _check_count(elements: Elements, points: Float[np.ndarray, "points 3"]) -> None:
    if len(points) != len(elements):
        raise InputError(
            f"got {len(points)} true points for {len(elements)} lines; expected them in the order of the lines"
        )
