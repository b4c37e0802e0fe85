"""The README's example of a diagnosis from Python, unchanged."""

import re
import sys
from pathlib import Path

import pytest
from support.command_line import run_process
from typer.testing import CliRunner

from pamctl.cli.app import app

PAGE = Path(__file__).parents[2] / "pamctl" / "manual" / "how_to" / "diagnose-a-log.md"


@pytest.mark.long
def test_the_example_runs_unchanged(tmp_path):
    for seed, name in (("1", "a.mcap"), ("2", "b.mcap")):
        run = ["run", "--fast", "--quiet", "--experiment", "diagnosis", "--duration", "3.5"]
        run += ["--seed", seed, "--set", f"experiment.seed={seed}", "--log", str(tmp_path / name)]
        result = CliRunner().invoke(app, run)
        assert result.exit_code == 0, result.output
    (example,) = re.findall(
        r"```python\n(from pamctl\.diagnose.*?)```", PAGE.read_text(), re.DOTALL
    )
    script = tmp_path / "example.py"
    script.write_text(example)
    done = run_process([sys.executable, script], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "nothing is missing" in done.stdout.lower()
