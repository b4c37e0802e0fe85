"""An export equals the log to the bit, in every format, with its units."""

from __future__ import annotations

import builtins
import csv
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat
from support.made_up import log_run
from typer.testing import CliRunner

import pamctl.log
from pamctl.cli.app import app
from pamctl.log.export import export_ticks
from pamctl.log.importing.pipeline import import_log
from pamctl.log.schema import unit_of_column

TICKS = 300
Read = Callable[[Path], dict[str, list[Any]]]


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> pamctl.log.Log:
    directory = tmp_path_factory.mktemp("log")
    return pamctl.log.read(log_run(directory / "a.ring", directory / "run.mcap", TICKS))


def pamctl_export(log: pamctl.log.Log, out: Path, *options: str) -> Any:
    return CliRunner().invoke(app, ["log", "export", str(log.path), str(out), *options])


def from_csv(path: Path) -> dict[str, list[Any]]:
    with path.open(newline="") as file:
        names, *rows = csv.reader(file)
    return dict(
        zip(names, ([float(x) for x in column] for column in zip(*rows, strict=True)), strict=True)
    )


def from_mat(path: Path) -> dict[str, list[Any]]:
    content = loadmat(path, simplify_cells=True)
    assert content["units"] == {name: unit_of_column(name) for name in content["log"]}
    return {name: column.tolist() for name, column in content["log"].items()}


def from_parquet(path: Path) -> dict[str, list[Any]]:
    from pyarrow import parquet

    table = parquet.read_table(path)
    for field in table.schema:
        assert field.metadata[b"unit"].decode() == unit_of_column(field.name)
    return dict(table.to_pydict())


FORMATS = {"csv": from_csv, "mat": from_mat, "parquet": from_parquet}


@pytest.mark.parametrize(("suffix", "read_back"), FORMATS.items(), ids=FORMATS)
def test_every_column_comes_back_to_the_bit(log, tmp_path, suffix, read_back: Read):
    done = pamctl_export(log, tmp_path / f"a.{suffix}")
    assert done.exit_code == 0, done.output
    back = read_back(tmp_path / f"a.{suffix}")
    assert list(back) == list(log.columns)
    for name, column in log.columns.items():
        assert back[name] == column.tolist(), name


@pytest.mark.parametrize(("suffix", "read_back"), FORMATS.items(), ids=FORMATS)
def test_a_part_is_chosen_by_fields_time_and_stride(log, tmp_path, suffix, read_back: Read):
    out = tmp_path / f"a.{suffix}"
    chosen = ("--fields", "position_m,t_s", "--from", "0.05", "--to", "0.1", "--every", "10")
    assert pamctl_export(log, out, *chosen).exit_code == 0
    back = read_back(out)
    assert list(back) == ["position_m", "t_s"]
    assert back["position_m"] == log["position_m"][50:101:10].tolist()


def test_numbers_that_are_not_finite_survive_a_csv(tmp_path):
    from pamctl.log.importing.pipeline import write_imported

    values = np.array([math.nan, math.inf, -math.inf, -0.0, 5e-324])
    write_imported(tmp_path / "a.mcap", np.arange(5.0), {"force_n": values}, {})
    export_ticks(tmp_path / "a.mcap", tmp_path / "a.csv")
    assert list(map(repr, from_csv(tmp_path / "a.csv")["force_n"])) == list(
        map(repr, values.tolist())
    )


@pytest.mark.parametrize("suffix", ["csv", "mat"])
def test_what_was_exported_can_be_imported(log, tmp_path, suffix):
    out = tmp_path / f"a.{suffix}"
    pamctl_export(log, out, "--fields", "t_s,position_m")
    done = import_log(out, tmp_path / "b.mcap", accept_units=True)
    assert done.written, done.findings
    back = pamctl.log.read(tmp_path / "b.mcap")
    assert back["position_m"].tolist() == log["position_m"].tolist()


@pytest.mark.parametrize(
    ("out", "options", "code", "told"),
    [
        ("a.xls", (), 2, "no such format '.xls'"),
        ("a.csv", ("--from", "9"), 2, "no ticks to export there; the log is from 0 s to 0.299 s"),
        ("a.csv", ("--fields", "position_mm"), 2, "did you mean position_m?"),
        ("a.csv", ("--fields", ","), 2, "names no column"),
        ("no/a.csv", (), 2, "there is no directory"),
        ("there.csv", (), 2, "never overwritten"),
    ],
)
def test_what_cannot_be_exported_is_refused_and_leaves_nothing(
    log, tmp_path, out, options, code, told
):
    (tmp_path / "there.csv").write_text("precious")
    done = pamctl_export(log, tmp_path / out, *options)
    assert done.exit_code == code
    assert told in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["there.csv"]
    assert (tmp_path / "there.csv").read_text() == "precious"


def test_parquet_without_its_package_says_what_to_install(log, tmp_path, monkeypatch):
    real = builtins.__import__

    def without_pyarrow(name: str, *rest: Any, **more: Any) -> Any:
        if name.partition(".")[0] == "pyarrow":
            raise ModuleNotFoundError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without_pyarrow)
    done = pamctl_export(log, tmp_path / "a.parquet")
    assert done.exit_code == 2
    assert "pip install pyarrow" in done.stderr
    assert not (tmp_path / "a.parquet").exists()
