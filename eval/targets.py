"""Figures in which the goals of attacks are set: ratios to the paper's attack and to the bound, and calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from eval.contenders import AttackContender, LeaveOneOutContender, lines_alone
from eval.contract import Contender
from eval.mean_curves import pooled_calibration_error
from eval.result_tables import Column, Table, decimals, distinct, percent, pooled
from eval.scoring import Row
from l2p.judging.measure import arithmetic_mean, geometric_mean

#: Each ratio: its name, the figure, and the reference whose figure is the divisor.
RATIOS = (
    ("median_ratio", "median_spacings", "heuristic"),
    ("precision_ratio", "neighbor_precision", "heuristic"),
    ("share_ratio", "within_1", "loo"),
)


@dataclass(frozen=True)
class References:
    """Labels of the reference methods of a run, None if it has none, and of all methods that use the truth.

    Attributes
    ----------
    heuristic, loo : str or None
        The paper's attack with the paper's counts, and leave-one-out; both see lines alone.
    knowing : frozenset of str
        Methods that use the truth.
    seeing : mapping
        Of each method that sees attributes, the leave-one-out bound that sees the same, or None.
    alone : mapping
        Of each method that sees attributes, the same method with the same settings that sees lines alone, or None.
    """

    heuristic: str | None
    loo: str | None
    knowing: frozenset[str]
    seeing: Mapping[str, str | None] = field(default_factory=dict)
    alone: Mapping[str, str | None] = field(default_factory=dict)

    @classmethod
    def of(cls, methods: Sequence[Contender]) -> References:
        """Find the references among the methods of a run."""
        heuristic = [m.label for m in methods if _is_papers(m)]
        # The first bound that sees so much.
        bounds = {m.sees: m.label for m in reversed(methods) if isinstance(m, LeaveOneOutContender)}
        knowing = frozenset(m.label for m in methods if m.knows_truth)
        seeing = {m.label: bounds.get(m.sees) for m in methods if m.sees}
        plain = {m.label: lines_alone(m, methods) for m in methods if m.sees}
        alone = {label: None if other is None else other.label for label, other in plain.items()}
        return cls(next(iter(heuristic), None), bounds.get(()), knowing, seeing, alone)

    def bound(self, method: str) -> str | None:
        """Label of the leave-one-out bound that sees what the method sees."""
        return self.seeing.get(method, self.loo)


def _is_papers(method: Contender) -> bool:
    """Whether it is the paper's attack with the paper's counts."""
    return isinstance(method, AttackContender) and method.name == "heuristic" and "fraction" not in method.settings


def maximum(values: Sequence[Any]) -> float:
    return float(np.max(values))


def _reached(values: Sequence[Any]) -> float:
    return float((np.asarray(values) >= 1).mean())


def target_table(rows: Sequence[Row], references: References) -> Table | None:
    """Tabulate the targets of each attack at each fraction, if their reference is in the run; None without any."""
    attacks = [method for method in distinct(rows, "method") if method not in references.knowing]
    columns = _columns(references, [row for row in rows if row["method"] in attacks])
    if not columns or not attacks:
        return None
    compared = with_ratios(rows, references)
    body = []
    for fraction in sorted({row["fraction"] for row in rows}, reverse=True):
        for method in attacks:
            own = [row for row in compared if row["fraction"] == fraction and row["method"] == method]
            if own:
                body.append([method, f"{100 * fraction:g} %", *(pooled(own, column) for column in columns)])
    title = "attacks against the heuristic, the leave-one-out bound and their own confidence"
    return Table("targets", title, ["method", "points", *(column.heading for column in columns)], body)


def with_ratios(rows: Sequence[Row], references: References) -> list[Row]:
    """Add to the rows each of ``RATIOS`` to the reference on the same line cloud; None if that is missing or 0.

    The leave-one-out bound of a method is the one that sees what it sees.
    """
    of = by_cloud(rows)
    found = []
    for row in rows:
        ratios = {}
        owners = {"heuristic": references.heuristic, "loo": references.bound(row["method"])}
        for name, figure, owner in RATIOS:
            reference = of.get((owners[owner], *cloud(row)))
            below = reference[figure] if reference else None
            ratios[name] = row[figure] / below if below and row[figure] is not None else None
        found.append({**row, **ratios, "reliability": row["curves"]["reliability"], "own_error": None})
        if row["curves"]["reliability"] is not None:
            found[-1]["own_error"] = row["calibration_error"]
    return found


def cloud(row: Row) -> tuple[Any, ...]:
    """Scene, fraction and seed of a row."""
    return row["scene"], row["fraction"], row["seed"]


def by_cloud(rows: Sequence[Row]) -> dict[tuple[Any, ...], Row]:
    """Rows by method and line cloud."""
    return {(row["method"], *cloud(row)): row for row in rows}


def _columns(references: References, rows: Sequence[Row]) -> list[Column]:
    columns = []
    if references.heuristic is not None:
        columns += [
            Column("median / heuristic's", "median_ratio", geometric_mean, decimals),
            Column("the same, worst scene", "median_ratio", maximum, decimals),
            Column("neighbour precision / heuristic's", "precision_ratio", geometric_mean, decimals),
        ]
    if any(references.bound(method) is not None for method in distinct(rows, "method")):
        columns += [
            Column("share within 1 / LOO's", "share_ratio", geometric_mean, decimals),
            Column("scenes not below LOO", "share_ratio", _reached, percent),
        ]
    confidence = confidence_columns(rows)
    return [*columns, *confidence] if columns or len(confidence) > 1 else []


def confidence_columns(rows: Sequence[Row]) -> list[Column]:
    """List the columns of the confidence for rows of :func:`with_ratios`: calibration, if any has it, and best half."""
    columns = []
    if any(row["curves"]["reliability"] is not None for row in rows):
        columns += [
            Column("calibration error", "reliability", pooled_calibration_error, decimals),
            Column("calibration error, worst scene", "own_error", maximum, decimals),
        ]
    return [*columns, Column("most confident half within 1", "confident_half", arithmetic_mean, percent)]
