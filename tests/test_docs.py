"""The documentation: links hold, code blocks run, commands and names exist, figures are those of the measurements.

Blocks of a page run in its order, in a folder with small files under the names that pages use. A block under
``<!-- not run: reason -->`` is not run, but its commands are looked at like all others.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir
from matplotlib.image import imread

import l2p
from l2p.cli import main as cli
from l2p.simulator import simulate_model

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "l2p/weights/README.md")),
    *sorted(DOCS.glob("*.md")),
]
#: Written by `python -m eval`, with the command that made them: an hour each.
GENERATED = {page for page in PAGES if page.name.startswith("results")}
FENCE = re.compile(
    r"(?:^<!-- not run: (?P<reason>[^\n]+) -->\n)?"
    r"^```(?P<language>\w*)(?: title=\"(?P<title>[^\"]+)\")?\n(?P<body>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
#: Simulated scenes of README are made smaller.
POINTS = re.compile(r"\bpoints=\d+")
#: What a block without a language begins with if it is one of a shell.
PROGRAMS = {"l2p", "make", "mkdir", "pip", "python"}


@dataclass(frozen=True)
class Block:
    """A fenced block; ``reason`` says why it is not run."""

    language: str
    title: str | None
    body: str
    reason: str | None

    def commands(self) -> list[list[str]]:
        """The words of each line of a shell block, continued lines as one."""
        lines = self.body.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line.removeprefix("$ "), comments=True))]

    def is_shell(self) -> bool:
        """Also without a language, if it begins with a program."""
        begins = self.body.split(maxsplit=1)[0]
        return self.language in ("sh", "console") or (self.language == "" and begins in PROGRAMS)


def blocks_of(page: Path) -> list[Block]:
    found = FENCE.finditer(page.read_text(encoding="utf-8"))
    return [Block(m["language"], m["title"], m["body"], m["reason"]) for m in found]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def prose_of(page: Path) -> str:
    """A page without its fenced blocks and comments."""
    return re.sub(r"<!--.*?-->", "", FENCE.sub("", page.read_text(encoding="utf-8")), flags=re.DOTALL)


# Links


def anchors_of(page: Path) -> set[str]:
    """The anchors that GitHub gives to headings."""
    headings = re.findall(r"^#+ (.+)$", prose_of(page), re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "") for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_anchors_hold(page: Path) -> None:
    dead = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose_of(page)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.is_file() or (anchor and anchor not in anchors_of(target)):
            dead.append(link)
    assert not dead


# Code blocks


@pytest.fixture(scope="session")
def small_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a map, its line cloud, its truth and a recovery, under the names that pages use."""
    folder = tmp_path_factory.mktemp("small")
    model = folder / "path" / "to" / "colmap" / "model"
    simulate_model("room", 400, 0).save_colmap(model)
    shutil.copytree(model, folder / "MODEL")
    scene = l2p.load(model, l2p.Scene)
    hidden = l2p.hide(scene.xyz, seed=0)
    lines, index = hidden.map, hidden.truth.index
    l2p.save(lines, folder / "lines.npz")
    l2p.save(l2p.Truth(scene.xyz[index], index, 0.5), folder / "truth.npz")
    l2p.save(l2p.recover(lines, method="tomography"), folder / "recovered.npz")
    (folder / "docs").mkdir()
    shutil.copy(DOCS / "simulator.csv", folder / "docs")
    return folder


