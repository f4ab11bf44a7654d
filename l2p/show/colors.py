"""Colours of errors: small errors stand out from the background, large ones fade into it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Error in spacings from which on the colour is constant.
ERROR_LIMIT = 2.0
#: Share of the colour map used on white, where its last colours would be invisible.
_ON_WHITE = 0.9


def error_colors(error: Float[np.ndarray, " points"], *, dark: bool) -> Float[np.ndarray, "points 4"]:
    """Colour of each error (spacings), for a dark or a white background."""
    return _error_map(dark)(np.clip(error / ERROR_LIMIT, 0, 1))


def error_bar(figure: Figure, label: str, *, dark: bool, **place: Any) -> Any:
    """Add the colour bar of the errors; ``place`` is passed to ``Figure.colorbar``."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    bar = figure.colorbar(ScalarMappable(Normalize(0, ERROR_LIMIT), _error_map(dark)), **place)
    bar.set_ticks([0, ERROR_LIMIT / 2, ERROR_LIMIT], labels=["0", f"{ERROR_LIMIT / 2:g}", f"{ERROR_LIMIT:g} or more"])
    bar.set_label(label)
    outline: Any = bar.outline
    outline.set_visible(False)
    return bar


def _error_map(dark: bool) -> Any:
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return colormaps["plasma_r"] if dark else ListedColormap(colormaps["plasma"](np.linspace(0, _ON_WHITE, 256)))
