"""How far chance alone may move a share that was counted on few points."""

from __future__ import annotations

import math

#: Standard deviations of a normal distribution that hold 95 % of it.
_NORMAL = 1.959964


def interval(share: float, count: int) -> tuple[float, float]:
    """95 % interval of a share that was counted on ``count`` points (Wilson, J. Am. Stat. Assoc. 22, 1927).

    Examples
    --------
    >>> [round(bound, 3) for bound in interval(0.5, 50)], [round(bound, 3) for bound in interval(1.0, 3)]
    ([0.366, 0.634], [0.439, 1.0])
    """
    if count == 0:
        return 0.0, 1.0
    z2 = _NORMAL**2 / count
    middle = (share + z2 / 2) / (1 + z2)
    half = _NORMAL * math.sqrt(share * (1 - share) / count + z2 / (4 * count)) / (1 + z2)
    return max(0.0, middle - half), min(1.0, middle + half)
