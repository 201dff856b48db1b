"""The architecture: which module may import which; what `import parkenv` gives, and what it costs."""

import ast
import functools
import inspect
import pydoc
import re
import subprocess
import sys
import tomllib
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import FunctionType

import pytest

import parkenv
import sim_sensors
from parkenv.lots.local_frame import LocalFrame

ROOT = Path(__file__).parents[1]

PACKAGES = ("sim_sensors", "parkenv", "planners")
MAY_SEE_PLANNERS = ("studies", "cli")
# A package imports the packages before it only.
LAYERS = (
    "errors", "version", "compiled", "files", "forecast", "world", "lots", "perception", "mapping", "belief",
    "scenarios", "driving", "engine", "show", "envs", "studies", "cli",
)  # fmt: skip
PLANNERS_MAY_SEE = (
    "parkenv.compiled", "parkenv.world", "parkenv.belief", "parkenv.driving", "parkenv.engine.local_observation",
    "parkenv.engine.model", "parkenv.engine.policy", "parkenv.errors", "parkenv.files", "parkenv.version",
)  # fmt: skip
REFERENCE = "\n".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md"))
PAGE = (ROOT / "docs" / "api" / "index.md").read_text(encoding="utf-8")


def import_statements(path):
    """Every import of a file, at any depth of its code, but those for type checking alone."""
    return parsed(path, path.stat().st_mtime_ns)[0]


def calls(path):
    """What a file calls, as it is written there: `json.loads`."""
    return parsed(path, path.stat().st_mtime_ns)[1]


