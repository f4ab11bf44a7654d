"""Entry point to all files: ``load`` reads any kind from a path, ``save`` writes any kind."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from typing import Any, TypeVar, overload

from l2p.checks import named
from l2p.errors import InputError
from l2p.io.descriptors import load_described
from l2p.io.hidden_files import load_hidden, load_permuted, load_planes, save_hidden
from l2p.io.kinds import HIDDEN_MAPS, SCENES, Kind, kind_of
from l2p.io.line_files import load_lines
from l2p.io.recovery_files import load_recovery, save_recovery
from l2p.io.scene_files import load_scene, load_truth, save_scene, save_truth
from l2p.maps.lines import LineCloud
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene
from l2p.maps.truth import MAPS, Truth

Thing = TypeVar("Thing", Scene, LineCloud, PlaneCloud, PermutedCloud, Recovery, Truth)

_LOADERS: dict[type[Any], Callable[..., Any]] = {
    Scene: load_scene,
    LineCloud: load_lines,
    PlaneCloud: load_planes,
    PermutedCloud: load_permuted,
    Recovery: load_recovery,
    Truth: load_truth,
}


@overload
def load(
    path: str | PathLike[str], *, descriptors: str | PathLike[str] | bool = False, columns: str | None = None
) -> Any: ...
@overload
def load(
    path: str | PathLike[str],
    expected: type[Thing],
    *,
    descriptors: str | PathLike[str] | bool = False,
    columns: str | None = None,
) -> Thing: ...


def load(
    path: str | PathLike[str],
    expected: type[Any] | None = None,
    *,
    descriptors: str | PathLike[str] | bool = False,
    columns: str | None = None,
) -> Any:
    """Read a scene, hidden map, recovery or truth; the content of the file decides which, not its name.

    Parameters
    ----------
    path : path
        A COLMAP model folder, PLY, npz, OBJ or text file (``docs/formats.md``).
    expected : type, optional
        ``Scene``, ``LineCloud``, ``PlaneCloud``, ``PermutedCloud``, ``Recovery`` or ``Truth``; any other kind is
        refused.
    descriptors : path or bool
        For a scene: a file with the descriptors of its points (``docs/formats.md``); True searches beside a COLMAP
        model, and requires them of an npz. By default an npz keeps its own, and a model has none.
    columns : str, optional
        For text and npy: what the columns hold, in their order, such as ``"x,y,z,dx,dy,dz"`` or ``"x,y,z,r,g,b"``; by
        default a header or the numbers tell it.

    Raises
    ------
    FileNotFoundError
        If there is nothing at ``path``.
    InputError
        If the file is damaged or of another kind, or a point has no descriptor where descriptors are wanted.

    Examples
    --------
    >>> import tempfile, l2p
    >>> lines = l2p.lift(l2p.simulate("room", points=300, seed=0).xyz, seed=0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     l2p.save(lines, f"{folder}/lines.npz")
    ...     len(l2p.load(f"{folder}/lines.npz"))
    300
    """
    if descriptors is not False:
        if expected not in (None, Scene):
            raise InputError(f"got descriptors for a {expected.__name__}; expected a Scene")
        return load_described(path, None if descriptors is True else descriptors)[0]
    if not isinstance(path, str | PathLike):
        raise InputError(f"got {named(path)}; expected the path of a file or folder")
    kind = kind_of(path, columns)
    if expected is not None:
        return _LOADERS[expected](path, columns) if columns is not None else _LOADERS[expected](path)
    if kind is Kind.CHECKPOINT:
        raise InputError(f"{path} is {kind.value}; give it to l2p.recover(lines, checkpoint=...)")
    if kind in HIDDEN_MAPS:
        return load_hidden(path, columns)
    if kind in SCENES:
        return load_scene(path, columns)
    return load_recovery(path) if kind is Kind.RECOVERY else load_truth(path)


def save(
    thing: Scene | LineCloud | PlaneCloud | PermutedCloud | Recovery | Truth,
    path: str | PathLike[str],
    *,
    overwrite: bool = False,
) -> None:
    """Write a hidden map, a recovery, a truth or a scene, whole or not at all.

    Lines go to npz, PLY or OBJ, planes, permuted points and truths to npz, recoveries and scenes to npz or PLY.

    Raises
    ------
    InputError
        If no format of this kind of data has the ending of ``path``, the file exists (without ``overwrite``), or it
        cannot be written.
    TypeError
        If ``thing`` is of none of these types.
    """
    if isinstance(thing, MAPS):
        save_hidden(thing, path, overwrite=overwrite)
    elif isinstance(thing, Recovery):
        save_recovery(thing, path, overwrite=overwrite)
    elif isinstance(thing, Truth):
        save_truth(thing, path, overwrite=overwrite)
    elif isinstance(thing, Scene):
        save_scene(thing, path, overwrite=overwrite)
    else:
        raise TypeError(f"got a {type(thing).__name__}; expected a hidden map, a Recovery, Truth or Scene")
