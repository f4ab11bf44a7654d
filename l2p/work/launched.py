"""What can be said of processes and threads without torch, which takes seconds to load."""

from __future__ import annotations

import os

#: Largest number of threads accepted: OpenMP crashes the process if the system refuses to start them.
MOST_THREADS = 1024


def among_others() -> bool:
    """Return whether this process is one of several ranks."""
    count = os.environ.get("WORLD_SIZE", "")
    return count.isdecimal() and int(count) > 1
