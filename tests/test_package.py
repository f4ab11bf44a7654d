"""The package as a whole: what it loads, what it ships, and which way its imports point."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import l2p

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "l2p"

#: Loaded when they are used, never before.
HEAVY = {"torch", "scipy", "open3d", "pycolmap", "plyfile", "matplotlib", "lightning", "hydra", "h5py"}
#: Of these, what no module may load when it is imported; numeric modules may load torch.
LAZY = HEAVY - {"torch"}

#: What knows the truth: an attack must not reach it.
TRUTH = ("l2p.maps.scene", "l2p.maps.truth", "l2p.schemes", "l2p.simulator", "l2p.judging")
#: Beside the schemes, but read by attacks: it looks at published lines only. What it imports is tested as well.
OF_LINES = ("l2p.schemes.recognition", "l2p.schemes.meeting")


def floors() -> dict[str, int]:
    """The floor of each room, the highest first, as docs/house.py has them."""
    spec = importlib.util.spec_from_file_location("house", ROOT / "docs" / "house.py")
    assert spec is not None and spec.loader is not None
    house = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(house)
    return {room: number for number, floor in enumerate(house.FLOORS) for room in floor}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def name_of(file: Path) -> str:
    """``l2p/io/ply.py`` is ``l2p.io.ply``."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imported(tree: ast.AST) -> Iterator[str]:
    """Full names of the modules that are imported anywhere in a tree."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert node.module is not None
            yield node.module


@cache
def arrows() -> set[tuple[str, str]]:
    """Pairs (importer, imported) of modules inside l2p, without the table of public names."""
    known = {name_of(file) for file in modules()}
    pairs = set()
    for file in modules():
        if file == PACKAGE / "__init__.py":
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module is not None and node.module.split(".")[0] == "l2p":
                inner = {f"{node.module}.{alias.name}" for alias in node.names} & known
                pairs |= {(name_of(file), name) for name in inner or {node.module}}
    return {(source, target) for source, target in pairs if source != target}


def room(module: str) -> str:
    """``l2p.io.ply`` is in ``io``."""
    return module.split(".")[1]


def at_import(tree: ast.Module) -> ast.Module:
    """What runs when a module is imported: neither bodies of functions nor blocks for type checkers."""

    class Strip(ast.NodeTransformer):
        def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
            return None

        def visit_If(self, node: ast.If) -> ast.AST | None:
            return None if ast.unparse(node.test) == "TYPE_CHECKING" else self.generic_visit(node)

    return Strip().visit(tree)


def loaded_after(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter has after ``code``."""
    report = "import sys; print('LOADED', *{name.split('.')[0] for name in sys.modules})"
    run = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True, timeout=60
    )
    return set(run.stdout.rpartition("LOADED")[2].split())


def test_import_is_light():
    assert not loaded_after("import l2p") & HEAVY


def test_help_is_light():
    code = """
import l2p.cli.main
try:
    code = l2p.cli.main.main(["--help"])
except SystemExit as stop:
    code = stop.code
assert not code, code
"""
    assert not loaded_after(code) & HEAVY


def test_public_names_are_found_also_after_their_modules_are_loaded():
    names = " ".join(l2p.__all__)
    code = f"""
import l2p, l2p.attacks.run, l2p.cli.commands, l2p.schemes.hide, types
for name in "{names}".split():
    assert not isinstance(getattr(l2p, name), types.ModuleType), name
"""
    loaded_after(code)


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        getattr(l2p, "nonsense")  # noqa: B009


def test_version_is_the_installed_one():
    assert importlib.metadata.version("l2p") == l2p.__version__, "reinstall: pip install -e ."


def test_version_heads_the_changelog():
    assert f"## [{l2p.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_wheel_ships_the_whole_package_and_nothing_else():
    config = (ROOT / "pyproject.toml").read_text()
    assert '[tool.hatch.build.targets.wheel]\npackages = ["l2p"]' in config


