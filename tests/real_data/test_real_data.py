"""The runner of measured sets, on a set that is made here and on the sets of this folder."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import real_data
import yaml
from hand_fit import HandFigures, HandFit, columns_of, evaluate, fit_by_hand
from measured_set import (
    VARIABLE,
    find_failures,
    find_sets,
    read_set,
    scale_guesses,
    write_pieces,
)

HERE = Path(__file__).parent
SHIPPED = sorted(path.parent for path in HERE.glob("*/set.yaml"))


# --- the hand fit ----------------------------------------------------------------------------


def test_dry_friction_that_grows_with_pressure_is_found_by_hand() -> None:
    rng = np.random.default_rng(1)
    area, dry, per_pa, viscous = 4.9e-4, 1.5, 8e-6, 12.0

    def stroke(pressure_pa: float) -> dict[str, Any]:
        t = np.arange(3000) * 0.01
        x = 0.02 * np.abs((t / 5.0) % 2.0 - 1.0)
        pressure = pressure_pa + rng.normal(0.0, 200.0, len(t))
        columns = columns_of({"t_s": t, "position_m": x, "gauge_pa": pressure}, 0.1)
        grip = (dry + per_pa * pressure) * np.sign(columns["v"])
        columns["f"] = area * pressure + grip + viscous * columns["v"]
        columns["f"] += rng.normal(0.0, 0.3, len(t))
        return columns

    plan = HandFit("f", ("p", "1", "v", "sgn(v)", "p*sgn(v)"), ("p", "1"), 0.1, 0.3)
    found = fit_by_hand(plan, [stroke(1e5), stroke(3e5), stroke(7e5)], [stroke(5e5)])
    assert found.coefficients["sgn(v)"] == pytest.approx(dry, abs=0.1)
    assert found.coefficients["p*sgn(v)"] == pytest.approx(per_pa, rel=0.05)
    assert found.held_out == pytest.approx(0.3, rel=0.1)
    assert found.base_held_out > 4.0


@pytest.mark.parametrize(
    ("term", "words"), [("__import__('os')", "__import__"), ("v.real", "may hold"), ("q", "lacks")]
)
def test_a_term_that_is_no_expression_of_the_record_is_refused(term: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        evaluate(term, {"v": np.zeros(3)})


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
HAND = HandFigures({}, 0.6, 0.65, 6.0, 6.5)


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
        ({"gap": {"channel": "force_n", "hand_times": 1.1, "base_divided_by": 5}}, None),
        ({"gap": {"channel": "force_n", "hand_times": 1.0}}, "hand fit allows"),
        ({"gap": {"channel": "force_n", "base_divided_by": 10}}, "base allows"),
        ({"gap": {"channel": "force_n", "at_most": 0.5}}, "limit"),
        ({"gap": {"channel": "position_m"}}, "no gap"),
    ],
)
def test_an_expectation_is_checked(
    tmp_path: Path, expect: dict[str, Any], words: str | None
) -> None:
    measured = read_set(make_set(tmp_path / "set", expect=expect), None)
    failed = find_failures(measured, DOCUMENT, HAND)
    assert failed == [] if words is None else words in failed[0]


@pytest.mark.long
def test_an_error_of_one_set_is_reported_and_the_others_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hand = {"target": "f", "terms": ["1", "x"], "slope_s": 0.05}
    for name in ("bad", "good", "lacking"):
        make_set(tmp_path / "sets" / name, hand_fit=hand)
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
    assert good["hand"]["all"]["coefficients"]["1"] == pytest.approx(100.0, abs=60.0)
    stored = [json.loads(line)["key"] for line in results.read_text().splitlines()]
    assert stored == ["bad x2", "good x2"]


# --- the sets of this folder -----------------------------------------------------------------


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda path: path.name)
def test_a_shipped_set_is_readable(folder: Path) -> None:
    measured = read_set(folder, Path("nowhere"))
    plant = yaml.safe_load((folder / "plant.yaml").read_text())
    assert scale_guesses(plant, measured.guessed, 2.0) != plant
    assert measured.missing
    used = {part: {p.file for p in pieces} for part, pieces in measured.parts.items()}
    assert not used["confirmed"] & (used["fitted"] | used["chosen"]), "what confirms is untouched"


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda path: path.name)
def test_the_hand_fit_of_a_shipped_set_reaches_its_stored_figures(
    folder: Path, tmp_path: Path
) -> None:
    data = os.environ.get(VARIABLE)
    if not data:
        pytest.skip(f"no measured data: {VARIABLE} names no folder")
    (measured,) = find_sets(folder, Path(data))
    if measured.missing:
        pytest.skip(f"{VARIABLE} lacks {', '.join(measured.missing)}")
    logs = {
        part: [real_data.import_piece(measured, path, 120.0) for path in paths]
        for part, paths in write_pieces(measured, tmp_path).items()
    }
    found = real_data.fit_parts(measured, logs)["steady"]
    # Stored: whole files at three pressures. Here: 70 % of them, another rule of what is steady.
    assert found.fitted == pytest.approx(measured.hand_figures["fitted_n"], rel=0.2)
    assert found.held_out == pytest.approx(measured.hand_figures["held_out_n"], rel=0.3)
    assert found.base_held_out > 5.0 * found.held_out
