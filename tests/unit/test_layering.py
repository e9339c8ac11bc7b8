"""The layer rules of docs/architecture.md, checked on the syntax tree of every module.

The checkers are plain functions over {module name: Module}; the last test feeds them offenders, so that a
checker that sees nothing is noticed.
"""

from __future__ import annotations

import ast
import graphlib
import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

import mavftpfs

PACKAGE = Path(mavftpfs.__file__).parent

LAYERS: dict[str, set[str]] = {
    "shared": set(),
    "protocol": {"shared"},
    "link": {"shared"},
    "hub": {"shared", "link"},
    "parameters": {"shared"},
    "cache": {"shared", "parameters"},
    "session": {"shared", "protocol", "link"},
    "client": {"shared", "protocol", "link", "parameters", "cache", "session"},
    "mount": {"shared", "protocol", "link", "parameters", "cache", "session", "client"},
    "sim": {"shared", "protocol", "link"},
    "cli": {
        *("shared", "protocol", "link", "parameters", "cache", "session", "client", "mount", "hub", "sim")
    },
    "api": {"shared", "protocol", "link", "parameters", "cache", "session", "client"},
    "__init__": {"api"},
}
"""Layer -> the layers below it that it may import. `__main__` runs the top one."""

CONTRACTS = {"cache.remote": {"session"}, "protocol.payload": {"cache"}}
"""Modules that other layers may import, too: what the caches need of the session, and the refusals' names."""

PURE_LAYERS = {"shared", "protocol", "parameters", "sim"}
IMPURE_MODULES = {"sim.endpoints", "sim.tree", "shared.private"}
IMPURE_IMPORTS = {"trio", "time", "socket", "logging", "pyfuse3", "os", "pathlib"}

SOLE_IMPORTERS = {
    "pyfuse3": {"mount.guard", "mount.invalidator", "mount.kernel", "mount.operations"},
    "pymavlink": {"link.framing"},
    "serial": {"link.serial"},
    "rich": {"cli.drawing", "cli.demo"},
}

MAX_FUNCTION_LINES = 60
MAX_MEDIAN_LINES = 8
MAX_MODULE_LINES = 600


@dataclass(frozen=True)
class Module:
    """A parsed module; name is relative to the package: `link.udp`, `link` (the package itself)."""

    name: str
    source: str

    @property
    def tree(self) -> ast.Module:
        """The syntax tree."""
        return _parsed(self.source)

    @property
    def layer(self) -> str:
        """The first part of the name."""
        return self.name.partition(".")[0]

    def imports(self) -> Iterator[str]:
        """Yield each imported module's full name; `from m import n` gives both m and m.n."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{self.name}: relative imports hide the layer"
                assert node.module is not None
                yield node.module
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


@cache
def _parsed(source: str) -> ast.Module:
    return ast.parse(source)


Modules = Mapping[str, Module]


@cache
def load_package() -> dict[str, Module]:
    """Read every module of mavftpfs."""
    modules = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__init__") or "__init__"
        modules[name] = Module(name, path.read_text())
    return modules


def own_imports(module: Module, modules: Modules) -> set[str]:
    """Return the modules of the package which `module` imports, without itself."""
    prefix = "mavftpfs."
    names = {name.removeprefix(prefix) for name in module.imports() if name.startswith(prefix)}
    return {name for name in names if name in modules} - {module.name}


def foreign_imports(module: Module) -> set[str]:
    """Return the top-level names of everything else it imports."""
    return {name.partition(".")[0] for name in module.imports()} - {"mavftpfs"}


def wrong_directions(modules: Modules) -> list[str]:
    """Rule 1: arrows point down only."""
    return [
        f"{module.name} imports {target}"
        for module in modules.values()
        for target in sorted(own_imports(module, modules))
        if not may_import(module, target)
    ]


def may_import(module: Module, target: str) -> bool:
    """Return whether the rules allow `module` to import the package's module `target`."""
    target_layer = target.partition(".")[0]
    if target_layer == module.layer or module.name in CONTRACTS.get(target, set()):
        return True
    if module.layer in CONTRACTS.get(target, set()):
        return True
    return target_layer in LAYERS.get(module.layer, {"cli"})


def headline(module: Module) -> str:
    """Return the first paragraph of a module's docstring."""
    return (ast.get_docstring(module.tree) or "").partition("\n\n")[0]


