"""Start from the weights of another checkpoint, whose network has fewer inputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.edges import feature_names
from l2p.attacks.learned.inputs import inputs_of
from l2p.attacks.learned.network import LineTransformer, NetworkConfig
from l2p.errors import InputError

#: The layer that reads the inputs.
_FIRST = "embed.0.weight"
#: Facts of an earlier training that are kept in the record of the next one.
_KEPT = ("command", "commit", "seed", "steps", "minutes")


@torch.no_grad()
def start_from(network: LineTransformer, path: Path) -> list[dict[str, Any]]:
    """Copy the weights; those of inputs that the checkpoint lacks become 0, so that the network first gives
    the same.

    Returns
    -------
    list of dict
        Command, commit, seed, steps and minutes of each training that made the checkpoint, the first one first.

    Raises
    ------
    FileNotFoundError, InputError
        If there is no such checkpoint, or its network is of other sizes or has other inputs.
    """
    whole = checkpoint.read(path)
    old, facts = whole.network, whole.facts
    mine, given = network.state_dict(), old.state_dict()
    columns = _columns(network.config)
    missing = [name for name in _columns(old.config) if name not in columns]
    other = [
        name
        for name, value in given.items()
        if name != _FIRST and (name not in mine or mine[name].shape != value.shape)
    ]
    if missing or other or len(mine[_FIRST]) != len(given[_FIRST]):
        raise InputError(
            f"{path} has {', '.join([*other, *missing]) or 'another width'}, unlike the network to train; expected "
            "the same sizes, and some of its inputs"
        )
    place = {name: number for number, name in enumerate(columns)}
    first = torch.zeros_like(mine[_FIRST])
    first[:, [place[name] for name in _columns(old.config)]] = given[_FIRST]
    network.load_state_dict({**mine, **given, _FIRST: first})
    before = facts.get("before")
    return [*(before if isinstance(before, list) else []), {name: facts.get(name) for name in _KEPT}]


def _columns(config: NetworkConfig) -> list[str]:
    """Names of the columns of the first layer."""
    state = [f"state {number}" for number in range(config.state)]
    around = [f"around {head} {number}" for head in range(config.heads) for number in range(config.around)]
    return [*feature_names(inputs_of(config.inputs)), *state, *around]
