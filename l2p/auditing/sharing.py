"""What of an audit may be passed on: figures and curves, but no point, path, image or machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from l2p.auditing.audit import Audit
from l2p.auditing.tradeoff import ReleaseInputs

#: Told of an attack in a shared file. Attacks of users may add anything else to their record.
_ATTACK = ("method", "used", "recognised", "seconds")
#: Entries of ``audit.json`` that tell places, images or machines.
_HOLDING = ("machine", "parts", "pictures")
#: What stands for the values of flags that hold paths or coordinates.
_STANDS = {
    "box": ["X0", "Y0", "Z0", "X1", "Y1", "Z1"],
    "ids": ["FILE"],
    "masks": ["FOLDER"],
}
#: Of a map whose name is not told.
NAMELESS = "a map"


def holding(audit: Audit, shared: bool) -> str:
    """Say what the page of an audit holds, and how to treat it."""
    if shared:
        return (
            "This page was made to be passed on (--share): it holds figures, but no point of the map, true or "
            "recovered, no path, no name of an image and no machine."
        )
    what = "the points of your map" if audit.known else "the lines, and the points that were recovered from them"
    return f"This page holds {what}: treat it like the map. l2p audit --share writes one that can be passed on."


def shared_figures(figures: dict[str, Any]) -> dict[str, Any]:
    """Leave out of the content of ``audit.json`` what tells where and of what files it was made."""
    trials = [
        {
            **trial,
            "attack": {
                **{name: trial["attack"][name] for name in _ATTACK if name in trial["attack"]},
                "settings": plain_settings(trial["attack"]["settings"]),
            },
        }
        for trial in figures["trials"]
    ]
    return {**{name: value for name, value in figures.items() if name not in _HOLDING}, "trials": trials}


def plain_settings(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of an attack without texts, which may name files; the digest of a checkpoint stays."""
    return {
        name: value
        for name, value in settings.items()
        if name == "digest" or value is None or isinstance(value, bool | int | float)
    }


def shared_release(release: ReleaseInputs) -> ReleaseInputs:
    """Leave out paths and coordinates of the commands that make a release."""
    return replace(
        release,
        scene="MODEL",
        descriptors=None if release.descriptors is None else "FILE",
        drop=tuple(without_values(release.drop)),
        # The reason may name a file.
        unlocalized="",
    )


def without_values(words: Sequence[str]) -> list[str]:
    """Replace the values of flags that choose points by what they stand for.

    >>> without_values(["--drop-ids", "/secret/ids.txt", "--drop-box", "0", "0", "0", "1", "1", "1"])
    ['--drop-ids', 'FILE', '--drop-box', 'X0', 'Y0', 'Z0', 'X1', 'Y1', 'Z1']
    """
    told = []
    for word in words:
        kind = word.rpartition("-")[2]
        if word.startswith("--") and kind in _STANDS:
            told += [word, *_STANDS[kind]]
    return told
