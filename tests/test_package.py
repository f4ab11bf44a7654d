"""The package as a whole: what it loads, what it ships, and which way its imports point."""

from __future__ import annotations

import ast
import importlib.metadata
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import l2p

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "l2p"

#: Loaded when they are used, never before.
HEAVY = {"torch", "scipy", "open3d", "pycolmap", "plyfile", "matplotlib", "lightning", "hydra"}
#: Of these, what no module may load when it is imported; numeric modules may load torch.
LAZY = HEAVY - {"torch"}

#: Each module may import those before it. Folders stand for all their files.
ORDER = [
    *("errors", "methods", "progress", "memory", "threads", "sharding", "journal", "rounds", "processes"),
    "point_neighbors",
    *("lines", "geometry", "frame", "recovery", "scene"),
    *("lifting", "point_tree", "point_search", "search", "peak", "octree", "tomography", "neighborhoods"),
    *("surfaces", "features", "network", "learned", "checkpoint", "attack"),
    *("metrics", "oracles", "simulator", "clean"),
    *("curves", "provenance", "auditing"),
    *("io", "tables", "pictures", "demo", "exhibit", "window", "page"),
    *("outputs", "recovering", "commands", "cli", "__main__"),
]
#: Calls like ``LineCloud.load`` that open a file: the only imports against the order, inside functions.
DOORS = {("lines", "io"), ("recovery", "io"), ("scene", "io"), ("checkpoint", "io"), ("auditing", "page")}
#: What knows the truth: an attack must not reach it.
TRUTH = {"scene", "metrics", "oracles", "simulator"}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def place(file: Path) -> str:
    """Name of a module in ORDER: ``l2p/io/ply.py`` is ``io``."""
    return file.relative_to(PACKAGE).with_suffix("").parts[0]


def imported(tree: ast.AST) -> Iterator[str]:
    """Full names of the modules that are imported anywhere in a tree."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert node.module is not None
            if node.module == "l2p":
                yield from (f"l2p.{alias.name}" for alias in node.names if alias.name != "__version__")
            else:
                yield node.module


def arrows() -> set[tuple[str, str]]:
    """Pairs (importer, imported) inside l2p, without the table of public names."""
    pairs = set()
    for file in modules():
        if file != PACKAGE / "__init__.py":
            names = [name.split(".") for name in imported(ast.parse(file.read_text()))]
            pairs |= {(place(file), name[1]) for name in names if name[0] == "l2p" and len(name) > 1}
    return {(source, target) for source, target in pairs if source != target}


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
import l2p.cli
try:
    code = l2p.cli.main(["--help"])
except SystemExit as stop:
    code = stop.code
assert not code, code
"""
    assert not loaded_after(code) & HEAVY


def test_public_names_are_found_also_after_their_modules_are_loaded():
    names = " ".join(l2p.__all__)
    code = f"""
import l2p, l2p.attack, l2p.commands, l2p.lifting, types
for name in "{names}".split():
    assert not isinstance(getattr(l2p, name), types.ModuleType), name
"""
    loaded_after(code)


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        l2p.nonsense  # noqa: B018


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
        *(f"l2p/page/templates/{name}" for name in ("audit.html", "page.css", "viewer.js")),
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
    from l2p.checkpoint import read, shipped
    from l2p.learned import LearnedConfig
    from l2p.network import NetworkConfig

    assert shipped() == PACKAGE / "weights" / "learned.safetensors"
    checkpoint = read(shipped())
    assert isinstance(checkpoint.network.config, NetworkConfig) and isinstance(checkpoint.config, LearnedConfig)
    assert checkpoint.config.rounds >= 1
    assert {"command", "commit", "seed", "scenes", "steps", "minutes", "results"} <= set(checkpoint.facts)
    assert checkpoint.facts["results"], "figures on line clouds that were held back"


def test_shipped_weights_recover_a_room():
    points = l2p.simulate("room", 800, seed=5).xyz
    lines, index = l2p.lift_indexed(points, seed=5)
    assert l2p.evaluate(l2p.recover(lines), points[index]).within_spacings["1"] > 0.6


@pytest.mark.parametrize("file", modules(), ids=lambda file: str(file.relative_to(ROOT)))
def test_module_loads_nothing_heavy(file):
    names = {name.split(".")[0] for name in imported(at_import(ast.parse(file.read_text())))}
    assert not names & LAZY


def test_every_module_has_a_place_in_the_order():
    assert {place(file) for file in modules()} - {"__init__"} <= set(ORDER)


def test_arrows_point_one_way():
    rank = {name: number for number, name in enumerate(ORDER)}
    against = {(source, target) for source, target in arrows() if rank[source] < rank[target]}
    assert against <= DOORS


def test_attack_cannot_reach_the_truth():
    reached, edge = set(), {"attack"}
    while edge:
        reached |= edge
        edge = {target for source, target in arrows() - DOORS if source in edge} - reached
    assert not reached & TRUTH


def test_package_imports_no_program():
    programs = {"train", "eval", "benchmarks", "tests"}
    for file in modules():
        names = {name.split(".")[0] for name in imported(ast.parse(file.read_text()))}
        assert not names & programs, file


@pytest.mark.parametrize("file", modules(), ids=lambda file: str(file.relative_to(ROOT)))
def test_file_tells_one_story(file):
    assert len(file.read_text().splitlines()) <= 400
