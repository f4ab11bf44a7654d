"""Draw the pictures of docs/how-it-works.md from one simulated room, and one from a real map:
python docs/figures.py

To draw some pictures only, give their names: python docs/figures.py affinities rounds
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.collections import LineCollection

import l2p
from l2p.attacks.attack import Elements
from l2p.attacks.heuristic import Heuristic
from l2p.attacks.learned.embedding import embedded
from l2p.attacks.learned.learned import Learned
from l2p.attacks.learned.teaching import taught
from l2p.attacks.named import named_attack
from l2p.attacks.peak import PeakConfig, find_peak
from l2p.attacks.run import run
from l2p.attacks.tomographic import Tomography
from l2p.attacks.tomography.reconstruct import reconstruct
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.nearest import nearest_lines_to_lines, nearest_lines_to_points, nearest_points_to_lines
from l2p.geometry.pairs import closest_points
from l2p.io.descriptors import load_described
from l2p.judging.accuracy import SPACING_NEIGHBOR, errors, spacing
from l2p.judging.calibration import risk_coverage
from l2p.judging.references import CandidateOracle, LeaveOneOut, Oracle
from l2p.show.colors import ERROR_LIMIT
from l2p.show.pictures import Box

IMAGES = Path(__file__).parent / "images"
#: Map with descriptors, for the picture of likeness.
DESCRIBED = Path(__file__).parents[2] / "shared" / "maps" / "val" / "strecha_castle_p30"
POINTS, SEED = 5000, 3
#: Neighbours of the paper's coarse stage, indoors.
K = 250
#: True neighbours, as the spacing and the bounds count them.
TRUE = SPACING_NEIGHBOR
GREY, BLUE, ORANGE, GREEN, RED = "#b8bec9", "#2563eb", "#ea7317", "#15803d", "#c81e3a"


@dataclass(frozen=True, eq=False)
class Room:
    """Simulated room and its line cloud; ``inside``, ``points`` and ``unit`` (a spacing) are in the working frame."""

    scene: l2p.Scene
    lines: l2p.LineCloud
    truth: Float[np.ndarray, "lines 3"]
    frame: Frame
    inside: Lines
    points: Float[torch.Tensor, "lines 3"]
    unit: float

    @classmethod
    def make(cls) -> Room:
        scene = l2p.simulate("room", points=POINTS, seed=SEED)
        hidden = l2p.hide(scene, seed=SEED)
        lines, truth = hidden.map, hidden.truth.xyz
        frame = Frame.of(lines)
        unit = spacing(scene.xyz) / frame.unit
        return cls(scene, lines, truth, frame, frame.enter(lines), frame.enter_points(truth), unit)


def save(figure: Any, name: str) -> None:
    IMAGES.mkdir(exist_ok=True)
    figure.savefig(IMAGES / f"{name}.png", dpi=110, facecolor="white")
    plt.close(figure)
    print(IMAGES / f"{name}.png")


def segments(room: Room, half: float) -> Float[np.ndarray, "lines 2 3"]:
    """Segment of each line, ``half`` scene units to both sides of its point nearest to the middle of the room."""
    middle = np.median(room.truth, axis=0)
    beta = np.sum((middle - room.lines.origin) * room.lines.direction, axis=1)
    ends = [room.lines.at(beta + side * half) for side in (-1, 1)]
    return np.stack(ends, axis=1)


def draw_lifting(room: Room) -> None:
    """Draw points, points with their lines, and lines, from above."""
    figure, panels = plt.subplots(1, 3, figsize=(13, 4.6), constrained_layout=True)
    some = np.random.default_rng(0).choice(len(room.truth), 500, replace=False)
    ends = segments(room, 20.0)[some][:, :, :2]
    titles = ("points: the map", "a random line through each", "the line cloud: which point of the line was it?")
    box = Box.of_room(room.scene)
    for panel, title in zip(panels, titles, strict=True):
        panel.set(title=title, aspect="equal", xticks=[], yticks=[])
        panel.set(xlim=(box.low[0] - 0.2, box.high[0] + 0.2), ylim=(box.low[1] - 0.2, box.high[1] + 0.2))
    for panel in panels[1:]:
        panel.add_collection(LineCollection(list(ends), colors=BLUE, linewidths=0.5, alpha=0.35))
    for panel in panels[:2]:
        panel.scatter(*room.truth[some, :2].T, s=6, c="black", zorder=3)
    save(figure, "lifting")


def typical_line(room: Room, neighbors: Int[torch.Tensor, "lines k"]) -> int:
    """Choose a line whose peak is right and of median sharpness."""
    votes = closest_points(room.inside, room.inside, neighbors)
    beta = find_peak(votes.beta, votes.valid.float())
    off = (room.inside.at(beta) - room.points).norm(dim=1) / room.unit
    right = torch.nonzero(off < 0.1).flatten()
    near = ((votes.beta - beta[:, None]).abs() < 0.5 * room.unit).sum(dim=1)
    return int(right[near[right].argsort()[len(right) // 2]])


def intervals(votes: Float[np.ndarray, " votes"]) -> list[tuple[float, float]]:
    """Compute x- and x+ of each step of the recursion, by the rule of the paper's main text."""
    found = []
    while len(votes) > 5:
        uniform = (votes - votes[0]) / (votes[-1] - votes[0])
        step = np.arange(len(votes) + 1) / len(votes)
        low = int(np.argmin(step[:-1] - uniform))
        high = low + int(np.argmax((step[1:] - uniform)[low:]))
        kuiper = (step[1:] - uniform)[high] - (step[:-1] - uniform)[low]
        found.append((votes[low], votes[high]))
        votes = votes[low : high + 1]
        if kuiper < PeakConfig.threshold:
            break
    return found


