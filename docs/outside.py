"""Hooks of mkdocs: add pages from outside docs/, and refuse pages that load from the network."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]

#: Files of the repository that become pages, and their names in the site.
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "l2p/weights/README.md": "checkpoint.md",
}
#: Relative link in Markdown, without its anchor.
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)#\s]+)")
#: Sphinx role of a name in a docstring, which mkdocs would show.
ROLE = re.compile(r":(?:func|class|mod|meth|attr):(?=<code>)")
#: Script, image, frame or stylesheet that a page loads from the network.
LOADED = re.compile(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"(?:https?:)?//|<link\b[^>]*stylesheet[^>]*\"https?:")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from outside docs/, and the files that any page links to."""
    for source, target in PAGES.items():
        files.append(File.generated(config, target, content=(ROOT / source).read_text(encoding="utf-8")))
    for file in [*files.documentation_pages()]:
        place = _place(file.src_uri)
        for link in LINK.findall(file.content_string):
            path = posixpath.normpath(posixpath.join(posixpath.dirname(place), link))
            linked = _in_site(path)
            if files.get_file_from_path(linked) is None and (ROOT / path).is_file():
                files.append(File.generated(config, linked, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the repository into links between pages of the site."""
    del config, files
    here = page.file.src_uri
    place = posixpath.dirname(_place(here))

    def moved(match: re.Match[str]) -> str:
        target = _in_site(posixpath.normpath(posixpath.join(place, match[1])))
        return posixpath.relpath(target, posixpath.dirname(here) or ".")

    return LINK.sub(moved, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Remove Sphinx roles from names in docstrings."""
    del page, config, files
    return ROLE.sub("", html)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Refuse a page that loads anything from the network."""
    del config
    found = LOADED.search(output)
    if found:
        raise PluginError(f"{page.file.src_uri} loads from the network: {output[found.start() : found.end() + 60]}")
    return output


def _place(src_uri: str) -> str:
    """Path in the repository of a page of the site."""
    return next((source for source, target in PAGES.items() if target == src_uri), f"docs/{src_uri}")


def _in_site(path: str) -> str:
    """Path in the site of a file of the repository."""
    return PAGES.get(path, path.removeprefix("docs/") if path.startswith("docs/") else f"files/{path}")
