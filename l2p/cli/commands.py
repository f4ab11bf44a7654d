"""Commands of ``l2p``: each checks its outputs first, then reads, works, and writes everything or nothing."""

from __future__ import annotations

import os
import shlex
import tempfile
import webbrowser
from argparse import Namespace
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from l2p.cli.drop import asks_to_drop, drop_words, dropped, warn_of_leaks
from l2p.cli.flags import settings_of
from l2p.cli.outputs import check_outputs, check_threads, figures_file, file_of, set_threads
from l2p.cli.recover import recover as recover
from l2p.errors import InputError
from l2p.io.atomic import atomic_file, check_folder
from l2p.io.descriptors import load_described
from l2p.io.kinds import LINE_CLOUDS, kind_of
from l2p.io.line_files import line_ending, load_lines, save_lines
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_scene, load_truth, truth_bytes
from l2p.judging.accuracy import matched, spacing
from l2p.judging.scores import evaluate as score
from l2p.maps.lines import LineCloud
from l2p.maps.scene import Scene
from l2p.schemes.hide import hide
from l2p.show.tables import descriptor_text, print_info, print_scores, print_shares
from l2p.work.progress import terminal_progress

if TYPE_CHECKING:
    from l2p.auditing.audit import Audit


def lift(arguments: Namespace) -> None:
    """Run ``l2p lift``."""
    given = (arguments.scene, arguments.descriptors or None, arguments.drop_ids, arguments.drop_masks)
    inputs = [path for path in given if path is not None]
    check_outputs(inputs, [arguments.output, arguments.truth], arguments.force)
    described = arguments.descriptors is not None
    asked = {"rgb": arguments.rgb, "descriptor": described}
    line_ending(arguments.output, [name for name, wanted in asked.items() if wanted])
    scene, source = _described_scene(arguments.scene, arguments.descriptors)
    if arguments.rgb and scene.rgb is None:
        raise InputError(f"{arguments.scene} has no colours; leave out --rgb")
    drop, left_out = dropped(arguments, scene)
    hidden = hide(scene, arguments.seed, arguments.fraction, arguments.scheme, arguments.rgb, described, drop=drop)
    with ExitStack() as stack:
        if arguments.truth is not None:
            # Renamed after the lines are written, so that a failure leaves neither file.
            truth = stack.enter_context(atomic_file(arguments.truth, overwrite=arguments.force))
            truth.write(truth_bytes(replace(hidden.truth, spacing=spacing(scene.xyz))))
        save_lines(hidden.map, arguments.output, overwrite=arguments.force)
    print(f"{arguments.output}: {len(hidden.map)} lines of {len(scene)} points")
    if left_out:
        print(left_out)
    if source is not None:
        print(f"descriptors of {_shown(str(source))}: {descriptor_text(hidden.map.appearance)}")
    warn_of_leaks(arguments.scene)


def evaluate(arguments: Namespace) -> None:
    """Run ``l2p evaluate``."""
    check_outputs([arguments.recovery, arguments.truth], [file_of(arguments.json)], arguments.force)
    recovery, truth = load_recovery(arguments.recovery), load_truth(arguments.truth)
    columns = {"all": score(recovery, truth, metric=arguments.metric)}
    if recovery.kept is not None and recovery.kept.any():
        row = matched(recovery, truth)
        some = truth.rows((row >= 0) & recovery.kept[row])
        columns["kept"] = score(recovery.rows(recovery.kept), some, metric=arguments.metric)
    with figures_file(arguments, {name: scores.as_dict() for name, scores in columns.items()}):
        pass
    if arguments.json != "-":
        print_scores(columns)


def audit(arguments: Namespace) -> None:
    """Run ``l2p audit``."""
    from l2p.auditing.audit import audit as examine
    from l2p.auditing.report import FILES, PAGE, figures_of, save_report
    from l2p.auditing.words import sentences

    _check_report(arguments, FILES)
    lines_given = kind_of(arguments.scene) in LINE_CLOUDS
    if lines_given and arguments.descriptors is not None:
        raise InputError("got --descriptors for a line cloud; expected none, since its file has all that is published")
    if lines_given and asks_to_drop(arguments):
        raise InputError("got --drop-... for a line cloud, whose points are unknown; expected it of l2p lift")
    scene = load_lines(arguments.scene) if lines_given else _described_scene(arguments.scene, arguments.descriptors)[0]
    set_threads(arguments.threads)
    found = examine(
        scene,
        arguments.fractions,
        arguments.seed,
        method=arguments.method,
        ignore=arguments.ignore,
        drop=None if isinstance(scene, LineCloud) else dropped(arguments, scene)[0],
        metric=arguments.metric,
        device=arguments.device,
        memory=arguments.memory,
        progress=terminal_progress(),
        name=_shown(arguments.scene),
        **settings_of(arguments),
    )
    command = _audit_command(arguments, lines_given)
    with figures_file(arguments, figures_of(found, command)):
        save_report(
            found,
            arguments.output,
            overwrite=arguments.force,
            command=command,
            most_points=arguments.max_view_points,
        )
    if arguments.json != "-":
        if found.known:
            _print_figures(found)
        for sentence in sentences(found):
            print(sentence.replace("\N{NO-BREAK SPACE}", " "))
        print(f"The report is {Path(arguments.output) / PAGE}")
    if arguments.open:
        _open(Path(arguments.output) / PAGE)


