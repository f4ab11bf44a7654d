"""Scoring of predictions: one row of figures per cell, saved beside its prediction."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

from eval.cells import Cell, Store, read_json, write_json
from eval.localizing import localization_of
from eval.mean_curves import curves_of
from l2p.io.atomic import atomic_file
from l2p.io.csv_rows import csv_bytes
from l2p.io.recovery_files import load_recovery
from l2p.judging.accuracy import compare
from l2p.judging.curves import SHARES, THRESHOLDS
from l2p.judging.measure import Figure, Need, figures, measured
from l2p.programs.commits import source_digest

Row = dict[str, Any]


def score(cell: Cell, store: Store, queries: int = 0) -> Row:
    """Return the row of a predicted cell; score it only if prediction or measures have changed since the last time.

    Of a COLMAP model, at most so many images are also localized in the line cloud (``queries``).
    """
    stamp = _stamp(cell, store, queries)
    path = store.scores / f"{cell.key}.json"
    if path.is_file():
        kept = read_json(path)
        if kept["stamp"] == stamp:
            return kept["row"]
    row = _row(cell, store, queries)
    write_json(path, {"stamp": stamp, "row": row})
    return row


def write_results(store: Store, rows: list[Row], about: dict[str, Any]) -> None:
    """Rewrite ``results.csv`` and ``results.json``, each whole or not at all.

    The CSV is the tidy table: one line per cell, one column per figure; curves are only in the JSON.
    """
    plain = [{name: value for name, value in row.items() if name != "curves"} for row in rows]
    with atomic_file(store.folder / "results.csv", overwrite=True) as file:
        file.write(csv_bytes(plain))
    axes = {"thresholds": THRESHOLDS.tolist(), "shares": SHARES.tolist()}
    write_json(store.folder / "results.json", {**about, **axes, "rows": rows})


def _stamp(cell: Cell, store: Store, queries: int) -> str:
    measures = " ".join([*(figure.name for figure in _figures()), source_digest("judging")])
    if queries:
        measures += f" {queries} {source_digest('utility')}"
    return hashlib.sha256(store.record(cell).read_bytes() + measures.encode()).hexdigest()[:16]


def _figures() -> list[Figure]:
    """List the columns of the table, without figures that need metric scenes."""
    return [figure for figure in figures() if figure.need is not Need.METRIC]


def _row(cell: Cell, store: Store, queries: int) -> Row:
    recovery, record = load_recovery(store.prediction(cell)), read_json(store.record(cell))
    found = replace(compare(recovery, cell.hidden().truth), localization=localization_of(cell, queries))
    values = measured(found)
    return {
        "scene": cell.scene.name,
        "kind": cell.scene.kind,
        "fraction": cell.fraction,
        "scheme": cell.scheme,
        "seed": cell.seed,
        "method": cell.method,
        **{figure.name: values[figure.name] for figure in _figures()},
        "seconds": record["seconds"],
        "peak_gib": record.get("peak_gib"),
        "made": record["made"],
        "commit": record["commit"],
        "code": record["code"],
        "curves": curves_of(found),
    }
