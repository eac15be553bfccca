"""The manual's pages say what --help says."""

import doctest
import re
from pathlib import Path

import pytest

from sc3d.cli import main
from sc3d.commands import COMMANDS, STAGES
from sc3d.settings.labels import Label, Segment
from sc3d.settings.reconstruction import ReconstructCommand
from tools.make_manual import main as write_manual
from tools.make_manual import options

MANUAL = Path(__file__).parents[2] / "data" / "manual"


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("manual")
    write_manual([str(folder)])
    return folder


def test_there_is_a_page_for_every_command(pages):
    assert {file.stem for file in pages.glob("*.md")} == {"README", *STAGES, *COMMANDS}


def test_the_committed_pages_are_those_that_the_code_writes(pages):
    for file in pages.glob("*.md"):
        assert (MANUAL / "commands" / file.name).read_text() == file.read_text(), (
            "run: python tools/make_manual.py"
        )


@pytest.mark.parametrize("command", ["label", "segment", "export", "reconstruct", "import", "view"])
def test_a_page_has_the_options_of_help(pages, command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    helped = set(re.findall(r"^\W{0,3}(--[a-z0-9][a-z0-9.-]*)", capsys.readouterr().out, re.M))
    written = set(re.findall(r"^\| `(--[a-z0-9.-]+)", (pages / f"{command}.md").read_text(), re.M))
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


def test_the_examples_of_the_geometry_utilities_run():
    failed, tried = doctest.testfile(
        str(MANUAL / "geometry.md"),
        module_relative=False,
        optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE,
    )
    assert tried > 10 and not failed
