"""Kinds of files, recognised by content: scenes, hidden maps, recoveries, truths and checkpoints."""

from __future__ import annotations

import os
import re
from enum import Enum
from os import PathLike
from pathlib import Path

from l2p.errors import InputError
from l2p.io import signatures
from l2p.io.colmap_folders import model_folder
from l2p.io.npz import npz_keys
from l2p.io.other_lines import holds_lines, missing
from l2p.io.table_files import table_layout

#: Bytes read from the start of a file: enough for the header of a PLY file and the first records of a text file.
_HEAD_BYTES = 65536

#: Longest header that safetensors reads, in bytes.
_MOST_TENSOR_HEADER = 100_000_000


class Kind(Enum):
    """Kinds of files that l2p reads; the value is the name in messages."""

    SCENE_MODEL = "a COLMAP model"
    SCENE_PLY = "a point cloud (PLY)"
    SCENE_NPZ = "a scene (npz)"
    SCENE_TEXT = "a point cloud (text)"
    SCENE_ARRAY = "a point cloud (npy)"
    SCENE_OBJ = "a point cloud (OBJ)"
    SCENE_XYZ = signatures.XYZ_TEXT
    SCENE_PCD = signatures.PCD
    SCENE_POINTS = signatures.COLMAP_POINTS
    SCENE_BUNDLER = signatures.BUNDLER
    SCENE_NVM = signatures.NVM
    SCENE_OPENSFM = signatures.OPENSFM
    SCENE_OPENMVG = signatures.OPENMVG
    SCENE_MESHROOM = signatures.MESHROOM
    SCENE_NERFSTUDIO = signatures.NERFSTUDIO
    LINES_NPZ = "a line cloud (npz)"
    LINES_PLY = "a line cloud (PLY)"
    LINES_OBJ = "a line cloud (OBJ)"
    LINES_TEXT = "a line cloud (text)"
    LINES_ARRAY = "a line cloud (npy)"
    LINES_FOREIGN = "a line cloud of another tool (npz)"
    PLANES = "a plane cloud (npz)"
    PERMUTED = "a permuted cloud (npz)"
    RECOVERY = "a recovery (npz)"
    TRUTH = "a truth (npz)"
    CHECKPOINT = "a checkpoint (safetensors)"


#: Rows of numbers: columns of points or of lines.
TABLES = (Kind.SCENE_TEXT, Kind.SCENE_ARRAY, Kind.LINES_TEXT, Kind.LINES_ARRAY)
SCENES = tuple(kind for kind in Kind if kind.name.startswith("SCENE_"))
LINE_CLOUDS = tuple(kind for kind in Kind if kind.name.startswith("LINES_"))
#: What schemes publish.
HIDDEN_MAPS = (*LINE_CLOUDS, Kind.PLANES, Kind.PERMUTED)

# Kinds of npz files by the arrays that they need; the first match counts.
_NPZ_KINDS = (
    (Kind.LINES_NPZ, {"direction", "moment"}),
    (Kind.PLANES, {"normal", "offset"}),
    (Kind.PERMUTED, {"permuted"}),
    (Kind.RECOVERY, {"xyz", "confidence", "beta"}),
    (Kind.TRUTH, {"xyz", "index", "spacing"}),
    (Kind.SCENE_NPZ, {"xyz"}),
)


def kind_of(path: str | PathLike[str], columns: str | None = None) -> Kind:
    """Find the kind of a file or folder from its content, not from its name.

    Parameters
    ----------
    columns : str, optional
        What the columns of a text or npy file hold (``--columns``); refused for other files. A table that is malformed
        or undecided counts as lines: their reader says what is wrong.

    Raises
    ------
    FileNotFoundError
        If there is nothing at ``path``.
    InputError
        If it is empty, or of no kind that l2p reads.
    """
    kind = _kind_of(path)
    if columns is not None and kind not in TABLES:
        raise InputError(f"got --columns for {path}, which is {kind.value}; expected it for text or npy only")
    return _table_kind(path, kind, columns) if kind in TABLES else kind


