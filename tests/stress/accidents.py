"""Accidents that can happen to the bytes of a file."""

from __future__ import annotations

import random


def damaged(content: bytes, chance: random.Random) -> bytes:
    """The content after one to four accidents."""
    found = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 4))):
        at, size = chance.randint(0, max(0, len(found) - 1)), chance.choice((1, 2, 4, 8, 40))
        accident = chance.choice(ACCIDENTS)
        accident(found, at, size, chance)
    return bytes(found)


def _flip(found: bytearray, at: int, size: int, chance: random.Random) -> None:
    found[at : at + 1] = bytes(byte ^ (1 << chance.randrange(8)) for byte in found[at : at + 1])


def _noise(found: bytearray, at: int, size: int, chance: random.Random) -> None:
    found[at : at + size] = chance.randbytes(size)


def _extreme(found: bytearray, at: int, size: int, chance: random.Random) -> None:
    """A number that lies on an edge: as bytes of either order, or as a word."""
    number = chance.choice((0, 1, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1))
    word = chance.choice(("nan", "inf", "-1", "1e999", "[", '"', "\n", " ", str(number))).encode()
    order = chance.choice(("little", "big"))
    found[at : at + size] = chance.choice((word, (number % 2 ** (8 * size)).to_bytes(size, order)))


def _cut(found: bytearray, at: int, size: int, chance: random.Random) -> None:
    del found[at : at + size]


def _double(found: bytearray, at: int, size: int, chance: random.Random) -> None:
    found[at:at] = found[at : at + size] * chance.choice((1, 1, 50))


def _insert(found: bytearray, at: int, size: int, chance: random.Random) -> None:
    found[at:at] = chance.randbytes(size)


def _end(found: bytearray, at: int, size: int, chance: random.Random) -> None:
    del found[at:]


ACCIDENTS = (_flip, _noise, _extreme, _extreme, _cut, _double, _insert, _end)