def draw_votes(room: Room) -> None:
    """Draw the nearest lines, their votes where they pass closest to one line, and the peak of the votes."""
    neighbors = nearest_lines_to_lines(room.inside, K).index
    row = typical_line(room, neighbors)
    own = room.inside.rows(slice(row, row + 1))
    vote = closest_points(own, room.inside, neighbors[row : row + 1]).beta[0]
    order = vote.argsort()
    trimmed = vote[order][5:-5].numpy() / room.unit
    true = float((room.points[row] - own.foot[0]) @ own.direction[0]) / room.unit
    steps = intervals(trimmed)
    answer = float(find_peak(vote[None])) / room.unit
    figure, panels = plt.subplots(2, 2, figsize=(13, 8), constrained_layout=True)
    _crossings(panels[0, 0], room, row, neighbors[row].long(), true)
    reach = (true - 14, true + 14)
    panels[0, 1].hist(trimmed, bins=np.arange(reach[0], reach[1], 0.5), color=BLUE, alpha=0.75)
    panels[0, 1].set(xlim=reach, ylabel="votes in half a spacing")
    panels[0, 1].set_title(f"{K} nearest lines vote: where each passes closest to the line")
    _distribution(panels[1, 0], trimmed, steps[0], "step 1: all votes")
    inner = trimmed[(trimmed >= steps[0][0]) & (trimmed <= steps[0][1])]
    _distribution(panels[1, 1], inner, steps[1], "step 2: the same, between x− and x+ of step 1")
    for panel in (panels[0, 1], panels[1, 1]):
        panel.axvline(true, color=GREEN, lw=2, label="true point")
        panel.axvline(answer, color=RED, ls="--", label=f"answer: the median after {len(steps)} steps")
        panel.legend(loc="lower right" if panel is panels[1, 1] else "upper left", fontsize=8)
    for panel in panels.flat:
        panel.set_xlabel("position along the line, spacings")
    save(figure, "votes")


def _crossings(panel: Any, room: Room, row: int, others: Int[torch.Tensor, " k"], true: float) -> None:
    """Draw a side view of the line with the nearest others."""
    own = room.inside.rows(slice(row, row + 1))
    along = own.direction[0]
    across = torch.linalg.cross(along, torch.tensor([0.0, 0.0, 1.0]))
    across = across / across.norm()
    near = room.inside.rows(others)
    beta = closest_points(near, own, torch.zeros(len(others), 1, dtype=torch.int64)).beta[:, 0]
    middle = near.at(beta) - own.foot
    drawn = []
    for side in (-1.5, 1.5):
        end = middle + side * room.unit * near.direction
        drawn.append(torch.stack([end @ along, end @ across], dim=1) / room.unit)
    panel.add_collection(LineCollection(list(torch.stack(drawn, dim=1).numpy()), colors=GREY, linewidths=0.7))
    panel.axhline(0, color=BLUE, lw=1.5)
    place = (middle @ along / room.unit).numpy()
    panel.plot(place, np.zeros(len(place)), "|", color=BLUE, ms=9, label="vote: the closest point")
    panel.plot([true], [0], "o", color=GREEN, ms=9, label="true point")
    panel.set(xlim=(true - 14, true + 14), ylim=(-2, 2), yticks=[])
    panel.set_title("one line, and parts of the lines that pass it closest")
    panel.legend(loc="upper left", fontsize=8)


