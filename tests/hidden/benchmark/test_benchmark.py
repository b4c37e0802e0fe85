"""The benchmark from records to table, as somebody else would run it with a method of his own."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest

from hidden.benchmark import benchmark_suite
from hidden.benchmark.benchmark_suite import Suite
from hidden.benchmark.command_line import main
from hidden.benchmark.failure import BenchmarkError
from hidden.benchmark.records_folder import list_ids, read_task, read_truth
from hidden.benchmark.run_method import load_method, run_method
from hidden.examination.examine import records_of
from pamctl.plant.catalogue import CATALOGUE

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[3]
FEW = ("null/parameters", "single/creep/10", "left_out/cubic_stiffness")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("benchmark")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark_suite, "_SAMPLE", FEW[:1] * 2 + FEW[1:])
        main(["write", str(folder / "records"), "--truth", str(folder / "truth.json")])
    return folder


def method_that_says(folder: Path, code: str) -> str:
    path = folder / f"own_{hashlib.sha256(code.encode()).hexdigest()[:8]}.py"
    path.write_text(code)
    return f"{path}:diagnose_task"


class StrangerProcess(Executor):
    """Runs each task in a process that can import pamctl, and nothing of the rigs by itself."""

    CODE = (
        "import pickle, sys\n"
        "function, arguments = pickle.load(sys.stdin.buffer)\n"
        "sys.stdout.buffer.write(pickle.dumps(function(*arguments)))"
    )

    def submit(self, fn: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        answer = subprocess.run(
            [sys.executable, "-P", "-c", self.CODE],
            input=pickle.dumps((fn, arguments)),
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            check=True,
            stdout=subprocess.PIPE,
        )
        future: Future[Any] = Future()
        future.set_result(pickle.loads(answer.stdout))
        return future


def test_a_task_reaches_a_process_that_knows_pamctl_alone(written: Path, tmp_path: Path) -> None:
    says_id = (
        "def diagnose_task(task):\n    return {'verdict': 'none_known', 'sentence': task.id}\n"
    )
    method = method_that_says(tmp_path, says_id)
    found = dict(run_method(method, written / "records", tmp_path / "out", StrangerProcess()))
    assert {id: verdict.get("sentence") for id, verdict in found.items()} == {
        id: id for id in list_ids(written / "records")
    }


def test_records_are_those_of_the_rigs_and_tell_nothing_of_what_they_hide(written: Path) -> None:
    records, cases = written / "records", read_truth(written / "truth.json")
    assert [*cases] == list_ids(records)
    assert {case.id for case in cases.values()} == {*FEW}
    for id, case in cases.items():
        task = read_task(records, id)
        train, held_out = records_of(case)
        assert (len(task.train), len(task.held_out)) == (len(train), len(held_out))
        for columns, record in zip(task.train, train, strict=True):
            for name, values in record.columns().items():
                assert columns[name] == pytest.approx(values, rel=1e-9, abs=1e-12)
        text = (records / id / "card.json").read_text()
        hidden = {*case.effects} - {*case.removed}
        assert not any(name in text for name in (*hidden, case.id))


def test_the_same_seed_makes_the_same_cases_and_another_seed_others() -> None:
    def draws(seed: int) -> set[tuple[str, int]]:
        return {(id, case.seed) for id, case in Suite(seed=seed).list_cases().items()}

    assert draws(0) == draws(0)
    assert not draws(0) & draws(1)
    every = Suite("all").list_cases()
    assert {"null", "single", "pair", "unknown", "bad"} <= {c.group for c in every.values()}


def test_a_method_from_a_file_is_run_once_and_scored(
    written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    always_creep = method_that_says(
        tmp_path,
        "def diagnose_task(task):\n"
        "    assert task.train[0]['t_s'].shape == task.train[0]['position_m'].shape\n"
        "    return {'verdict': 'named', 'effects': [{'name': 'creep'}]}\n",
    )
    verdicts = tmp_path / "verdicts"
    command = ["run", str(written / "records"), "--method", always_creep, "--out", str(verdicts)]
    main(command)
    stamps = {path: path.stat().st_mtime_ns for path in verdicts.iterdir()}
    main(command)
    assert stamps == {path: path.stat().st_mtime_ns for path in verdicts.iterdir()}
    capsys.readouterr()
    main(["score", str(written / "truth.json"), f"creep={verdicts}", "--json"])
    scored = json.loads(capsys.readouterr().out)["creep"]
    marks = {one["case"]: one["mark"] for one in scored["cases"]}
    assert marks == {FEW[0]: "alarm", FEW[1]: "right", FEW[2]: "wrong"}
    next(iter(stamps)).unlink()
    main(["score", str(written / "truth.json"), str(verdicts)])
    table = capsys.readouterr().out
    assert "| | verdicts |" in table
    assert "| without a verdict | 1 |" in table


def test_a_crash_on_a_case_is_said_and_keeps_the_other_verdicts(
    written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    id = list_ids(written / "records")[0]
    method = method_that_says(
        tmp_path,
        "def diagnose_task(task):\n"
        f"    assert task.id != '{id}', 'no idea'\n"
        "    return {'verdict': 'miscalibrated'}\n",
    )
    out = tmp_path / "verdicts"
    with pytest.raises(SystemExit) as leaving:
        main(["run", str(written / "records"), "--method", method, "--out", str(out)])
    assert leaving.value.code == 3
    assert f"raised on {id}" in capsys.readouterr().err
    assert not (out / f"{id}.json").exists()
    assert len([*out.iterdir()]) == len(list_ids(written / "records")) - 1


def test_a_changed_record_or_a_wrong_verdict_is_refused_with_its_place(
    written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    id = list_ids(written / "records")[0]
    path = written / "records" / id / "train-1.csv"
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"1", b"2", 1))
    with pytest.raises(BenchmarkError, match=r"train-1\.csv: is missing or was changed"):
        read_task(written / "records", id)
    path.write_bytes(whole)
    wrong: list[tuple[Any, str]] = [
        ({"schema": 1, "verdict": "perhaps"}, "verdict: Input should be 'no_discrepancy'"),
        ({"verdict": "named"}, "schema: Field required"),
        ([], "holds no JSON object"),
    ]
    for document, message in wrong:
        (tmp_path / f"{id}.json").write_text(json.dumps(document))
        with pytest.raises(SystemExit) as leaving:
            main(["score", str(written / "truth.json"), str(tmp_path)])
        assert leaving.value.code == 65
        assert message in capsys.readouterr().err


def test_the_truth_is_kept_out_of_the_records(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inside = str(tmp_path / "records" / "truth.json")
    with pytest.raises(SystemExit) as leaving:
        main(["write", str(tmp_path / "records"), "--truth", inside])
    assert leaving.value.code == 65
    assert "keep the truth apart" in capsys.readouterr().err
    assert not (tmp_path / "records").exists()


def test_an_unknown_method_is_refused_before_any_case_is_run() -> None:
    with pytest.raises(BenchmarkError, match="give pamctl, MODULE:FUNCTION or FILE"):
        load_method("nobody:knows")


def test_the_module_runs_from_anywhere_and_explains_itself(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pamctl.benchmark", "--help"]
    done = subprocess.run(
        command, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "write|run|score" in done.stdout


@pytest.mark.parametrize("name", FEW[:2])
@pytest.mark.parametrize("rival", ["ladder", "grey_box"])
def test_a_rival_is_silent_where_nothing_is_missing_and_sees_a_creep(
    written: Path, name: str, rival: str
) -> None:
    cases = read_truth(written / "truth.json")
    id = next(id for id, case in cases.items() if case.id == name)
    method = load_method(f"{ROOT / 'scripts' / 'rivals' / rival}.py:diagnose_task")
    task = read_task(written / "records", id)
    if rival == "grey_box":  # each structure takes it a second
        few = {"creep", "cubic_stiffness", "valve_leak"}
        task.card["names_not_to_use"] = [*({*CATALOGUE} - few)]
    verdict = method(task)
    said = {effect["name"] for effect in verdict.get("effects", [])}
    said |= {name for group in verdict.get("ambiguous", []) for name in group}
    assert said >= {"creep"} if "creep" in name else verdict == {"verdict": "miscalibrated"}