@functools.cache
def parsed(path, _):
    imported, called = [], set()
    waiting = [ast.parse(path.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            imported += [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            imported += [(node.module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Call):
            called.add(ast.unparse(node.func))
        # Public names, which are imported when they are first used.
        if (
            path.name == "__init__.py"
            and isinstance(node, ast.If)
            and "TYPE_CHECKING" in ast.unparse(node.test)
        ):
            node.body = []
        waiting += ast.iter_child_nodes(node)
    return imported, called


def imports(path):
    """Every module that a file imports from; what is imported from `parkenv` itself by its full name."""
    return {f"{m}.{name}" if m == "parkenv" and name else m for m, name in import_statements(path)}


# What reads a file of any size and depth, by the modules that may do so within limits.
READS = dict.fromkeys(
    ("json.load", "json.loads", "yaml.safe_load", "tomllib.load", "csv.DictReader", "gzip.open", "joblib.load",
     "np.load", "np.loadtxt", "np.genfromtxt", "cv2.imread", "cv2.imdecode", "Image.open", "pickle.load"), (),
) | dict.fromkeys(("yaml.load", "tomllib.loads", "csv.reader"), ("parkenv/files/limited_reading.py",)) | {
    "torch.load": ("parkenv/studies/training/training.py",),  # weights_only
    "PillowImage.open": ("parkenv/files/images.py",),
    "tarfile.open": ("parkenv/files/limited_reading.py",),
    "zipfile.ZipFile": (
        "parkenv/files/limited_reading.py", "parkenv/perception/car_model.py", "parkenv/studies/training/training.py",
    ),
    "pickle.loads": ("parkenv/compiled/code_files.py",),
}  # fmt: skip


def import_graph(root):
    """The modules below a folder, and which of them each imports."""
    modules = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for package in PACKAGES
        for path in (root / package).rglob("*.py")
    }
    graph = {}
    for module, path in modules.items():
        # `from package import module` imports the module.
        named = {(f"{m}.{n}" if f"{m}.{n}" in modules else m) for m, n in import_statements(path)}
        graph[module] = (named & modules.keys()) - {module}
    return graph


def folder_graph(root):
    """The folders of modules, and which of them each imports; a folder and those in it count as one room."""
    folders = {}
    for module, targets in import_graph(root).items():
        here = folder_of(root, module)
        others = {folder_of(root, target) for target in targets} - {here}
        outside = {o for o in others if not within(o, (here,)) and not within(here, (o,))}
        folders.setdefault(here, set()).update(outside)
    return folders


def folder_of(root, module):
    """The folder that a module stands in; a package's own `__init__` stands in the package."""
    return module if (root / module.replace(".", "/")).is_dir() else module.rpartition(".")[0]


def sources(package):
    return sorted((ROOT / package).rglob("*.py"))


def offenders(package, refused):
    """The imports of a package's modules that a rule refuses: `refused(path below the package, module)`."""
    return [
        f"{path.relative_to(ROOT)}: {module}"
        for path in sources(package)
        for module in sorted(imports(path))
        if refused(path.relative_to(ROOT / package).with_suffix(""), module)
    ]


def within(module, packages):
    """Whether a module is one of the packages, or in one of them."""
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def test_packages_import_those_below_them_only():
    ours, compiled = ("parkenv", "planners"), ("parkenv.compiled",)
    assert not offenders("sim_sensors", lambda _, m: within(m, ours) and not within(m, compiled))
    assert not offenders("planners", lambda _, m: within(m, ours[:1]) and not within(m, PLANNERS_MAY_SEE))

    def points_up(path, module):
        if within(module, ("planners",)):
            return path.parts[0] not in MAY_SEE_PLANNERS
        here = {"lot_v0": "envs"}.get(path.parts[0], path.parts[0])  # named as PettingZoo's environments are
        if here not in LAYERS or not module.startswith("parkenv."):
            return False
        return module.split(".")[1] in LAYERS[LAYERS.index(here) + 1 :]

    assert not offenders("parkenv", points_up)


def test_files_are_read_within_limits():
    for path in (path for package in PACKAGES for path in sources(package)):
        name = path.relative_to(ROOT).as_posix()
        unlimited = {call for call in calls(path) & READS.keys() if name not in READS[call]}
        assert not unlimited, f"{name}: read by parkenv.files instead"


def test_parkenv_holds_nothing_but_its_layers():
    entries = {path.name for path in (ROOT / "parkenv").iterdir() if path.name != "__pycache__"}
    modules = {"errors", "version"}
    files = {"__init__.py", "__main__.py", "lot_v0.py", "py.typed", *(f"{module}.py" for module in modules)}
    assert entries == (set(LAYERS) - modules) | files


def test_neither_modules_nor_folders_import_each_other_in_a_circle():
    TopologicalSorter(import_graph(ROOT)).prepare()  # raises CycleError, which names the modules
    TopologicalSorter(folder_graph(ROOT)).prepare()


def test_a_circle_of_folders_is_found_where_no_modules_are_in_one(tmp_path):
    for folder in ("one", "two", "two/inner", "../planners", "../sim_sensors"):
        (tmp_path / "parkenv" / folder).mkdir(parents=True, exist_ok=True)
    targets = {"one/a": "two.inner.b", "one/c": "errors", "two/inner/b": "two.d", "two/d": "errors"}
    for module, target in targets.items():
        (tmp_path / "parkenv" / f"{module}.py").write_text(f"import parkenv.{target}\n")
    TopologicalSorter(folder_graph(tmp_path)).prepare()
    (tmp_path / "parkenv" / "two" / "inner" / "e.py").write_text("from parkenv.one import c\n")
    TopologicalSorter(import_graph(tmp_path)).prepare()
    with pytest.raises(CycleError):
        TopologicalSorter(folder_graph(tmp_path)).prepare()


def test_a_circle_is_found_within_functions_and_for_type_checking(tmp_path):
    for package in PACKAGES:
        (tmp_path / package).mkdir()
    one, two = tmp_path / "parkenv" / "one.py", tmp_path / "parkenv" / "two.py"
    one.write_text("from parkenv import two\n")
    for text in (
        "if TYPE_CHECKING:\n    from parkenv.one import f\n",
        "def g():\n    from parkenv.one import f\n",
    ):
        two.write_text(text)
        with pytest.raises(CycleError):
            TopologicalSorter(import_graph(tmp_path)).prepare()


@pytest.mark.parametrize(
    ("module", "unloaded"),
    [
        ("parkenv", ("torch", "matplotlib", "cv2", "numba", "pydantic", "planners", "parkenv.studies")),
        ("parkenv.cli", ("torch", "matplotlib", "cv2")),
        ("sim_sensors.laser", ("cv2", "sim_sensors.camera")),
    ],
)
def test_what_is_imported_alone_is_light(module, unloaded):
    program = f"import sys, {module}; print([name for name in {unloaded} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_are_those_of_the_page_and_exist():
    listed = PAGE.partition("Classes of these names:")[2]
    assert set(re.findall(r"`(\w+)`", listed)) == set(parkenv.__all__) == set(parkenv._EXPORTS)
    for package in (parkenv, sim_sensors):
        assert all(getattr(package, name).__name__ == name for name in package.__all__)


@pytest.mark.parametrize("name", re.findall(r"^::: (\S+)", REFERENCE, re.M))
def test_the_reference_documents_every_member(name):
    thing = pydoc.locate(name)
    own = vars(thing).items() if inspect.isclass(thing) else ()
    kinds = FunctionType | classmethod | property
    methods = [member for member, what in own if isinstance(what, kinds) and member[0] != "_"]
    assert inspect.getdoc(thing)
    assert [member for member in methods if not inspect.getdoc(getattr(thing, member))] == []


def test_a_comparison_needs_no_folder_and_knows_its_fields():
    agents = ["first-free", "greedy-goal"]
    result = parkenv.compare(scenarios=["mini"], agents=agents, episodes=2, jobs=1, figures=False)
    assert {row["agent"] for row in result.rows} == set(agents)
    assert result.complete
    with pytest.raises(parkenv.InputError, match=r"unknown key 'episods'; did you mean 'episodes'"):
        parkenv.compare(episods=3)


def test_the_command_lets_ctrl_c_end_it_before_it_imports_its_modules():
    program = (
        "import os, signal, sys, types; from parkenv.__main__ import main\n"
        "assert 'parkenv.cli' not in sys.modules\n"
        "command = types.ModuleType('parkenv.cli')\n"
        "command.main = lambda: os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.modules['parkenv.cli'] = command; signal.signal(signal.SIGINT, signal.default_int_handler); main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (130, "")


def test_what_needs_an_extra_says_so_in_a_line(monkeypatch, tmp_path):
    for module in ("pyproj", "yaml", "sklearn.cluster", "osmium"):
        monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / "map.yml").write_text("PARKING_AREAS:\n")
    (tmp_path / "map.osm.pbf").write_bytes(b"")
    for needs in (
        lambda: LocalFrame(7.85, 48.0).to_xy([[7.85, 48.0]]),
        lambda: parkenv.load_lot(tmp_path / "map.yml"),
        lambda: parkenv.import_lot(tmp_path / "map.osm.pbf"),
    ):
        with pytest.raises(parkenv.InputError, match=r'needs the extra osm: pip install "parkenv\[osm\]"'):
            needs()


def test_the_two_commands_of_the_readme_need_few_packages():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert len(project["dependencies"]) <= 17
