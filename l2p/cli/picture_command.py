"""Command ``l2p picture``: what a camera would have seen, from points, recovered points or rays."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from l2p.cli.outputs import check_outputs, figures_file, file_of
from l2p.errors import InputError
from l2p.io.endings import checked_ending
from l2p.io.image_files import IMAGE_ENDINGS, image_bytes
from l2p.io.kinds import LINE_CLOUDS, SCENES, Kind, kind_of

if TYPE_CHECKING:
    from l2p.images.picture_points import PicturePoints
    from l2p.images.views import View
    from l2p.maps.scene import Scene

#: Size of a picture of a placed camera, and of a panorama, pixels.
_SIZE, _PANORAMA = (320, 240), (640, 320)


def picture(arguments: Namespace) -> None:
    """Run ``l2p picture``."""
    given = (arguments.source, arguments.model, arguments.lines, arguments.weights)
    inputs = [path for path in given if path is not None]
    check_outputs(inputs, [arguments.output, file_of(arguments.json)], arguments.force)
    ending = checked_ending(arguments.output, "a picture", dict.fromkeys(IMAGE_ENDINGS, ()))
    kind = kind_of(arguments.source)
    if kind is Kind.SCENE_MODEL and arguments.model is None:
        arguments.model = arguments.source
    _check_view(arguments, kind)
    from l2p.images.inversion_file import load_inversion
    from l2p.images.picture import draw
    from l2p.images.projection import sighted
    from l2p.io.atomic import atomic_file

    points, view = _points_and_view(arguments, kind)
    appearance = points.appearance.without(arguments.ignore)
    points = points._replace(appearance=appearance)
    network, _ = load_inversion(arguments.weights)
    made = draw(network, points, view)
    shown = len(sighted(points.xyz, points.confidence, view).row)
    figures = {"points": len(points.xyz), "shown": shown, "used": list(appearance.names)}
    figures |= _against_photograph(arguments, view, made)
    with figures_file(arguments, figures), atomic_file(arguments.output, overwrite=arguments.force) as file:
        file.write(image_bytes(made, ending))
    if arguments.json != "-":
        print(f"{arguments.output}: {view.width} x {view.height} pixels from {shown} of {len(points.xyz)} points")
        if not appearance.names:
            print("Neither colours nor descriptors are known, so that the picture shows little.")
        if "ssim" in figures:
            print(f"Against the photograph: SSIM {figures['ssim']:.2f}, PSNR {figures['psnr']:.1f} dB")


def _check_view(arguments: Namespace, kind: Kind) -> None:
    """Refuse views that contradict each other, before anything is loaded."""
    if kind not in SCENES and kind not in LINE_CLOUDS and kind is not Kind.RECOVERY:
        raise InputError(f"{arguments.source} is {kind.value}; expected a recovery, a scene or a line cloud")
    if arguments.view is not None and arguments.at is not None:
        raise InputError("got --view and --at; expected one of them")
    if (arguments.at is None) != (arguments.toward is None):
        raise InputError("got one of --at and --toward; expected both: where a camera stands, and what it looks at")
    if arguments.view is not None and arguments.model is None:
        raise InputError(f"got --view {arguments.view} without --model; expected the model that has this image")
    if arguments.lines is not None and kind is not Kind.RECOVERY:
        raise InputError("got --lines beside something else than a recovery; expected the lines of a recovery")
    if kind not in LINE_CLOUDS and arguments.view is None and arguments.at is None:
        raise InputError("got no view; expected --view NAME of the model, or --at X,Y,Z --toward X,Y,Z")


def _points_and_view(arguments: Namespace, kind: Kind) -> tuple[PicturePoints, View]:
    import numpy as np

    from l2p.images.panorama import rays_seen
    from l2p.images.views import panorama_view, placed_view, view_of
    from l2p.io.colmap import read_model
    from l2p.io.line_files import load_lines

    up = np.array(arguments.up)
    size = arguments.size or (_PANORAMA if kind in LINE_CLOUDS else _SIZE)
    if kind in LINE_CLOUDS:
        points, center = rays_seen(load_lines(arguments.source), arguments.center)
        if arguments.view is None and arguments.at is None:
            return points, panorama_view(center, up, size[0])
    else:
        points = points_at(arguments.source, kind, arguments.lines)
    if arguments.view is not None:
        return points, view_of(read_model(arguments.model), arguments.view)
    at, toward = np.array(arguments.at), np.array(arguments.toward)
    return points, placed_view(at, toward, up, angle=arguments.angle, width=size[0], height=size[1])


def points_at(path: str, kind: Kind, lines: str | None) -> PicturePoints:
    """Read the points of a scene, or of a recovery with the descriptors of its lines."""
    from l2p.images.picture_points import points_of
    from l2p.io.line_files import load_lines
    from l2p.io.recovery_files import load_recovery

    if kind is Kind.RECOVERY:
        return points_of(load_recovery(path), None if lines is None else load_lines(lines))
    return points_of(_scene(path))


def _scene(path: str) -> Scene:
    """Read a scene, with the descriptors that it has or that lie beside it."""
    from l2p.io.descriptors import file_beside, load_described
    from l2p.io.scene_files import load_scene

    if kind_of(path) is Kind.SCENE_MODEL and file_beside(path) is not None:
        return load_described(path)[0]
    return load_scene(path)


def _against_photograph(arguments: Namespace, view: View, made: object) -> dict[str, float]:
    """Compare with the photograph, if the view has one."""
    if arguments.view is None:
        return {}
    from l2p.images.photographs import folder_beside, photograph
    from l2p.images.similarity import likeness

    folder = arguments.photographs or folder_beside(arguments.model)
    if folder is None or (arguments.photographs is None and not (Path(folder) / view.name).is_file()):
        return {}
    return likeness(made, photograph(folder, view))._asdict()  # type: ignore[arg-type]
