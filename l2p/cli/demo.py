"""Demonstration: a simulated room is mapped, hidden in a line cloud, and recovered from the lines alone."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path

from l2p.io.atomic import atomic_folder
from l2p.io.line_files import save_lines
from l2p.io.recovery_files import save_recovery
from l2p.io.scene_files import load_scene, save_scene, save_truth
from l2p.judging.accuracy import errors, spacing
from l2p.judging.scores import Scores, evaluate
from l2p.schemes.hide import hide
from l2p.show.pictures import Captions, draw_attack
from l2p.show.tables import print_scores
from l2p.simulator import simulate_model
from l2p.work.progress import NO_PROGRESS, Progress

#: Files of the folder: the map, its published line cloud, an attacker's recovery, and the truth.
MODEL, MAP, LINES, RECOVERY, CLOUD, TRUTH, PICTURE = FILES = (
    "model",
    "map.ply",
    "lines.npz",
    "recovered.npz",
    "recovered.ply",
    "truth.npz",
    "demo.png",
)


def run(
    folder: str | PathLike[str],
    points: int,
    seed: int,
    progress: Progress = NO_PROGRESS,
    *,
    overwrite: bool = False,
) -> None:
    """Simulate, lift, recover, score and draw; print the table to stdout, write the rest into ``folder``.

    Parameters
    ----------
    folder : path
        Output folder, written whole or not at all.
    points, seed : int
        Size and seed of the simulated room (:func:`l2p.simulate`).
    overwrite : bool
        Replace the folder of an earlier demonstration.

    Raises
    ------
    InputError
        If the folder exists and may not be replaced, or there are too few points for a room.
    """
    with atomic_folder(folder, overwrite=overwrite, replaceable=frozenset(FILES)) as place:
        simulate_model("room", points, seed).save_colmap(place / MODEL)
        from l2p.attacks.run import recover  # loads torch, for which a wrong folder or number need not wait

        # Read back from its files, like a user's map.
        scene = load_scene(place / MODEL)
        save_scene(scene, place / MAP)
        hidden = hide(scene, seed=seed)
        save_lines(hidden.map, place / LINES)
        recovery = recover(hidden.map, progress=progress)
        save_recovery(recovery, place / RECOVERY)
        save_recovery(recovery, place / CLOUD)
        # With the ids, `l2p recover --model --truth` makes a COLMAP model of the recovered points.
        truth = replace(hidden.truth, spacing=spacing(scene.xyz))
        save_truth(truth, place / TRUTH)
        scores = evaluate(recovery, truth, metric=True)
        error = errors(recovery, truth) / scores.spacing
        picture = draw_attack(scene, hidden.map, recovery.xyz, error, _captions(scores))
        (place / PICTURE).write_bytes(picture)
    print_scores({str(recovery.info["method"]): scores})
    print(f"The picture is {Path(folder) / PICTURE}; the recovered room is {Path(folder) / CLOUD}.")


def _captions(scores: Scores) -> Captions:
    half, one, share = 100 * scores.median, 100 * scores.spacing, scores.within_spacings["1"]
    return Captions(
        title="Turning the points of a map into lines does not hide the room",
        map=("The map", f"{scores.lines:,} points of a simulated room:\nshelf, pictures, desk, table, sofa, plant"),
        lines=(
            "The published line cloud",
            "each point replaced by a random line through it:\nwhat people think is safe",
        ),
        recovered=(
            "What an attacker gets back",
            f"computed from the lines alone: half of the points\n"
            f"less than {half:.1f} cm off, {share:.0%} less than {one:.1f} cm",
        ),
        error=f"error in spacings of {one:.1f} cm: bright is right, dark is wrong",
    )
