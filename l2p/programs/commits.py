"""Provenance of a result: the commit and a digest of the sources."""

from __future__ import annotations

import hashlib
import subprocess
from functools import cache
from pathlib import Path

import l2p

PACKAGE = Path(l2p.__file__).parent


@cache
def commit() -> str | None:
    """Commit of the working tree, followed by ``+`` if the programs differ from it; None without git."""
    head = _git("rev-parse", "HEAD")
    if not head:
        return None
    return head + ("+" if _git("status", "--porcelain", "--", "l2p", "eval", "train", "configs") else "")


@cache
def source_digest(room: str = "") -> str:
    """A digest of the sources of l2p, or of one folder in it: it differs where results may."""
    digest = hashlib.sha256()
    for file in sorted((PACKAGE / room).rglob("*.py")):
        digest.update(file.relative_to(PACKAGE).as_posix().encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=PACKAGE.parent, capture_output=True, text=True, timeout=30, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
