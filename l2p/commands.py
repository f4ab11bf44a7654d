"""What the commands of ``l2p`` do: check the outputs first, then read, work, and write all of it or nothing."""

from __future__ import annotations

import json
import os
import shlex
import tempfile
import webbrowser
from argparse import Namespace
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int, UInt8

from l2p.clean import inliers, load_open3d
from l2p.errors import InputError
from l2p.io.atomic import atomic_file, check_file, check_folder
from l2p.io.colmap import check_ids, check_model_output, save_recovered_model
from l2p.io.kinds import LINE_CLOUDS, kind_of
from l2p.io.line_files import line_ending, load_lines, save_lines
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_scene, load_truth, truth_bytes
from l2p.lifting import lift_indexed
from l2p.lines import LineCloud
from l2p.methods import RANKING
from l2p.metrics import evaluate as score
from l2p.metrics import spacing
from l2p.progress import terminal_progress
from l2p.recovery import Recovery
from l2p.scene import Scene, Truth
from l2p.tables import print_info, print_scores


def lift(arguments: Namespace) -> None:
    """``l2p lift``."""
    _check_outputs([arguments.scene], [arguments.output, arguments.truth], arguments.force)
    line_ending(arguments.output)
    scene = load_scene(arguments.scene)
    cloud, index = lift_indexed(
        scene.xyz,
        seed=arguments.seed,
        fraction=arguments.fraction,
        scheme=arguments.scheme,
        rgb=_colours(arguments, scene.rgb),
    )
    with ExitStack() as stack:
        if arguments.truth is not None:
            # Renamed after the lines are in place, so that a failure leaves neither.
            file = stack.enter_context(atomic_file(arguments.truth, overwrite=arguments.force))
            file.write(truth_bytes(_truth(scene, index, arguments.seed)))
        save_lines(cloud, arguments.output, overwrite=arguments.force)
    print(f"{arguments.output}: {len(cloud)} lines of {len(scene)} points")


def recover(arguments: Namespace) -> None:
    """``l2p recover``."""
    from l2p.attack import recover as attack

    _check_recover(arguments)
    lines, ids = _recover_inputs(arguments)
    _set_threads(arguments.threads)
    recovery = attack(
        lines,
        arguments.method,
        checkpoint=arguments.checkpoint,
        rounds=arguments.rounds,
        scene_kind=arguments.scene_kind,
        density=arguments.density,
        device=arguments.device,
        memory=arguments.memory,
        progress=terminal_progress(),
    )
    if arguments.seed is not None:
        recovery = replace(recovery, info={**recovery.info, "seed": arguments.seed})
    recovery = _filtered(recovery, arguments.min_confidence, arguments.clean)
    kept = len(recovery) if recovery.kept is None else int(recovery.kept.sum())
    stats = {
        "lines": len(recovery),
        "kept": kept,
        "median_confidence": float(np.median(recovery.confidence)),
        **recovery.info,
    }
    with _json(arguments, stats):
        _save(recovery, ids, arguments)
    if arguments.json != "-":
        print(f"{arguments.output}: {kept} of {len(recovery)} points, {recovery.info['seconds']:.1f} s")


def evaluate(arguments: Namespace) -> None:
    """``l2p evaluate``."""
    _check_outputs([arguments.recovery, arguments.truth], [_file(arguments.json)], arguments.force)
    recovery, truth = load_recovery(arguments.recovery), load_truth(arguments.truth)
    columns = {"all": score(recovery, truth.xyz, truth.spacing, metric=arguments.metric)}
    if recovery.kept is not None and recovery.kept.any():
        some = _rows(recovery, recovery.kept)
        columns["kept"] = score(some, truth.xyz[recovery.kept], truth.spacing, metric=arguments.metric)
    with _json(arguments, {name: scores.as_dict() for name, scores in columns.items()}):
        pass
    if arguments.json != "-":
        print_scores(columns, calibrated=recovery.info.get("method") not in RANKING)


