"""Import of Open3D, which needs libraries of the system."""

from __future__ import annotations

from typing import Any

from l2p.errors import InputError

#: Debian packages that Open3D needs.
DEBIAN_PACKAGES = "libusb-1.0-0 libgl1 libegl1 libx11-6"


def load_open3d(flag: str = "--clean", otherwise: str | None = None) -> Any:
    """Import open3d; InputError with how to install it if that fails.

    ``flag`` is the option that needs it; ``otherwise`` says what to do if none does.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"Open3D does not load ({reason}); install it with pip install open3d and apt install {DEBIAN_PACKAGES}, "
            f"or {otherwise or f'leave out {flag}'}"
        ) from error
    return open3d
