"""Tables that the command line prints."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from l2p.errors import InputError, sentence
from l2p.io.colmap_folders import model_folder
from l2p.io.descriptors import file_beside
from l2p.io.hidden_files import load_hidden
from l2p.io.kinds import HIDDEN_MAPS, SCENES, Kind, kind_of
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_scene, load_truth
from l2p.io.taken_for import taken_for
from l2p.judging.measure import Figure, Form, figures
from l2p.judging.scores import Scores
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud
from l2p.maps.scene import Scene
from l2p.schemes.recognition import recognise
from l2p.schemes.rounding import resolution_words
from l2p.utility.localization import Localization

if TYPE_CHECKING:
    from l2p.attacks.learned.checkpoint import Checkpoint

#: Width of tables in characters when stdout is no terminal: the default of 80 is too narrow.
FILE_WIDTH = 140

#: Format of each kind of figure.
_FORMS = {Form.COUNT: "d", Form.LENGTH: ".4g", Form.SPACINGS: ".3f", Form.SHARE: ".1%", Form.NUMBER: ".3f"}


def print_scores(columns: dict[str, Scores], by_spacing: bool = True) -> None:
    """Print the figures of each column to stdout, or only those that are not measured by the spacing."""
    table = Table(*("", *columns), title="error of the recovered points")
    for figure in figures():
        if figure.by_spacing and not by_spacing:
            continue
        if any(scores.figures[figure.name] is not None for scores in columns.values()):
            table.add_row(figure.heading, *(_figure(figure, scores) for scores in columns.values()))
    console().print(table)


def _figure(figure: Figure, scores: Scores) -> str:
    value = scores.figures[figure.name]
    if value is None:
        return "-"
    return figure.counted(value, scores.lines) or format(value, _FORMS[figure.form])


def print_shares(rows: dict[str, list[float]], columns: list[str]) -> None:
    """Print the share of points within 1 spacing of each attacker (rows) at each fraction (columns) to stdout."""
    cells = [[attacker, *(f"{share:.1%}" for share in shares)] for attacker, shares in rows.items()]
    print_rows("points within 1 spacing", ["attacker sees", *columns], cells)


def print_rows(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table of texts to stdout."""
    table = Table(*heads, title=title)
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    console().print(table)


def print_localization(found: Localization) -> None:
    """Print the figures of each release to stdout."""
    unit = "m" if found.metric else "% of extent"
    heads = ["published", "share", "wrong matches", "matches", f"position ({unit})", "rotation (deg)"]
    title = f"median errors of {len(found.trials[0].attempts)} queries"
    table = Table(*heads, *(f"within {limit}" for limit in found.limits), "s / query", title=title)
    for trial in found.trials:
        position = found.position(trial) * (1 if found.metric else 100)
        table.add_row(
            trial.scheme,
            f"{100 * trial.fraction:g} %",
            "-" if trial.wrong is None else f"{100 * trial.wrong:g} %",
            f"{trial.matches:.0f}",
            *("not found" if math.isinf(value) else f"{value:.3g}" for value in (position, trial.rotation)),
            *(f"{trial.within(limit, found.extent):.0%}" for limit in found.limits),
            f"{trial.seconds:.2f}",
        )
    console().print(table)


def print_info(path: str | PathLike[str], columns: str | None = None) -> None:
    """Print a description of a file to stdout; for a checkpoint, also its results on the held-back clouds.

    Parameters
    ----------
    path : path
    columns : str, optional
        What the columns of a text or npy file hold (``--columns``).

    Raises
    ------
    FileNotFoundError, InputError
        As for the reader of that kind of file.
    """
    kind = kind_of(path, columns)
    table = Table("what", kind.value, title=escape(Path(path).name))
    tables = [table]
    if kind is Kind.CHECKPOINT:
        from l2p.attacks.learned.checkpoint import digest, read

        checkpoint = read(path)
        rows = [*_describe_checkpoint(checkpoint), ("digest", digest(path))]
        tables += _held_back(checkpoint.facts.get("results"))
    else:
        rows = _describe(path, kind, columns)
    for what, value in rows:
        table.add_row(what, escape(value))
    for each in tables:
        console().print(each)


