"""Pictures of maps with photographs: how like the photographs they are, and sheets of them to look at.

    python benchmarks/pictures.py ../shared/maps/val/* --folder runs/pictures --sheets docs/images

Recoveries are stored in ``--folder`` and computed once. Tables: pictures from true and from recovered points beside
filling between coloured points; pictures at shares of the points; panoramas of maps whose lines meet in centres,
compared with the picture that the true points give there; seconds a picture. ``--weights`` judges another network.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from harness import print_table
from jaxtyping import UInt8

import l2p
from l2p.attacks.run import run
from l2p.images.filling import gaussian_fill
from l2p.images.inversion import Inversion
from l2p.images.inversion_file import load_inversion
from l2p.images.panorama import rays_seen
from l2p.images.picture import draw
from l2p.images.picture_points import PicturePoints, points_of
from l2p.images.similarity import Likeness, likeness
from l2p.images.views import panorama_view
from l2p.judging.accuracy import spacing
from l2p.judging.references import Oracle
from l2p.work.progress import terminal_progress
from train.picture_clouds import PictureCloud, PictureMap, picture_maps

FRACTIONS = (1.0, 0.5, 0.25, 0.1, 0.05)
#: What is known of the points in a picture: attributes to leave out, and which recovery is drawn.
KNOWN = {
    "lines alone": ({"rgb", "descriptor"}, "lines"),
    "+ descriptors": ({"rgb"}, "all"),
    "+ colours": ({"descriptor"}, "all"),
    "+ both": (set(), "all"),
    "known neighbours, + both": (set(), "oracle"),
}


class Judged(NamedTuple):
    """Mean likeness to the photographs, and the share of the points within 1 spacing."""

    psnr: float
    ssim: float
    share: float


def views_of(one: PictureMap, most: int) -> list[int]:
    """Evenly spread views, neither the first nor the last."""
    return [int((place + 0.5) * len(one.views) / most) for place in range(most)]


def points(one: PictureMap, cloud: PictureCloud, hidden: set[str]) -> PicturePoints:
    return PicturePoints(cloud.xyz, cloud.confidence, one.scene.appearance.without(hidden).rows(cloud.index))


def share_right(one: PictureMap, cloud: PictureCloud, scale: float) -> float:
    return float((np.linalg.norm(cloud.xyz - one.scene.xyz[cloud.index], axis=1) <= scale).mean())


def clouds_of(one: PictureMap) -> dict[tuple[str, float], PictureCloud]:
    """Recovered points by attack and fraction, those of known neighbours included."""
    names = [(known, fraction) for fraction in FRACTIONS for known in ("lines", "all")]
    found = dict(zip(names, one.recovered, strict=True))
    for fraction in FRACTIONS:
        hidden = l2p.hide(one.scene, 0, fraction)
        recovery = run(hidden.map, Oracle(hidden.truth.xyz, k=min(50, len(hidden.map) - 1)))
        confidence = np.ones(len(recovery), dtype=np.float32)
        found["oracle", fraction] = PictureCloud(recovery.xyz, hidden.truth.index, confidence)
    return found


def mean_likeness(one: PictureMap, seen: PicturePoints, rows: Sequence[int], network: Inversion | None) -> Likeness:
    """Mean over views; without a network, of filling."""
    found = []
    for row in rows:
        view, photograph = one.views[row]
        made = gaussian_fill(seen, view) if network is None else draw(network, seen, view)
        found.append(likeness(made, photograph))
    return Likeness(*(float(np.mean(column)) for column in zip(*found, strict=True)))


def print_gain(maps: Sequence[PictureMap], network: Inversion, views: int) -> None:
    """Filling and network, from true and from recovered points, all published."""
    rows, kept = [], []
    for one in maps:
        some = views_of(one, views)
        true, found = points(one, one.true, set()), points(one, one.recovered[1], set())
        fill, net = mean_likeness(one, true, some, None), mean_likeness(one, true, some, network)
        fill_found, net_found = mean_likeness(one, found, some, None), mean_likeness(one, found, some, network)
        kept.append([(net_found.ssim - fill.ssim) / (net.ssim - fill.ssim), net.ssim - fill.ssim, net.psnr - fill.psnr])
        cells = [f"{each.ssim:.3f} / {each.psnr:.2f}" for each in (fill, net, fill_found, net_found)]
        rows.append([one.name, *cells, f"{kept[-1][1]:+.3f} / {kept[-1][2]:+.2f}", f"{kept[-1][0]:.2f}"])
    mean = np.mean(kept, axis=0)
    rows.append(["mean", "", "", "", "", f"{mean[1]:+.3f} / {mean[2]:+.2f}", f"{mean[0]:.2f}"])
    heads = ["map", "true, filled", "true, network", "recovered, filled", "recovered, network", "gain", "gain kept"]
    print_table(f"SSIM / PSNR (dB) of {views} views", heads, rows)


def judged_at(
    maps: Sequence[PictureMap], clouds: Sequence[dict[tuple[str, float], PictureCloud]], network: Inversion, views: int
) -> dict[tuple[str, float], Judged]:
    """Means over the maps, by what is known and fraction."""
    table = {}
    for name, (hidden, attack) in KNOWN.items():
        for fraction in FRACTIONS:
            cells = []
            for one, found in zip(maps, clouds, strict=True):
                cloud, scale = found[attack, fraction], spacing(one.scene.xyz)
                like = mean_likeness(one, points(one, cloud, hidden), views_of(one, views), network)
                cells.append([*like, share_right(one, cloud, scale)])
            table[name, fraction] = Judged(*np.mean(cells, axis=0).tolist())
    return table


def print_shares(table: dict[tuple[str, float], Judged]) -> None:
    rows = [
        [
            name,
            *(f"{each.ssim:.3f} / {each.psnr:.1f} / {each.share:.2f}" for each in (table[name, f] for f in FRACTIONS)),
        ]
        for name in KNOWN
    ]
    heads = ["attacker sees", *(f"{100 * fraction:g} %" for fraction in FRACTIONS)]
    print_table("SSIM / PSNR (dB) / share of the points within 1 spacing, by points published", heads, rows)


class Around(NamedTuple):
    """Panoramas of a map from a centre, by how they were made."""

    true: UInt8[np.ndarray, "height width 3"]
    made: dict[str, UInt8[np.ndarray, "height width 3"]]


def around(one: PictureMap, scheme: str, network: Inversion) -> Around:
    """Panoramas of a sphere cloud, as it is and with fakes told apart; of a ray cloud, from its larger centre, by both
    sides of each line and by the side of the recovered point."""
    hidden = l2p.hide(one.scene, 0, scheme=scheme, rgb=True, descriptor=True)
    recovery = l2p.recover(hidden.map)
    seen, center = rays_seen(hidden.map)
    view = panorama_view(center, np.array([0.0, -1, 0]), 480)
    made = {"as published": draw(network, seen, view)}
    if scheme == "rays":
        side = np.zeros(len(hidden.map))
        side[recovery.element] = np.sum((recovery.xyz - center) * hidden.map.direction[recovery.element], axis=1)
        made["sides recovered"] = draw(network, rays_seen(hidden.map, side=side)[0], view)
    else:
        real = np.zeros(len(hidden.map), dtype=bool)
        real[recovery.element] = recovery.confidence >= np.median(recovery.confidence)
        made["likelier half"] = draw(network, rays_seen(hidden.map, real=real)[0], view)
    # The same points, with their depth.
    made["points recovered"] = draw(network, points_of(recovery, hidden.map), view)
    return Around(draw(network, points(one, one.true, set()), view), made)


def print_around(found: dict[tuple[str, str], Around]) -> None:
    rows = []
    for (scheme, name), each in found.items():
        for how, image in each.made.items():
            like = likeness(image, each.true)
            rows.append([scheme, name, how, f"{like.ssim:.3f} / {like.psnr:.1f}"])
    print_table("Panoramas against that of the true points, SSIM / PSNR (dB)", ["scheme", "map", "made of", ""], rows)


def print_seconds(one: PictureMap, network: Inversion) -> None:
    view, true = one.views[0][0], points(one, one.true, set())
    draw(network, true, view)
    began = time.perf_counter()
    for _ in range(5):
        draw(network, true, view)
    print(f"\n{(time.perf_counter() - began) / 5:.2f} s a picture of {view.width} x {view.height}, one thread\n")


def sheet(path: Path, rows: Sequence[tuple[str, Sequence[np.ndarray]]], heads: Sequence[str]) -> None:
    """Draw rows of pictures with their names."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    ratios = [images[0].shape[0] / images[0].shape[1] for _, images in rows]
    size = (2.1 * len(heads), 2.1 * sum(ratios) + 0.3)
    grid = {"height_ratios": ratios}
    figure, axes = plt.subplots(len(rows), len(heads), figsize=size, squeeze=False, gridspec_kw=grid)
    for (name, images), row in zip(rows, axes, strict=True):
        for image, axis in zip(images, row, strict=True):
            axis.imshow(image)
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        row[0].set_ylabel(name, fontsize=5)
    for head, axis in zip(heads, axes[0], strict=True):
        axis.set_title(head, fontsize=8)
    figure.subplots_adjust(left=0.04, right=0.995, top=1 - 0.25 / size[1], bottom=0.005, wspace=0.03, hspace=0.03)
    figure.savefig(path, dpi=150, pil_kwargs={"quality": 85})
    plt.close(figure)
    print(path)


