"""Masks of images: the points that an image sees in a black pixel, as a slow loop finds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import l2p
from l2p.errors import InputError
from l2p.io.colmap import read_model
from l2p.io.mask_files import marked_by_masks
from l2p.simulator import simulate_model


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A simulated COLMAP model."""
    folder = tmp_path_factory.mktemp("simulated") / "model"
    simulate_model("room", 300, 2).save_colmap(folder)
    return folder


@pytest.fixture(scope="module")
def model(folder):
    return read_model(folder)


@pytest.fixture(scope="module")
def ids(folder) -> np.ndarray:
    ids = l2p.load(folder, l2p.Scene).ids
    assert ids is not None
    return ids


def names_of(model) -> list[str]:
    return sorted(image.name for image in model.images.values())


def size_of(model) -> tuple[int, int]:
    """Width, height of all cameras."""
    (size,) = {(camera.width, camera.height) for camera in model.cameras.values()}
    return size


def grey_of(model, rng: np.random.Generator, share: float = 0.1) -> np.ndarray:
    """A picture, black in coarse blocks."""
    width, height = size_of(model)
    shape = (height // 16 + 1, width // 16 + 1)
    blocks = np.where(rng.random(shape) < share, 0, rng.integers(1, 256, shape)).astype(np.uint8)
    return np.repeat(np.repeat(blocks, 16, axis=0), 16, axis=1)[:height, :width]


def save(grey: np.ndarray, path: Path, mode: str = "L") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(grey)
    if mode == "1":
        image = Image.fromarray(grey > 0)
    elif mode == "I;16":
        image = Image.fromarray(grey.astype(np.uint16))
    elif mode == "P":
        # Colours by number, in which number 0 is white.
        image = Image.fromarray((grey == 0).astype(np.uint8))
        image.putpalette([255, 255, 255, 0, 0, 0])
    elif mode != "L":
        image = image.convert(mode)
    image.save(path, compress_level=1)


def slowly(model, ids: np.ndarray, masks: dict[str, np.ndarray]) -> list[bool]:
    """Whether each point is seen in a black pixel, observation by observation from the side of the images."""
    marked = set()
    for image in model.images.values():
        grey = masks.get(image.name)
        if grey is None:
            continue
        for keypoint in image.points2D:
            if keypoint.has_point3D():
                x, y = (int(np.floor(value)) for value in keypoint.xy)
                outside = not (0 <= x < grey.shape[1] and 0 <= y < grey.shape[0])
                if outside or grey[y, x] == 0:
                    marked.add(keypoint.point3D_id)
    return [key in marked for key in ids.tolist()]


@pytest.mark.parametrize("mode", ["L", "1", "I;16", "P", "RGB", "RGBA", "LA"])
def test_points_are_those_that_a_loop_finds(model, ids, tmp_path, rng, mode):
    masks = {name: grey_of(model, rng) for name in names_of(model)[::6]}
    for name, grey in masks.items():
        save(grey, tmp_path / f"{name}.png", mode)
    found = marked_by_masks(tmp_path, model, ids)
    assert found.points.tolist() == slowly(model, ids, masks)
    assert 0 < found.points.sum() < len(ids)
    assert found.masks == len(masks) and found.images == len(names_of(model))


def test_one_image_is_enough_and_black_or_white_masks_are_all_or_nothing(model, ids, tmp_path):
    width, height = size_of(model)
    name = names_of(model)[0]
    save(np.full((height, width), 255, np.uint8), tmp_path / f"{name}.png")
    outside = marked_by_masks(tmp_path, model, ids).points.sum()
    save(np.zeros((height, width), np.uint8), tmp_path / f"{name}.png")
    (image,) = (image for image in model.images.values() if image.name == name)
    seen = {keypoint.point3D_id for keypoint in image.points2D if keypoint.has_point3D()}
    assert marked_by_masks(tmp_path, model, ids).points.tolist() == [key in seen for key in ids.tolist()]
    assert outside == 0, "no keypoint of the simulator is outside of its picture"


def test_masks_are_found_with_the_ending_of_the_image_or_in_its_place(model, ids, tmp_path, rng):
    name = names_of(model)[1]
    masks = [grey_of(model, rng), grey_of(model, rng)]
    for folder, files in (("a", [f"{name}.png"]), ("b", [f"{Path(name).stem}.png"])):
        save(masks[0], tmp_path / folder / files[0])
    both = tmp_path / "both"
    save(masks[0], both / f"{name}.png")
    save(masks[1], both / f"{Path(name).stem}.png")
    a, b, together = (marked_by_masks(tmp_path / folder, model, ids).points for folder in ("a", "b", "both"))
    np.testing.assert_array_equal(a, b)
    assert together.tolist() == slowly(model, ids, {name: np.minimum(*masks)})


def test_images_in_folders_have_masks_in_folders(ids, folder, tmp_path, rng):
    model = read_model(folder)
    for image in model.images.values():
        image.name = f"left/{image.image_id % 2}/{image.name}"
    name = names_of(model)[2]
    grey = grey_of(model, rng)
    save(grey, tmp_path / f"{name}.png")
    assert marked_by_masks(tmp_path, model, ids).points.tolist() == slowly(model, ids, {name: grey})


def test_keypoints_outside_of_the_picture_count_as_black(write_model, tmp_path):
    folder = write_model(tmp_path / "model")
    model = read_model(folder)
    ids = np.array(sorted(model.point3D_ids()))
    image = next(iter(model.images.values()))
    camera = model.cameras[image.camera_id]
    for row, place in enumerate([(-0.01, 5), (5, camera.height), (camera.width - 0.01, 5), (np.nan, 1)]):
        image.points2D[row].xy = np.array(place, dtype=float)
    save(np.full((camera.height, camera.width), 255, np.uint8), tmp_path / "masks" / f"{image.name}.png")
    found = marked_by_masks(tmp_path / "masks", model, ids)
    black = {image.points2D[row].point3D_id for row in (0, 1, 3) if image.points2D[row].has_point3D()}
    assert black and set(ids[found.points].tolist()) == black


def test_what_is_no_mask_is_refused(model, ids, tmp_path, rng):
    width, height = size_of(model)
    with pytest.raises(InputError, match="is not a folder; expected a folder of masks"):
        marked_by_masks(tmp_path / "absent", model, ids)
    with pytest.raises(InputError, match=rf"has no mask of the \d+ images .* such as {names_of(model)[0]}\.png"):
        marked_by_masks(tmp_path, model, ids)
    path = tmp_path / f"{names_of(model)[0]}.png"
    save(np.full((height, width - 1), 255, np.uint8), path)
    with pytest.raises(
        InputError, match=f"has {width - 1} x {height} pixels; expected the {width} x {height} of the c"
    ):
        marked_by_masks(tmp_path, model, ids)
    save(grey_of(model, rng), path)
    whole = path.read_bytes()
    for content in (b"", b"PNG", whole[:20], whole[:-30], whole[: len(whole) // 2], whole[:50] + b"\0" * 200):
        path.write_bytes(content)
        with pytest.raises(InputError, match="is no readable picture; expected a PNG"):
            marked_by_masks(tmp_path, model, ids)
    with pytest.raises(InputError, match="the model lacks the point 999999"):
        marked_by_masks(tmp_path, model, np.array([999999]))
