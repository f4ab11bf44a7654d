"""Tables as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any


def csv_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Encode rows with the same keys, which become the heading, as UTF-8; nothing for no rows.

    >>> csv_bytes([{"name": "a", "value": None}, {"name": "b", "value": 0.5}])
    b'name,value\\na,\\nb,0.5\\n'
    """
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue().encode("utf-8")
