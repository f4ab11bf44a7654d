"""How a program starts: hydra composes the config, and what the user got wrong ends in one sentence and exit code 2."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from l2p.errors import InputError, sentence


def launch(program: str, main: Callable[[], None]) -> None:
    """Run what ``hydra.main`` made of a function."""
    # Hydra's own reports are several lines long and end with exit code 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        main()
    except (HydraException, OmegaConfBaseException) as error:  # some are an OSError, too
        _end(program, _of_hydra(error))
    except OSError as error:  # of the folder that hydra makes; the function's own errors do not get here
        _end(program, f"{sentence(error)}; expected a folder that can be written to, run=FOLDER")


@contextmanager
def explained(program: str) -> Iterator[None]:
    """End with a sentence what the user got wrong in the block; hydra never sees it, and adds nothing."""
    try:
        yield
    except (InputError, OSError) as error:
        _end(program, sentence(error))


def _end(program: str, said: str) -> NoReturn:
    print(f"{program}: {said}", file=sys.stderr)
    sys.exit(2)


def _of_hydra(error: Exception) -> str:
    """What hydra says, without how it searched, and the first line of what it was told itself."""
    said = str(error).partition("Config search path")[0]
    if isinstance(error.__cause__, OmegaConfBaseException):
        said += f": {str(error.__cause__).splitlines()[0]}"
    return " ".join(said.split())