@pytest.mark.parametrize(
    "file",
    [
        "l2p/py.typed",
        *("l2p/weights/learned.safetensors", "l2p/weights/README.md"),
        *(f"l2p/show/page/templates/{name}" for name in ("audit.html", "page.css", "region.js", "viewer.js")),
    ],
)
def test_package_data_are_there_and_not_ignored(file):
    """Hatchling leaves out what git ignores."""
    assert (ROOT / file).is_file()
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    ignored = subprocess.run(["git", "check-ignore", "-q", file], cwd=ROOT, check=False).returncode
    assert ignored == 1


def test_shipped_weights_are_installed_beside_the_code_and_say_how_they_were_made():
    from l2p.attacks.learned.checkpoint import read, shipped
    from l2p.attacks.learned.learned_config import LearnedConfig
    from l2p.attacks.learned.network import NetworkConfig

    assert shipped() == PACKAGE / "weights" / "learned.safetensors"
    checkpoint = read(shipped())
    assert isinstance(checkpoint.network.config, NetworkConfig) and isinstance(checkpoint.config, LearnedConfig)
    assert checkpoint.config.rounds >= 1
    assert {"command", "commit", "seed", "scenes", "steps", "minutes", "results"} <= set(checkpoint.facts)
    assert checkpoint.facts["results"], "figures on line clouds that were held back"


def test_shipped_weights_recover_a_room():
    points = l2p.simulate("room", 800, seed=5).xyz
    hidden = l2p.hide(points, seed=5)
    assert l2p.evaluate(l2p.recover(hidden.map), hidden.truth).within_spacings["1"] > 0.6


@pytest.mark.parametrize("file", modules(), ids=lambda file: str(file.relative_to(ROOT)))
def test_module_loads_nothing_heavy(file):
    names = {name.split(".")[0] for name in imported(at_import(ast.parse(file.read_text())))}
    # Programs start with hydra, which comes with their extra.
    assert not names & (LAZY - {"hydra"} if room(name_of(file) + ".x") == "programs" else LAZY)


def test_every_room_has_a_floor():
    rooms = {room(name_of(file)) for file in modules() if name_of(file) not in ("l2p", "l2p.__main__")}
    assert rooms == set(floors())


def test_arrows_point_down():
    floor = floors()
    inside = {(source, target) for source, target in arrows() if source != "l2p.__main__"}
    up = {
        (source, target)
        for source, target in inside
        if room(source) != room(target) and floor[room(source)] >= floor[room(target)]
    }
    assert not up


def test_no_imports_go_in_circles():
    """Not even inside functions: each module can be read after those that it imports."""
    pairs = arrows()
    left = {name: {target for source, target in pairs if source == name} for name in map(name_of, modules())}
    while left:
        free = [name for name, targets in left.items() if not targets & set(left)]
        assert free, f"a circle among {sorted(left)}"
        for name in free:
            del left[name]


def test_few_files_lie_outside_the_rooms():
    assert len(list(PACKAGE.glob("*.py"))) <= 8


def test_no_file_name_stands_for_two_things():
    files = [file for top in ("l2p", "train", "eval") for file in sorted((ROOT / top).rglob("*.py"))]
    names = [file.name for file in files if not file.name.startswith("__")]
    assert sorted(set(names)) == sorted(names)


def test_programs_do_not_import_each_other():
    for program, other in (("train", "eval"), ("eval", "train")):
        for file in (ROOT / program).rglob("*.py"):
            names = {name.split(".")[0] for name in imported(ast.parse(file.read_text()))}
            assert other not in names, file


def test_attack_cannot_reach_the_truth():
    reached, edge = set(), {name_of(file) for file in modules() if room(name_of(file) + ".x") == "attacks"}
    while edge:
        reached |= edge
        edge = {target for source, target in arrows() if source in edge} - reached
    assert not [name for name in reached if name.startswith(TRUTH) and name not in OF_LINES]


def test_package_imports_no_program():
    programs = {"train", "eval", "benchmarks", "tests"}
    for file in modules():
        names = {name.split(".")[0] for name in imported(ast.parse(file.read_text()))}
        assert not names & programs, file


@pytest.mark.parametrize("file", modules(), ids=lambda file: str(file.relative_to(ROOT)))
def test_file_tells_one_story(file):
    assert len(file.read_text().splitlines()) <= 400
