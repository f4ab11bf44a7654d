"""Command ``l2p localize``: how well the images of a model are localized in releases of its map."""

from __future__ import annotations

from argparse import Namespace
from contextlib import ExitStack

from l2p.cli.lift import printable
from l2p.cli.outputs import check_outputs, figures_file, file_of
from l2p.io.atomic import atomic_file
from l2p.io.csv_rows import csv_bytes
from l2p.io.kinds import kind_of
from l2p.show.tables import print_localization
from l2p.work.progress import terminal_progress


def localize(arguments: Namespace) -> None:
    """Run ``l2p localize``."""
    inputs = [path for path in (arguments.scene, arguments.features) if path is not None]
    check_outputs(inputs, [file_of(arguments.json), arguments.csv], arguments.force)
    kind_of(arguments.scene)  # which refuses what is missing or of no kind, before torch is loaded
    from l2p.utility.releases import localize as localized

    found = localized(
        arguments.scene,
        arguments.schemes,
        arguments.fractions,
        matching=arguments.matches,
        wrong=arguments.wrong,
        features=arguments.features,
        most_queries=arguments.queries,
        gravity=None if arguments.gravity is None else tuple(arguments.gravity),
        metric=arguments.metric,
        seed=arguments.seed,
        progress=terminal_progress(),
        name=printable(arguments.scene),
    )
    with ExitStack() as stack:
        if arguments.csv is not None:
            stack.enter_context(atomic_file(arguments.csv, overwrite=arguments.force)).write(csv_bytes(found.rows()))
        stack.enter_context(figures_file(arguments, found.as_dict()))
    if arguments.json != "-":
        print_localization(found)
