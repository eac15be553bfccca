"""The manual's pages say what --help says."""

import doctest
import importlib
import inspect
import re
from pathlib import Path

import pytest

from sc3d.cli import main
from sc3d.commands import COMMANDS, STAGES
from sc3d.settings.labels import Label, Segment
from sc3d.settings.reconstruction import ReconstructCommand
from tools.docstring_pages import module_page
from tools.make_manual import NOTE_GEOMETRY, options
from tools.make_manual import main as write_manual

MANUAL = Path(__file__).parents[2] / "data" / "manual"


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("manual")
    (folder / "geometry").mkdir()
    (folder / "geometry" / "gone.md").write_text(NOTE_GEOMETRY + "\n# of a module that is no more")
    write_manual([str(folder)])
    return folder


def test_there_is_a_page_for_every_command(pages):
    assert {file.stem for file in (pages / "commands").glob("*.md")} == {"README", *STAGES, *COMMANDS}


@pytest.mark.parametrize("folder", ["commands", "geometry"])
def test_the_committed_pages_are_those_that_the_code_writes(pages, folder):
    written = {file.name: file.read_text() for file in (pages / folder).glob("*.md")}
    committed = {file.name: file.read_text() for file in (MANUAL / folder).glob("*.md")}
    assert written.keys() == committed.keys(), "run: python tools/make_manual.py"
    assert [name for name in written if written[name] != committed[name]] == [], (
        "run: python tools/make_manual.py"
    )


@pytest.mark.parametrize("command", ["label", "segment", "export", "reconstruct", "import", "view"])
def test_a_page_has_the_options_of_help(pages, command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    helped = set(re.findall(r"^\W{0,3}(--[a-z0-9][a-z0-9.-]*)", capsys.readouterr().out, re.M))
    written = set(
        re.findall(r"^\| `(--[a-z0-9.-]+)", (pages / "commands" / f"{command}.md").read_text(), re.M)
    )
    assert helped == written


def test_options_tell_defaults_choices_and_positionals():
    found = {option.flag: option for option in options(Label)}
    assert found["--edge-width"].default == "3.0" and found["--edge-width"].values == "number"
    assert found["--method"].values == "direct, majority, conflict-lock, paper"
    assert (
        "--depth-filter, --no-depth-filter" in found
        and "labels penetrate" in found["--depth-filter, --no-depth-filter"].help
    )
    assert {option.flag: option.values for option in options(Segment)}["--prompts"] == "text ..."
    flags = [option.flag for option in options(ReconstructCommand)]
    assert flags[:2] == ["PHOTOS", "SCENE"] and "--matching" in flags


def test_every_public_function_and_class_of_the_geometry_has_a_section(pages):
    for name in ("cameras", "neighbors", "raycast", "graph", "tsdf"):
        module = importlib.import_module(f"sc3d.geometry.{name}")
        own = {
            key
            for key, value in vars(module).items()
            if (inspect.isfunction(value) or inspect.isclass(value))
            and value.__module__ == module.__name__
            and not key.startswith("_")
        }
        page = (pages / "geometry" / f"{name}.md").read_text()
        assert set(re.findall(r"^## (\w+)$", page, re.M)) == own


def test_a_page_has_signatures_and_entries_of_docstrings(tmp_path):
    source = '''"""About. More."""

@dataclass
class Box:
    """A box.

    low, high: (3,) corners; name: of the box, or
        none; text: not a field
    """

    low: np.ndarray
    high: np.ndarray
    name: str = ""

    @property
    def size(self) -> float:
        """Its size."""

    @classmethod
    def around(cls, points: dict[str, int], *, margin: float = 1.0) -> Box:
        """points: of it

        returns: the box, see eq. 7. It holds
        them all.
        Nothing else.
        """

@numba.njit(cache=True)
def kernel(x):
    """Not public."""

def _hidden(): ...
'''
    file = tmp_path / "boxes.py"
    file.write_text(source)
    assert module_page(file, "a.boxes", "note").split("\n\n") == [
        "note",
        "# a.boxes",
        "About. More.",
        "- [`Box`](#box): A box.",
        "## Box",
        '```python\nBox(low: np.ndarray, high: np.ndarray, name: str = "")\n```',
        "A box.",
        "- `low`, `high`: (3,) corners\n- `name`: of the box, or none; text: not a field",
        "```python\n.size -> float\n```",
        "Its size.",
        "```python\nBox.around(points: dict[str, int], *, margin: float = 1.0) -> Box\n```",
        "- `points`: of it",
        "- returns: the box, see eq. 7. It holds them all.",
        "Nothing else.\n",
    ]


def test_the_examples_of_the_geometry_utilities_run():
    failed, tried = doctest.testfile(
        str(MANUAL / "geometry-by-example.md"),
        module_relative=False,
        optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE,
    )
    assert tried > 10 and not failed
