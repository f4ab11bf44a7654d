"""``l2p view --pictures``: the page of a file, served to this machine, which makes pictures."""

from __future__ import annotations

import webbrowser
from argparse import Namespace

from l2p.cli.map_names import shown_name
from l2p.cli.picture_command import points_at
from l2p.errors import InputError
from l2p.io.kinds import SCENES, Kind, kind_of


def serve(arguments: Namespace) -> None:
    """Serve the page until Ctrl-C."""
    if not arguments.pictures:
        raise InputError("got --lines without --pictures; expected both")
    if arguments.output is not None or arguments.window:
        raise InputError("got --pictures beside -o or --window; expected it alone, since such a page is served")
    kind = kind_of(arguments.file, arguments.columns)
    if kind not in SCENES and kind is not Kind.RECOVERY:
        raise InputError(f"got --pictures of {kind.value}; expected a recovery or a scene")
    if arguments.lines is not None and kind is not Kind.RECOVERY:
        raise InputError("got --lines beside something else than a recovery; expected the lines of a recovery")
    from l2p.images.inversion_file import load_inversion
    from l2p.show.exhibit import Exhibit
    from l2p.show.page.file_view import view_page
    from l2p.show.serve import PictureServer
    from l2p.show.window import has_display

    points = points_at(arguments.file, kind, arguments.lines)
    exhibit = Exhibit.load(arguments.file, arguments.columns)
    page = view_page(exhibit, shown_name(arguments.file), kind.value, pictures=True)
    with PictureServer(page, points, load_inversion()[0]) as server:
        print(f"{server.address} is open to this machine, until Ctrl-C", flush=True)
        if has_display():
            webbrowser.open(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("closed")
