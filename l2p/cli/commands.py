"""Commands of ``l2p``: each checks its outputs first, then reads, works, and writes everything or nothing."""

from __future__ import annotations

import os
import shlex
import tempfile
import webbrowser
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from l2p.auditing import FILES, PAGE
from l2p.checks import check_fraction
from l2p.cli.chosen import asks_for_points, chosen, dropped, point_words
from l2p.cli.flags import POINT_FLAGS, settings_of
from l2p.cli.lift import described_scene, printable
from l2p.cli.lift import lift as lift
from l2p.cli.localize import localize as localize
from l2p.cli.map_names import map_name, shown_name
from l2p.cli.outputs import check_attack, check_outputs, figures_file, file_of, say_taken, set_threads
from l2p.cli.picture_command import picture as picture
from l2p.cli.recover import recover as recover
from l2p.cli.serve_command import serve
from l2p.errors import InputError, sentence
from l2p.io.atomic import atomic_file, check_folder
from l2p.io.kinds import LINE_CLOUDS, Kind, kind_of
from l2p.io.line_files import load_lines
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_truth
from l2p.judging.accuracy import matched
from l2p.judging.scores import evaluate as score
from l2p.maps.lines import LineCloud
from l2p.maps.scene import Scene
from l2p.show.tables import print_info, print_rows, print_scores, print_shares
from l2p.utility import BY_DESCRIPTORS, BY_TRACKS, MOST_QUERIES, WRONG
from l2p.work.progress import terminal_progress

if TYPE_CHECKING:
    from l2p.auditing.audit import Audit
    from l2p.auditing.seen import Place
    from l2p.utility.queries import Queries


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
    _check_report(arguments)
    from l2p.auditing.audit import audit as examine
    from l2p.auditing.decision import decide, parsed_goal
    from l2p.auditing.report import ReleaseInputs, figures_of, save_report
    from l2p.auditing.seen import pictures_of
    from l2p.auditing.sharing import NAMELESS, holding
    from l2p.auditing.tradeoff import decision_sentences, option_table
    from l2p.auditing.verdict import verdict_of
    from l2p.auditing.words import sentences
    from l2p.utility.localization import checked_limits
    from l2p.utility.releases import LocalizeConfig

    goal = parsed_goal(arguments.localize, arguments.recovered)
    if goal is not None:
        checked_limits([goal.limit], arguments.metric)
    if arguments.queries < 0:
        raise InputError(f"got --queries {arguments.queries}; expected 0 or more")
    localizing = LocalizeConfig(arguments.matches, (arguments.wrong,), arguments.queries or None)
    lines_given = kind_of(arguments.scene, arguments.columns) in LINE_CLOUDS
    if lines_given and arguments.descriptors is not None:
        raise InputError("got --descriptors for a line cloud; expected none, since its file has all that is published")
    for flag in POINT_FLAGS:
        if lines_given and asks_for_points(arguments, flag):
            raise InputError(f"got --{flag}-... for a line cloud, whose points are unknown; expected it of l2p lift")
    scene: LineCloud | Scene
    if lines_given:
        scene = load_lines(arguments.scene, arguments.columns)
    else:
        scene = described_scene(arguments.scene, arguments.descriptors, arguments.columns)[0]
    say_taken(arguments.scene, scene, arguments)
    queries, why = _queries(arguments, scene, needed=goal is not None)
    places = [] if arguments.share else _places(arguments)
    drop = None if isinstance(scene, LineCloud) else dropped(arguments, scene)[0]
    set_threads(arguments.threads)
    found = examine(
        scene,
        arguments.fractions,
        arguments.seed,
        method=arguments.method,
        ignore=arguments.ignore,
        drop=drop,
        region=None if isinstance(scene, LineCloud) else chosen(arguments, scene, "region")[0],
        schemes=arguments.schemes,
        releases=arguments.releases,
        metric=arguments.metric,
        device=arguments.device,
        memory=arguments.memory,
        queries=queries,
        localizing=localizing,
        progress=terminal_progress(),
        name=arguments.name or (NAMELESS if arguments.share else map_name(arguments.scene)),
        **settings_of(arguments),
    )
    if not isinstance(scene, LineCloud):
        seen = pictures_of(found.trials, scene, places, ignored=found.ignored, drop=drop, progress=terminal_progress())
        found = replace(found, pictures=seen)
    command = _audit_command(arguments, lines_given)
    release = ReleaseInputs(
        goal, printable(arguments.scene), arguments.descriptors or None, tuple(point_words(arguments, "drop")), why
    )
    with figures_file(arguments, figures_of(found, command, release, arguments.share)):
        save_report(
            found,
            arguments.output,
            overwrite=arguments.force,
            command=command,
            most_points=arguments.max_view_points,
            release=release,
            share=arguments.share,
        )
    if arguments.json != "-":
        if found.known:
            _print_figures(found)
        decision = decide(found, goal)
        if decision is not None:
            print_rows(
                "releases of the map (*: the best, in brackets: another one is better)", *option_table(found, decision)
            )
        told = [
            str(verdict_of(found)),
            *sentences(found),
            *([] if decision is None else decision_sentences(found, decision)),
        ]
        for each in told:
            print(each.replace("\N{NO-BREAK SPACE}", " "))
        print(f"The report is {Path(arguments.output) / PAGE}")
        print(holding(found, arguments.share))
    if arguments.open:
        _open(Path(arguments.output) / PAGE)