def _distribution(panel: Any, votes: Float[np.ndarray, " votes"], step: tuple[float, float], title: str) -> None:
    """Draw the empirical distribution against the uniform one, and the interval where they differ most."""
    panel.step(votes, np.arange(1, len(votes) + 1) / len(votes), where="post", color=BLUE, label="votes, F")
    panel.plot([votes[0], votes[-1]], [0, 1], color="black", lw=1, label="uniform, U")
    for place, name in zip(step, ("x−", "x+"), strict=True):
        panel.axvline(place, color=ORANGE, lw=1.5)
        panel.annotate(name, (place, 0.03), color=ORANGE, fontsize=12, ha="right" if name == "x−" else "left")
    panel.set(title=title, ylabel="share of the votes below", ylim=(0, 1.02))
    panel.legend(loc="upper left", fontsize=8)


def draw_neighborhoods(room: Room) -> None:
    """Draw N_ll and N_pl along the line, N_lp from the side."""
    estimate = run(room.lines, Heuristic())
    points = room.frame.enter_points(estimate.xyz)
    right = errors(estimate.xyz, room.truth) / spacing(room.scene.xyz)
    row = int(np.argsort(right)[len(right) // 5])
    n_ll = nearest_lines_to_lines(room.inside, 25).index[row].long()
    n_pl = nearest_points_to_lines(room.inside, points, 25).index[row].long()
    n_lp = nearest_lines_to_points(points, room.inside, 25).index[row].long()
    along = room.inside.direction[row]
    first = torch.linalg.cross(along, torch.tensor([0.0, 0.0, 1.0]))
    first = first / first.norm()
    axes = torch.stack([first, torch.linalg.cross(along, first), along])
    figure, panels = plt.subplots(1, 3, figsize=(14, 5.6), constrained_layout=True)
    center = points[row]
    seen = ((points - center) @ axes.T / room.unit).numpy()
    flat = _flat_lines(room, center, axes) / room.unit
    for panel, chosen in ((panels[0], n_ll), (panels[2], n_lp)):
        view = flat[:, :, [0, 1]] if panel is panels[0] else flat[:, :, [2, 0]]
        panel.add_collection(LineCollection(list(view[::25]), colors=GREY, linewidths=0.4, alpha=0.6))
        panel.add_collection(LineCollection(list(view[chosen]), colors=BLUE, linewidths=0.9))
    panels[1].scatter(*seen[:, :2].T, s=5, c=GREY)
    panels[1].scatter(*seen[n_pl, :2].T, s=16, c=BLUE)
    for panel in panels[:2]:
        panel.plot([0], [0], "+", color=RED, ms=14, mew=2)
    panels[2].axhline(0, color=RED, lw=1.5)
    panels[2].plot([0], [0], "o", color=RED, ms=7)
    titles = (
        "N_ll: lines nearest to the line\n(seen along the line, the red cross)",
        "N_pl: estimates nearest to the line\n(seen along the line)",
        "N_lp: lines nearest to the estimate\n(seen from the side; red: the line and its estimate)",
    )
    for panel, title in zip(panels, titles, strict=True):
        panel.set(title=title, aspect="equal", xticks=[], yticks=[], xlim=(-3, 3), ylim=(-3, 3))
    save(figure, "neighborhoods")


def _flat_lines(
    room: Room, center: Float[torch.Tensor, "3"], axes: Float[torch.Tensor, "3 3"]
) -> Float[np.ndarray, "lines 2 3"]:
    """Segments of the lines around their points nearest to ``center``, in the axes of a view."""
    apart = center - room.inside.foot
    beta = (apart * room.inside.direction).sum(dim=1)
    ends = [room.inside.at(beta + side * 100 * room.unit) - center for side in (-1, 1)]
    return (torch.stack(ends, dim=1) @ axes.T).numpy()


def draw_tomography(room: Room) -> None:
    """Draw the room from above: the coverage of the lines, the result of the tomography, and the truth."""
    posterior = reconstruct(room.inside)
    beta, weight = posterior.beta, posterior.probability
    upright = torch.as_tensor(room.frame.axes.T, dtype=beta.dtype)  # from the axes of the lines to those of the room
    direction, foot = room.inside.direction[:, None] @ upright, room.inside.foot[:, None] @ upright
    at = foot + beta[:, :, None] * direction
    even = foot + torch.linspace(-6, 6, 1200)[None, :, None] * direction
    box = Box.of_room(room.scene)
    low, high = ((corner - room.frame.center) / room.frame.unit for corner in (box.low, box.high))
    edges = [np.arange(a - 0.1, b + 0.1, 0.25 * room.unit) for a, b in zip(low[:2], high[:2], strict=True)]
    figure, panels = plt.subplots(1, 3, figsize=(14, 5), constrained_layout=True)
    clouds = (
        ("lines: mass spread evenly", even.reshape(-1, 3).numpy(), None),
        ("tomography: mass where the lines agree", at.reshape(-1, 3).numpy(), weight.flatten().numpy()),
        ("the points", (room.points @ upright).numpy(), None),
    )
    for panel, (title, points, mass) in zip(panels, clouds, strict=True):
        image = np.histogram2d(points[:, 0], points[:, 1], bins=edges, weights=mass)[0]
        top = np.percentile(image[image > 0], 99)
        panel.imshow(np.sqrt(image.T / top), origin="lower", cmap="magma", vmin=0, vmax=1)
        panel.set(title=title, xticks=[], yticks=[])
    save(figure, "density")


@cache
def learned(room: Room, rounds: int | None) -> l2p.Recovery:
    """Recover with the shipped checkpoint in ``rounds`` rounds; None: all of its rounds."""
    return l2p.recover(room.lines, rounds=rounds)


def spacings_off(room: Room, recovery: l2p.Recovery) -> Float[np.ndarray, " lines"]:
    """Errors in spacings."""
    return errors(recovery.xyz, room.truth) / spacing(room.scene.xyz)


def beside(
    lines: l2p.LineCloud, points: Float[np.ndarray, "lines k 3"], unit: float
) -> tuple[Float[np.ndarray, "lines k"], Float[np.ndarray, "lines k"]]:
    """Positions of the feet of some points on each line, and their distances from it, in units."""
    apart = points - lines.origin[:, None]
    foot = np.einsum("nkd,nd->nk", apart, lines.direction) / unit
    return foot, np.linalg.norm(apart / unit - foot[..., None] * lines.direction[:, None], axis=2)


def draw_affinities(room: Room) -> None:
    """Draw one line that the first round corrects: its candidates, and their votes weighted by affinity."""
    before, after = learned(room, 0), learned(room, 1)
    assert after.neighbors is not None and after.affinity is not None
    lines, unit = room.lines, spacing(room.scene.xyz)
    foot, across = beside(lines, before.xyz[np.maximum(after.neighbors, 0)], unit)
    true, first, answer = (
        np.sum((points - lines.origin) * lines.direction, axis=1) / unit
        for points in (room.truth, before.xyz, after.xyz)
    )
    weight = np.where(after.neighbors < 0, 0, after.affinity)
    near = np.abs(foot - true[:, None]) <= 1
    gain = (weight * near).sum(axis=1) / weight.sum(axis=1) - near.mean(axis=1)
    # One of the corrected lines, with a large gain by affinity (90 % quantile).
    moved = np.flatnonzero((np.abs(first - true) > 3) & (np.abs(first - true) < 10) & (np.abs(answer - true) < 0.25))
    row = int(moved[np.argsort(gain[moved])[int(0.9 * len(moved))]])
    place, share = foot[row], weight[row] / weight[row].sum()
    nearest = np.argsort(np.linalg.norm(room.truth - room.truth[row], axis=1))[1 : TRUE + 1]
    own = np.isin(after.neighbors[row], nearest)
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.2), constrained_layout=True)
    left.scatter(place[own], across[row][own], s=110, facecolors="none", edgecolors=GREEN, label="a true neighbour")
    shown = left.scatter(place, across[row], s=36, c=weight[row], cmap="viridis_r", vmin=0)
    figure.colorbar(shown, ax=left, label="affinity", pad=0.01)
    left.set(title="the candidates of one line, and the affinities that the network gives them")
    left.set(ylabel="distance from the line, spacings", ylim=(0, 1.15 * np.quantile(across[row], 0.95)))
    reach = (min(true[row], first[row]) - 8, max(true[row], first[row]) + 8)
    bins = np.arange(reach[0], reach[1], 0.5)
    right.hist(place, bins, weights=np.full(len(place), 1 / len(place)), color=GREY, label="all count alike")
    right.hist(place, bins, weights=share, histtype="step", lw=2, color=BLUE, label="each counts by its affinity")
    right.set(title="where the candidates vote", ylabel="share of the votes in half a spacing")
    for panel in (left, right):
        panel.axvline(first[row], color=ORANGE, ls="--", label="estimate before the round")
        panel.axvline(answer[row], color=RED, ls="--", label="estimate after it")
        panel.axvline(true[row], color=GREEN, lw=1.5, ls=":", label="true point")
        panel.set(xlabel="position along the line, spacings", xlim=reach)
        panel.legend(fontsize=8)
    save(figure, "affinities")


