"""The parser of the command line: errors in one line, and help that ends with an example."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from typing import Any, NoReturn

#: Exit code of the user's error.
USER_ERROR = 2


class Parser(argparse.ArgumentParser):
    """Parser that reports an error in one line, without the usage, and takes -1e-3 and -inf for numbers."""

    def __init__(self, *words: Any, **names: Any) -> None:
        super().__init__(*words, **names)
        self.formatter_class = argparse.RawDescriptionHelpFormatter
        self.ending: Callable[[], str] | None = None
        # argparse's own, until Python 3.14, takes what has an exponent for an option.
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$|-inf$", re.IGNORECASE)

    def format_help(self) -> str:
        """Add an example and the address of the documentation."""
        return super().format_help() + ("" if self.ending is None else f"\n{self.ending()}\n")

    def error(self, message: str) -> NoReturn:
        complain(f"{message} (see {self.prog} --help)")
        raise SystemExit(USER_ERROR)


def complain(said: str) -> None:
    """Print an error in one line."""
    print("l2p: error:", " ".join(said.split()), file=sys.stderr)
