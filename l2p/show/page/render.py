"""Templates to one HTML file: text from the input is escaped, scripts and data are embedded."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from typing import Any

from l2p.show.exhibit import Exhibit
from l2p.show.page import MOST_POINTS
from l2p.show.page.numbers import count
from l2p.show.page.view import MOST_LINES, view_data
from l2p.version import __version__

_SCRIPTS, _VIEWER_SCRIPTS = ("theme.js", "copy.js"), ("region.js", "viewer.js")


def render(
    template: str,
    title: str,
    exhibits: Sequence[tuple[str, Exhibit]],
    most_points: int = MOST_POINTS,
    attackers: Sequence[str] = ("",),
    pictures: bool = False,
    **words: Any,
) -> bytes:
    """Render a page with an interactive view of the exhibits, UTF-8; without exhibits, it has no view.

    With several ``attackers``, each label has so many exhibits one after another, one per attacker; ``words`` are
    variables of the template. With ``pictures``, a server beside the page makes pictures (:mod:`l2p.show.serve`).
    """
    environment, view = _environment(), view_data(exhibits, most_points) if exhibits else None
    script = "".join(_source(name) for name in (*_SCRIPTS, *(_VIEWER_SCRIPTS if exhibits else ())))
    page = environment.get_template(template).render(
        title=title,
        version=__version__,
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        view=view,
        clouds=[label for label, _ in exhibits[:: len(attackers)]],
        attackers=attackers,
        pictures=pictures,
        thinned=_thinned(exhibits, most_points),
        **(_choices(exhibits[0][1]) if exhibits else {}),
        **words,
    )
    # File names may hold bytes that are not UTF-8.
    return page.encode("utf-8", errors="replace")


def _choices(exhibit: Exhibit) -> dict[str, Any]:
    """Layers and colours that the view offers; the first layer is shown first, and ``both`` has two beside each other:
    what the map is, or what is published of it, and what comes back."""
    layers = {"points": "The map", "lines": "What is published: lines", "recovered": "What comes back"}
    found = [(name, label) for name, label in layers.items() if getattr(exhibit, name) is not None]
    sides = [found[0], found[-1]] if len(found) > 1 and found[-1][0] == "recovered" else []
    if sides:
        found.insert(0, ("both", "Side by side"))
    if exhibit.points is not None and exhibit.error is not None:
        found.append(("exposed", "Exposed part of the map"))
    colors = {
        "error": ("Exposed or not", exhibit.error),
        "confidence": ("How sure the attacker is", exhibit.confidence),
        "rgb": ("The map's own", exhibit.rgb),
    }
    recovered = exhibit.recovered is not None
    return {
        "layers": found,
        "sides": sides,
        "colors": [(name, label) for name, (label, values) in colors.items() if recovered and values is not None],
        "confident": exhibit.confidence is not None,
    }


def _thinned(exhibits: Sequence[tuple[str, Exhibit]], most_points: int) -> str:
    """Sentence on what the view leaves out; empty if it shows everything."""
    left_out = []
    if any(len(exhibit) > most_points for _, exhibit in exhibits):
        left_out.append(f"at most {count(most_points)} points")
    if any(exhibit.lines is not None and len(exhibit) > MOST_LINES for _, exhibit in exhibits):
        left_out.append(f"at most {count(MOST_LINES)} lines")
    if not left_out:
        return ""
    return f"The picture shows {' and '.join(left_out)} of each cloud, drawn at random. All figures count every point."


@cache
def _environment() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("l2p.show.page"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _source(name: str) -> str:
    """Read a file beside the templates, unrendered."""
    environment = _environment()
    return environment.loader.get_source(environment, name)[0]