@pytest.fixture
def place(small_files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of them to work in; nothing opens a browser, and modules written there are found."""
    shutil.copytree(small_files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda *_, **__: True)
    return tmp_path


@pytest.mark.parametrize("page", [page for page in PAGES if blocks_of(page)], ids=name_of)
def test_code_blocks_run(page: Path, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Of the images of the model, audits localize a few.
    monkeypatch.setattr("l2p.cli.localize_flags.MOST_QUERIES", 2)
    names: dict[str, Any] = {"__name__": "page"}
    for block in blocks_of(page):
        if block.is_shell():
            for words in block.commands():
                check(words)
                if block.reason is None and page not in GENERATED:
                    run(words, place)
        elif block.language == "python":
            code = compile(POINTS.sub("points=400", block.body), name_of(page), "exec")
            if block.title:
                (place / block.title).write_text(block.body)
            if block.reason is None:
                exec(code, names)
        elif block.language == "yaml":
            yaml.safe_load(block.body)
        else:
            assert block.language in ("", "text"), f"{block.language} blocks are not checked"


def run(words: list[str], place: Path) -> None:
    """Run what belongs to l2p; `make` and `pip` are what CI itself is started with."""
    program, *arguments = words
    if program == "l2p":
        # Pages may be read in any order: what an earlier block wrote is replaced.
        force = ["--force"] if "--force" in options(arguments[0]) else []
        assert cli.main([*arguments, *force]) == 0, shlex.join(words)
    elif program == "mkdir":
        for name in arguments:
            (place / name).mkdir()
    elif program == "python":
        code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); import runpy; sys.argv = {arguments[1:]!r}; "
        code += f"runpy.run_module({arguments[1]!r}, run_name='__main__', alter_sys=True)"
        done = subprocess.run([sys.executable, "-c", code], cwd=place, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{shlex.join(words)}\n{done.stderr}"


# Commands that are not run, in blocks and in sentences


def check(words: list[str]) -> None:
    """A command exists, and so do its options."""
    program, *arguments = words
    if program == "l2p":
        parser().parse_args(arguments)
    elif program == "make":
        targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert {word for word in arguments if "=" not in word} <= set(targets)
    elif program == "pip":
        extras = re.findall(r"\[(\w+)\]$", words[-1])
        text = (ROOT / "pyproject.toml").read_text()
        assert (ROOT / "constraints.txt").is_file() and all(f"\n{extra} = [" in text for extra in extras)
    elif program.endswith("python"):
        check_python(arguments)
    elif program == "mkdir":
        assert not any(word.startswith("-") for word in arguments)
    elif program == "torchrun":
        check(arguments[arguments.index("-m") + 1 :])
    else:
        raise AssertionError(f"{program} is not known here: {shlex.join(words)}")


def check_python(arguments: list[str]) -> None:
    """A script exists, and a program's config can be composed."""
    if arguments[0] != "-m":
        assert (ROOT / arguments[0]).is_file()
    elif arguments[1] in ("eval", "train"):
        config, words = arguments[1], arguments[2:]
        if words[:1] == ["--config-name"]:
            config, words = words[1], words[2:]
        overrides = [word for word in words if word not in ("--multirun", "-m")]
        if len(overrides) < len(words):
            overrides = [re.sub(r"=([^\[,]+),.*", r"=\1", override) for override in overrides]
        composed(arguments[1], overrides, config)
    elif (ROOT / f"{arguments[1].replace('.', '/')}.py").is_file():
        return
    else:
        assert arguments[1] == "pytest" and all((ROOT / word).is_file() for word in arguments[2:] if word[0] != "-")


def composed(program: str, overrides: list[str], name: str) -> None:
    """An unknown key, experiment or type is an error of hydra."""
    import eval.eval_config
    import train.picture_config
    import train.train_config

    configs = {"eval": eval.eval_config.CONFIGS, "train": train.train_config.CONFIGS}[program]
    with initialize_config_dir(str(configs), version_base="1.3"):
        config = compose(name, overrides)
    if name == "train":
        train.train_config.settings_of(config)
    if name == "pictures" and config.maps:
        train.picture_config.picture_run_of(config)


def parser() -> argparse.ArgumentParser:
    return cli._parser()


def options(command: str) -> set[str]:
    """The options of a command of l2p."""
    commands = next(action for action in parser()._actions if isinstance(action, argparse._SubParsersAction))
    return {name for action in commands.choices[command]._actions for name in action.option_strings}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_in_sentences_exist(page: Path) -> None:
    text = prose_of(page)
    for line in re.findall(r"^ {4}(python .+)$", text, re.MULTILINE):
        check(shlex.split(line))
    for command, rest in re.findall(r"`l2p ([a-z]+)\b([^`]*)`", text):
        assert set(re.findall(r"(?<!\S)--?[a-z][a-z-]*", rest)) <= options(command), f"l2p {command}{rest}"
    for arguments in re.findall(r"`python -m ((?:eval|train)\b[^`]*)`", text):
        check(["python", "-m", *shlex.split(arguments)])


# Names and figures


def test_every_public_name_is_in_the_reference() -> None:
    listed = set(re.findall(r"^::: l2p\.(\w+)$", (DOCS / "api.md").read_text(), re.MULTILINE))
    assert listed == set(l2p.__all__)


def test_the_house_is_drawn_as_it_is() -> None:
    """The drawing is made from the order that the imports are held against."""
    spec = importlib.util.spec_from_file_location("house", DOCS / "house.py")
    assert spec is not None and spec.loader is not None
    house = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(house)
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    assert house.drawn(page) == page, "python docs/house.py"


def figures_of(text: str) -> Iterator[str]:
    yield from re.findall(r"(?<![\w.#])\d+(?:,\d{3})+|(?<![\w.])\d+\.\d+(?: / \d+ %)?", text)


#: Pages whose figures are those of a run.
MEASURED = ("experiments.md", "results.md", "simulator.md")


def test_figures_of_open_problems_are_measured() -> None:
    measured = "".join((DOCS / name).read_text() for name in MEASURED)
    measured = re.sub(r"(?<=\d) (?=\d{3}\b)", ",", measured)
    made_up = [figure for figure in figures_of(prose_of(DOCS / "open-problems.md")) if figure not in measured]
    assert not made_up


# Examples


def test_the_example_leaves_a_picture_and_points(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    command = [sys.executable, str(ROOT / "examples" / "audit_a_map.py"), "-o", str(folder)]
    command += ["--points", "400", "--method", "tomography"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert re.search(r"within 1 spacing: \d+% of all points", done.stdout)
    assert np.ptp(imread(folder / "audit.png")) > 0.5, "the picture is not blank"
    assert len(l2p.load(folder / "recovered.ply", l2p.Scene)) == len(l2p.load(folder / "lines.npz", l2p.LineCloud))