def _queries(arguments: Namespace, scene: Scene | LineCloud, needed: bool) -> tuple[Queries | None, str]:
    """Images of the model to localize, or None and why there are none; InputError if they are needed."""
    from l2p.utility.landmarks import poselib
    from l2p.utility.releases import queries_at

    try:
        if arguments.queries == 0:
            raise InputError("no images were to be localized (--queries 0)")
        if isinstance(scene, LineCloud) or kind_of(arguments.scene) is not Kind.SCENE_MODEL:
            raise InputError("only a COLMAP model has the images that can be localized")
        poselib()
        by_features = arguments.matches == BY_DESCRIPTORS
        return queries_at(arguments.scene, scene, arguments.descriptors or None, by_features), ""
    except InputError as error:
        if needed or arguments.matches != BY_TRACKS:
            raise
        return None, sentence(error)


def _places(arguments: Namespace) -> list[Place]:
    """Views of the model to make pictures of; none of a map that has no views."""
    from l2p.auditing import VIEWS
    from l2p.auditing.seen import places_of

    if kind_of(arguments.scene) is not Kind.SCENE_MODEL:
        if arguments.views or arguments.photographs is not None:
            raise InputError("got views of a map that is no COLMAP model; expected a model, which has cameras")
        return []
    if arguments.views is not None or arguments.photographs is not None:
        return places_of(arguments.scene, VIEWS if arguments.views is None else arguments.views, arguments.photographs)
    try:
        return places_of(arguments.scene, VIEWS)
    except InputError:  # a model whose points alone can be read
        return []


def _print_figures(audit: Audit) -> None:
    """Print the figures of the attacker who uses most; with several, also the share that each recovers."""
    from l2p.auditing.attackers import seen_by

    scores = {f"{100 * trial.fraction:g} %": trial.scores for trial in audit.strongest if trial.scores}
    print_scores(scores, by_spacing=not audit.few)
    if len(audit.attackers) > 1 and not audit.few:
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
    if arguments.pictures or arguments.lines is not None:
        serve(arguments)
        return
    exhibit = Exhibit.load(arguments.file, arguments.columns)
    name = shown_name(arguments.file)
    if arguments.window:
        show(exhibit, name)
        return
    page = view_page(exhibit, name, kind_of(arguments.file, arguments.columns).value)
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
    print_info(arguments.file, arguments.columns)


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


def _check_report(arguments: Namespace) -> None:
    """Refuse wrong arguments of an audit before torch is loaded and the scene is read."""
    given = (arguments.scene, arguments.checkpoint, arguments.descriptors or None)
    given += (arguments.drop_ids, arguments.drop_masks, arguments.region_ids, arguments.region_masks)
    inputs = [path for path in given if path is not None]
    check_outputs(inputs, [file_of(arguments.json)], arguments.force)
    check_folder(arguments.output, overwrite=arguments.force, replaceable=frozenset(FILES))
    report = Path(os.path.realpath(arguments.output))
    for path in (*inputs, file_of(arguments.json)):
        if path is not None and Path(os.path.realpath(path)).is_relative_to(report):
            raise InputError(f"{path} is in {arguments.output}; expected a report folder with nothing else in it")
    kind_of(arguments.scene)  # which refuses what is missing or of no kind
    check_attack(arguments)
    for share in arguments.fractions or ():
        check_fraction(share)
    if arguments.max_view_points < 1:
        raise InputError(f"got --max-view-points {arguments.max_view_points}; expected at least 1")


def _audit_command(arguments: Namespace, lines_given: bool) -> str:
    """Return the command line that repeats this audit; of a report to share, without paths, coordinates and machine."""
    from l2p.auditing.sharing import without_values

    points = [*point_words(arguments, "drop"), *point_words(arguments, "region")]
    if arguments.share:
        stands = {"scene": "LINES" if lines_given else "MODEL", "output": "REPORT_DIR", "device": None, "threads": None}
        stands |= {"descriptors": arguments.descriptors and "FILE", "checkpoint": arguments.checkpoint and "FILE"}
        arguments, points = Namespace(**{**vars(arguments), **stands, "memory": None}), without_values(points)
    words = ["l2p", "audit", arguments.scene, "-o", arguments.output]
    words += ["--share"] if arguments.share else []
    words += ["--name", arguments.name] if arguments.name else []
    if arguments.fractions is not None:
        words += ["--fractions", *(f"{share:.15g}" for share in arguments.fractions)]
    if arguments.descriptors is not None:
        words += ["--descriptors", *([arguments.descriptors] if arguments.descriptors else [])]
    words += [] if arguments.columns is None else ["--columns", arguments.columns]
    words += ["--ignore", ",".join(arguments.ignore)] if arguments.ignore else []
    words += points
    words += [] if lines_given else ["--seed", str(arguments.seed)]
    words += ["--method", arguments.method]
    flags = {**settings_of(arguments), **{name: getattr(arguments, name) for name in ("device", "threads", "memory")}}
    for name, value in flags.items():
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    words += ["--schemes", *arguments.schemes] if arguments.schemes else []
    words += [] if arguments.releases == 1 else ["--releases", str(arguments.releases)]
    words += [] if arguments.views is None else ["--views", str(arguments.views)]
    words += [] if arguments.photographs is None else ["--photographs", arguments.photographs]
    words += ["--metric"] if arguments.metric else []
    words += [] if arguments.queries == MOST_QUERIES else ["--queries", str(arguments.queries)]
    words += [] if arguments.matches == BY_TRACKS else ["--matches", arguments.matches]
    words += [] if arguments.wrong == WRONG else ["--wrong", f"{arguments.wrong:.15g}"]
    for name in ("localize", "recovered"):
        words += [f"--{name}", getattr(arguments, name)] if getattr(arguments, name) is not None else []
    return printable(shlex.join(words))
