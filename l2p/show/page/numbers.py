"""Numbers as text."""

from __future__ import annotations

#: Keeps a number and its unit on one line.
SPACE = "\N{NO-BREAK SPACE}"


def percent(share: float) -> str:
    """A share in percent, with a decimal below 1 and above 99 percent.

    >>> [percent(share) for share in (0.6234, 0.005, 1.0, 0.9996)]
    ['62\\xa0%', '0.5\\xa0%', '100\\xa0%', '99.9\\xa0%']
    """
    value = 100 * share
    if 99 < value < 100:
        number = f"{min(value, 99.9):.1f}"
    else:
        number = f"{value:.0f}" if value >= 1 or value == 0 else f"{value:.1g}"
    return f"{number}{SPACE}%"


def fraction(share: float) -> str:
    """A share that the user chose, in percent with all its digits.

    >>> fraction(0.07), fraction(0.125)
    ('7\\xa0%', '12.5\\xa0%')
    """
    return f"{100 * share:.6g}{SPACE}%"


def length(value: float, metric: bool) -> str:
    """A length in scene units, or in metres or centimetres if ``metric`` (scene units are metres).

    >>> [length(value, True) for value in (0.0412, 0.999, 12.34)], length(0.0412, False)
    (['4.1\\xa0cm', '0.999\\xa0m', '12.3\\xa0m'], '0.0412 scene units')
    """
    if not metric:
        return f"{value:.3g} scene units"
    return f"{100 * value:.2g}{SPACE}cm" if value < 0.99 else f"{value:.3g}{SPACE}m"


def count(number: int) -> str:
    """A number with commas between thousands.

    >>> count(20000)
    '20,000'
    """
    return f"{number:,}"