def audit(arguments: Namespace) -> None:
    """``l2p audit``."""
    from l2p.auditing import audit as examine
    from l2p.page.report import FILES, PAGE, figures_of, save_report
    from l2p.page.words import headline, sparser, typical

    _check_report(arguments, FILES)
    lines_given = kind_of(arguments.scene) in LINE_CLOUDS
    scene = load_lines(arguments.scene) if lines_given else load_scene(arguments.scene)
    _set_threads(arguments.threads)
    found = examine(
        scene,
        arguments.fractions,
        arguments.seed,
        method=arguments.method,
        checkpoint=arguments.checkpoint,
        metric=arguments.metric,
        device=arguments.device,
        memory=arguments.memory,
        progress=terminal_progress(),
        name=_shown(arguments.scene),
    )
    command = _audit_command(arguments, lines_given)
    with _json(arguments, figures_of(found, command)):
        save_report(
            found,
            arguments.output,
            overwrite=arguments.force,
            command=command,
            most_points=arguments.max_view_points,
        )
    if arguments.json != "-":
        if found.known:
            columns = {f"{100 * trial.fraction:g} %": trial.scores for trial in found.trials if trial.scores}
            print_scores(columns, calibrated=found.calibrated)
        for sentence in filter(None, (headline(found), typical(found), sparser(found))):
            print(sentence.replace("\N{NO-BREAK SPACE}", " "))
        print(f"The report is {Path(arguments.output) / PAGE}")
    if arguments.open:
        _open(Path(arguments.output) / PAGE)


def view(arguments: Namespace) -> None:
    """``l2p view``."""
    from l2p.exhibit import Exhibit
    from l2p.page.file_view import view_page
    from l2p.window import check_window, show

    if arguments.window and arguments.output is not None:
        raise InputError(f"got --window and -o {arguments.output}; expected one of them")
    if arguments.window:
        check_window()
    _check_outputs([arguments.file], [arguments.output], arguments.force)
    exhibit, name = Exhibit.load(arguments.file), _shown(arguments.file)
    if arguments.window:
        show(exhibit, name)
        return
    page = view_page(exhibit, name, kind_of(arguments.file).value)
    output = arguments.output or os.path.join(tempfile.mkdtemp(prefix="l2p-view-"), "view.html")
    with atomic_file(output, overwrite=arguments.force) as file:
        file.write(page)
    print(output)
    if arguments.output is None or arguments.open:
        _open(Path(output))


def _open(page: Path) -> None:
    """Show a page in the browser, where there is a display."""
    from l2p.window import has_display

    if has_display():
        webbrowser.open(page.resolve().as_uri())


def info(arguments: Namespace) -> None:
    """``l2p info``."""
    print_info(arguments.file)


def demo(arguments: Namespace) -> None:
    """``l2p demo``."""
    from l2p.demo import run

    run(
        arguments.output,
        arguments.points,
        arguments.seed,
        terminal_progress(),
        overwrite=arguments.force,
    )


def _check_outputs(inputs: list[str], outputs: list[str | None], force: bool) -> None:
    """Refuse, before any work, outputs that must not be written, or that are inputs or each other."""
    taken = {os.path.realpath(path) for path in inputs}
    for path in outputs:
        if path is None:
            continue
        if os.path.realpath(path) in taken:
            raise InputError(f"got {path} twice; expected every output to be a file of its own")
        taken.add(os.path.realpath(path))
        check_file(path, overwrite=force)


def _file(json_path: str | None) -> str | None:
    return None if json_path == "-" else json_path


def _colours(arguments: Namespace, rgb: UInt8[np.ndarray, "points 3"] | None) -> UInt8[np.ndarray, "points 3"] | None:
    if arguments.rgb and rgb is None:
        raise InputError(f"{arguments.scene} has no colours; leave out --rgb")
    return rgb if arguments.rgb else None


def _truth(scene: Scene, index: Int[np.ndarray, " lines"], seed: int | None) -> Truth:
    ids = None if scene.ids is None else scene.ids[index]
    return Truth(scene.xyz[index], index, spacing(scene.xyz), ids, seed)


def _check_recover(arguments: Namespace) -> None:
    """Everything that can be refused before the lines are read."""
    model_output = _model_output(arguments)
    given = (arguments.lines, arguments.model, arguments.truth, arguments.checkpoint)
    inputs = [path for path in given if path is not None]
    outputs = [_file(arguments.json)] if model_output else [arguments.output, _file(arguments.json)]
    _check_outputs(inputs, outputs, arguments.force)
    if model_output:
        check_model_output(arguments.model, arguments.output, overwrite=arguments.force)
    if arguments.min_confidence is not None and not 0 <= arguments.min_confidence <= 1:
        raise InputError(f"got --min-confidence {arguments.min_confidence}; expected a number in [0, 1]")
    _check_threads(arguments.threads)
    if arguments.clean:
        load_open3d()


