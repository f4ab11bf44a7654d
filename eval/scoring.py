"""From predictions to rows of figures: one row a cell, kept beside the prediction it was scored from."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from eval.cells import Cell, Store, read_json, write_json
from eval.mean_curves import SHARES, THRESHOLDS, curves_of, found_neighbors
from l2p.io.atomic import atomic_file
from l2p.io.recovery_files import load_recovery
from l2p.judging.accuracy import compare, evaluate, neighbor_scores
from l2p.maps.recovery import Recovery
from l2p.programs.commits import source_digest

#: Increase when a row gets other figures, so that old rows are scored again.
ROW_VERSION = 2

Row = dict[str, Any]


def score(cell: Cell, store: Store) -> Row:
    """The row of a predicted cell; scored only if prediction or measures are new since it last was."""
    stamp = _stamp(cell, store)
    path = store.scores / f"{cell.key}.json"
    if path.is_file():
        kept = read_json(path)
        if kept["stamp"] == stamp:
            return kept["row"]
    row = _row(cell, store)
    write_json(path, {"stamp": stamp, "row": row})
    return row


def csv_bytes(rows: Iterable[Row]) -> bytes:
    """The tidy table: one line a cell, one column a figure; curves are for JSON alone."""
    plain = [{name: value for name, value in row.items() if name != "curves"} for row in rows]
    text = io.StringIO()
    if plain:
        writer = csv.DictWriter(text, list(plain[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(plain)
    return text.getvalue().encode("utf-8")


def write_results(store: Store, rows: list[Row], about: dict[str, Any]) -> None:
    """Rewrite ``results.csv`` and ``results.json``, each whole or not at all."""
    with atomic_file(store.folder / "results.csv", overwrite=True) as file:
        file.write(csv_bytes(rows))
    axes = {"thresholds": THRESHOLDS.tolist(), "shares": SHARES.tolist()}
    write_json(store.folder / "results.json", {**about, **axes, "rows": rows})


def _stamp(cell: Cell, store: Store) -> str:
    measures = f"{ROW_VERSION} {source_digest('judging')}"
    return hashlib.sha256(store.record(cell).read_bytes() + measures.encode()).hexdigest()[:16]


def _row(cell: Cell, store: Store) -> Row:
    recovery, record = load_recovery(store.prediction(cell)), read_json(store.record(cell))
    found = compare(recovery, cell.hidden().truth)
    scores, error = evaluate(recovery, found.truth), found.spacings
    right = found_neighbors(recovery, found.truth)
    return {
        "scene": cell.scene.name,
        "kind": cell.scene.kind,
        "fraction": cell.fraction,
        "seed": cell.seed,
        "method": cell.contender.label,
        "lines": scores.lines,
        "spacing": scores.spacing,
        "median": scores.median,
        "mean": scores.mean,
        "median_spacings": scores.median_spacings,
        **{f"within_{limit}": share for limit, share in scores.within_spacings.items()},
        **_confidence_figures(found.confidence, error <= 1, scores),
        **_neighbor_figures(recovery, found.truth.xyz, right),
        "seconds": record["seconds"],
        "peak_gib": record.get("peak_gib"),
        "made": record["made"],
        "commit": record["commit"],
        "code": record["code"],
        "curves": curves_of(found, right),
    }


def _confidence_figures(
    confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"], scores: Any
) -> Row:
    """What the confidence is worth; nothing where it is the same for every line."""
    if confidence.min() == confidence.max():
        return dict.fromkeys(("confident_half", "confident_quarter", "calibration_error", "confidence_auc"))
    return {
        "confident_half": scores.confident_half,
        "confident_quarter": scores.confident_quarter,
        "calibration_error": scores.calibration_error,
        "confidence_auc": ranking(confidence, inside),
    }


def ranking(confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"]) -> float | None:
    """Area under the ROC curve: how often a line within 1 spacing is surer than one outside; None without both."""
    from scipy.stats import rankdata

    right = int(inside.sum())
    wrong = len(inside) - right
    if right == 0 or wrong == 0:
        return None
    return float((rankdata(confidence)[inside].sum() - right * (right + 1) / 2) / (right * wrong))


def _neighbor_figures(
    recovery: Recovery, truth: Float[np.ndarray, "lines 3"], right: Bool[np.ndarray, "lines k"] | None
) -> Row:
    if recovery.neighbors is None or right is None:
        return dict.fromkeys(("neighbor_precision", "under_half_outliers", "neighbors_used"))
    scores = neighbor_scores(recovery.neighbors, truth, recovery.affinity, right)
    return {
        "neighbor_precision": scores.precision,
        "under_half_outliers": scores.under_half_outliers,
        "neighbors_used": scores.used,
    }
