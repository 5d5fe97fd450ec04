"""Imports go one way, and every heavy dependency has one owner (README, "The tree")."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
LAYERS = [
    {"config", "provenance", "atomic"},
    {"command", "stages", "products", "episode"},
    {"engine"},
    {"birdview", "sim"},
    {"selection", "adapt"},
    {"frames", "imported", "state", "fitting"},
    {"result", "job"},
    {"autoencoder", "policy", "stats"},
    {"exported", "claims", "points", "store", "view"},
    {"mlmodel", "confounds"},
    {"tracking", "figures", "display", "report_model", "document"},
    {"rounding", "summary", "markdown"},
    {"comparison", "report_text"},
    {"drawings", "card", "preview"},
    {"data"},
    {"cell", "plan"},
    {"run_cells", "report", "intake", "status", "verify"},
    {"sweep", "train"},
]
OWNERS = {
    "pydantic": {"config", "command"},
    "yaml": {"config", "command"},
    "highway_env": {"sim"},
    "gymnasium": {"sim"},
    "cv2": {"birdview"},
    "lightning": {"fitting", "autoencoder", "policy"},
    "mlflow": {"mlmodel", "store", "tracking"},
    "optuna": {"engine"},
    "distributed": {"engine"},
    "dask": {"engine"},
    "dask_jobqueue": {"engine"},
    "scipy": {"stats"},
    "matplotlib": {"figures"},
    "PIL": {"preview"},
    "jinja2": {"report_text"},
    "typst": {"report"},
    "rich": {"display"},
    "argparse": {"command", "plan", "run_cells", "sweep", "train", "data"},
}


def modules():
    """Module name (each of the packages `engine` and `sim` counts as one) -> the names that its files import."""
    found: dict[str, set[str]] = {}
    for path in sorted((ROOT / "study").rglob("*.py")):
        parts = path.relative_to(ROOT / "study").with_suffix("").parts
        if parts == ("__init__",):
            continue
        names = found.setdefault(parts[0], set())
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names.add(node.module)
    return found


def layer(module):
    return next(depth for depth, names in enumerate(LAYERS) if module in names)


def test_every_module_has_a_layer():
    assert set(modules()) == set().union(*LAYERS)


def test_modules_import_from_lower_layers_only():
    wrong = []
    for module, names in modules().items():
        for name in names:
            parts = name.split(".")
            if parts[0] == "study" and len(parts) > 1 and parts[1] != module and layer(parts[1]) >= layer(module):
                wrong.append(f"{module} imports {parts[1]}")
    assert wrong == []


def test_heavy_dependencies_have_one_owner():
    wrong = [
        f"{module} imports {name}"
        for module, names in modules().items()
        for name in {name.split(".")[0] for name in names}
        if module not in OWNERS.get(name, {module})
    ]
    assert wrong == []


def test_flows_need_neither_dask_nor_optuna():
    """A machine may lack both and still train, one task after the other; each has one module."""
    found = {
        path.stem
        for path in (ROOT / "study" / "engine").glob("*.py")
        if re.search(r"^\s*(?:from|import) (?:dask|distributed|optuna)\b", path.read_text(), flags=re.MULTILINE)
    }
    assert found == {"cluster", "trials"}


def test_the_readmes_tree_is_the_tree():
    tree = re.findall(r"^study/(\w+)(?:\.py|/) ", (ROOT / "README.md").read_text(), flags=re.MULTILINE)
    assert sorted(tree) == sorted(modules())