def draw_likeness(_: Room) -> None:
    """Draw one line of a real map that lies in the wrong crowd without colours and descriptors, in the right one with
    them; the simulator has no descriptors."""
    if not DESCRIBED.is_dir():
        print(f"likeness: {DESCRIBED} is missing, so the picture stays as it is")
        return
    scene, _file = load_described(DESCRIBED)
    hidden = l2p.hide(scene, seed=SEED, rgb=True, descriptor=True)
    lines, truth, unit = hidden.map, hidden.truth.xyz, spacing(scene.xyz)
    alone, seen = l2p.recover(lines.without(["rgb", "descriptor"])), l2p.recover(lines)
    assert alone.affinity is not None and alone.neighbors is not None
    index = np.maximum(alone.neighbors, 0)
    foot, across = beside(lines, alone.xyz[index], unit)
    true, wrong, right = (
        np.sum((points - lines.origin) * lines.direction, axis=1) / unit for points in (truth, alone.xyz, seen.xyz)
    )
    weight = np.where(alone.neighbors < 0, 0, alone.affinity)
    here = (weight * (np.abs(foot - true[:, None]) <= 1)).sum(axis=1) / weight.sum(axis=1)
    off = np.abs(wrong - true)
    corrected = np.flatnonzero((off > 4) & (off < 12) & (np.abs(right - true) < 0.25) & (seen.confidence > 0.9))
    # Two crowds: that at the true place has nearly half of the affinity.
    row = int(corrected[np.argmin(np.abs(here[corrected] - 0.35))])
    like = likeness(lines, seen, row, index[row])
    figure, (left, below) = plt.subplots(1, 2, figsize=(13, 4.2), constrained_layout=True)
    nearest = np.argsort(np.linalg.norm(truth - truth[row], axis=1))[1 : TRUE + 1]
    own = np.isin(index[row], nearest)
    left.scatter(foot[row][own], across[row][own], s=110, facecolors="none", edgecolors=GREEN, label="a true neighbour")
    bound = np.abs(like).max()
    shown = left.scatter(foot[row], across[row], s=36, c=like, cmap="coolwarm", vmin=-bound, vmax=bound)
    figure.colorbar(shown, ax=left, label="likeness s", pad=0.01)
    left.set(title="two crowds beside one line, and their likeness to it", ylabel="distance from the line, spacings")
    reach = (min(true[row], wrong[row]) - 5, max(true[row], wrong[row]) + 5)
    bins = np.arange(reach[0], reach[1], 0.5)
    share = weight[row] / weight[row].sum()
    below.hist(foot[row], bins, weights=share, color=GREY, label="by geometry")
    both = share * np.exp(like)
    below.hist(
        foot[row], bins, weights=both / both.sum(), histtype="step", lw=2, color=BLUE, label="times exp(likeness)"
    )
    below.set(title="where the candidates vote", ylabel="share of the votes in half a spacing")
    for panel in (left, below):
        panel.axvline(wrong[row], color=ORANGE, ls="--", label="answer from lines alone")
        panel.axvline(right[row], color=RED, ls="--", label="answer with colours and descriptors")
        panel.axvline(true[row], color=GREEN, lw=1.5, ls=":", label="true point")
        panel.set(xlabel="position along the line, spacings", xlim=reach)
        panel.legend(fontsize=8)
    save(figure, "likeness")


