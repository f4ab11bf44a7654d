"""Command ``l2p recover``: on one process, or on several ranks; from the start, or from a finished round; from one line
cloud, or from several releases of one map."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int

from l2p.cli.expectation import expectation, expected_within, map_spacing
from l2p.cli.flags import settings_of
from l2p.cli.outputs import check_attack, check_inputs, check_outputs, figures_file, file_of, say_taken, set_threads
from l2p.errors import InputError
from l2p.io.colmap import check_ids, check_model_output, save_recovered_model
from l2p.io.hidden_files import load_hidden
from l2p.io.kinds import HIDDEN_MAPS, kind_of
from l2p.io.open3d import load_open3d
from l2p.io.recovery_files import ENDINGS, save_recovery
from l2p.io.scene_files import load_truth
from l2p.io.state_files import StateFile, state_path
from l2p.judging.clean import inliers
from l2p.maps.lines import LineCloud
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud
from l2p.maps.recovery import Recovery
from l2p.schemes.recognition import NOT_STATED
from l2p.schemes.scheme import published_by
from l2p.work.launched import among_others
from l2p.work.progress import terminal_progress

if TYPE_CHECKING:
    from l2p.attacks.attack import Attack
    from l2p.work.processes import Place

#: Most processes to start, a limit on typing errors: more than the cores of any machine.
MOST_PROCESSES = 1024


def recover(arguments: Namespace) -> None:
    """Run ``l2p recover`` alone, on ranks that are started here, or as one of the ranks of an external launcher."""
    _check_several(arguments, started_elsewhere=among_others())
    if not among_others():
        # What takes no work to see is refused before torch is loaded.
        _check_recover(arguments)
    from l2p.work.processes import joined, launch

    if arguments.processes not in (None, 1) and not among_others():
        code = launch(arguments.words, arguments.processes)
        if code:
            raise SystemExit(code)
        return
    with joined(arguments.device) as place:
        if place.shards.rank == 0:
            _recover(arguments, place)
        else:
            from l2p.attacks.run import assist

            set_threads(arguments.threads)
            assist(_attack(arguments), place.shards, device=place.device, memory=arguments.memory)


def _recover(arguments: Namespace, place: Place) -> None:
    """Run the attack on rank 0, and write the result."""
    from l2p.attacks.by_scheme import by_own_attack, recover_own
    from l2p.attacks.run import lines_of, run
    from l2p.work.work import Work

    if arguments.processes not in (None, place.shards.processes):
        raise InputError(
            f"got --processes {arguments.processes} in one of {place.shards.processes} processes that were started "
            "elsewhere; leave it out"
        )
    _check_recover(arguments)
    attack = _attack(arguments)
    releases, ids = _recover_inputs(arguments)
    set_threads(arguments.threads)
    state = StateFile(arguments.output, resume=arguments.resume, overwrite=arguments.force)
    if len(releases) > 1:
        recovery = _recover_several([lines_of(each) for each in releases], arguments, place.device)
    elif by_own_attack(releases[0], arguments.method, settings_of(arguments)):
        recovery = recover_own(releases[0], terminal_progress())
    else:
        recovery = run(
            lines_of(releases[0]),
            attack,
            device=place.device,
            memory=arguments.memory,
            work=Work(place.shards, state, terminal_progress()),
            name=arguments.method,
        )
    _warn_of_lines(recovery)
    if arguments.seed is not None:
        recovery = replace(recovery, info={**recovery.info, "seed": arguments.seed})
    with _rounds_left(state):
        _write(recovery, ids, releases, arguments)
    state.remove()


def _recover_several(releases: list[LineCloud], arguments: Namespace, device: str) -> Recovery:
    from l2p.attacks.several import recover_releases

    return recover_releases(
        releases,
        arguments.method,
        device=device,
        memory=arguments.memory,
        progress=terminal_progress(),
        **settings_of(arguments),
    )


@contextmanager
def _rounds_left(state: StateFile) -> Iterator[None]:
    """Add to the error of an output that cannot be written that the finished rounds are saved."""
    try:
        yield
    except InputError as error:
        if not state.path.exists():
            raise
        raise InputError(f"{error}; {state.path} has the rounds: add --resume") from error


def _warn_of_lines(recovery: Recovery) -> None:
    """Say on stderr what the scheme forbids, or what the lines were recognised as, unless they are uniform."""
    if "sentence" in recovery.info:
        print(f"l2p: {recovery.info['sentence']}", file=sys.stderr)
        return
    from l2p.attacks.apart import apart_words

    apart = apart_words(recovery.info)
    if apart:
        print(f"l2p: {apart}", file=sys.stderr)
    found = recovery.info.get("recognised")
    if found is not None and not found["expected"]:
        print(" ".join(["l2p:", found["sentence"], *([] if recovery.calibrated else [NOT_STATED])]), file=sys.stderr)


def _write(
    recovery: Recovery,
    ids: Int[np.ndarray, " lines"] | None,
    releases: list[LineCloud | PlaneCloud | PermutedCloud],
    arguments: Namespace,
) -> None:
    """Write the recovery, filtered, and its figures."""
    recovery = _filtered(recovery, arguments.min_confidence, arguments.clean)
    kept = len(recovery) if recovery.kept is None else int(recovery.kept.sum())
    scale = map_spacing(recovery) if recovery.calibrated else None
    stats = {
        "lines": len(recovery),
        "kept": kept,
        "median_confidence": float(np.median(recovery.confidence)) if recovery.calibrated else None,
        "expected_within": expected_within(recovery),
        "spacing": scale,
        **recovery.info,
    }
    with figures_file(arguments, stats):
        _save(recovery, ids, arguments)
    for path, hidden in zip(arguments.lines, releases, strict=True):
        say_taken(path, hidden, arguments)
    if arguments.json != "-":
        some = "" if recovery.kept is None else f"{kept:,} kept of "
        print(f"{arguments.output}: {some}{len(recovery):,} points, {recovery.info['seconds']:.1f} s")
        if "met" in recovery.info:
            other = "the other release" if len(recovery.info["releases"]) == 2 else "another release"
            print(f"{recovery.info['met']:,} of {len(recovery):,} lines meet a line of {other} in their point")
        print(expectation(recovery, scale))


def _check_several(arguments: Namespace, started_elsewhere: bool) -> None:
    """Refuse, for several releases, what only one can have: processes and rounds to resume."""
    if len(arguments.lines) == 1:
        return
    for flag, given in (("--processes", arguments.processes not in (None, 1)), ("--resume", arguments.resume)):
        if given:
            raise InputError(f"got {flag} with {len(arguments.lines)} line clouds; expected it with one; leave it out")
    if started_elsewhere:
        raise InputError(f"got {len(arguments.lines)} line clouds in processes started elsewhere; expected one process")


def _check_recover(arguments: Namespace) -> None:
    """Refuse wrong arguments before the lines are read."""
    model_output = _model_output(arguments)
    given = (*arguments.lines, arguments.model, arguments.truth, arguments.checkpoint)
    inputs = [path for path in given if path is not None]
    outputs = [file_of(arguments.json)] if model_output else [arguments.output, file_of(arguments.json)]
    check_outputs(inputs, outputs, arguments.force)
    if model_output:
        check_model_output(arguments.model, arguments.output, overwrite=arguments.force)
    check_outputs([*inputs, *filter(None, outputs)], [str(state_path(arguments.output))], True)
    StateFile(arguments.output, resume=arguments.resume, overwrite=arguments.force)
    if arguments.min_confidence is not None and not 0 <= arguments.min_confidence <= 1:
        raise InputError(f"got --min-confidence {arguments.min_confidence}; expected a number in [0, 1]")
    if arguments.processes is not None and not 1 <= arguments.processes <= MOST_PROCESSES:
        raise InputError(f"got --processes {arguments.processes}; expected at least 1, at most {MOST_PROCESSES}")
    check_attack(arguments)
    for path in arguments.lines:
        if kind_of(path) not in HIDDEN_MAPS:
            load_hidden(path)  # which refuses it in its own words
    check_inputs(arguments.model, arguments.truth)
    if arguments.clean:
        load_open3d()


def _model_output(arguments: Namespace) -> bool:
    """Whether the output is a COLMAP model."""
    ending = Path(arguments.output).suffix.lower()
    both = arguments.model is not None and arguments.truth is not None
    neither = arguments.model is None and arguments.truth is None
    if ending in ENDINGS:
        if not neither:
            raise InputError(f"got --model or --truth with {arguments.output}; expected a folder, for a COLMAP model")
        return False
    if not both:
        raise InputError(
            f"got -o {arguments.output}; expected {', '.join(ENDINGS)}, or a folder together with --model MODEL "
            "--truth TRUTH.npz"
        )
    return True


def _attack(arguments: Namespace) -> Attack:
    """Build the attack from the arguments."""
    from l2p.attacks.named import named_attack

    return named_attack(arguments.method, **settings_of(arguments))


def _named(hidden: LineCloud | PlaneCloud | PermutedCloud, scheme: str | None) -> Any:
    """Name the scheme of lines whose file does not say it."""
    if scheme is None:
        return hidden
    if not isinstance(hidden, LineCloud) or published_by(scheme) is not LineCloud:
        raise InputError(f"got --scheme {scheme} for a map of scheme {hidden.scheme}; expected it for lines only")
    return replace(hidden, scheme=scheme)


def _recover_inputs(
    arguments: Namespace,
) -> tuple[list[LineCloud | PlaneCloud | PermutedCloud], Int[np.ndarray, " lines"] | None]:
    """Read the releases, without ignored attributes, and, for a COLMAP model, the point id behind each line of the
    first."""
    releases = []
    for path in arguments.lines:
        hidden = load_hidden(path, arguments.columns)
        releases.append(_named(hidden, arguments.scheme).without(arguments.ignore))
    if arguments.model is None:
        return releases, None
    lines = releases[0]
    truth = load_truth(arguments.truth)
    ids = truth.ids
    if ids is None:
        raise InputError(f"{arguments.truth} has no point ids; expected the truth of a lifted COLMAP model")
    if len(ids) != len(lines) or not truth.one_each:
        raise InputError(f"got {len(lines)} lines and {len(ids)} ids; expected the truth of these very lines")
    check_ids(arguments.model, ids)
    return releases, ids


def _filtered(recovery: Recovery, min_confidence: float | None, clean: bool) -> Recovery:
    """Mark the points of the recovery that pass the given filters."""
    if min_confidence is None and not clean:
        return recovery
    kept = recovery.confidence >= (min_confidence or 0.0)
    if not kept.any():
        raise InputError(
            f"no point has confidence {min_confidence}; the highest is {recovery.confidence.max():.3f}, so lower "
            "--min-confidence"
        )
    if clean:
        sure = np.flatnonzero(kept)
        kept[sure] = inliers(recovery.xyz[sure])
    return replace(recovery, kept=kept)


def _save(recovery: Recovery, ids: Int[np.ndarray, " lines"] | None, arguments: Namespace) -> None:
    if ids is None:
        save_recovery(recovery, arguments.output, overwrite=arguments.force, double=arguments.double or None)
        return
    kept = slice(None) if recovery.kept is None else recovery.kept
    save_recovered_model(arguments.model, ids[kept], recovery.xyz[kept], arguments.output, overwrite=arguments.force)