def descriptor_text(appearance: Appearance) -> str:
    """Describe descriptors: ``sift, 128 x uint8``, or ``no``."""
    descriptor = appearance.descriptor
    return "no" if descriptor is None else f"{appearance.descriptor_kind}, {descriptor.shape[1]} x {descriptor.dtype}"


def console() -> Console:
    """Return stdout as a console that is wide enough for tables, even if it is no terminal."""
    return Console(file=sys.stdout, width=None if sys.stdout.isatty() else FILE_WIDTH)


def _describe(path: str | PathLike[str], kind: Kind, columns: str | None) -> Sequence[tuple[str, str]]:
    if kind in HIDDEN_MAPS or kind in SCENES:
        content = load_hidden(path, columns) if kind in HIDDEN_MAPS else load_scene(path, columns)
        taken = ("taken for", taken_for(path, content, columns).split(": ", 1)[1])
        return [taken, *(_describe_scene(path, content) if isinstance(content, Scene) else _describe_hidden(content))]
    return _describe_recovery(path) if kind is Kind.RECOVERY else _describe_truth(path)


def _describe_hidden(cloud: LineCloud | PlaneCloud | PermutedCloud) -> list[tuple[str, str]]:
    known = _describe_appearance(cloud.appearance)
    names = " and ".join(word for word, value in known if value != "no")
    what = element_name(type(cloud))
    gives = f"the {what}; an attacker also uses the {names}" if names else f"the {what} alone"
    rows = [(what, str(len(cloud))), ("scheme", cloud.scheme), *known]
    if isinstance(cloud, LineCloud):
        from l2p.attacks.apart import far_words
        from l2p.geometry.parts import parts_of

        found = recognise(cloud)
        rows.insert(2, ("recognised", found.sentence))
        parts = parts_of(cloud) if found.expected else []
        if len(parts) > 1:
            rows.insert(3, ("far apart", far_words([len(part) for part in parts])))
    if isinstance(cloud, LineCloud) and cloud.second is not None:
        rows.append(("points of a line", "two, each with its own appearance"))
    return [*rows, ("gives away", gives)]


def element_name(published: type[Any]) -> str:
    """What the elements of such a hidden map are called, in the plural."""
    return {LineCloud: "lines", PlaneCloud: "planes", PermutedCloud: "permuted points"}[published]


def _describe_scene(path: str | PathLike[str], scene: Scene) -> list[tuple[str, str]]:
    cameras = "unknown" if scene.camera_centers is None else str(len(scene.camera_centers))
    tracks = "unknown" if scene.track_length is None else f"{np.median(scene.track_length):g} images (median)"
    return [
        ("points", str(len(scene))),
        *_extent(scene.xyz),
        ("resolution", resolution_words(scene.xyz, noticed=0) or "double precision"),
        *_describe_appearance(scene.appearance),
        *_beside(path),
        ("ids", _yes(scene.ids)),
        ("track length", tracks),
        ("cameras", cameras),
    ]


def _describe_appearance(appearance: Appearance) -> list[tuple[str, str]]:
    return [("colours", _yes(appearance.rgb)), ("descriptors", descriptor_text(appearance))]


def _beside(path: str | PathLike[str]) -> list[tuple[str, str]]:
    """The file beside a COLMAP model whose descriptors could be published."""
    if kind_of(path) is not Kind.SCENE_MODEL:
        return []
    try:
        file = file_beside(path)
        folder = model_folder(path, say=False)
        return [("descriptors beside it", "no" if file is None else os.path.relpath(file, folder))]
    except (InputError, OSError) as error:
        return [("descriptors beside it", sentence(error))]


def _describe_recovery(path: str | PathLike[str]) -> list[tuple[str, str]]:
    recovery = load_recovery(path)
    low, middle, high = np.quantile(recovery.confidence, (0.25, 0.5, 0.75))
    return [
        ("points", str(len(recovery))),
        ("kept", str(len(recovery) if recovery.kept is None else int(recovery.kept.sum()))),
        ("method", str(recovery.info.get("method", "unknown"))),
        *_checkpoint_of(recovery.info.get("settings")),
        *_recognised(recovery.info.get("recognised")),
        (
            f"confidence{'' if recovery.calibrated else ', ranks only'} (quartiles)",
            f"{low:.2f} {middle:.2f} {high:.2f}",
        ),
        *_extent(recovery.xyz),
        ("colours", _yes(recovery.rgb)),
    ]


