"""Ends of the help: an example of each command, and where more is written."""

from __future__ import annotations

import textwrap

#: Of each command: an example, what it does, and its page in the folder docs/ of the repository.
EXAMPLES: dict[str, tuple[str, str, str]] = {
    "lift": (
        "l2p lift sparse/0 -o lines.npz --truth truth.npz",
        "hides the points of a COLMAP model, and keeps apart which line hides which",
        "schemes.md",
    ),
    "recover": (
        "l2p recover lines.npz -o recovered.ply --min-confidence 0.5",
        "writes the points that lie within one spacing with a probability of at least one half",
        "how-it-works.md",
    ),
    "evaluate": (
        "l2p evaluate recovered.npz truth.npz --metric",
        "prints the errors of a recovery of a map in metres",
        "formats.md",
    ),
    "localize": (
        "l2p localize sparse/0 --fractions 1 0.1",
        "localizes the images of a model in its points and in its lines, all of them and a tenth",
        "localization.md",
    ),
    "audit": (
        "l2p audit sparse/0 -o report --open",
        "tells what would come back of a model, and shows the page",
        "audit.md",
    ),
    "view": ("l2p view recovered.ply -o page.html --open", "shows a recovery in the browser", "formats.md"),
    "picture": (
        "l2p picture recovered.npz --model sparse/0 --view IMG_0012.jpg -o seen.png",
        "draws what an image of the model shows of the recovered points",
        "pictures.md",
    ),
    "info": ("l2p info lines.npz", "says what a file is, and what its lines give away", "formats.md"),
    "demo": ("l2p demo -o demo", "makes a room, hides it and recovers it; demo/demo.png shows it", "how-it-works.md"),
    "completion": (
        "l2p completion bash > ~/.local/share/bash-completion/completions/l2p",
        "completes the words of l2p from the next shell on; for zsh, write it to a file _l2p in a folder of $fpath",
        "formats.md",
    ),
}


def ending(command: str) -> str:
    """End of the help of a command."""
    example, does, page = EXAMPLES[command]
    explained = textwrap.fill(does, 78, initial_indent="    ", subsequent_indent="    ")
    return f"example:\n  {example}\n{explained}\n\ndocumentation: {address(page)}"


def address(page: str) -> str:
    """Return where a page of the documentation is: the address in the metadata of the package, or in its repository."""
    import importlib.metadata

    try:
        urls = importlib.metadata.metadata("l2p").get_all("Project-URL") or []
    except importlib.metadata.PackageNotFoundError:
        urls = []
    named = dict(url.split(", ", 1) for url in urls if ", " in url)
    site = named.get("Documentation")
    return f"docs/{page} of the repository of l2p" if site is None else f"docs/{page}, {site}"
