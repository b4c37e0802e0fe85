"""What `pamctl diagnose --on-rig` refuses."""

import pytest
from typer.testing import CliRunner

from pamctl.base.errors import ExitCode
from pamctl.cli.app import app


@pytest.mark.parametrize(
    ("words", "said", "code"),
    [
        (["a.mcap", "--runs", "3"], "is for --on-rig", ExitCode.USAGE),
        ([], "at least one log", ExitCode.USAGE),
        (["--on-rig", "--holdout", "b.mcap"], "no effect with --on-rig", ExitCode.USAGE),
        (["--on-rig", "--socket", "none.sock"], "no daemon listens", ExitCode.UNAVAILABLE),
    ],
)
def test_one_clear_error_and_nothing_is_written(words, said, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["diagnose", "--out", "out", *words])
    assert result.exit_code == code
    assert said in " ".join(result.output.split())
    assert not any(tmp_path.iterdir())
