"""The page that makes pictures: what it answers, and to whom."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator
from http.client import HTTPConnection
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import torch
from PIL import Image
from test_page import WIDE, browser

from l2p.images.inversion import Inversion, InversionConfig
from l2p.images.picture import draw
from l2p.images.picture_points import PicturePoints
from l2p.images.views import placed_view
from l2p.maps.appearance import Appearance
from l2p.show.exhibit import Exhibit
from l2p.show.page.file_view import view_page
from l2p.show.serve import HOST, SIZE, PictureServer
from l2p.show.stance import Stance

__all__ = ["browser"]

PICTURE = "picture?at=0,0,0&toward=0,0,1&up=0,-1,0&angle=60"


@pytest.fixture
def server(rng) -> Iterator[PictureServer]:
    xyz = rng.normal(loc=(0, 0, 4), size=(300, 3))
    colors = rng.integers(256, size=(300, 3), dtype=np.uint8)
    points = PicturePoints(xyz, np.ones(300, dtype=np.float32), Appearance(colors))
    torch.manual_seed(0)
    network = Inversion(InversionConfig(features=8, widths=(8, 8, 8))).eval().requires_grad_(False)
    with PictureServer(b"<p>page</p>", points, network) as serving:
        thread = threading.Thread(target=serving.serve_forever, daemon=True)
        thread.start()
        yield serving
        serving.shutdown()
        thread.join()


def ask(server: PictureServer, path: str, host: str | None = None) -> tuple[int, bytes]:
    connection = HTTPConnection(HOST, server.server_port, timeout=30)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


def test_the_page_and_the_pictures_are_at_a_secret_address(server):
    assert ask(server, f"/{server.secret}/") == (200, b"<p>page</p>")
    status, body = ask(server, f"/{server.secret}/{PICTURE}")
    assert status == 200
    view = placed_view(np.zeros(3), np.array([0, 0, 1.0]), np.array([0, -1.0, 0]), width=SIZE[0], height=SIZE[1])
    with Image.open(io.BytesIO(body)) as image:
        np.testing.assert_array_equal(np.asarray(image), draw(server.network, server.points, view))


@pytest.mark.parametrize("path", ["/", f"/{PICTURE}", "/other/", f"/other/{PICTURE}"])
def test_without_the_secret_there_is_nothing(server, path):
    assert ask(server, path) == (404, b"")


def test_other_names_of_this_machine_are_refused(server):
    """A page of another site may let its own name point here; its requests name that site."""
    assert ask(server, f"/{server.secret}/", "evil.example")[0] == 403


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("picture", "got at None; expected three numbers"),
        ("picture?at=0,0,0&toward=0,0&up=0,1,0&angle=60", "got toward"),
        ("picture?at=0,0,0&toward=0,1,0&up=0,1,0&angle=60", "looks along its up direction"),
        ("picture?at=0,0,0&toward=1,1,0&up=0,1,0&angle=x", "got angle"),
        ("picture?at=nan,0,0&toward=1,1,0&up=0,1,0&angle=60", "got at"),
    ],
)
def test_impossible_places_are_said(server, query, said):
    status, body = ask(server, f"/{server.secret}/{query}")
    assert status == 400 and said in body.decode()


def test_stand_here_shows_the_picture_of_the_place(browser, rng):
    """The camera that the button asks for stands where the view's does: its target is in the middle of the picture."""
    xyz = rng.normal(size=(300, 3))
    points = PicturePoints(xyz, np.ones(300, dtype=np.float32), Appearance(np.full((300, 3), 90, dtype=np.uint8)))
    network = Inversion(InversionConfig(features=8, widths=(8, 8, 8))).eval().requires_grad_(False)
    exhibit = Exhibit(points=xyz, rgb=points.appearance.rgb)
    with PictureServer(view_page(exhibit, "map", "a scene", pictures=True), points, network) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        page = browser.new_page(viewport={"width": WIDE[0], "height": WIDE[1]})
        page.goto(serving.address)
        with page.expect_response(lambda answer: "/picture?" in answer.url) as answered:
            page.click("#stand")
        assert answered.value.status == 200
        asked = parse_qs(urlsplit(page.get_attribute("#stood-picture", "src")).query)
        page.close()
        serving.shutdown()
    at, toward, up = (np.array(asked[name][0].split(","), dtype=float) for name in ("at", "toward", "up"))
    stance = Stance.before(exhibit)
    np.testing.assert_allclose(toward, stance.center, atol=1e-9)
    assert np.linalg.norm(at - toward) == pytest.approx(2.6 * stance.radius)
    assert up @ stance.axes[2] > 0.8
