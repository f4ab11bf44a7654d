"""What ``python -m train`` and ``python -m eval`` need besides l2p, said in a sentence where it is missing."""

from __future__ import annotations

import sys
from typing import NoReturn

#: Packages of the extra ``train``, by the names that are imported.
EXTRA = ("hydra", "omegaconf", "lightning", "tensorboard")


def end_without(program: str, error: ModuleNotFoundError) -> NoReturn:
    """End a program whose package is missing with exit code 2; any other module that is missing is an error."""
    name = (error.name or "").partition(".")[0]
    if name not in EXTRA:
        raise error
    print(
        f"{program}: {name} is not installed; in the checkout of l2p, install what this program needs: "
        "pip install -c constraints.txt -e '.[train]'",
        file=sys.stderr,
    )
    sys.exit(2)
