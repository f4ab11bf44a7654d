"""The page that shows one file: a scene, a truth, a line cloud or a recovery."""

from __future__ import annotations

from l2p.show.exhibit import Exhibit
from l2p.show.page.numbers import count
from l2p.show.page.render import render


def view_page(exhibit: Exhibit, name: str, kind: str, *, pictures: bool = False) -> bytes:
    """Render the page, UTF-8; ``kind`` is the kind of the file in words, such as ``a line cloud (npz)``.

    With ``pictures``, the page is served by one that makes pictures (:mod:`l2p.show.serve`).
    """
    what = f"This is {kind} of {count(len(exhibit))} {'points' if exhibit.lines is None else 'lines'}."
    if exhibit.confidence is not None and not exhibit.calibrated:
        what += " Its confidence ranks points and is no probability."
    return render("view.html", name, [("all", exhibit)], pictures=pictures, what=what)