def _check_report(arguments: Namespace, files: Iterable[str]) -> None:
    """Everything about an audit that can be refused before the scene is read."""
    inputs = [path for path in (arguments.scene, arguments.checkpoint) if path is not None]
    _check_outputs(inputs, [_file(arguments.json)], arguments.force)
    check_folder(arguments.output, overwrite=arguments.force, replaceable=frozenset(files))
    report = Path(os.path.realpath(arguments.output))
    for path in (*inputs, _file(arguments.json)):
        if path is not None and Path(os.path.realpath(path)).is_relative_to(report):
            raise InputError(f"{path} is in {arguments.output}; expected a report folder with nothing else in it")
    _check_threads(arguments.threads)
    if arguments.max_view_points < 1:
        raise InputError(f"got --max-view-points {arguments.max_view_points}; expected at least 1")


def _audit_command(arguments: Namespace, lines_given: bool) -> str:
    """The command line that gives this audit again."""
    words = ["l2p", "audit", arguments.scene, "-o", arguments.output]
    if arguments.fractions is not None:
        words += ["--fractions", *(f"{share:.15g}" for share in arguments.fractions)]
    words += [] if lines_given else ["--seed", str(arguments.seed)]
    words += ["--method", arguments.method]
    for flag in ("checkpoint", "device", "threads", "memory"):
        value = getattr(arguments, flag)
        words += [] if value is None else [f"--{flag}", str(value)]
    words += ["--metric"] if arguments.metric else []
    return _shown(shlex.join(words))


def _shown(path: str) -> str:
    """A path as text; its bytes need be none."""
    return os.fsencode(path).decode("utf-8", errors="replace")


def _check_threads(threads: int | None) -> None:
    if threads is None:
        return
    from l2p.threads import MOST_THREADS  # loads torch

    if not 1 <= threads <= MOST_THREADS:
        raise InputError(f"got --threads {threads}; expected at least 1, at most {MOST_THREADS}")


def _model_output(arguments: Namespace) -> bool:
    """Whether -o asks for a COLMAP model."""
    ending = Path(arguments.output).suffix.lower()
    both = arguments.model is not None and arguments.truth is not None
    neither = arguments.model is None and arguments.truth is None
    if ending in (".npz", ".ply"):
        if not neither:
            raise InputError(f"got --model or --truth with {arguments.output}; expected a folder, for a COLMAP model")
        return False
    if not both:
        raise InputError(
            f"got -o {arguments.output}; expected .npz, .ply, or a folder together with --model MODEL --truth TRUTH.npz"
        )
    return True


def _recover_inputs(arguments: Namespace) -> tuple[LineCloud, Int[np.ndarray, " lines"] | None]:
    """The lines, and for a COLMAP model the point id behind each."""
    lines = load_lines(arguments.lines)
    if arguments.model is None:
        return lines, None
    ids = load_truth(arguments.truth).ids
    if ids is None:
        raise InputError(f"{arguments.truth} has no point ids; expected the truth of a lifted COLMAP model")
    if len(ids) != len(lines):
        raise InputError(f"got {len(lines)} lines and {len(ids)} ids; expected the truth of these very lines")
    check_ids(arguments.model, ids)
    return lines, ids


def _set_threads(threads: int | None) -> None:
    if threads is not None:
        import torch

        torch.set_num_threads(threads)


def _filtered(recovery: Recovery, min_confidence: float | None, clean: bool) -> Recovery:
    """The recovery with the points marked that pass the filters that were asked for."""
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


def _rows(recovery: Recovery, kept: Bool[np.ndarray, " lines"]) -> Recovery:
    return Recovery(recovery.xyz[kept], recovery.confidence[kept], recovery.beta[kept])


def _save(recovery: Recovery, ids: Int[np.ndarray, " lines"] | None, arguments: Namespace) -> None:
    if ids is None:
        recovery.save(arguments.output, overwrite=arguments.force)
        return
    kept = slice(None) if recovery.kept is None else recovery.kept
    save_recovered_model(arguments.model, ids[kept], recovery.xyz[kept], arguments.output, overwrite=arguments.force)


@contextmanager
def _json(arguments: Namespace, figures: dict[str, Any]) -> Iterator[None]:
    """Write the figures where --json says, once what the block writes is in place."""
    text = json.dumps(figures, indent=2) + "\n"
    if arguments.json in (None, "-"):
        yield
        if arguments.json == "-":
            print(text, end="")
        return
    with atomic_file(arguments.json, overwrite=arguments.force) as file:
        file.write(text.encode("utf-8"))
        yield
