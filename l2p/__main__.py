"""``python -m l2p`` is the command ``l2p``."""

import sys

from l2p.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
