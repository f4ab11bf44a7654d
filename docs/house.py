"""Order of the rooms of l2p, and its drawing in docs/architecture.md: python docs/house.py

``tests/test_package.py`` checks the imports of the package against the same order.
"""

from __future__ import annotations

from pathlib import Path

PAGE = Path(__file__).parent / "architecture.md"
BEGIN, END = "<!-- house -->", "<!-- /house -->"

#: Floors, highest first. A room may import from lower floors, never from its own floor or above.
FLOORS: tuple[dict[str, str], ...] = (
    {"cli": "the command l2p"},
    {"auditing": "the audit and its report", "programs": "what train and eval share"},
    {"show": "pages, pictures, tables"},
    {"judging": "errors, confidence, bounds"},
    {
        "attacks": "heuristic, tomography, learned",
        "utility": "cameras localized in a release",
        "images": "pictures of points",
    },
    {"io": "files in and out"},
    {"geometry": "lines in the frame", "schemes": "points to lines", "simulator": "maps without data"},
    {"maps": "what is known, published, found", "work": "processes, memory, progress"},
    {"checks": "what arrays must be"},
    {"errors": "what users got wrong", "version": ""},
)


def drawing() -> str:
    """Draw the floors as text, each box as wide as the house."""
    width = 72
    rule = "─" * width
    rows = [f"┌{' l2p '.center(width, '─')}┐"]
    for number, floor in enumerate(FLOORS):
        rooms = [f"{room}: {what}" if what else room for room, what in floor.items()]
        if number:
            rows.append(f"├{rule}┤")
        line = ""
        for room in rooms:
            longer = f"{line}    {room}" if line else room
            if len(longer) > width - 2:
                rows.append(f"│ {line.ljust(width - 2)} │")
                longer = room
            line = longer
        rows.append(f"│ {line.ljust(width - 2)} │")
    return "\n".join([*rows, f"└{rule}┘"])


def drawn(text: str) -> str:
    """Insert the drawing in its place in the page."""
    begin, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    return f"{text[:begin]}\n\n```text\n{drawing()}\n```\n\n{text[end:]}"


if __name__ == "__main__":
    PAGE.write_text(drawn(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    print(PAGE)
