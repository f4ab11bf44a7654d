"""Describe the points of a COLMAP model anew from its photographs, by OpenCV: descriptors that the checkpoint does not
know, for trials of what an attack teaches itself.

    python benchmarks/describe.py --kind orb -o described ../shared/maps/val/*
    python -m eval experiment=appearance name=orb scenes=[described]

Photographs are those in MODEL/thumbs; they may be smaller than the model's images. Each model becomes an npz scene of
the points that could be described; the others, at the borders of the images, are left out.

It needs OpenCV 4 (pip install "opencv-python-headless<5"), since 5 has no AKAZE. A point's descriptor
is that of its first observation (bits, or with --single), or the mean over its track (numbers).
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.io.colmap import read_model, scene_of_model
from l2p.io.npz import npz_bytes
from l2p.maps.appearance import BINARY_KINDS

KINDS = ("orb", "akaze", "brisk", "sift")
#: Diameter of a keypoint, pixels of the photograph; unknown in a model, so one for all.
SIZE = 12.0


def observations(model: Any, photographs: Path, kind: str, size: float) -> Iterable[tuple[int, np.ndarray]]:
    """Point id and descriptor of each observation that OpenCV can describe."""
    cv2 = opencv()
    maker = {"orb": cv2.ORB_create, "akaze": akaze, "brisk": cv2.BRISK_create, "sift": cv2.SIFT_create}[kind]()
    for _, image in sorted(model.images.items()):
        file = photographs / image.name
        grey = cv2.imread(str(file if file.is_file() else file.with_suffix(".jpg")), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            raise InputError(f"{photographs} has no photograph {image.name}; expected those of the model")
        scale = grey.shape[1] / model.cameras[image.camera_id].width
        seen = [point for point in image.points2D if point.has_point3D()]
        # The rank of a keypoint travels in its response: OpenCV leaves out those at the border.
        keypoints = [
            cv2.KeyPoint(*(float(x) for x in point.xy * scale), size, 0.0, float(rank), 0, 0)
            for rank, point in enumerate(seen)
        ]
        found, descriptor = maker.compute(grey, keypoints)
        for keypoint, row in zip(found, descriptor if descriptor is not None else [], strict=True):
            yield seen[round(keypoint.response)].point3D_id, row


def opencv() -> Any:
    """OpenCV 4, which no part of l2p needs."""
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        raise InputError('OpenCV is missing; pip install "opencv-python-headless<5"') from error


def akaze() -> Any:
    """AKAZE itself finds where its own keypoints are; its descriptor at given places is upright."""
    cv2 = opencv()
    return cv2.AKAZE_create(descriptor_type=cv2.AKAZE_DESCRIPTOR_MLDB_UPRIGHT)


def described(model: Any, photographs: Path, kind: str, size: float, single: bool) -> tuple[np.ndarray, np.ndarray]:
    """Ids of the points that were described, ascending, and their descriptors."""
    rows: dict[int, list[np.ndarray]] = {}
    for point, row in observations(model, photographs, kind, size):
        rows.setdefault(point, []).append(row)
    ids = np.array(sorted(rows), dtype=np.int64)
    pick = (
        (lambda own: own[0]) if single or kind in BINARY_KINDS else (lambda own: np.mean(own, axis=0, dtype=np.float32))
    )
    return ids, np.stack([pick(rows[int(point)]) for point in ids])


def main(words: list[str]) -> int:
    """Describe the models; exit code 2 is a user's error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL")
    parser.add_argument("-o", dest="output", type=Path, required=True, help="folder to write")
    parser.add_argument("--kind", choices=KINDS, default="orb")
    parser.add_argument(
        "--size", type=float, default=SIZE, help="diameter of a keypoint, pixels (default: %(default)s)"
    )
    parser.add_argument("--single", action="store_true", help="one observation of each point, not the mean of all")
    given = parser.parse_args(words)
    try:
        given.output.mkdir(parents=True, exist_ok=True)
        for path in given.models:
            model = read_model(path)
            scene = scene_of_model(model)
            ids, descriptor = described(model, path / "thumbs", given.kind, given.size, given.single)
            assert scene.ids is not None and scene.rgb is not None
            some = np.searchsorted(scene.ids, ids)
            arrays = {"xyz": scene.xyz[some], "rgb": scene.rgb[some], "ids": ids, "descriptor": descriptor}
            with atomic_file(given.output / f"{path.name}.npz", overwrite=True) as file:
                file.write(npz_bytes({**arrays, "descriptor_kind": np.array(given.kind)}))
            print(f"{path.name}: {len(ids)} of {len(scene)} points, {descriptor.shape[1]} x {descriptor.dtype}")
    except (InputError, OSError) as error:
        print("describe:", error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
