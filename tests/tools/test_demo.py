"""The demo's commands exist, it ends at the first that fails, and says what came of it."""

import json
import subprocess
import sys

import pytest

from sc3d.cli import parse
from tools import demo


@pytest.mark.parametrize("full", [False, True])
def test_commands_are_commands_of_sc3d(tmp_path, full):
    for name, *arguments in demo.commands(tmp_path, full):
        command, _ = parse(name, arguments)
        assert (demo.TOOLS / f"{name}.py").is_file()
        assert name != "run" or command.extract.method == ("tsdf" if full else "depth")


@pytest.mark.parametrize("failing", [None, "run"])
def test_commands_run_in_turn_until_one_fails(tmp_path, monkeypatch, capsys, failing):
    called = []

    def run(words, check):
        called.append(words[1].stem)
        return subprocess.CompletedProcess(words, 3 if words[1].stem == failing else 0)

    (tmp_path / "scene").mkdir()
    figures = {"masks": {"miou": 0.651}, "labels": {"miou": 0.874}}
    (tmp_path / "scene" / "metrics.json").write_text(json.dumps(figures))
    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(sys, "argv", ["demo.py", str(tmp_path)])
    if failing:
        with pytest.raises(SystemExit, match="3"):
            demo.main()
    else:
        demo.main()
    assert called == (["synthesize", "run"] if failing else ["synthesize", "run", "view"])
    told = capsys.readouterr().out
    assert (str(tmp_path / "labelled.png") in told) is not bool(failing)
    assert ("65.1 % of the masks" in told and "87.4 % of the labels" in told) is not bool(failing)
