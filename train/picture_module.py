"""Training of the inversion network: crops of photographs, and the points that lie in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional
from torch.utils.data import DataLoader

from l2p.images.inversion import Inversion
from l2p.images.picture import draw
from l2p.images.picture_points import PicturePoints
from l2p.images.projection import Marks, marks, sighted
from l2p.images.similarity import likeness, ssim
from l2p.images.views import View
from l2p.maps.appearance import Appearance
from l2p.maps.scene import Scene
from train.averaged import AveragedModule
from train.picture_clouds import KNOWN, PictureCloud, PictureMap
from train.picture_config import PictureSettings

#: Weights of the parts of the loss beside the absolute error: squared error, structure, and differences of neighbours.
_SQUARE, _STRUCTURE, _GRADIENT = 2.0, 0.5, 0.5
#: Largest change of the brightness of a channel, with which photographs and colours are varied.
_TINT = 0.15
#: Names of the validation figures.
_FIGURES = ("val/score", "val/ssim", "val/psnr")


class Crop(NamedTuple):
    """Part of a photograph, the points in it, and the pixels that are of the photograph."""

    marks: Marks
    photograph: Float[Tensor, "3 side side"]
    inside: Float[Tensor, "1 side side"]


class Held(NamedTuple):
    """A held-back view, and the points to make its picture from, with the names of both."""

    map: str
    known: str
    view: View
    photograph: UInt8[np.ndarray, "height width 3"]
    points: PicturePoints


class PictureModule(AveragedModule):
    """Module of the trained ``network`` and its moving ``average``."""

    network: Inversion
    average: Inversion

    def __init__(
        self, network: Inversion, settings: PictureSettings, maps: Sequence[PictureMap], held: Sequence[Held]
    ) -> None:
        super().__init__(network, settings)
        self.settings, self.maps, self.held = settings, maps, held

    def val_dataloader(self) -> DataLoader[int]:
        """Return the numbers of the held-back views of this rank, padded so that all ranks have equally many."""
        ranks = self.trainer.world_size
        most = math.ceil(len(self.held) / ranks) * ranks
        return DataLoader(range(self.global_rank, most, ranks), batch_size=None)  # type: ignore[arg-type]

    def training_step(self, batch: int, batch_idx: int) -> Tensor:
        """Compute the loss of some crops, drawn by the number of the step so that a continued run goes on."""
        rng = np.random.default_rng([self.settings.seed, self.global_step, self.global_rank])
        side = self.settings.crop
        crops = [self._crop(rng) for _ in range(self.settings.crops)]
        photograph = torch.stack([crop.photograph for crop in crops]).to(self.device)
        inside = torch.stack([crop.inside for crop in crops]).to(self.device)
        together = joined([crop.marks for crop in crops], side * side)
        together = Marks(*(part.to(self.device) for part in together))
        picture = self.network(together, (len(crops), side, side))
        loss, figures = picture_loss(picture, photograph, inside)
        self.log_dict({f"train/{name}": value for name, value in figures.items()}, batch_size=1)
        self.log("loss", loss.detach(), prog_bar=True, logger=False, batch_size=1)
        return loss

    def validation_step(self, batch: int, batch_idx: int) -> None:
        """Make the picture of a held-back view with the averaged network."""
        figures = torch.zeros(len(_FIGURES))
        if batch < len(self.held):
            held = self.held[batch]
            picture = draw(self.average, held.points, held.view)
            found = likeness(picture, held.photograph)
            figures = torch.tensor([1 - found.ssim, found.ssim, found.psnr]) / len(self.held)
        self.log_sums(_FIGURES, figures)

    def _crop(self, rng: np.random.Generator) -> Crop:
        """Draw a crop: a map, a view of it, its points or recovered ones, what of their appearance is known."""
        settings, side = self.settings, self.settings.crop
        chosen = self.maps[int(rng.integers(len(self.maps)))]
        view, photograph = chosen.views[int(rng.integers(len(chosen.views)))]
        if rng.random() < settings.recovered:
            cloud = chosen.recovered[int(rng.integers(len(chosen.recovered)))]
        else:
            cloud = thinned(chosen.true, rng, least=min(settings.fractions))
        appearance = partly(chosen.scene, rng, settings.absent).rows(cloud.index)
        found = marks(sighted(cloud.xyz, cloud.confidence, view), appearance, cloud.confidence)
        image = torch.from_numpy(photograph).permute(2, 0, 1).float() / 255
        if rng.random() < 0.5:
            image, found = image.flip(2), found._replace(place=_mirrored(found.place, view.width))
        if appearance.rgb is not None:
            tint = torch.from_numpy(rng.uniform(1 - _TINT, 1 + _TINT, 3).astype(np.float32))
            image = (image * tint[:, None, None]).clamp(0, 1)
            found = found._replace(color=(found.color * tint).clamp(0, 1))
        top, left = (int(rng.integers(min(0, size - side), max(0, size - side) + 1)) for size in image.shape[1:])
        return Crop(*_cut(found, image, top, left, side))


def thinned(cloud: PictureCloud, rng: np.random.Generator, least: float) -> PictureCloud:
    """Keep a random share of the points, log-uniform from ``least`` to 1."""
    count = max(1, round(len(cloud.xyz) * math.exp(rng.uniform(math.log(least), 0))))
    some = rng.permutation(len(cloud.xyz))[:count]
    return PictureCloud(cloud.xyz[some], cloud.index[some], cloud.confidence[some])


def partly(scene: Scene, rng: np.random.Generator, absent: float) -> Appearance:
    """Leave out colours, and descriptors, by chance."""
    gone = [name for name in scene.appearance.names if rng.random() < absent]
    return scene.appearance.without(gone)


def joined(parts: Sequence[Marks], pixels: int) -> Marks:
    """Join the points of several pictures of so many pixels."""
    shifted = [part._replace(place=part.place + number * pixels) for number, part in enumerate(parts)]
    return Marks(*(torch.cat(columns) for columns in zip(*shifted, strict=True)))


def picture_loss(
    picture: Float[Tensor, "pictures 3 height width"],
    photograph: Float[Tensor, "pictures 3 height width"],
    inside: Float[Tensor, "pictures 1 height width"],
) -> tuple[Tensor, dict[str, Tensor]]:
    """Compare pictures with photographs inside of these: values, structure, and differences of neighbours.

    The squared error is what PSNR counts; it makes the network cautious where nothing is known.
    """
    picture, photograph = picture * inside, photograph * inside
    share = inside.mean()
    value = functional.l1_loss(picture, photograph) / share
    square = functional.mse_loss(picture, photograph) / share
    structure = (1 - ssim(picture, photograph)) / share
    across = functional.l1_loss(picture.diff(dim=3), photograph.diff(dim=3)) / share
    down = functional.l1_loss(picture.diff(dim=2), photograph.diff(dim=2)) / share
    total = value + _SQUARE * square + _STRUCTURE * structure + _GRADIENT * (across + down)
    return total, {"total": total, "value": value, "structure": structure}


def _mirrored(place: Tensor, width: int) -> Tensor:
    return place // width * width + (width - 1 - place % width)


def _cut(found: Marks, image: Tensor, top: int, left: int, side: int) -> tuple[Marks, Tensor, Tensor]:
    """Cut a square; a photograph smaller than it is surrounded by 0."""
    height, width = image.shape[1:]
    row, column = found.place // width - top, found.place % width - left
    kept = (row >= 0) & (row < side) & (column >= 0) & (column < side)
    found = Marks(*(part[kept] for part in found))._replace(place=(row * side + column)[kept])
    whole, inside = torch.zeros(3, side, side), torch.zeros(1, side, side)
    rows = slice(max(0, -top), min(side, height - top))
    columns = slice(max(0, -left), min(side, width - left))
    source = slice(max(0, top), top + rows.stop), slice(max(0, left), left + columns.stop)
    whole[:, rows, columns] = image[:, source[0], source[1]]
    inside[:, rows, columns] = 1
    return found, whole, inside


def held_views(maps: Sequence[PictureMap], views: int) -> list[Held]:
    """Choose some views of each map, evenly; for each its points, and those recovered by all that the map has."""
    held = []
    for chosen in maps:
        some = np.linspace(0, len(chosen.views) - 1, min(views, len(chosen.views))).round().astype(int)
        for number in some:
            view, photograph = chosen.views[int(number)]
            for name, cloud in zip(("true", *KNOWN), (chosen.true, *chosen.recovered), strict=True):
                points = PicturePoints(cloud.xyz, cloud.confidence, chosen.scene.appearance.rows(cloud.index))
                held.append(Held(chosen.name, name, view, photograph, points))
    return held