def _kind_of(path: str | PathLike[str]) -> Kind:
    """The kind; of rows of numbers whether they are text or npy only."""
    if not os.fspath(path):
        raise InputError("got an empty path; expected the path of a file or folder")
    if not os.path.lexists(path):
        raise FileNotFoundError(f"{path} does not exist")
    if os.path.isdir(path):
        return _folder_kind(Path(path))
    if not os.path.isfile(path):
        raise InputError(f"{path} is not a regular file")
    with open(path, "rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise InputError(f"{path} is empty")
    if head.startswith(b"PK"):
        return _npz_kind(path)
    if head.startswith(b"ply"):
        return _ply_kind(head)
    if _is_safetensors(head):
        return Kind.CHECKPOINT
    foreign = signatures.foreign(path, head)
    return _text_kind(path, head) if foreign is None else Kind(foreign)


def _is_safetensors(head: bytes) -> bool:
    """Whether the file begins with the length of a JSON object and the object; a text gives a larger length."""
    return head[8:9] == b"{" and int.from_bytes(head[:8], "little") <= _MOST_TENSOR_HEADER


def _folder_kind(path: Path) -> Kind:
    """A model, or the folder of a project with one model in it; InputError if there is none, or several."""
    model_folder(path, say=False)
    return Kind.SCENE_MODEL


def _ply_kind(head: bytes) -> Kind:
    """Lines, or points: the edges of a scene, of camera frames or of a mesh, leave vertices over, or have faces."""
    header = head.split(b"end_header")[0]
    counts = {name: int(count) for name, count in re.findall(rb"[\r\n]element\s+(\w+)\s+(\d{1,18})", header)}
    edges = counts.get(b"edge", 0)
    drawn = edges > 0 and counts.get(b"vertex", 0) <= 2 * edges and not counts.get(b"face", 0)
    return Kind.LINES_PLY if drawn else Kind.SCENE_PLY


def _npz_kind(path: str | PathLike[str]) -> Kind:
    keys = npz_keys(path)
    found = next((kind for kind, needed in _NPZ_KINDS if needed <= keys), None)
    if found in (Kind.LINES_NPZ, Kind.SCENE_NPZ, None) and not {"direction", "moment", "scheme", "version"} <= keys:
        found = Kind.LINES_FOREIGN if holds_lines(keys) else found
    if found is not None:
        return found
    if any(name.endswith("data.pkl") for name in keys):
        raise InputError(f"{path} is a PyTorch file, which l2p does not read; write its points with numpy.savez")
    if keys and all("." in name or name.endswith("/") for name in keys):
        raise InputError(f"{path} is a zip archive of {len(keys)} files; unpack it, and give what is in it")
    names = ", ".join(sorted(keys)[:8]) or "nothing"
    raise InputError(f"{path} holds {names}; {missing(keys)}")


def _table_kind(path: str | PathLike[str], kind: Kind, columns: str | None) -> Kind:
    """Whether rows of numbers are points or lines."""
    text = kind is Kind.LINES_TEXT
    try:
        lines = table_layout(path, columns).are_lines
    except InputError:
        lines = True
    if lines:
        return kind
    return Kind.SCENE_TEXT if text else Kind.SCENE_ARRAY


def _text_kind(path: str | PathLike[str], head: bytes) -> Kind:
    if head.startswith(b"\x93NUMPY"):
        return Kind.LINES_ARRAY
    if b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path} is neither npz, PLY, OBJ nor text; expected one of these")
    records = {line.split(None, 1)[0] for line in head.splitlines() if line.strip()}
    if not records & {b"v", b"l"}:
        return Kind.LINES_TEXT
    return Kind.LINES_OBJ if _has_lines(path) else Kind.SCENE_OBJ


def _has_lines(path: str | PathLike[str]) -> bool:
    """Whether an OBJ has lines, which may follow all of its vertices."""
    with open(path, "rb") as file:
        return any(line.split(None, 1)[:1] == [b"l"] for line in file)
