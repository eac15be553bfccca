"""The numbered examples of the manual run as their first lines say, and are short."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "data" / "manual" / "examples").glob("*.py"))


def test_examples_are_numbered():
    assert [file.name[:3] for file in EXAMPLES] == [
        f"{number:02d}_" for number in range(1, len(EXAMPLES) + 1)
    ]
    assert len(EXAMPLES) >= 3


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_an_example_runs_and_is_short(file, tmp_path):
    text = file.read_text(encoding="utf-8")
    assert (
        len(text.splitlines()) < 60 and text.startswith('"""') and f"data/manual/examples/{file.name}" in text
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    # minutes, because a fresh checkout has to compile the kernels first
    result = subprocess.run(
        [sys.executable, str(file), str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=600,
        env=environment,
        cwd=tmp_path,
    )
    assert result.returncode == 0, result.stderr
    assert 3 <= len(result.stdout.splitlines()) <= 10