def likeness(lines: l2p.LineCloud, found: l2p.Recovery, row: int, others: np.ndarray) -> Float[np.ndarray, " k"]:
    """Likeness of a line with some others, as the map taught it after the last round."""
    attack = named_attack("learned")
    assert isinstance(attack, Learned)
    frame = Frame.of(lines)
    elements = Elements.sorted(frame.enter(lines), frame, lines.appearance)
    elements, embedding = attack.seen(elements)
    assert embedding is not None
    place = elements.row.argsort()
    point = frame.enter_points(found.xyz)[elements.row]
    confidence = torch.as_tensor(found.confidence)[elements.row]
    published = {name: elements.attributes[name] for name in lines.appearance.names}
    pupil = taught(embedding, published, point, confidence, attack.config.teaching)
    seen = embedded(pupil, published, ())
    return seen.likeness(place[[row]], place[torch.as_tensor(others)][None])[0].numpy()


def draw_rounds(room: Room) -> None:
    """Draw the room from above after no, one and all rounds, and the truth."""
    figure, panels = plt.subplots(1, 4, figsize=(16, 4.4), constrained_layout=True)
    last = learned(room, None)
    rounds = last.info["settings"]["rounds"]
    found = {"before the first round: tomography": learned(room, 0), "after round 1": learned(room, 1)}
    found[f"after round {rounds}"] = last
    box = Box.of_room(room.scene)
    for panel, (title, recovery) in zip(panels, found.items(), strict=False):
        error = spacings_off(room, recovery)
        order = np.argsort(error)[::-1]
        points = panel.scatter(
            *recovery.xyz[order, :2].T, s=2, c=error[order], cmap="plasma", vmin=0, vmax=ERROR_LIMIT, linewidths=0
        )
        panel.set_title(f"{title}\n{(error <= 1).mean():.0%} within 1 spacing, median {np.median(error):.2f}")
    panels[3].scatter(*room.truth[:, :2].T, s=2, c="black", linewidths=0)
    panels[3].set_title("the points\n")
    for panel in panels:
        panel.set(aspect="equal", xticks=[], yticks=[])
        panel.set(xlim=(box.low[0] - 0.3, box.high[0] + 0.3), ylim=(box.low[1] - 0.3, box.high[1] + 0.3))
    bar = figure.colorbar(points, ax=list(panels), location="bottom", shrink=0.4, aspect=40, pad=0.02)
    bar.set_label(f"error, spacings ({ERROR_LIMIT:g} or more has one colour)")
    save(figure, "rounds")


