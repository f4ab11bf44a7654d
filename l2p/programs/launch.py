"""Start of a program: hydra composes the config, and errors of the user end in one sentence and exit code 2."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from l2p.errors import InputError, sentence
from l2p.programs.needed import end_without

#: Exit code after Ctrl-C, 128 + SIGINT.
INTERRUPTED = 130


def launch(program: str, main: Callable[[], None]) -> None:
    """Run ``main``, a function decorated by ``hydra.main``; errors of its config end the program with code 2."""
    # Hydra's own reports are several lines long and end with exit code 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        main()
    except (HydraException, OmegaConfBaseException) as error:  # some are an OSError, too
        _end(program, _hydra_message(error))
    except OSError as error:  # of the folder that hydra makes; ``explained`` ends the program for other errors
        _end(program, f"{sentence(error)}; expected a folder that can be written to, run=FOLDER")


@contextmanager
def explained(program: str, left: Callable[[], str] = lambda: "the same command continues the run") -> Iterator[None]:
    """End the program in one sentence on InputError, OSError or a missing package, before hydra reports it.

    On Ctrl-C it ends with code 130 and says what is ``left``; of several ranks, one does.
    """
    try:
        yield
    except (InputError, OSError) as error:
        _end(program, sentence(error))
    except ModuleNotFoundError as error:
        end_without(program, error)
    except KeyboardInterrupt:
        if os.environ.get("LOCAL_RANK", "0") == "0":
            print(f"{program}: interrupted; {left()}", file=sys.stderr)
        sys.exit(INTERRUPTED)


def _end(program: str, message: str) -> NoReturn:
    print(f"{program}: {message}", file=sys.stderr)
    sys.exit(2)


def _hydra_message(error: Exception) -> str:
    """Message of hydra without its search path, and the first line of its cause."""
    message = str(error).partition("Config search path")[0]
    if isinstance(error.__cause__, OmegaConfBaseException):
        message += f": {str(error.__cause__).splitlines()[0]}"
    return " ".join(message.split())
