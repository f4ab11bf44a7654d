"""The file of an inversion network: weights in half precision, its sizes, and the record of its training."""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any

import torch

from l2p.errors import InputError
from l2p.images.inversion import Inversion, InversionConfig

#: Version of the file format, and its key in the metadata of the safetensors file.
FORMAT, _FORMAT_KEY = 1, "l2p_inversion"
#: File of the weights that are installed with the package.
WEIGHTS = "inversion.safetensors"


def shipped_inversion() -> Path:
    """Path of the network that is installed with the package.

    Raises
    ------
    FileNotFoundError
        If it is missing from the installation.
    """
    path = Path(str(files("l2p") / "weights" / WEIGHTS))
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is missing from this installation; install l2p again, or give weights of your own"
        )
    return path


def save_inversion(
    path: str | PathLike[str], network: Inversion, facts: dict[str, Any], *, overwrite: bool = False
) -> None:
    """Write a network atomically, in half precision."""
    from safetensors.torch import save as encoded

    from l2p.io.atomic import atomic_file

    tensors = {name: value.detach().cpu().half().contiguous() for name, value in network.state_dict().items()}
    metadata = {
        _FORMAT_KEY: str(FORMAT),
        "network": json.dumps(asdict(network.config)),
        "facts": json.dumps(facts, ensure_ascii=False),
    }
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(encoded(tensors, metadata))


def load_inversion(path: str | PathLike[str] | None = None) -> tuple[Inversion, dict[str, Any]]:
    """Read a network and the facts of its training; by default the installed one.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is no inversion network of this version of l2p.
    """
    from safetensors import SafetensorError, safe_open

    path = shipped_inversion() if path is None else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; give the weights of an inversion network")
    try:
        with safe_open(str(path), framework="pt") as file:
            about = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is no safetensors file, or is damaged ({error})") from error
    if about.get(_FORMAT_KEY) != str(FORMAT):
        raise InputError(
            f"{path} has format {about.get(_FORMAT_KEY, 'none')} of inversion networks; expected {FORMAT}: weights "
            "that python -m train --config-name pictures writes"
        )
    try:
        sizes = json.loads(about["network"])
        network = Inversion(InversionConfig(**{**sizes, "widths": tuple(sizes["widths"])}))
        network.load_state_dict(tensors)
        facts = json.loads(about["facts"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{path} is damaged: its weights are not of the network that it names ({error})") from error
    return network.eval().requires_grad_(False), facts


@torch.no_grad()
def halved(network: Inversion) -> Inversion:
    """Round the weights to half precision, as a file has them."""
    for weight in network.parameters():
        weight.copy_(weight.half().float())
    return network