def draw_bounds(room: Room) -> None:
    """Draw the errors of the attacks and of their bounds, and the quality of the confidence."""
    methods = {
        "heuristic (paper)": (Heuristic(), BLUE, "-"),
        "tomography": (Tomography(), ORANGE, "-"),
        "leave-one-out": (LeaveOneOut(room.truth), GREEN, "--"),
        "candidate oracle(50)": (CandidateOracle(room.truth, Tomography()), RED, ":"),
        "oracle(50)": (Oracle(room.truth, 50), "black", ":"),
    }
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.8), constrained_layout=True)
    for name, (method, color, style) in methods.items():
        result = run(room.lines, method)
        off = errors(result.xyz, room.truth) / spacing(room.scene.xyz)
        share = (off <= 1).mean()
        label = f"{name}: median {np.median(off):.2f}, {share:.0%} within 1"
        left.plot(np.sort(off), np.arange(1, len(off) + 1) / len(off), color=color, ls=style, label=label)
        if style == "-":
            coverage, risk = risk_coverage(result.confidence, off <= 1)
            right.plot(coverage, risk, color=color, label=name)
            right.axhline(1 - share, color=color, lw=0.6, ls="--")
    left.axvline(1, color=GREY, lw=1)
    left.set(xscale="log", xlim=(0.01, 100), ylim=(0, 1), xlabel="error, spacings", ylabel="share of points below")
    left.set_title("attacks (solid) and bounds (broken)")
    left.legend(fontsize=8, loc="lower right")
    right.set(xlim=(0, 1), ylim=(0, None), xlabel="share of points kept, most confident first")
    right.set(ylabel="share of these more than 1 spacing off", title="confidence ranks the points")
    right.legend(fontsize=9)
    save(figure, "bounds")


DRAWINGS = {
    "lifting": draw_lifting,
    "votes": draw_votes,
    "neighborhoods": draw_neighborhoods,
    "density": draw_tomography,
    "affinities": draw_affinities,
    "likeness": draw_likeness,
    "rounds": draw_rounds,
    "bounds": draw_bounds,
}


def main(names: list[str]) -> None:
    torch.set_num_threads(1)
    unknown = set(names) - set(DRAWINGS)
    if unknown:
        sys.exit(f"got {', '.join(sorted(unknown))}; expected some of {', '.join(DRAWINGS)}")
    room = Room.make()
    for name in names or DRAWINGS:
        DRAWINGS[name](room)


if __name__ == "__main__":
    main(sys.argv[1:])
