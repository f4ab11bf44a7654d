"""The learned attack: tomography first, then rounds of candidates, affinities and weighted peaks.

Each round finds the candidates of every line from the last estimates, lets the network judge them
(:mod:`l2p.attacks.learned.network`), and refines the peak of their weighted votes by an M-estimate. All rounds share
one network, which was trained on the estimates of all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.attack import Attack, Elements, Estimate
from l2p.attacks.learned.candidates import Candidates, most_alike
from l2p.attacks.learned.edges import Edges, edges_of
from l2p.attacks.learned.embedding import (
    OTHER,
    TAUGHT,
    Embedding,
    averaged,
    check_length,
    compared,
    embedded,
    new_embedding,
    vectors,
)
from l2p.attacks.learned.inputs import inputs_of
from l2p.attacks.learned.inputs.family import Inputs
from l2p.attacks.learned.knowledge import LINES_ALONE, Calibrations, between_radii, knowledges
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import NOTHING, Judgement, LineTransformer
from l2p.attacks.learned.nodes import Estimates, Nodes, described, neighborhood, nodes_of
from l2p.attacks.learned.pairing import assigned, nearest_allowed
from l2p.attacks.learned.teaching import taught
from l2p.attacks.peak import find_peak, settled
from l2p.attacks.structured import STRUCTURED
from l2p.attacks.tomography.posterior import Posterior, first_places, mass_within
from l2p.attacks.tomography.reconstruct import LINE_BYTES as TOMOGRAPHY_BYTES
from l2p.attacks.tomography.reconstruct import reconstruct
from l2p.attacks.votes import equal_weights
from l2p.errors import InputError
from l2p.maps.appearance import ATTRIBUTES, Appearance
from l2p.schemes.recognition import FALSE_PLACES, UNIFORM
from l2p.work.shards import BLOCK
from l2p.work.work import ALONE, Work

#: Least ratio of spacings of which a confidence is computed: 0 has no logarithm.
_LEAST_RATIO = 1e-30


class Round(NamedTuple):
    """Result of a round: estimates of all lines; candidates, affinities and logits of this process's lines.

    ``found`` holds the logits that the estimate is within each of the network's radii of the point.
    """

    estimates: Estimates
    candidates: Int[Tensor, "own k"]
    affinity: Float[Tensor, "own k"]
    found: Float[Tensor, "own radii"]


class State(NamedTuple):
    """The state before a round: all lines and their nodes, and the posterior of this process's lines.

    ``embedding`` is that before any lesson; None without published attributes.
    """

    elements: Elements
    posterior: Posterior
    nodes: Nodes
    embedding: Embedding | None = None


class Learned(Attack):
    """The learned attack; O(rounds x lines x k^2) besides tomography and the searches.

    It knows what lines through pairs of points and lines through a few centres tell (:mod:`l2p.attacks.structure`).

    Parameters
    ----------
    network : LineTransformer
    config : LearnedConfig, optional
    calibration : mapping, optional
        For each knowledge (:mod:`l2p.attacks.learned.knowledge`), round and radius (a, b): sigmoid(a found + b) is the
        probability that the error is within the radius. The confidence passed from round to round is uncalibrated.
    fraction : float
        Fraction of the map's points in the line cloud, as far as it is known. The confidence is that of lying within
        1 spacing of the *map*, which is smaller than that of a thinned cloud.
    inputs : sequence of Inputs, optional
        Families of inputs with the constants of the training; default: the default constants.
    source : dict, optional
        Name and digest of the file of the weights, for the record.
    scheme : str
        Scheme of the lines that the weights were trained on.
    siblings : callable, optional
        Returns the attack with the weights for another scheme; default: these weights serve all schemes.

    Raises
    ------
    InputError
        If a knowledge is not calibrated, or has fewer calibrations than rounds.
    """

    schemes = (*STRUCTURED, FALSE_PLACES)
    by_part = True

    def __init__(
        self,
        network: LineTransformer,
        config: LearnedConfig | None = None,
        calibration: Calibrations | None = None,
        fraction: float = 1.0,
        inputs: Sequence[Inputs] | None = None,
        source: dict[str, str] | None = None,
        scheme: str = UNIFORM,
        siblings: Callable[[str], Learned] | None = None,
    ) -> None:
        self.network = network
        self.config = config or LearnedConfig()
        self.inputs = inputs_of(network.config.inputs) if inputs is None else tuple(inputs)
        identity = [(1.0, 0.0)] * len(network.config.radii)
        rounds = {known: rounds_with(self.config, known) for known in knowledges(network.config)}
        self.calibration = calibration or {known: [identity] * count for known, count in rounds.items()}
        for known, wanted in rounds.items():
            count = len(self.calibration.get(known, ()))
            if count < wanted:
                raise InputError(f"got {count} calibrations of {known} for {wanted} rounds; expected as many")
        self.fraction, self.source = fraction, source or {}
        self.scheme, self.siblings = scheme, siblings
        # Without rounds, the confidence comes from the tomography and only ranks.
        self.calibrated = self.config.rounds > 0
        self.columns = {"beta": (), "confidence": (), "state": (network.config.state,)}
        # Measured by benchmarks/recover.py.
        self.line_bytes = max(TOMOGRAPHY_BYTES, 4000 + 40 * self.config.candidates)

    def for_scheme(self, scheme: str) -> Learned:
        """Return the attack with the weights for this scheme."""
        return self if self.siblings is None or scheme == self.scheme else self.siblings(scheme)

    def rounds_of(self, elements: Elements) -> int:
        """Return the rounds but the last, which is in ``finish``: its estimates need no nodes."""
        return max(0, self._rounds(elements) - 1)

    def begin(self, elements: Elements, saved: Mapping[str, Tensor] | None, work: Work) -> State:
        """Reconstruct the posterior; the first estimates are its modes."""
        self.network.eval().to(elements.row.device)
        elements, embedding = self.seen(elements)
        posterior = reconstruct(elements.lines, self.config.tomography, work, elements.structure)
        if saved is None:
            return State(elements, posterior, self.first_nodes(elements, posterior, work), embedding)
        nodes = nodes_of(elements.lines, Estimates(**saved), self.config.nodes, work)
        return self.schooled(State(elements, posterior, nodes, embedding), work)

    def step(self, state: State, work: Work) -> State:
        """Judge all lines, and build the nodes of the new estimates."""
        return self.next(state, self.judge(state, work), work)

    def saved(self, state: State) -> Mapping[str, Tensor]:
        """Return the estimates, from which the nodes follow."""
        nodes = state.nodes
        return {"beta": nodes.beta, "confidence": nodes.confidence, "state": nodes.state}

    def finish(self, state: State, work: Work) -> Estimate:
        """Judge once more; without rounds, return the modes of the posterior."""
        own = work.own(len(state.elements))
        if self._rounds(state.elements):
            last = self.judge(state, work)
            logits = self.calibrated_logits(last, self.knowledge(state.elements))
            confidence = self.confidence(logits)
            return Estimate(last.estimates.beta[own], confidence, last.candidates, last.affinity, logits=logits)
        nodes, candidates = state.nodes, self.candidates(state, work)
        affinity = equal_weights(state.elements.lines, candidates)
        return Estimate(nodes.beta[own], nodes.confidence[own], candidates, affinity)

    def settings(self) -> dict[str, Any]:
        """Return rounds, candidates, size of the network, fraction, and the file of the weights."""
        return {
            **asdict(self.config),
            "network": asdict(self.network.config),
            "fraction": self.fraction,
            **self.source,
        }

    # Parts of a round

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return the attributes that an input of the network needs; likeness takes all."""
        needed = {name for family in self.inputs for name in family.needs}
        return tuple(name for name in appearance.names if self.network.config.appearance or name in needed)

    def seen(self, elements: Elements, embedding: Embedding | None = None) -> tuple[Elements, Embedding | None]:
        """Add the appearances of the lines before any lesson, and return the embedding to be taught.

        ``embedding`` is the one that knows colours and the network's kind of descriptors; default: the network's own.
        It embeds what it knows; of other descriptors, a new embedding learns in the first lesson.
        """
        config, published = self.network.config, self._usable(elements)
        if not published:
            return elements, None
        embedding = embedding or self.network.embedding
        known = {name: value for name, value in published.items() if name != "descriptor" or self._knows(elements)}
        attributes = dict(elements.attributes)
        if known:
            check_length(known, config.length)
            attributes["appearance"] = embedded(embedding, known, tuple(known))
        if len(known) < len(published):
            length = published["descriptor"].shape[1]
            embedding = new_embedding(length, config.hidden, config.embedding).to(elements.row.device)
        return replace(elements, attributes=attributes), embedding

    def schooled(self, state: State, work: Work = ALONE) -> State:
        """Let the map teach the embedding, by the neighbours of its present estimates; rank 0 teaches."""
        elements, nodes = state.elements, state.nodes
        if state.embedding is None:
            return state
        published, config, pupil = self._usable(elements), self.config.teaching, state.embedding
        fresh = "descriptor" in published and not self._knows(elements)
        if config.steps_of(len(nodes.beta), fresh) == 0:
            return state
        if work.shards.rank == 0:
            pupil = taught(pupil, published, nodes.point, nodes.confidence, config, fresh, work)
        names = tuple(OTHER if fresh and name == "descriptor" else name for name in published)
        found = vectors(pupil, published)
        if not fresh:
            # What the map teaches is not better than what is known of other maps; both are better than either.
            found = averaged(found, vectors(state.embedding, published))
        appearance = compared(found, (*names, TAUGHT))
        vector, background = (work.shards.first(part) for part in (appearance.vector, appearance.background))
        attributes = {**elements.attributes, "appearance": appearance._replace(vector=vector, background=background)}
        return state._replace(elements=replace(elements, attributes=attributes))

    def _usable(self, elements: Elements) -> dict[str, Tensor]:
        """Published attributes that the network can use: descriptors of another kind need lines to learn from."""
        names = ATTRIBUTES if self.network.config.appearance else ()
        if not self._knows(elements) and self.config.teaching.steps_of(len(elements), True) == 0:
            names = tuple(name for name in names if name != "descriptor")
        return {name: elements.attributes[name] for name in names if name in elements.attributes}

    def knowledge(self, elements: Elements) -> str:
        """Name what the attack knows in its last round (:mod:`l2p.attacks.learned.knowledge`)."""
        other = {} if self._knows(elements) else {"descriptor": OTHER}
        return "+".join(other.get(name, name) for name in self._usable(elements)) or LINES_ALONE

    def _rounds(self, elements: Elements) -> int:
        return rounds_with(self.config, self.knowledge(elements))

    def _knows(self, elements: Elements) -> bool:
        return elements.descriptor_kind == self.network.config.kind

    def first_nodes(self, elements: Elements, posterior: Posterior, work: Work = ALONE) -> Nodes:
        """Build the nodes of the first round from the modes of the posterior."""
        lines, count = elements.lines, len(elements)
        mode = first_places(posterior, elements.structure.twin, work.own(count))
        beta = work.gather(mode, count)
        if elements.structure.twin is not None:
            beta = self._assigned(elements, Estimates(beta, beta, beta[:, None])).beta
            mode = beta[work.own(count)]
        around = neighborhood(lines, beta, self.config.nodes, work)
        confidence = work.gather(mass_within(posterior, mode, around.scale[work.own(count)]), count)
        state = beta.new_zeros(count, self.network.config.state)
        return described(lines, around, Estimates(beta, confidence, state), self.config.nodes, work)

    def candidates(self, state: State, work: Work = ALONE) -> Int[Tensor, "own k"]:
        """Find the candidates of each line, -1 for none."""
        lines, nodes, count = state.elements.lines, state.nodes, self.config.candidates
        appearance = state.elements.attributes.get("appearance")
        k = count if appearance is None else max(count, self.config.alike)
        near = nearest_allowed(lines, nodes, k, state.elements.structure, work)
        if appearance is None or near.index.shape[1] <= count:
            return near.index
        first = work.own(len(nodes.beta)).start
        return most_alike(near, appearance, count, self.config.liking, first)

    def edges(
        self, state: State, rows: Int[Tensor, " rows"], candidates: Int[Tensor, "rows k"], first: int = 0
    ) -> Edges:
        """Compute the network's inputs for candidates of some rows; the posterior begins with line ``first``."""
        elements, posterior, nodes, _ = state
        pairs = Candidates(elements.lines, nodes, posterior, rows, candidates, first, elements.attributes)
        return edges_of(pairs, self.inputs)

    def judge(self, state: State, work: Work = ALONE) -> Round:
        """Run one round on the lines of this process."""
        nodes = state.nodes
        candidates = self.candidates(state, work)
        own, count = work.own(len(nodes.beta)), len(candidates)
        beta, passed = nodes.beta[own].clone(), torch.zeros_like(nodes.state[own])
        affinity = torch.zeros_like(candidates, dtype=beta.dtype)
        found = beta.new_full((count, len(self.network.config.radii)), NOTHING)
        row_bytes = judging_bytes(self.network, candidates.shape[1])

        def judged(block: slice, _: Work) -> tuple[Judgement, Tensor]:
            rows = torch.arange(own.start + block.start, own.start + block.stop, device=candidates.device)
            judgement = self.network(self.edges(state, rows, candidates[block], own.start))
            return judgement, weighted_peak(judgement, self.config)

        with work.task("affinities", count) as advance:
            if candidates.shape[1]:
                for block, (judgement, move) in work.over_blocks(judged, count, BLOCK, candidates.device, row_bytes):
                    beta[block] += move
                    passed[block], found[block] = judgement.state, judgement.found
                    affinity[block] = torch.sigmoid(judgement.affinity)
                    advance(block.stop - block.start)
        columns = beta, self.passed_confidence(found), passed
        estimates = Estimates(*(work.gather(column, len(nodes.beta)) for column in columns))
        return Round(estimates, candidates, affinity, found)

    def next(self, state: State, result: Round, work: Work = ALONE) -> State:
        """Return the state for the next round."""
        return self.moved(state, result.estimates, work)

    def moved(self, state: State, estimates: Estimates, work: Work = ALONE) -> State:
        """Build the nodes of the over-relaxed estimates, and let them teach."""
        estimates = self._assigned(state.elements, relaxed(state.nodes, estimates, self.config))
        nodes = nodes_of(state.elements.lines, estimates, self.config.nodes, work)
        return self.schooled(state._replace(nodes=nodes), work)

    def _assigned(self, elements: Elements, estimates: Estimates) -> Estimates:
        """Decide which of the two points of a line is where, if their appearances tell."""
        twin, appearance = elements.structure.twin, elements.attributes.get("appearance")
        if twin is None or appearance is None:
            return estimates
        return assigned(elements.lines, estimates, twin, appearance)

    def passed_confidence(self, found: Float[Tensor, "lines radii"]) -> Float[Tensor, " lines"]:
        """Uncalibrated confidence within 1 spacing, passed to the next round."""
        return torch.sigmoid(found[:, self.network.config.one])

    def calibrated_logits(self, result: Round, known: str) -> Float[Tensor, "own radii"]:
        """Calibrated logits that each point of the last round lies within each of the network's radii."""
        calibration = result.found.new_tensor(self.calibration[known][rounds_with(self.config, known) - 1])
        return (calibration[:, 0] * result.found + calibration[:, 1]).cummax(dim=1).values

    def within(self, estimate: Estimate, ratio: float) -> Float[Tensor, " points"]:
        """Return the probability of lying within ``ratio`` spacings of the map whose part was attacked."""
        if estimate.logits is None:
            return super().within(estimate, ratio)
        return self.confidence(estimate.logits, ratio)

    def confidence(self, logits: Float[Tensor, "own radii"], ratio: float = 1.0) -> Float[Tensor, " own"]:
        """Return the probability that each point lies within ``ratio`` spacings of the map, from calibrated logits."""
        radii = self.network.config.radii
        log_radius = math.log(spacing_ratio(self.fraction, self.config.dimension)) + math.log(max(ratio, _LEAST_RATIO))
        found = torch.sigmoid(between_radii(logits, radii, min(log_radius, math.log(radii[-1]))))
        below = log_radius - math.log(radii[0])
        if ratio == 1 or below >= 0:
            return found
        # Far below the smallest radius the share within falls at least with the radius, whatever the slope of logits.
        return found.minimum(torch.sigmoid(logits[:, 0]) * math.exp(below))


