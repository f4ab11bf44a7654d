"""Localization of a model's images in the line clouds of a run, beside what is recovered from them."""

from __future__ import annotations

from functools import lru_cache

from eval.cells import Cell
from l2p.io.kinds import Kind, kind_of
from l2p.utility.localization import Localization
from l2p.utility.queries import Queries
from l2p.utility.releases import LocalizeConfig, localize_hidden, localizes, read_queries


def localization_of(cell: Cell, queries: int) -> Localization | None:
    """Localize the images of the cell's scene in its hidden map and its points; None if it is no COLMAP model."""
    if not queries or cell.scene.source.startswith("sim:") or kind_of(cell.scene.source) is not Kind.SCENE_MODEL:
        return None
    return _localized(cell.scene.source, cell.fraction, cell.seed, cell.scheme, queries)


@lru_cache(maxsize=256)
def _localized(source: str, fraction: float, seed: int, scheme: str, queries: int) -> Localization | None:
    """Localize once for all methods of a hidden map; None if cameras cannot be localized in it."""
    hidden = Cell.hidden_scene(source, fraction, seed, scheme)
    if not localizes(hidden):
        return None
    config = LocalizeConfig(most_queries=queries, seed=seed)
    return localize_hidden(_queries(source), {fraction: hidden}, config)


@lru_cache(maxsize=4)
def _queries(source: str) -> Queries:
    return read_queries(source)[1]
