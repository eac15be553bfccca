"""Imports point down only, and heavy packages stay where they belong."""

import ast
from pathlib import Path

import sc3d

ROOT = Path(sc3d.__file__).parent
# lowest first; a module may import its own layer and those below
LAYERS = [
    ["sc3d.errors"],
    ["sc3d.settings.train", "sc3d.settings.synthesize"],
    ["sc3d.settings"],
    ["sc3d.commands"],
    ["sc3d.geometry"],
    ["sc3d.io.atomic", "sc3d.io.limits"],
    ["sc3d.calibration", "sc3d.scene.class_table", "sc3d.io"],
    ["tools.make_manual", "sc3d.tiling.executor"],
    ["sc3d.scene.scene"],
    ["sc3d.georeferencing"],
    [
        "sc3d.importers",
        "sc3d.splatting",
        "sc3d.sfm",
        "sc3d.segmentation",
        "sc3d.synthetic",
        "sc3d.labelling.density",
        "sc3d.labelling.verification",
        "sc3d.labelling.voting_kernels",
        "sc3d.labelling.voting",
        "sc3d.labelling.fusion",
        "sc3d.metrics",
    ],
    ["sc3d.propagation", "sc3d.scene.labelled_cloud", "sc3d.labelling.inputs"],
    ["sc3d.view", "sc3d.exporters", "sc3d.segmentation.mask_refinement", "sc3d.annotate", "sc3d.tiling"],
    ["sc3d.report"],
    ["sc3d.runner", "tools.benchmark"],
    ["sc3d.cli"],
]
# stages' packages that must not know one another
SIDE_BY_SIDE = {"sc3d.splatting", "sc3d.sfm", "sc3d.segmentation", "sc3d.synthetic"}


def layer(module: str) -> int:
    fitting = [
        (len(name), row)
        for row, names in enumerate(LAYERS)
        for name in names
        if module == name or module.startswith(name + ".")
    ]
    return max(fitting)[1] if fitting else -1


def package(module: str) -> str:
    return ".".join(module.split(".")[:2])


def imports_of(file: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            found.add(node.module)
            found |= {
                f"{node.module}.{alias.name}"
                for alias in node.names
                if (ROOT.parent / node.module.replace(".", "/") / f"{alias.name}.py").exists()
            }
    return found


def modules() -> dict[str, set[str]]:
    return {
        ".".join(file.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): imports_of(
            file
        )
        for file in ROOT.rglob("*.py")
    }


def test_imports_point_down():
    upward = [
        f"{module} imports {name}"
        for module, names in modules().items()
        if module != "sc3d"
        for name in names
        if name.startswith("sc3d.") and layer(name) > layer(module)
    ]
    assert not upward


def test_every_module_has_a_layer():
    assert not [module for module in modules() if module != "sc3d" and layer(module) < 0]


def test_stage_packages_do_not_know_one_another():
    crossing = [
        f"{module} imports {name}"
        for module, names in modules().items()
        for name in names
        if package(module) in SIDE_BY_SIDE
        and package(name) in SIDE_BY_SIDE
        and package(module) != package(name)
    ]
    stages = [
        f"{module} imports {name}"
        for module, names in modules().items()
        if module.startswith("sc3d.runner.") and module != "sc3d.commands.run"
        for name in names
        if name.startswith("sc3d.runner.")
    ]
    assert not crossing and not stages


def test_torch_lives_in_splatting_and_segmentation_only():
    # the benchmark takes splatting apart to time it
    homes = ("sc3d.splatting", "sc3d.segmentation", "tools.benchmark")
    assert not [
        module
        for module, names in modules().items()
        if not module.startswith(homes)
        and any(name.split(".")[0] in ("torch", "transformers") for name in names)
    ]


def test_no_pickle_and_no_print_in_the_package():
    for file in ROOT.rglob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        calls = [
            node.func.id
            for node in ast.walk(tree)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        ]
        assert "print" not in calls, file
        assert not imports_of(file) & {"pickle", "dill", "joblib"}, file
