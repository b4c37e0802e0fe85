"""The runner of measured sets, on a set that is made here and on the sets of this folder."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import real_data
import yaml
from measured_set import find_failures, read_set, scale_guesses

HERE = Path(__file__).parent
SHIPPED = sorted(path.parent for path in HERE.glob("*/set.yaml"))


# --- a set -----------------------------------------------------------------------------------


def make_set(folder: Path, **changes: Any) -> Path:
    """Write a set of two files with white space and no names."""
    folder.mkdir(parents=True)
    rows = [f"{k * 10} {np.sin(k / 20):.6f} {k}" for k in range(400)]
    for name in ("a.txt", "b.txt"):
        (folder / name).write_text("\n".join(rows) + "\n")
    told = {
        "header": ["time_ms", "position_mm", "force_n"],
        "parts": {"fitted": [{"file": "a.txt", "rows": [0.0, 0.5]}], "confirmed": ["b.txt"]},
        "guessed": ["parameters.mass_kg"],
        **changes,
    }
    (folder / "set.yaml").write_text(yaml.safe_dump(told))
    (folder / "map.yaml").write_text(
        "time: {column: time_ms, unit: ms}\n"
        "position: {column: position_mm, unit: mm}\nforce: {column: force_n}\n"
    )
    (folder / "plant.yaml").write_text("actuator: direct\nparameters: {mass_kg: 2.0}\n")
    return folder


DOCUMENT: dict[str, Any] = {
    "verdict": "partial",
    "effects": [
        {"name": "coulomb_friction", "parameters": {"force_n": {"value": 20.0, "ci90": [19, 21]}}}
    ],
    "recalibrated": {"mass_kg": {"value": 95.0}},
    "gap": {"force_n": {"nominal": 9.0, "recalibrated": 6.0, "extended": 0.7, "floor": 0.4}},
}


@pytest.mark.parametrize(
    ("expect", "words"),
    [
        ({"verdicts": ["named", "partial"], "names": ["coulomb.*"]}, None),
        ({"verdicts": ["named"]}, "verdict partial"),
        ({"names": ["cubic_.*"]}, "nothing like"),
        ({"names": [r"coulomb_friction\.force_n"]}, None),
        ({"never": ["coulomb.*n"]}, "is named"),
        ({"numbers": {"mass_kg": {"value": 95.11, "within": 0.05}}}, None),
        ({"numbers": {"coulomb_friction.force_n": {"value": 30.0, "within": 0.05}}}, "not 30"),
        ({"numbers": {"coulomb_friction.share": {"value": 30.0, "within": 0.05}}}, "is None"),
        ({"gap": {"channel": "force_n", "at_most": 0.8}}, None),
        ({"gap": {"channel": "force_n", "at_most": 0.5}}, "limit"),
        ({"gap": {"channel": "position_m"}}, "no gap"),
    ],
)
def test_an_expectation_is_checked(tmp_path, expect, words):
    measured = read_set(make_set(tmp_path / "set", expect=expect), None)
    failed = find_failures(measured, DOCUMENT)
    assert failed == [] if words is None else words in failed[0]


@pytest.mark.long
def test_an_error_of_one_set_is_reported_and_the_others_go_on(tmp_path, capsys, monkeypatch):
    for name in ("bad", "good", "lacking"):
        make_set(tmp_path / "sets" / name)
    (tmp_path / "sets" / "bad" / "a.txt").write_text("no numbers\n" * 9)
    (tmp_path / "sets" / "lacking" / "b.txt").unlink()
    document = {**DOCUMENT, "verdict": "none_known", "effects": []}
    call = real_data.call_pamctl

    def answer_at_once(arguments: Any, *others: Any, **more: Any) -> str:
        if arguments[0] != "diagnose":
            return call(arguments, *others, **more)
        assert yaml.safe_load(Path(arguments[5]).read_text())["parameters"]["mass_kg"] == 4.0
        out = Path(arguments[3])
        out.mkdir()
        (out / "diagnosis.json").write_text(json.dumps(document))
        return ""

    monkeypatch.setattr(real_data, "call_pamctl", answer_at_once)
    results = tmp_path / "results.jsonl"
    code = real_data.main([str(tmp_path / "sets"), "--guesses", "2", "--resume", str(results)])
    told = json.loads(capsys.readouterr().out)
    assert code == real_data.CHECK_FAILED
    assert told["files_missing"] == {"lacking": ["b.txt"]}
    bad, good = told["results"]
    assert "bad" in bad["key"]
    assert "not imported" in bad["error"] or "a-fitted" in bad["error"]
    assert good["document"]["verdict"] == "none_known"
    stored = [json.loads(line)["key"] for line in results.read_text().splitlines()]
    assert stored == ["bad x2", "good x2"]


# --- the sets of this folder -----------------------------------------------------------------


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda path: path.name)
def test_a_shipped_set_is_readable(folder):
    measured = read_set(folder, Path("nowhere"))
    plant = yaml.safe_load((folder / "plant.yaml").read_text())
    assert scale_guesses(plant, measured.guessed, 2.0) != plant
    assert measured.missing
    used = {part: {p.file for p in pieces} for part, pieces in measured.parts.items()}
    assert not used["confirmed"] & (used["fitted"] | used["chosen"]), "what confirms is untouched"
