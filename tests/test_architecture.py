"""docs/design.md against the code: who imports whom, no circles; and what light commands must not import."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ambiguous_wild.cli.main import COMMANDS

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "ambiguous_wild"
DESIGN = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
HEAVY = ("torch", "numba", "pycolmap", "cv2", "matplotlib", "transformers", "scipy", "pandas", "skimage")
FILES = sorted(PACKAGE.rglob("*.py"))
MAX_LINES = 500  # of a Python file


def imports(path: Path) -> Iterator[tuple[str, int, bool]]:
    """(absolute module, line, at run time) of every import, those inside functions included."""
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parts = path.relative_to(ROOT).with_suffix("").parts
            base = ".".join(parts[: len(parts) - node.level]) if node.level else ""
            module = ".".join(filter(None, (base, node.module)))
            # "from package import sub" imports package.sub where that is a module.
            names = [f"{module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            yield name, node.lineno, id(node) not in typing_only


def of_ours(module: str) -> str | None:
    """The package of ours that a module is in; "" for what the root itself offers."""
    parts = module.split(".")
    if parts[0] != "ambiguous_wild":
        return None
    return parts[1] if len(parts) > 1 and (PACKAGE / parts[1]).is_dir() else ""


def imported_packages() -> dict[str, set[str]]:
    """Which packages of ours each package imports, inside functions and for types alone too."""
    found: dict[str, set[str]] = {}
    for path in FILES:
        package = path.relative_to(PACKAGE).parts[0]
        if package.endswith(".py"):
            continue
        targets = {of_ours(module) for module, _, _ in imports(path)}
        found.setdefault(package, set()).update(target for target in targets if target and target != package)
    return found


def test_the_table_of_packages_is_what_the_code_imports() -> None:
    rows = re.findall(r"^\| `(\w+)/` \|.*\| ([^|]+) \|$", DESIGN, re.MULTILINE)
    names = {name for name, _ in rows}
    said = {
        name: names - {name} if words == "all others" else set(words.split(", ")) - {"nothing of ours"}
        for name, words in rows
    }
    assert imported_packages() == said
    assert names == {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"}


def test_the_drawing_has_every_package_and_no_arrow_goes_up() -> None:
    layers = [line.split() for line in DESIGN.split("```")[1].strip().splitlines()]
    layer = {name: level for level, line in enumerate(layers) for name in line}
    arrows = imported_packages()
    assert sorted(name for line in layers for name in line) == sorted(arrows)
    assert not [(a, b) for a, below in arrows.items() for b in below if layer[a] >= layer[b]]


def test_the_reader_of_imports_sees_every_form() -> None:
    # The checks above would pass on everything if this returned nothing.
    found = list(imports(PACKAGE / "metrics" / "lpips.py"))
    modules = {name for name, _, _ in found}
    assert {"torch", "numpy", "ambiguous_wild.core.AwError", "torch.nn"} <= modules
    assert ("torch.Tensor", False) in {(name, at_run_time) for name, _, at_run_time in found}
    assert of_ours("ambiguous_wild.core.AwError") == "core" and of_ours("ambiguous_wild.__version__") == ""
    assert of_ours("numpy.core") is None


def test_only_the_back_end_asks_where_tensors_lie() -> None:
    """Whatever differs between the CPU and a GPU is a call of `splat/backend.py`."""
    asking = {
        path.relative_to(PACKAGE).as_posix()
        for path in FILES
        if re.search(r"\baccelerated\(", path.read_text(encoding="utf-8"))
    }
    ours = {f"methods/refinesplat/{name}.py" for name in ("density", "recipe")}
    assert asking - ours == {"splat/backend.py"}


def module_of(path: Path) -> str:
    """The module that a file of the package is: a package's __init__.py is the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def import_graph() -> dict[str, set[str]]:
    """Which modules of ours each module imports, inside functions and for types alone too.

    That Python runs the __init__.py of a module's own packages first is no import of the module's, and what
    the root tells type checkers of the names that it imports on demand is none of the root's.
    """
    modules = {module_of(path): path for path in FILES}
    graph: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        for target, _, at_run_time in imports(path):
            if name == PACKAGE.name and not at_run_time:
                continue
            # "from module import thing" is read as module.thing
            found = next((m for m in (target, target.rpartition(".")[0]) if m in modules), None)
            if found is not None:
                graph[name].add(found)
    return graph


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Sets of modules each of which leads to every other one, and modules that import themselves."""
    names = sorted(graph)
    number = {name: index for index, name in enumerate(names)}
    pairs = [(number[a], number[b]) for a in names for b in graph[a]]
    rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    matrix = csr_array((np.ones(len(pairs)), (rows, columns)), shape=(len(names), len(names)))
    count, labels = connected_components(matrix, connection="strong")
    parts = [[names[i] for i in np.flatnonzero(labels == label)] for label in range(count)]
    return [part for part in parts if len(part) > 1 or part[0] in graph[part[0]]]


def test_no_modules_import_each_other() -> None:
    assert circles(import_graph()) == []


def test_the_finder_of_circles_finds_them() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set(), "e": {"e"}}
    assert circles(graph) == [["a", "b", "c"], ["e"]]
    assert circles({"a": {"b"}, "b": set()}) == []
    real = import_graph()
    ours = "ambiguous_wild.methods"
    assert f"{ours}.graft" in real[f"{ours}.registry"]
    assert f"{ours}.mask_policies" in real[f"{ours}.graft"]  # inside a function
    assert f"{ours}.external_process" in real[f"{ours}.entry"]  # for types alone
    assert "ambiguous_wild.core" in real[f"{ours}.truth"]  # a name of a package


def test_no_file_is_too_long() -> None:
    folders = [ROOT / name for name in ("ambiguous_wild", "tests", "benchmarks", "examples")]
    files = [path for folder in folders for path in folder.rglob("*.py")]
    lines = {str(p.relative_to(ROOT)): len(p.read_text(encoding="utf-8").splitlines()) for p in files}
    assert len(lines) > len(FILES)
    too_long = {name: count for name, count in lines.items() if count > MAX_LINES}
    assert too_long == {}


def late_constants(path: Path) -> list[int]:
    """Lines of constants after the third definition that could stand at the top of the file.

    Those made of the file's own functions or classes cannot: tables of functions, instances.
    """
    defined: set[str] = set()
    late = []
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            defined.add(node.name)
            continue
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        named = [t.id for t in targets if isinstance(t, ast.Name) and t.id.strip("_").isupper()]
        used = {inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)}
        if named and len(defined) >= 3:
            if used & defined:
                defined.update(named)
            else:
                late.append(node.lineno)
    return late


def test_constants_stand_at_the_top(tmp_path: Path) -> None:
    late = {str(path.relative_to(ROOT)): lines for path in FILES if (lines := late_constants(path))}
    assert late == {}
    text = "def a(): ...\ndef b(): ...\ndef c(): ...\nTABLE = {1: a}\nOTHER = TABLE\nMOST = 5\n"
    (tmp_path / "module.py").write_text(text)
    assert late_constants(tmp_path / "module.py") == [6]


def repeated(names: list[str]) -> list[str]:
    return sorted({name for name in names if names.count(name) > 1})


def test_names_of_files_and_classes_occur_once() -> None:
    """So that a reader can search for them."""
    assert repeated([path.stem for path in FILES if path.stem != "__init__"]) == []
    bodies = [ast.parse(path.read_text(encoding="utf-8")).body for path in FILES]
    classes = [node.name for body in bodies for node in body if isinstance(node, ast.ClassDef)]
    assert repeated([name.lstrip("_") for name in classes]) == []


def test_every_package_has_a_folder_of_tests() -> None:
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert packages <= {path.name for path in (ROOT / "tests").iterdir()}


def test_pycolmap_is_imported_by_the_guard_alone() -> None:
    found = [
        p.relative_to(PACKAGE).as_posix()
        for p in FILES
        for m, _, _ in imports(p)
        if m.split(".")[0] == "pycolmap"
    ]
    assert found == ["io/safe_pycolmap.py"]


def test_the_judge_is_independent() -> None:
    # What it shares with the code that it judges, it cannot judge.
    judge = PACKAGE / "splat" / "reference.py"
    assert {of_ours(module) for module, _, _ in imports(judge)} <= {None, "core"}
    name = module_of(judge)
    users = {of_ours(module_of(p)) for p in FILES for m, _, _ in imports(p) if m.startswith(f"{name}.")}
    assert users == {"stress"}  # which compares with it


def test_core_needs_numpy_alone() -> None:
    allowed = set(sys.stdlib_module_names) | {"numpy", "ambiguous_wild"}
    late = {"weight_files.py": {"torch", "safetensors"}}  # when a file is read
    for path in PACKAGE.glob("core/*.py"):
        assert {m.split(".")[0] for m, _, _ in imports(path)} <= allowed | late.get(path.name, set()), path


def imported_by(calls: list[list[str]], folder: Path) -> tuple[str, list[set[str]]]:
    """Run commands in one interpreter; return their output, and what of `HEAVY` each imports first."""
    code = (
        "import sys\n"
        "from ambiguous_wild.cli.main import cli\n"
        "known = set()\n"
        f"for words in {calls!r}:\n"
        "    try:\n"
        "        cli.main(words, prog_name='aw', standalone_mode=False)\n"
        "    except SystemExit as end:\n"
        "        assert not end.code, words\n"
        f"    new = set({HEAVY!r}) & set(sys.modules) - known\n"
        "    known |= new\n"
        "    print('IMPORTS', *new, file=sys.stderr)\n"
    )
    command = [sys.executable, "-c", code]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    lines = [line.split()[1:] for line in done.stderr.splitlines() if line.startswith("IMPORTS")]
    return done.stdout, [set(names) for names in lines]


def test_help_and_the_list_of_methods_import_nothing_heavy(tmp_path: Path) -> None:
    calls = [["--help"], *([name, "--help"] for name in COMMANDS), ["methods", "--json"]]
    printed, imported = imported_by(calls, tmp_path)
    assert printed.count("Usage: aw") == len(COMMANDS) + 1
    assert {" ".join(words): names for words, names in zip(calls, imported, strict=True) if names} == {}


# What commands that only read may import. One interpreter runs those of a row, in this order: a package
# counts for the first that imports it.
READERS: tuple[dict[str, set[str]], ...] = (
    {
        "simulate": set(),
        "fetch": set(),
        "table RUNS": {"pandas", "scipy"},  # scipy.special: intervals
        "table RUNS --layout means --format latex": set(),
    },
    {
        "cost RUNS -o cost --json": {"matplotlib"},
        "plan SCENE --no-probe -o plan.json": {"cv2"},  # SciPy only where points have tracks
        "audit": {"scipy"},
        "figure RUNS -o figure.png": {"pandas"},
    },
    {"statement RUNS": {"torch", "cv2", "scipy"}},  # the defaults of a method stand in its recipe
)


@pytest.mark.parametrize("readers", READERS, ids=lambda row: "+".join(text.split()[0] for text in row))
def test_what_only_reads_imports_what_it_needs(
    readers: dict[str, set[str]], scene: Path, finished: Path, tmp_path: Path
) -> None:
    paths = {"RUNS": str(finished), "SCENE": str(scene)}
    calls = [[paths.get(word, word) for word in text.split()] for text in readers]
    _, imported = imported_by(calls, tmp_path)
    unneeded = {text: names - readers[text] for text, names in zip(readers, imported, strict=True)}
    assert {text: names for text, names in unneeded.items() if names} == {}