def is_pure(module: Module) -> bool:
    """Return whether the module says, or all of its layer are, to use neither trio, time, files, sockets nor
    the kernel."""
    of_layer = module.layer in PURE_LAYERS and module.name not in IMPURE_MODULES
    return of_layer or "; pure" in headline(module)


def impurities(modules: Modules) -> list[str]:
    """Rule 2: no clock, no I/O, no global randomness in a pure module."""
    found = []
    for module in filter(is_pure, modules.values()):
        found += [f"{module.name} imports {name}" for name in foreign_imports(module) & IMPURE_IMPORTS]
        found += [f"{module.name} uses random.{name}" for name in sorted(global_randomness(module))]
    return found


def global_randomness(module: Module) -> set[str]:
    """Return what a module uses of `random` beside the class Random (an argument's type, or seeded)."""
    used = set()
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "random":
            used.add(node.attr)
        if isinstance(node, ast.ImportFrom) and node.module == "random":
            used |= {alias.name for alias in node.names}
    return used - {"Random"} if "random" in foreign_imports(module) else set()


def trespassers(modules: Modules) -> list[str]:
    """Rule 3: each heavy dependency is known in one place (or a package of that name)."""
    return [
        f"{module.name} imports {library}"
        for module in modules.values()
        for library in sorted(foreign_imports(module) & SOLE_IMPORTERS.keys())
        if not ({module.name, module.layer} & SOLE_IMPORTERS[library])
    ]


def functions(module: Module) -> Iterator[tuple[str, int]]:
    """Yield (name, lines without docstring) of each function."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or 0) - node.lineno + 1
            first = node.body[0]
            if ast.get_docstring(node) is not None:
                lines -= (first.end_lineno or 0) - first.lineno + 1
            yield f"{module.name}.{node.name}", lines


def long_parts(modules: Modules) -> list[str]:
    """Rule 5: caps on functions and modules."""
    found = []
    for module in modules.values():
        found += [f"{name}: {n} lines" for name, n in functions(module) if n > MAX_FUNCTION_LINES]
        total = module.source.count("\n")
        found += [f"{module.name}: {total} lines"] if total > MAX_MODULE_LINES else []
    return found


def import_cycle(modules: Modules) -> list[str]:
    """Return the members of one import cycle, or nothing."""
    graph = {name: own_imports(module, modules) for name, module in modules.items()}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def test_imports_point_down() -> None:
    assert wrong_directions(load_package()) == []


def test_pure_modules_have_no_clock_and_no_io() -> None:
    assert impurities(load_package()) == []


def test_each_module_says_its_layer() -> None:
    modules = [
        module for module in load_package().values() if module.name not in {*LAYERS, "__init__", "__main__"}
    ]
    lost = [module.name for module in modules if f"Layer: {module.layer}" not in headline(module)]
    assert lost == []


def test_each_dependency_is_known_in_one_place() -> None:
    assert trespassers(load_package()) == []


def test_functions_and_modules_stay_small() -> None:
    modules = load_package()
    assert long_parts(modules) == []
    lengths = [lines for module in modules.values() for _, lines in functions(module)]
    assert statistics.median(lengths) <= MAX_MEDIAN_LINES


def test_no_import_cycles() -> None:
    assert import_cycle(load_package()) == []


def package(**sources: str) -> dict[str, Module]:
    """Return modules from sources; `link__udp` names `link.udp`."""
    names = {key.replace("__", "."): source for key, source in sources.items()}
    return {name: Module(name, source) for name, source in names.items()}


GIANT = "def f() -> None:\n" + "    pass\n" * MAX_FUNCTION_LINES


@pytest.mark.parametrize(
    ("checker", "modules"),
    [
        (wrong_directions, package(session__store="import mavftpfs.cache.files", cache__files="")),
        (impurities, package(link__uri='"""Links. Layer: link; pure."""\nfrom time import monotonic')),
        (impurities, package(protocol__engine="import random\nx = random.random()")),
        (trespassers, package(cache__files="import pymavlink.mavutil")),
        (long_parts, package(mount__kernel=GIANT)),
        (long_parts, package(mount__kernel="\n" * (MAX_MODULE_LINES + 1))),
        (import_cycle, package(cache__a="import mavftpfs.cache.b", cache__b="from mavftpfs.cache import a")),
    ],
)
def test_each_checker_sees_an_offender(checker: Callable[[Modules], list[str]], modules: Modules) -> None:
    assert checker(modules) != []
