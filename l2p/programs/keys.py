"""Keys of a config that its schema does not have: hydra lets ``+key=value`` add them, and nothing would read them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

from l2p.errors import InputError


def check_keys(resolved: Mapping[str, Any], schema: type[Any], file: str) -> None:
    """Refuse keys that are not in the schema, a dataclass whose fields may be dataclasses; ``file`` explains the keys.

    Raises
    ------
    InputError
        If there is one; free mappings, as ``dict[str, str]``, may have any.
    """
    for key in _unknown(resolved, schema):
        raise InputError(f"got {key}, which is no key of this program; expected one of {file}")


def _unknown(resolved: Mapping[str, Any], schema: type[Any]) -> Iterator[str]:
    hints = get_type_hints(schema)
    known = {entry.name: hints[entry.name] for entry in fields(schema)}
    for key, value in resolved.items():
        if key not in known:
            yield key
        elif is_dataclass(known[key]) and isinstance(value, Mapping):
            yield from (f"{key}.{below}" for below in _unknown(value, known[key]))  # type: ignore[arg-type]
