"""Command ``l2p lift``: publish a map hidden by a scheme, or a share of its points."""

from __future__ import annotations

import os
from argparse import Namespace
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from l2p.cli.chosen import dropped, warn_of_leaks
from l2p.cli.outputs import check_outputs
from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.io.descriptors import load_described
from l2p.io.hidden_files import hidden_ending, save_hidden
from l2p.io.scene_files import load_scene, save_scene, scene_ending, truth_bytes
from l2p.judging.accuracy import spacing
from l2p.maps.scene import Scene
from l2p.maps.truth import Hiding
from l2p.schemes.hide import hide
from l2p.schemes.rounding import resolution_words
from l2p.schemes.scheme import DEFAULT_SCHEME, published_by
from l2p.show.tables import descriptor_text, element_name
from l2p.utility import POINTS


def lift(arguments: Namespace) -> None:
    """Run ``l2p lift``."""
    given = (arguments.scene, arguments.descriptors or None, arguments.drop_ids, arguments.drop_masks)
    inputs = [path for path in given if path is not None]
    check_outputs(inputs, [arguments.output, arguments.truth], arguments.force)
    described, plain = arguments.descriptors is not None, arguments.scheme == POINTS
    asked = [name for name, wanted in {"rgb": arguments.rgb, "descriptor": described}.items() if wanted]
    if plain and arguments.truth is not None:
        raise InputError("got --truth for points that are published as they are; expected none, as nothing is hidden")
    scheme = DEFAULT_SCHEME if plain else arguments.scheme
    if plain:
        scene_ending(arguments.output, asked)
    else:
        hidden_ending(arguments.output, published_by(scheme), asked)
    scene, source = described_scene(arguments.scene, arguments.descriptors, arguments.columns)
    if arguments.rgb and scene.rgb is None:
        raise InputError(f"{arguments.scene} has no colours; leave out --rgb")
    drop, left_out = dropped(arguments, scene)
    hidden = hide(
        scene, arguments.seed, arguments.fraction, scheme, arguments.rgb, described, drop=drop, cell=arguments.cell
    )
    if plain:
        save_scene(_points_of(hidden, arguments.rgb, described, scene), arguments.output, overwrite=arguments.force)
    else:
        _save_hidden(arguments, hidden, scene)
    made = f"{len(hidden.truth)} points" if plain else f"{len(hidden.map)} {element_name(type(hidden.map))}"
    print(f"{arguments.output}: {made} of {len(scene)} points")
    if left_out:
        print(left_out)
    resolution = resolution_words(scene.xyz)
    if resolution:
        print(f"{resolution}: each point is moved within its step, and is known no better than that")
    if source is not None:
        print(f"descriptors of {printable(str(source))}: {descriptor_text(hidden.map.appearance)}")
    warn_of_leaks(arguments.scene)


def described_scene(path: str, descriptors: str | None, columns: str | None = None) -> tuple[Scene, Path | None]:
    """Read a scene and, unless ``descriptors`` is None, the descriptors of that file; empty: of the one beside it.

    Return it with the file that the descriptors are from.
    """
    return (load_scene(path, columns), None) if descriptors is None else load_described(path, descriptors or None)


def printable(path: str) -> str:
    """Return a path as printable text, even if its bytes are not valid text."""
    return os.fsencode(path).decode("utf-8", errors="replace")


def _points_of(hidden: Hiding, rgb: bool, described: bool, scene: Scene) -> Scene:
    """The chosen points, in random order, with nothing but what is asked for."""
    chosen = scene.rows(hidden.truth.index)
    own = {"rgb": chosen.rgb if rgb else None, "descriptor": chosen.descriptor if described else None}
    return Scene(chosen.xyz, **own, descriptor_kind=chosen.descriptor_kind if described else None)


def _save_hidden(arguments: Namespace, hidden: Hiding, scene: Scene) -> None:
    with ExitStack() as stack:
        if arguments.truth is not None:
            # Renamed after the map is written, so that a failure leaves neither file.
            truth = stack.enter_context(atomic_file(arguments.truth, overwrite=arguments.force))
            truth.write(truth_bytes(replace(hidden.truth, spacing=spacing(scene.xyz))))
        save_hidden(hidden.map, arguments.output, overwrite=arguments.force)
