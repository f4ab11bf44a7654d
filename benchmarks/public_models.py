"""The public models of README's table: local copies become scenes, and line clouds with their truth.

    python benchmarks/public_models.py CLONES -o scenes --fractions 1 0.1
    python -m eval experiment=readme scenes=[scenes] pictures.scenes=[] docs=null update=[]

``docs/public-models.csv`` lists them: repository on GitHub, path, commit, licence. None of them is part of l2p. CLONES
holds clones, each as OWNER/NAME; what is missing is named, with the place to get it. Two of them are photographs, to
reconstruct first with COLMAP: their model is looked for as CLONES/SCENE.
"""

from __future__ import annotations

import argparse
import csv
import sys
from dataclasses import replace
from pathlib import Path

import l2p
from l2p.errors import sentence
from l2p.judging.accuracy import spacing

LIST = Path(__file__).resolve().parents[1] / "docs" / "public-models.csv"


def place_of(row: dict[str, str], clones: Path) -> Path:
    """The local copy of a model: its own folder, or its path in the clone of its repository."""
    own = clones / row["scene"]
    return own if own.exists() or not row["commit"] else clones / row["repository"] / row["path"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clones", type=Path, help="folder of clones, each as OWNER/NAME")
    parser.add_argument("-o", dest="output", type=Path, required=True, help="folder to write")
    parser.add_argument("--fractions", type=float, nargs="*", default=[], help="also lift so much of each, seed 0")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    rows = list(csv.DictReader(LIST.read_text(encoding="utf-8").splitlines()))
    done = 0
    for row in rows:
        name, place = row["scene"], place_of(row, arguments.clones)
        if not place.exists():
            what = f"git clone https://github.com/{row['repository']}, commit {row['commit']}"
            if not row["commit"]:
                what = f"reconstruct {row['path']} of https://github.com/{row['repository']}"
            print(f"{name}: {place} is missing; {what}", file=sys.stderr)
            continue
        try:
            scene = l2p.load(place, l2p.Scene)
        except (l2p.InputError, OSError) as error:
            print(f"{name}: {sentence(error)}", file=sys.stderr)
            continue
        l2p.save(scene, arguments.output / f"{name}.npz", overwrite=True)
        for fraction in arguments.fractions:
            hidden, stem = l2p.hide(scene, 0, fraction), f"{name}-{100 * fraction:g}"
            (arguments.output / "lines").mkdir(exist_ok=True)
            l2p.save(hidden.map, arguments.output / "lines" / f"{stem}.npz", overwrite=True)
            truth = replace(hidden.truth, spacing=spacing(scene.xyz))
            l2p.save(truth, arguments.output / "lines" / f"{stem}.truth.npz", overwrite=True)
        done += 1
        print(f"{name}: {len(scene):,} points (listed: {int(row['points']):,})")
    print(f"{done} of {len(rows)} models, into {arguments.output}")
    return 0 if done else 2


if __name__ == "__main__":
    sys.exit(main())
