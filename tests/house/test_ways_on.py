"""Whatever a check finds wrong comes with the way on."""

import ast
from collections.abc import Iterator
from pathlib import Path

from pamctl.log.check import FIXES

ROOT = Path(__file__).parents[2]
LEVEL, FIX = 1, 4
"""Places of two arguments of `report_check`."""


def list_calls(folder: str) -> Iterator[tuple[str, str, ast.Call]]:
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                name = getattr(node.func, "attr", getattr(node.func, "id", ""))
                yield f"{path.relative_to(ROOT)}:{node.lineno}", name, node


def test_each_error_of_log_check_has_a_way_on():
    kinds = set[str]()
    for where, name, call in list_calls("pamctl/log"):
        named = [a.value for a in call.args if isinstance(a, ast.Constant)]
        kind = next((value for value in named if isinstance(value, str)), "")
        if name in {"error", "errors", "_error"} and "importing" not in where and kind:
            kinds.add(kind)
        if name == "make_problem" and any(k.arg == "is_fatal" for k in call.keywords):
            kinds.add(kind)
    assert {"damage", "gap", "backwards"} <= kinds
    assert kinds - set(FIXES) == set()


def test_each_fault_that_the_doctor_finds_has_a_fix():
    findings = [
        (where, call)
        for folder in ("hal", "pamctl/commissioning")
        for where, name, call in list_calls(folder)
        if name == "report_check"
    ]
    assert len(findings) > 50
    without = []
    for where, call in findings:
        level = call.args[LEVEL]
        if isinstance(level, ast.Constant) and level.value == "ok":
            continue
        named = [keyword.value for keyword in call.keywords if keyword.arg == "fix"]
        fix = next(iter([*call.args[FIX:], *named]), None)
        if fix is None or (isinstance(fix, ast.Constant) and not fix.value):
            without.append(where)
    assert without == []


def test_each_doubt_about_the_data_of_a_diagnosis_has_a_way_on():
    doubts = [
        (where, call)
        for where, name, call in list_calls("pamctl/diagnose")
        if name == "Problem" and {"refuse", "record_doubts", "time_shifts"} & {Path(where).stem}
    ]
    assert [where for where, call in doubts if "fix" not in {k.arg for k in call.keywords}] == []
    tree = ast.parse((ROOT / "pamctl/diagnose/record_doubts.py").read_text())
    yielded = [node.value for node in ast.walk(tree) if isinstance(node, ast.Yield)]
    triples = [one for one in yielded if isinstance(one, ast.Tuple)]  # rule, text, way on
    assert [one.lineno for one in triples if len(one.elts) != 3] == []
    assert len(doubts) + len(triples) > 20
