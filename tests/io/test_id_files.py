"""Files of point ids: every form gives the same ids, and whatever is no id is refused in one sentence."""

from __future__ import annotations

import numpy as np
import pytest

from l2p.errors import InputError
from l2p.io.id_files import load_ids, marked_by_ids

IDS = np.array([17, 3, 9223372036854775807, 42], dtype=np.int64)


def test_all_forms_give_the_same_ids(tmp_path):
    words = [str(each) for each in IDS]
    (tmp_path / "lines").write_text("\n".join(words))
    (tmp_path / "blanks").write_text(
        "\ufeff# of a region\n " + "  ".join(words[:2]) + " # two\r\n\n" + ", ".join(words[2:])
    )
    np.save(tmp_path / "ids.npy", IDS)
    np.save(tmp_path / "unsigned.npy", IDS.astype(np.uint64))
    np.savez(tmp_path / "ids.npz", point3D_id=IDS)
    np.savez_compressed(tmp_path / "small.npz", point3D_id=IDS, descriptor=np.zeros((4, 2)))
    for name in ("lines", "blanks", "ids.npy", "unsigned.npy", "ids.npz", "small.npz"):
        assert load_ids(tmp_path / name).tolist() == IDS.tolist(), name
        assert load_ids(tmp_path / name).dtype == np.int64


@pytest.mark.parametrize("word", ["x", "1.5", "-1", "1e3", "0x1", "9223372036854775808", "9" * 5000, "٣", "1_0"])
def test_a_word_that_is_no_id_is_named_with_its_line(tmp_path, word):
    (tmp_path / "ids").write_text(f"1 2\n# all\n3 {word}\n")
    with pytest.raises(InputError, match=r"ids line 3: got .* expected a point id") as error:
        load_ids(tmp_path / "ids")
    assert len(str(error.value)) < 300


@pytest.mark.parametrize("content", [b"", b"\n \n", b"# nothing\n", b"\xff\xfe\x00", b"PK\x03\x04", b"\x93NUMPY\x01"])
def test_what_has_no_ids_is_refused(tmp_path, content):
    (tmp_path / "ids").write_bytes(content)
    with pytest.raises(InputError, match=r"expected (point ids|a complete)"):
        load_ids(tmp_path / "ids")


@pytest.mark.parametrize(
    "array",
    [
        np.array([1.0]),
        np.array(1),
        np.ones((2, 2), int),
        np.array(["1"]),
        np.array([2**63], np.uint64),
        np.zeros(0, int),
    ],
)
def test_an_array_of_other_than_ids_is_refused(tmp_path, array):
    np.save(tmp_path / "ids.npy", array)
    np.savez(tmp_path / "ids.npz", point3D_id=array)
    for name in ("ids.npy", "ids.npz"):
        with pytest.raises(InputError, match=r"ids\.np"):
            load_ids(tmp_path / name)


def test_objects_are_never_unpickled_and_cut_files_are_refused(tmp_path):
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="Python objects"):
        load_ids(tmp_path / "objects.npy")
    np.save(tmp_path / "ids.npy", IDS)
    whole = (tmp_path / "ids.npy").read_bytes()
    for cut in range(8, len(whole), 7):
        (tmp_path / "cut.npy").write_bytes(whole[:cut])
        with pytest.raises(InputError, match="truncated or damaged"):
            load_ids(tmp_path / "cut.npy")
    np.savez(tmp_path / "other.npz", ids=IDS)
    with pytest.raises(InputError, match="has no point3D_id"):
        load_ids(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError):
        load_ids(tmp_path / "absent")
    with pytest.raises(InputError, match="is a folder; expected point ids"):
        load_ids(tmp_path)


def test_points_are_found_by_their_ids(tmp_path, rng):
    ids = rng.permutation(1000)[:200]
    listed = np.append(ids[::7], ids[0])
    (tmp_path / "ids").write_text(" ".join(map(str, listed)))
    assert marked_by_ids(tmp_path / "ids", ids).tolist() == [each in set(listed.tolist()) for each in ids.tolist()]


def test_ids_of_another_scene_are_refused(tmp_path):
    (tmp_path / "ids").write_text("5 6 2000 7 1000")
    with pytest.raises(InputError, match="lists 2 of its 5 point ids that the scene lacks, 1000 among them"):
        marked_by_ids(tmp_path / "ids", np.arange(10))
    with pytest.raises(InputError, match="without ids; expected a COLMAP model"):
        marked_by_ids(tmp_path / "ids", None)