def _recognised(found: Any) -> list[tuple[str, str]]:
    """What the lines of a recovery were recognised as, if its file says it."""
    if not isinstance(found, dict) or "sentence" not in found:
        return []
    return [("lines recognised", str(found["sentence"]))]


def _checkpoint_of(settings: Any) -> list[tuple[str, str]]:
    """Describe the checkpoint of a recovery, if its method has one."""
    if not isinstance(settings, dict) or "checkpoint" not in settings:
        return []
    return [("checkpoint", f"{settings['checkpoint']} ({settings.get('digest', 'no digest')})")]


def _describe_checkpoint(checkpoint: Checkpoint) -> list[tuple[str, str]]:
    """Describe sizes and training of a checkpoint; each fact may be missing."""
    size, config, facts = checkpoint.network.config, checkpoint.config, checkpoint.facts
    scenes = facts.get("scenes")
    trained = {
        "trained at commit": facts.get("commit"),
        "seed": facts.get("seed"),
        "training steps": facts.get("steps"),
        "training minutes": facts.get("minutes"),
        "training scenes": len(scenes) if isinstance(scenes, list) else None,
    }
    return [
        ("parameters", str(sum(value.numel() for value in checkpoint.network.parameters()))),
        ("width, layers, heads", f"{size.width}, {size.layers}, {size.heads}"),
        ("rounds", str(config.rounds)),
        ("candidates", str(config.candidates)),
        *((what, "unknown" if value is None else str(value)) for what, value in trained.items()),
        *(("trained before", _training(each)) for each in _dicts(facts.get("before"))),
    ]


def _training(facts: dict[str, Any]) -> str:
    """An earlier training, in a few words."""
    return f"{facts.get('steps')} steps, {facts.get('minutes')} minutes, at commit {facts.get('commit')}"


def _dicts(value: Any) -> list[dict[str, Any]]:
    """The dicts of what should be a list of them; a file may hold anything."""
    return [each for each in value if isinstance(each, dict)] if isinstance(value, list) else []


def _held_back(results: Any) -> list[Table]:
    """Table of the held-back line clouds; empty if the training recorded none."""
    rows = _dicts(results)
    if not rows:
        return []
    columns: list[tuple[str, str, Callable[[float], str]]] = [
        ("scene", "scene", str),
        ("fraction of the points", "fraction", lambda value: f"{100 * value:g}%"),
        ("lines", "lines", str),
        ("attacker knows", "known", str),
        ("median error by round (spacings)", "median", lambda value: f"{value:.3f}"),
        ("within 1 spacing by round", "within", lambda value: f"{value:.1%}"),
        ("most confident half within 1", "confident_half", lambda value: f"{value:.1%}"),
        ("calibration error", "calibration_error", lambda value: f"{value:.3f}"),
    ]
    table = Table(*(heading for heading, _, _ in columns), title="held-back line clouds, in spacings of their own")
    for row in rows:
        table.add_row(*(escape(_figures(row.get(name), form)) for _, name, form in columns))
    return [table]


def _figures(value: Any, form: Callable[[float], str]) -> str:
    """Format a figure, or one per round; anything but a number stays as it is."""
    if value is None:
        return "-"
    values = value if isinstance(value, list) else [value]
    return " ".join(form(each) if isinstance(each, int | float) else str(each) for each in values)


def _describe_truth(path: str | PathLike[str]) -> list[tuple[str, str]]:
    truth = load_truth(path)
    return [
        ("points", str(len(truth))),
        ("spacing (scene units)", f"{truth.spacing:.4g}"),
        *_extent(truth.xyz),
        ("ids", _yes(truth.ids)),
        ("seed", "not stored" if truth.seed is None else str(truth.seed)),
    ]


def _extent(xyz: np.ndarray) -> list[tuple[str, str]]:
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    return [(f"{axis} from, to", f"{a:.4g}, {b:.4g}") for axis, a, b in zip("xyz", low, high, strict=True)]


def _yes(value: object) -> str:
    return "no" if value is None else "yes"
