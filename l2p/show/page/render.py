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

_SCRIPTS = ("theme.js", "region.js", "viewer.js", "copy.js")


def render(
    template: str,
    title: str,
    exhibits: Sequence[tuple[str, Exhibit]],
    most_points: int = MOST_POINTS,
    attackers: Sequence[str] = ("",),
    **words: Any,
) -> bytes:
    """Render a page with an interactive view of the exhibits, UTF-8.

    With several ``attackers``, each label has so many exhibits one after another, one per attacker; ``words`` are
    variables of the template.
    """
    environment, view = _environment(), view_data(exhibits, most_points)
    script = "".join(_source(name) for name in _SCRIPTS)
    page = environment.get_template(template).render(
        title=title,
        version=__version__,
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        view=view,
        clouds=[label for label, _ in exhibits[:: len(attackers)]],
        attackers=attackers,
        thinned=_thinned(exhibits, most_points),
        **_choices(exhibits[0][1]),
        **words,
    )
    # File names may hold bytes that are not UTF-8.
    return page.encode("utf-8", errors="replace")


def _choices(exhibit: Exhibit) -> dict[str, Any]:
    """Layers and colours that the view offers."""
    layers = {"points": "True points", "lines": "Line cloud", "recovered": "Recovered points"}
    colors = {
        "error": ("By error", exhibit.error),
        "confidence": ("By confidence", exhibit.confidence),
        "rgb": ("The map's own", exhibit.rgb),
    }
    recovered = exhibit.recovered is not None
    return {
        "layers": [(name, label) for name, label in layers.items() if getattr(exhibit, name) is not None],
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
