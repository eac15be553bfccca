"""The demo's commands exist, and it ends at the first that fails."""

import subprocess
import sys

import pytest

from sc3d.cli import parse
from tools import demo


def test_commands_are_commands_of_sc3d(tmp_path):
    for name, *arguments in demo.commands(tmp_path):
        parse(name, arguments)
        assert (demo.TOOLS / f"{name}.py").is_file()


@pytest.mark.parametrize("failing", [None, "run"])
def test_commands_run_in_turn_until_one_fails(tmp_path, monkeypatch, capsys, failing):
    called = []

    def run(words, check):
        called.append(words[1].stem)
        return subprocess.CompletedProcess(words, 3 if words[1].stem == failing else 0)

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(sys, "argv", ["demo.py", str(tmp_path)])
    if failing:
        with pytest.raises(SystemExit, match="3"):
            demo.main()
    else:
        demo.main()
    assert called == (["synthesize", "run"] if failing else ["synthesize", "run", "view"])
    assert (str(tmp_path / "labelled.png") in capsys.readouterr().out) is not bool(failing)
