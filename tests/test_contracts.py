"""Promises the repository makes as a whole: who imports whom, what an import costs, what is shipped, what is named."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from athlete_twin.assets import assets_root, named_toml, read_toml, robot_dir, robot_names
from athlete_twin.errors import ConfigError

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("athlete_twin", "planner", "envs")
HEAVY = ("pybullet", "open3d", "ompl", "gymnasium", "matplotlib", "viser", "ray", "mujoco")
NEEDS_GIT = pytest.mark.skipif(
    not (ROOT / ".git").exists() or shutil.which("git") is None, reason="lists the files of the git checkout"
)


def sources(*folders: str) -> Iterator[tuple[Path, ast.Module]]:
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield path, ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imported_modules(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def modules_after(statement: str) -> set[str]:
    """Modules that a fresh interpreter has loaded after the statement and not before it."""
    program = (
        "import json, sys\nbefore = set(sys.modules)\n"
        f"{statement}\nsys.stdout.write(json.dumps(sorted(set(sys.modules) - before)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout))


def loaded_of(names: tuple[str, ...], modules: set[str]) -> set[str]:
    return {name for name in names if name in modules}


# Who imports whom -----------------------------------------------------------------------------------------------------


def test_import_contracts_hold() -> None:
    done = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports"))], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_module_of_the_vehicle_is_in_the_contracts_that_concern_it() -> None:
    here = {f"athlete_twin.{p.stem}" for p in (ROOT / "athlete_twin").glob("[!_]*") if p.is_dir() or p.suffix == ".py"}
    contracts = {c["name"]: c for c in project()["tool"]["importlinter"]["contracts"]}
    ground = contracts["The ground knows the drawings, never the truth"]["forbidden_modules"]
    drawings = {f"athlete_twin.{name}" for name in ("errors", "geometry", "model", "messages")}
    assert set(ground) == here - drawings | {"envs"}
    bullet = contracts["Bullet lives in world and physics only"]["source_modules"]
    assert set(bullet) == here - {"athlete_twin.world", "athlete_twin.physics"} | {"planner", "envs"}


def test_planner_imports_of_the_vehicle_only_drawings_and_messages() -> None:
    # The contract above lists what is forbidden; this one lists what is allowed, so that a new module starts forbidden.
    allowed = {"errors", "geometry", "model", "messages"}
    for path, tree in sources("planner"):
        of_the_vehicle = {m.split(".")[1] for m in imported_modules(tree) if m.startswith("athlete_twin.")}
        assert of_the_vehicle <= allowed, f"{path.relative_to(ROOT)} imports {sorted(of_the_vehicle - allowed)}"
        assert "athlete_twin" not in {m for m in imported_modules(tree) if "." not in m}, path


def test_planner_opens_no_file() -> None:
    for path, tree in sources("planner"):
        calls = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
        opening = {c for c in calls if c == "open" or c.endswith((".open", ".read_text", ".read_bytes"))}
        assert not opening, f"{path.relative_to(ROOT)} opens a file: {sorted(opening)}"


def test_ground_never_reads_the_truth_of_an_environment() -> None:
    # `info["truth"]` is for scores; an agent that looked there would know where it is.
    for path, tree in sources("planner"):
        keys = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
        assert "truth" not in keys, path


def test_library_reads_no_clock_no_environment_and_no_network() -> None:
    forbidden = {"datetime", "random", "socket", "urllib", "requests", "secrets", "os.environ", "os.getenv"}
    forbidden |= {"time.time", "time.sleep", "time.monotonic"}
    for path, tree in sources(*PACKAGES):
        used = set(imported_modules(tree))
        used |= {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert not used & forbidden, f"{path.relative_to(ROOT)} uses {sorted(used & forbidden)}"


def test_library_modules_do_not_hide_the_standard_library() -> None:
    for path, _ in sources(*PACKAGES):
        assert path.stem not in sys.stdlib_module_names or path.stem.startswith("__"), path


# What an import costs -------------------------------------------------------------------------------------------------


def test_importing_athlete_twin_loads_nothing_else() -> None:
    assert modules_after("import athlete_twin") == {"athlete_twin"}


@pytest.mark.parametrize("module", ["planner", "planner.agent"])
def test_importing_the_ground_loads_no_simulator_and_no_plotting(module: str) -> None:
    # Open3D and OMPL belong to the ground, and are loaded when they are first needed.
    if not (ROOT / Path(*module.split("."))).with_suffix(".py").is_file() and not (ROOT / module).is_dir():
        pytest.skip(f"{module} is not part of this checkout")
    modules = modules_after(f"import {module}")
    assert not loaded_of(HEAVY, modules)
    assert not {m for m in modules if m.startswith(("athlete_twin.physics", "athlete_twin.world", "envs"))}


def test_importing_envs_loads_no_bullet_and_no_open3d() -> None:
    assert not loaded_of(("pybullet", "open3d", "ompl", "matplotlib"), modules_after("import envs"))


@pytest.mark.slow
def test_every_module_can_be_imported_first() -> None:
    # In one fresh interpreter each module is imported with our own packages forgotten: no module needs another's luck.
    names = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path, _ in sources(*PACKAGES)
    ]
    program = (
        f"import importlib, sys\nfor name in {names!r}:\n"
        f"    for m in [m for m in sys.modules if m.split('.')[0] in {PACKAGES!r}]:\n        del sys.modules[m]\n"
        "    try:\n        importlib.import_module(name)\n"
        "    except Exception as e:\n        sys.exit(f'{name}: {type(e).__name__}: {e}')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# What is shipped ------------------------------------------------------------------------------------------------------


def test_assets_are_found_and_every_toml_parses() -> None:
    assert robot_names() == ["sdm_b", "t12"]
    for robot in robot_names():
        for name in ("spec.toml", "truth.toml", "robot.urdf"):
            assert (robot_dir(robot) / name).is_file()
    for path in assets_root().rglob("*.toml"):
        assert read_toml(path)


def test_unknown_names_are_answered_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'sdm_c'.*sdm_b, t12"):
        robot_dir("sdm_c")
    with pytest.raises(ConfigError, match=r"scenario 'rock_feild'.*rock_field"):
        named_toml("scenarios", "rock_feild")


def test_wheel_ships_the_packages_and_the_assets() -> None:
    wheel = project()["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert tuple(wheel["packages"]) == PACKAGES
    assert wheel["force-include"] == {"assets": "athlete_twin/_assets"}


def test_constraints_pin_every_requirement_to_a_version_it_allows() -> None:
    pins = dict(line.split("==") for line in constraint_lines())
    pins = {canonicalize_name(name): version for name, version in pins.items()}
    table = project()["project"]
    for text in [*table["dependencies"], *(r for extra in table["optional-dependencies"].values() for r in extra)]:
        requirement = Requirement(text)
        pinned = pins.get(canonicalize_name(requirement.name))
        assert pinned is not None, f"{requirement.name} is not pinned"
        assert requirement.specifier.contains(pinned), f"{text} does not allow the pinned {pinned}"


def test_version_is_the_same_everywhere() -> None:
    version = project()["project"]["version"]
    citation = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert citation is not None
    assert citation.group(1) == version
    assert f"## [{version}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


# What is named --------------------------------------------------------------------------------------------------------


@NEEDS_GIT
def test_no_file_names_a_registry_or_a_machine() -> None:
    registry = r"pypi\.|pythonhosted|registry\.npm|deb\.debian|index-url|find-links|files\.python"
    machine = r"(?<![\w.\-/\]}])/(?:home|root|work|Users|mnt)/\w"
    pattern = re.compile(f"{registry}|{machine}")
    for path in tracked_files():
        if path == Path(__file__).resolve() or b"\0" in path.read_bytes()[:4096]:
            continue
        found = pattern.search(path.read_text(encoding="utf-8"))
        assert found is None, f"{path.relative_to(ROOT)} names {found.group()!r}"


def test_tests_shadow_no_package_and_no_other_test() -> None:
    # tests/planner/__init__.py would hide the real `planner`; two files of one name would hide each other in reports.
    assert not list((ROOT / "tests").rglob("__init__.py"))
    names = Counter(path.name for path, _ in sources("tests"))
    assert not {name for name, count in names.items() if count > 1 and name != "conftest.py"}


def test_no_two_tests_of_a_file_have_one_name() -> None:
    for path, tree in sources("tests"):
        for scope in [tree, *(node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))]:
            names = Counter(n.name for n in scope.body if isinstance(n, ast.FunctionDef | ast.ClassDef))
            assert not {n for n, count in names.items() if count > 1}, path


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_page_names_only_files_and_targets_that_exist(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    code = "\n".join(re.findall(r"```.*?```|`[^`\n]*`", text, re.DOTALL))
    named = set(re.findall(r"\bmake ([a-z-]+)", code))
    assert named <= targets, f"{page} names make targets {sorted(named - targets)}"
    for path in set(re.findall(r"\b(?:scripts|assets|tests|athlete_twin|planner|envs)/[\w/]+\.\w+", text)):
        assert (ROOT / path).is_file(), f"{page} names {path}"
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        compile(block, page, "exec")


@pytest.mark.parametrize("name", ["gymnasium", "pybullet", "open3d", "ompl", "pinocchio", "coal", "cv2", "numba"])
def test_library_of_the_stack_is_installed(name: str) -> None:
    assert find_spec(name) is not None


# Reading the project's own files --------------------------------------------------------------------------------------


def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def constraint_lines() -> list[str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def tracked_files() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [path for name in listed.split("\0") if name and (path := (ROOT / name).resolve()).is_file()]
