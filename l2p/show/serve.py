"""A page of this machine that makes pictures: "stand here" asks for one, and gets it."""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError
from l2p.images.inversion import Inversion
from l2p.images.picture import draw
from l2p.images.picture_points import PicturePoints
from l2p.images.views import placed_view
from l2p.io.image_files import image_bytes

#: The only address that is served: nobody else on the network sees the map.
HOST = "127.0.0.1"
#: Pixels of a picture.
SIZE = (480, 320)


class PictureServer(ThreadingHTTPServer):
    """Serves a page, and pictures of the points in it, to this machine only.

    The address has a secret that other pages in the same browser do not know; requests for another host are refused,
    so that no name that is made to point to this machine can ask.

    Parameters
    ----------
    page : bytes
        HTML; ``PICTURES`` in it stands for the address of pictures.
    points : PicturePoints
    network : Inversion
    port : int
        0: any free port.
    """

    daemon_threads = True

    def __init__(self, page: bytes, points: PicturePoints, network: Inversion, port: int = 0) -> None:
        super().__init__((HOST, port), _Handler)
        self.secret = secrets.token_urlsafe(16)
        self.page, self.points, self.network = page, points, network

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server_port}/{self.secret}/"

    def answer(self, query: Mapping[str, list[str]]) -> bytes:
        """Make the picture that a query asks for: ``at``, ``toward``, ``up`` (X,Y,Z) and ``angle``, degrees.

        Raises
        ------
        InputError
            If a word is missing or is no place, or the camera cannot look that way.
        """
        at, toward, up = (_place(query, name) for name in ("at", "toward", "up"))
        angle = _number(query, "angle")
        view = placed_view(at, toward, up, angle=angle, width=SIZE[0], height=SIZE[1])
        return image_bytes(draw(self.network, self.points, view))


class _Handler(BaseHTTPRequestHandler):
    server: PictureServer

    def do_GET(self) -> None:
        where = urlsplit(self.path)
        if self.headers.get("Host") != f"{HOST}:{self.server.server_port}":
            self._send(HTTPStatus.FORBIDDEN, b"", "text/plain")
        elif where.path == f"/{self.server.secret}/":
            self._send(HTTPStatus.OK, self.server.page, "text/html; charset=utf-8")
        elif where.path == f"/{self.server.secret}/picture":
            try:
                self._send(HTTPStatus.OK, self.server.answer(parse_qs(where.query)), "image/png")
            except InputError as error:
                self._send(HTTPStatus.BAD_REQUEST, json.dumps(str(error)).encode(), "application/json")
        else:
            self._send(HTTPStatus.NOT_FOUND, b"", "text/plain")

    def _send(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        """Say nothing: the terminal is for the user."""


def _place(query: Mapping[str, list[str]], name: str) -> Float[np.ndarray, "3"]:
    try:
        found = np.array([float(part) for part in query[name][0].split(",")])
    except (KeyError, ValueError):
        found = np.empty(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise InputError(f"got {name} {query.get(name)}; expected three numbers, X,Y,Z")
    return found


def _number(query: Mapping[str, list[str]], name: str) -> float:
    try:
        return float(query[name][0])
    except (KeyError, ValueError):
        raise InputError(f"got {name} {query.get(name)}; expected a number") from None
