"""The run: predict every cell that is not predicted yet, then score all, then show the results."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml

from eval.appearance_table import appearance_tables
from eval.capacity import cores, fitting
from eval.cells import Cell, Store, cells_of, predict, without_unseen
from eval.eval_config import Settings
from eval.figures import draw_figures
from eval.localization_table import localization_tables
from eval.parallel import outcomes
from eval.result_tables import Image, Table, document, print_tables, tables, updated
from eval.scheme_figure import draw_schemes
from eval.scheme_table import scheme_tables
from eval.scoring import Row, score, write_results
from eval.side_by_side import check_pictures, draw_pictures
from eval.targets import References, target_table
from l2p.io.atomic import atomic_file
from l2p.judging.provenance import machine, versions
from l2p.programs.commits import commit, source_digest
from l2p.programs.scenes import load, scenes_of
from l2p.work.progress import terminal_progress

log = logging.getLogger("eval")


def evaluate_all(settings: Settings, folder: Path, command: str) -> int:
    """Start or continue the run in ``folder``; return the number of cells that failed.

    Raises
    ------
    FileNotFoundError, InputError
        If a scene does not exist, the folder has predictions with other settings, or another run has locked it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder)
    load.cache_clear()  # files may have changed since this process last ran
    about = _about(settings, command)  # before the long part, in which sources may change
    scenes = scenes_of(settings.scenes, settings.kinds)
    check_pictures(settings.pictures, scenes)
    cells = without_unseen(cells_of(settings, scenes))
    failed = 0
    predicting = "predict" in settings.steps
    with store.locked() if predicting else nullcontext():
        store.check(cells)
        _write_text(folder / "config.yaml", yaml.safe_dump(settings.resolved, sort_keys=False, allow_unicode=True))
        if predicting:
            failed = _predict_all(cells, store, settings)
        if "score" in settings.steps:
            _show(_score_all(cells, store, settings.queries, about), cells, store, settings, about)
    return failed


def _predict_all(cells: Sequence[Cell], store: Store, settings: Settings) -> int:
    """Predict the missing cells; a failure is logged and does not stop the others."""
    open_cells = [cell for cell in cells if not store.done(cell)]
    edited = sum(store.prediction(cell).is_file() and store.record(cell).is_file() for cell in open_cells)
    if edited:
        log.info("%d predictions are made anew: the file of their method has changed", edited)
    processes, threads = plan(settings, open_cells)
    log.info(
        "%d of %d cells to predict, into %s; processes: %d, threads of each: %d",
        *(len(open_cells), len(cells), store.predictions, processes, threads),
    )
    failed = 0
    with (
        _threads(threads),
        terminal_progress().task("predictions", total=len(open_cells)) as advance,
        closing(outcomes(partial(predict, store=store), open_cells, processes, threads)) as ended,
    ):
        for cell, failure in ended:
            if failure is not None:
                failed += 1
                log.error("%s failed: %s", cell.key, "\n".join(filter(None, (failure.sentence, failure.place))))
            advance(1)
    return failed


def plan(settings: Settings, cells: Sequence[Cell]) -> tuple[int, int]:
    """Choose the number of processes, and of threads per process: as in the settings, else by cores and free memory."""
    processes, threads = settings.processes, settings.threads
    if processes is None:
        lines = [cell.fraction * len(load(cell.scene.source).xyz) for cell in cells]
        processes = fitting(lines, most=max(1, cores() // (threads or 1)))
    return processes, threads or max(1, cores() // processes)


def _score_all(cells: Sequence[Cell], store: Store, queries: int, about: dict[str, Any]) -> list[Row]:
    """Score the predicted cells; the results are rewritten after every cell."""
    rows: list[Row] = []
    predicted = [cell for cell in cells if store.done(cell)]
    with terminal_progress().task("scores", total=len(predicted)) as advance:
        for cell in predicted:
            rows.append(score(cell, store, queries))
            write_results(store, rows, about)
            advance(1)
    codes = {row["code"] for row in rows}
    if len(codes) > 1:
        log.warning("the predictions were made by %d states of l2p: column code of results.csv", len(codes))
    return rows


def _show(rows: list[Row], cells: Sequence[Cell], store: Store, settings: Settings, about: dict[str, Any]) -> None:
    """Write tables to stdout and results.md, figures and pictures; also to the docs, if the settings name them."""
    if not rows:
        log.warning("nothing is predicted yet: no tables")
        return
    references = References.of(settings.methods)
    found = scheme_tables(rows) or _tables(rows, references)
    print_tables(found)
    drawings = [
        *(draw_schemes(rows) or draw_figures(rows, references.knowing)),
        *draw_pictures(cells, rows, store, settings.pictures),
    ]
    places = [(store.folder / "results.md", "figures", "")]
    if settings.docs is not None:
        places.append((settings.docs, "images", f"{settings.docs.stem}-"))
    for page, below, prefix in places:
        images = page.parent / below
        images.mkdir(parents=True, exist_ok=True)
        shown = [Image(images / f"{prefix}{drawing.name}", drawing.caption) for drawing in drawings]
        for image, drawing in zip(shown, drawings, strict=True):
            _write(image.path, drawing.content)
        _write_text(page, document(rows, found, about, shown, page.parent))
    _update(settings, found)
    log.info("results are in %s", store.folder)


def _tables(rows: list[Row], references: References) -> list[Table]:
    """Tables of a run of one scheme: those of methods come before those of scenes."""
    found = tables(rows)
    targets = target_table(rows, references)
    if targets is not None:
        found.insert(1, targets)
    found[-1:-1] = [*appearance_tables(rows, references), *localization_tables(rows)]
    return found


def _update(settings: Settings, found: Sequence[Table]) -> None:
    """Insert the tables into the files that have a place for them."""
    for file in settings.update:
        before = file.read_text(encoding="utf-8")
        after = updated(before, settings.name, found)
        if after is None:
            log.warning("%s has no line <!-- eval:%s:TABLE -->: nothing to update there", file, settings.name)
        elif after != before:
            _write_text(file, after)


def _about(settings: Settings, command: str) -> dict[str, Any]:
    return {
        "command": command,
        "commit": commit(),
        "code": source_digest(),
        "machine": machine(),
        "versions": versions(),
        "config": settings.resolved,
    }


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Set torch's threads, and restore them afterwards: the caller may be a test."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _write_text(path: Path, text: str) -> None:
    _write(path, text.encode("utf-8"))


def _write(path: Path, content: bytes) -> None:
    with atomic_file(path, overwrite=True) as file:
        file.write(content)