def _described_scene(path: str, descriptors: str | None) -> tuple[Scene, Path | None]:
    """Read a scene and, unless ``descriptors`` is None, the descriptors of that file; empty: of the one beside it.

    Return it with the file that the descriptors are from.
    """
    return (load_scene(path), None) if descriptors is None else load_described(path, descriptors or None)


def _print_figures(audit: Audit) -> None:
    """Print the figures of the attacker who uses most; with several, also the share that each recovers."""
    from l2p.auditing.attackers import seen_by

    print_scores({f"{100 * trial.fraction:g} %": trial.scores for trial in audit.strongest if trial.scores})
    if len(audit.attackers) > 1:
        shares = {
            seen_by(attacker): [trial.within for trial in audit.of_attacker(attacker) if trial.within is not None]
            for attacker in audit.attackers
        }
        print_shares(shares, [f"{100 * share:g} %" for share in audit.fractions])


def view(arguments: Namespace) -> None:
    """Run ``l2p view``."""
    from l2p.show.exhibit import Exhibit
    from l2p.show.page.file_view import view_page
    from l2p.show.window import check_window, show

    if arguments.window and arguments.output is not None:
        raise InputError(f"got --window and -o {arguments.output}; expected one of them")
    if arguments.window:
        check_window()
    check_outputs([arguments.file], [arguments.output], arguments.force)
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
    """Open a page in the browser, if there is a display."""
    from l2p.show.window import has_display

    if has_display():
        webbrowser.open(page.resolve().as_uri())


def info(arguments: Namespace) -> None:
    """Run ``l2p info``."""
    print_info(arguments.file)


def demo(arguments: Namespace) -> None:
    """Run ``l2p demo``."""
    from l2p.cli.demo import run

    run(
        arguments.output,
        arguments.points,
        arguments.seed,
        terminal_progress(),
        overwrite=arguments.force,
    )


def _check_report(arguments: Namespace, files: Iterable[str]) -> None:
    """Refuse wrong arguments of an audit before the scene is read."""
    given = (arguments.scene, arguments.checkpoint, arguments.descriptors or None)
    given += (arguments.drop_ids, arguments.drop_masks)
    inputs = [path for path in given if path is not None]
    check_outputs(inputs, [file_of(arguments.json)], arguments.force)
    check_folder(arguments.output, overwrite=arguments.force, replaceable=frozenset(files))
    report = Path(os.path.realpath(arguments.output))
    for path in (*inputs, file_of(arguments.json)):
        if path is not None and Path(os.path.realpath(path)).is_relative_to(report):
            raise InputError(f"{path} is in {arguments.output}; expected a report folder with nothing else in it")
    check_threads(arguments.threads)
    if arguments.max_view_points < 1:
        raise InputError(f"got --max-view-points {arguments.max_view_points}; expected at least 1")


def _audit_command(arguments: Namespace, lines_given: bool) -> str:
    """Return the command line that repeats this audit."""
    words = ["l2p", "audit", arguments.scene, "-o", arguments.output]
    if arguments.fractions is not None:
        words += ["--fractions", *(f"{share:.15g}" for share in arguments.fractions)]
    if arguments.descriptors is not None:
        words += ["--descriptors", *([arguments.descriptors] if arguments.descriptors else [])]
    words += ["--ignore", ",".join(arguments.ignore)] if arguments.ignore else []
    words += drop_words(arguments)
    words += [] if lines_given else ["--seed", str(arguments.seed)]
    words += ["--method", arguments.method]
    flags = {**settings_of(arguments), **{name: getattr(arguments, name) for name in ("device", "threads", "memory")}}
    for name, value in flags.items():
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    words += ["--metric"] if arguments.metric else []
    return _shown(shlex.join(words))


def _shown(path: str) -> str:
    """Return a path as printable text, even if its bytes are not valid text."""
    return os.fsencode(path).decode("utf-8", errors="replace")
