"""The run: predict every cell that is not predicted yet, then score all, then show what came out."""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import yaml

from eval.cells import Cell, Store, cells_of, predict
from eval.config import Settings
from eval.figures import draw_figures
from eval.provenance import commit, machine, source_digest, versions
from eval.scenes import load, scenes_of
from eval.scoring import Row, score, write_results
from eval.tables import document, print_tables
from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.progress import terminal_progress

log = logging.getLogger("eval")


def evaluate_all(settings: Settings, folder: Path, command: str) -> int:
    """Run, or finish, the run in ``folder``; gives the number of cells that failed.

    Raises
    ------
    FileNotFoundError, InputError
        If a scene is not there, or predictions in the folder were made with other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder)
    load.cache_clear()  # files may have changed since this process last ran
    about = _about(settings, command)  # before the long part, in which sources may change
    with _threads(settings.threads):
        cells = cells_of(settings, scenes_of(settings.scenes, settings.kinds))
        store.check(cells)
        _write_text(folder / "config.yaml", yaml.safe_dump(settings.resolved, sort_keys=False, allow_unicode=True))
        failed = _predict_all(cells, store, settings) if "predict" in settings.steps else 0
        if "score" in settings.steps:
            _show(_score_all(cells, store, about), settings, folder, about)
    return failed


def _predict_all(cells: Sequence[Cell], store: Store, settings: Settings) -> int:
    """Predict what is not predicted; a cell that fails is logged and does not stop the others."""
    open_cells = [cell for cell in cells if not store.done(cell)]
    log.info("%d of %d cells to predict, into %s", len(open_cells), len(cells), store.predictions)
    failed = 0
    with terminal_progress().task("predictions", total=len(open_cells)) as advance:
        for cell, error in _outcomes(open_cells, store, settings):
            if error is not None:
                failed += 1
                # An InputError says all in one sentence; of anything else the place matters.
                log.error("%s failed: %s", cell.key, error, exc_info=None if isinstance(error, InputError) else error)
            advance(1)
    return failed


def _outcomes(cells: Sequence[Cell], store: Store, settings: Settings) -> Iterator[tuple[Cell, Exception | None]]:
    """Predict the cells, in this process or in several; each with the exception that ended it, if one did."""
    workers = min(settings.workers, len(cells))
    if workers <= 1:
        for cell in cells:
            yield cell, _attempt(cell, store)
        return
    # Not forked: torch's threads do not survive that.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, torch.set_num_threads, (settings.threads,)) as pool:
        futures: dict[Future[None], Cell] = {pool.submit(predict, cell, store): cell for cell in cells}
        try:
            for future in as_completed(futures):
                error = future.exception()
                if error is not None and not isinstance(error, Exception):
                    raise error
                yield futures[future], error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _attempt(cell: Cell, store: Store) -> Exception | None:
    try:
        predict(cell, store)
    except Exception as error:  # a user's method may raise anything, and the other cells are still wanted
        return error
    return None


def _score_all(cells: Sequence[Cell], store: Store, about: dict[str, Any]) -> list[Row]:
    """Score what is predicted; the results are rewritten after every cell."""
    rows: list[Row] = []
    predicted = [cell for cell in cells if store.done(cell)]
    with terminal_progress().task("scores", total=len(predicted)) as advance:
        for cell in predicted:
            rows.append(score(cell, store))
            write_results(store, rows, about)
            advance(1)
    codes = {row["code"] for row in rows}
    if len(codes) > 1:
        log.warning("the predictions were made by %d states of l2p: column code of results.csv", len(codes))
    return rows


def _show(rows: list[Row], settings: Settings, folder: Path, about: dict[str, Any]) -> None:
    """Tables on stdout and in results.md, figures, and both in the docs where asked for."""
    if not rows:
        log.warning("nothing is predicted yet: no tables")
        return
    knowing = [contender.label for contender in settings.methods if contender.knows_truth]
    print_tables(rows)
    places = [(folder / "results.md", folder / "figures", "")]
    if settings.docs is not None:
        places.append((settings.docs, settings.docs.parent / "images", f"{settings.docs.stem}-"))
    for text, images, prefix in places:
        images.mkdir(parents=True, exist_ok=True)
        figures = draw_figures(rows, knowing, images, prefix)
        _write_text(text, document(rows, about, [figure.relative_to(text.parent).as_posix() for figure in figures]))
    log.info("results are in %s", folder)


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
    """Torch's threads, put back afterwards: the caller may be a test."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _write_text(path: Path, text: str) -> None:
    with atomic_file(path, overwrite=True) as file:
        file.write(text.encode("utf-8"))
