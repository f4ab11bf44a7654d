"""Pictures of recoveries, scenes and ray clouds, by Python and by the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import l2p
from l2p.cli.main import main
from l2p.errors import InputError
from l2p.images.inversion import Inversion, InversionConfig
from l2p.images.inversion_file import save_inversion
from l2p.images.panorama import rays_seen
from l2p.images.photographs import folder_beside, photograph
from l2p.images.picture_points import points_of
from l2p.images.views import view_of
from l2p.io.colmap import read_model
from l2p.simulator import simulate_model


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A model with photographs, its line cloud, a recovery, and weights that fill between points."""
    folder = tmp_path_factory.mktemp("pictures")
    simulate_model("room", 400, 2).save_colmap(folder / "model")
    scene = l2p.load(folder / "model", l2p.Scene)
    hidden = l2p.hide(scene, 1, rgb=True)
    l2p.save(hidden.map, folder / "lines.npz")
    l2p.save(l2p.recover(hidden.map, "tomography"), folder / "found.npz")
    l2p.save(l2p.hide(scene, 1, scheme="sphere", rgb=True).map, folder / "sphere.npz")
    save_inversion(folder / "net.safetensors", Inversion(InversionConfig(features=8, widths=(8, 8, 8))), {})
    model = read_model(folder / "model")
    (folder / "model" / "images").mkdir()
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        half = np.zeros((camera.height // 2, camera.width // 2, 3), dtype=np.uint8)
        Image.fromarray(half).save(folder / "model" / "images" / image.name)
    return folder


@pytest.fixture(scope="module")
def name(files) -> str:
    return min(image.name for image in read_model(files / "model").images.values())


def run(files: Path, *words: object) -> int:
    return main(["picture", *map(str, words), "--weights", str(files / "net.safetensors")])


def test_python_takes_what_is_at_hand(files, name):
    view, weights = view_of(read_model(files / "model"), name), files / "net.safetensors"
    scene, recovery = l2p.load(files / "model", l2p.Scene), l2p.load(files / "found.npz", l2p.Recovery)
    lines = l2p.load(files / "lines.npz", l2p.LineCloud)
    by_view = l2p.picture(recovery, view, weights=weights)
    by_name = l2p.picture(recovery, name, model=files / "model", weights=weights)
    np.testing.assert_array_equal(by_view, by_name)
    assert by_view.shape == (view.height, view.width, 3)
    np.testing.assert_array_equal(l2p.picture(recovery, view, lines=lines, weights=weights), by_view)
    assert (l2p.picture(scene, view, weights=weights) != by_view).any()
    with pytest.raises(InputError, match="without a model; expected the model that has it"):
        l2p.picture(recovery, name, weights=weights)
    with pytest.raises(InputError, match="got lines beside a scene"):
        l2p.picture(scene, view, lines=lines, weights=weights)
    with pytest.raises(InputError, match="got lines that do not meet in a centre"):
        l2p.picture(lines, view, weights=weights)


def test_points_that_a_filter_dropped_are_not_drawn(files, rng):
    recovery = l2p.load(files / "found.npz", l2p.Recovery)
    kept = rng.random(len(recovery)) < 0.5
    from dataclasses import replace

    points = points_of(replace(recovery, kept=kept))
    np.testing.assert_array_equal(points.xyz, recovery.xyz[kept])
    assert recovery.rgb is not None and points.appearance.rgb is not None
    np.testing.assert_array_equal(points.appearance.rgb, recovery.rgb[kept])


def test_a_recovery_of_other_lines_is_refused(files):
    recovery = l2p.load(files / "found.npz", l2p.Recovery)
    few = l2p.load(files / "lines.npz", l2p.LineCloud).rows(np.arange(10))
    with pytest.raises(InputError, match="expected the lines that it was recovered from"):
        points_of(recovery, few)


def test_a_sphere_cloud_shows_the_scene_without_any_depth(files):
    """Each line is at the pixel where its point is seen from the centre."""
    scene = l2p.load(files / "model", l2p.Scene)
    hidden = l2p.hide(scene, 1, scheme="sphere")
    rays, center = rays_seen(hidden.map)
    toward = hidden.truth.xyz - center
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    shown = (rays.xyz - center) @ toward.T
    # Each real point has a ray in its direction; the others are fakes.
    np.testing.assert_allclose(shown.max(axis=0), 1, atol=1e-6)


def test_a_ray_cloud_needs_the_sides_of_its_points(rng):
    xyz = rng.normal(size=(400, 3)) * 3
    hidden = l2p.hide(xyz, 1, scheme="rays")
    both, center = rays_seen(hidden.map)
    mine = np.isclose(np.linalg.norm(np.cross(center - hidden.map.origin, hidden.map.direction), axis=1), 0, atol=1e-6)
    side = np.sum((hidden.truth.xyz - center) * hidden.map.direction, axis=1)
    known, _ = rays_seen(hidden.map, side=side)
    assert len(both.xyz) == 2 * len(known.xyz) == 2 * mine.sum()
    true = hidden.truth.xyz[mine] - center
    np.testing.assert_allclose(known.xyz - center, true / np.linalg.norm(true, axis=1, keepdims=True), atol=1e-6)
    second, other = rays_seen(hidden.map, 2)
    assert np.linalg.norm(other - center) > 0.1 and len(second.xyz) + len(both.xyz) == 2 * len(xyz)
    with pytest.raises(InputError, match="got centre 3; expected 1 to 2"):
        rays_seen(hidden.map, 3)


def test_the_command_draws_a_recovery_and_tells_how_like_the_photograph_it_is(files, name, tmp_path, capsys):
    out = tmp_path / "seen.png"
    assert run(files, files / "found.npz", "--model", files / "model", "--view", name, "-o", out) == 0
    said = capsys.readouterr().out
    assert "pixels from" in said and "Against the photograph: SSIM" in said
    with Image.open(out) as image:
        assert max(image.size) == 320
    assert run(files, files / "model", "--view", name, "-o", tmp_path / "true.jpg", "--json", "-") == 0
    assert '"used"' in capsys.readouterr().out


def test_the_command_places_cameras_and_looks_around(files, tmp_path, capsys):
    out = tmp_path / "placed.png"
    words = ("--at", "0,0,0", "--toward", "1,0,0", "--up", "0,0,1", "--size", "100x60")
    assert run(files, files / "found.npz", *words, "--ignore", "rgb", "-o", out) == 0
    assert "Neither colours nor descriptors are known" in capsys.readouterr().out
    with Image.open(out) as image:
        assert image.size == (100, 60)
    assert run(files, files / "sphere.npz", "-o", tmp_path / "around.png") == 0
    with Image.open(tmp_path / "around.png") as image:
        assert image.size == (640, 320)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("found.npz", "-o", "x.png"), "got no view; expected --view NAME of the model, or --at X,Y,Z --toward X,Y,Z"),
        (("found.npz", "--view", "a.jpg", "-o", "x.png"), "got --view a.jpg without --model"),
        (("found.npz", "--at", "0,0,0", "-o", "x.png"), "got one of --at and --toward; expected both"),
        (("found.npz", "--at", "0,0", "--toward", "1,1,1", "-o", "x.png"), "got '0,0'; expected three numbers"),
        (("model", "--view", "none.jpg", "-o", "x.png"), "got view 'none.jpg'; expected one of the"),
        (("lines.npz", "-o", "x.png"), "got lines that do not meet in a centre"),
        (("net.safetensors", "-o", "x.png"), "expected a recovery, a scene or a line cloud"),
        (("model", "--view", "none.jpg", "-o", "x.gif"), "expected a picture to end with .png or .jpg"),
        (("model", "--lines", "lines.npz", "--view", "a", "-o", "x.png"), "got --lines beside something else"),
        (("sphere.npz", "--center", "2", "-o", "x.png"), "got centre 2; expected 1 to 1"),
    ],
)
def test_wrong_words_are_refused(files, monkeypatch, capsys, words, said):
    monkeypatch.chdir(files)
    try:
        code = main(["picture", *words])
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    assert said in capsys.readouterr().err
    assert not Path("x.png").exists()


def test_photographs_are_found_and_checked(files, name, tmp_path):
    folder, view = folder_beside(files / "model"), view_of(read_model(files / "model"), name)
    assert folder is not None and photograph(folder, view).shape == (view.height, view.width, 3)
    with pytest.raises(FileNotFoundError, match="give the folder of the model's photographs"):
        photograph(tmp_path, view)
    (tmp_path / name).write_text("no image")
    with pytest.raises(InputError, match="is no image that can be read"):
        photograph(tmp_path, view)
    Image.fromarray(np.zeros((50, 50, 3), np.uint8)).save(tmp_path / name)
    with pytest.raises(InputError, match="expected the photograph that the model was made from"):
        photograph(tmp_path, view)