def sheets(
    folder: Path,
    maps: Sequence[PictureMap],
    clouds: Sequence[dict[tuple[str, float], PictureCloud]],
    panoramas: dict[tuple[str, str], Around],
    network: Inversion,
) -> None:
    """Contact sheets: three views of each map, one view of each at all shares, and panoramas."""
    rows = []
    for one, found in zip(maps, clouds, strict=True):
        for row in views_of(one, 3):
            view = one.views[row][0]
            seen = [points(one, one.true, set()), points(one, found["all", 1.0], set())]
            images = [gaussian_fill(seen[0], view), *(draw(network, each, view) for each in seen)]
            images.append(draw(network, points(one, found["all", 1.0], {"rgb"}), view))
            rows.append((one.name, images))
    heads = ["true points, filled", "true points", "recovered", "recovered, without colours"]
    for number in range(0, len(rows), 6):
        sheet(folder / f"pictures-{number // 6 + 1}.jpg", rows[number : number + 6], heads)
    rows = []
    for one, found in zip(maps, clouds, strict=True):
        view = one.views[views_of(one, 3)[1]][0]
        for name in ("+ both", "known neighbours, + both"):
            hidden, attack = KNOWN[name]
            images = [draw(network, points(one, found[attack, f], hidden), view) for f in FRACTIONS]
            rows.append((f"{one.name}\n{'recovered' if attack == 'all' else 'known neighbours'}", images))
    heads = [f"{100 * fraction:g} %" for fraction in FRACTIONS]
    sheet(folder / "pictures-shares-1.jpg", rows[:6], heads)
    sheet(folder / "pictures-shares-2.jpg", rows[6:], heads)
    for scheme in dict.fromkeys(scheme for scheme, _ in panoramas):
        own = [(name, each) for (of, name), each in panoramas.items() if of == scheme]
        rows = [(name, [each.true, *each.made.values()]) for name, each in own]
        sheet(folder / f"panoramas-{scheme}.jpg", rows, ["true points", *own[0][1].made])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", help="COLMAP models with descriptors and photographs")
    parser.add_argument("--folder", type=Path, required=True, help="where recoveries are stored")
    parser.add_argument("--sheets", type=Path, help="folder for sheets of pictures")
    parser.add_argument("--weights", type=Path, help="weights of python -m train --config-name pictures")
    parser.add_argument("--views", type=int, default=6, help="views of each map")
    parser.add_argument("--schemes", nargs="*", default=["sphere-50", "rays"], help="schemes to look around in")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    network, _ = load_inversion(arguments.weights)
    maps = picture_maps(arguments.maps, FRACTIONS, 0, arguments.folder, terminal_progress())
    clouds = [clouds_of(one) for one in maps]
    print_seconds(maps[0], network)
    print_gain(maps, network, arguments.views)
    print_shares(judged_at(maps, clouds, network, arguments.views))
    panoramas = {(scheme, one.name): around(one, scheme, network) for scheme in arguments.schemes for one in maps}
    print_around(panoramas)
    if arguments.sheets is not None:
        arguments.sheets.mkdir(parents=True, exist_ok=True)
        sheets(arguments.sheets, maps, clouds, panoramas, network)
    return 0


if __name__ == "__main__":
    sys.exit(main())