def rounds_with(config: LearnedConfig, known: str) -> int:
    """Return the rounds of an attack with this knowledge."""
    return config.rounds if known == LINES_ALONE else config.alike_rounds


def judging_bytes(network: LineTransformer, k: int) -> float:
    """Bytes of temporaries per line with k candidates: kernels of all their pairs in each head, and their tokens."""
    width, heads = network.config.width, network.config.heads
    return 4 * k * (k * (2 * heads + 2) + 12 * width + 450)


def relaxed(nodes: Nodes, estimates: Estimates, config: LearnedConfig) -> Estimates:
    """Over-relax: move each estimate ``relaxation`` times as far from ``nodes`` as the round did."""
    moved = estimates.beta - nodes.beta
    ahead = nodes.beta + config.relaxation * moved
    return estimates._replace(beta=torch.where(moved.abs() < nodes.scale, ahead, estimates.beta))


def weighted_peak(judgement: Judgement, config: LearnedConfig) -> Float[Tensor, " lines"]:
    """Find the peak of the weighted votes, relative to the last estimate; 0 where there is no vote."""
    weight = torch.softmax(judgement.vote.flatten(1), dim=1)
    place = judgement.place.flatten(1)
    peak = find_peak(place, weight, config.peak)
    spread = config.widening * judgement.spread.flatten(1)
    return settled(peak, place, weight, spread, config.settling).nan_to_num(nan=0.0)


def spacing_ratio(fraction: float, dimension: float = LearnedConfig.dimension) -> float:
    """Spacing of a map over that of a ``fraction`` of its points: fraction ** (1 / dimension).

    A ratio measured on estimates is biased, since they scatter: at 10 % and 5 % of five training scenes it was four
    fifths of the true one. The effective dimension is more accurate (``benchmarks/spacing_ratio.py``).
    """
    return fraction ** (1 / dimension)
