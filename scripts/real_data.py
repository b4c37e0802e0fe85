"""Diagnose measured sets from wrong guesses, beside what a plain fit by hand leaves.

    python scripts/real_data.py DIR [--data FOLDER] [--only NAME] [--guesses 0.5 1 2]
        [--resume FILE] [--jobs N] [--keep FOLDER] [--timeout-s 3600]

DIR holds sets (`scripts/measured_set.py` says what a set is) or is one. Files that may not lie in
the project are looked for below --data, else below the folder in PAMCTL_MEASURED_DATA. Each set is
imported and diagnosed by the command line, once for each guess. The JSON document on stdout has all
figures; stderr has the table. Exit code 3: an expectation failed, or a set could not be diagnosed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]

from measured_set import (  # noqa: E402
    VARIABLE,
    MeasuredSet,
    SetRefused,
    find_failures,
    find_sets,
    scale_guesses,
    write_pieces,
)
from resumable_study import run_resumable  # noqa: E402

CHECK_FAILED = 3
BAD_DATA = 65


@dataclass(frozen=True)
class Trial:
    """One diagnosis: a set, and the factor of its guesses."""

    measured: MeasuredSet
    factor: float
    keep: Path | None
    timeout_s: float

    @property
    def key(self) -> str:
        """The key of its result."""
        return f"{self.measured.name} x{self.factor:g}"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", type=Path, help=f"folder of measured data; else {VARIABLE}")
    parser.add_argument("--only", default="", help="only sets whose name contains this")
    parser.add_argument("--guesses", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--resume", type=Path, help="file of results: stored ones are not repeated")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder that keeps each diagnosis")
    parser.add_argument("--timeout-s", type=float, default=3600.0)
    options = parser.parse_args(arguments)
    stated = os.environ.get(VARIABLE)
    data = options.data or (Path(stated) if stated else None)
    try:
        sets = [s for s in find_sets(options.folder, data) if options.only in s.name]
    except SetRefused as error:
        parser.error(str(error))
    absent = {s.name: s.missing for s in sets if s.missing}
    trials = [
        Trial(s, factor, options.keep, options.timeout_s)
        for s in sets
        if s.name not in absent
        for factor in options.guesses
    ]
    tasks = {trial.key: trial for trial in trials}
    stored = run_resumable(tasks, run_trial, options.resume, options.jobs, describe_result)
    results = [stored[trial.key] for trial in trials]
    print(json.dumps({"results": results, "files_missing": absent}, indent=2))
    print(format_results(results, absent), file=sys.stderr)
    return CHECK_FAILED if any(r.get("failed") or "error" in r for r in results) else 0


def run_trial(trial: Trial) -> dict[str, Any]:
    """Diagnose one set from one guess; what goes wrong is a result too."""
    try:
        with tempfile.TemporaryDirectory() as folder:
            return {"key": trial.key, **diagnose_set(trial, Path(folder))}
    except (SetRefused, ValueError, OSError, subprocess.SubprocessError) as error:
        return {"key": trial.key, "error": str(error)}
    except Exception:
        return {"key": trial.key, "error": traceback.format_exc(limit=-4)}


def diagnose_set(trial: Trial, folder: Path) -> dict[str, Any]:
    """Import and diagnose; return the figures."""
    measured = trial.measured
    pieces = write_pieces(measured, folder)
    logs = {
        part: [import_piece(measured, path, trial.timeout_s) for path in paths]
        for part, paths in pieces.items()
    }
    plant = yaml.safe_load((measured.folder / "plant.yaml").read_text(encoding="utf-8"))
    (folder / "plant.yaml").write_text(
        yaml.safe_dump(scale_guesses(plant, measured.guessed, trial.factor))
    )
    out = folder / "diagnosis"
    if trial.keep is not None:
        trial.keep.mkdir(parents=True, exist_ok=True)
        out = trial.keep / trial.key.replace(" ", "-")
    judges = [*logs["chosen"], *logs["confirmed"]]
    call = ["diagnose", *logs["fitted"], "--out", out, "--plant", folder / "plant.yaml", "--json"]
    for log in judges:
        call += ["--holdout", log]
    call_pamctl(call, trial.timeout_s, allowed=(0, BAD_DATA))
    document = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    return {
        "document": document,
        "hand_figures": dict(measured.hand_figures),
        "failed": find_failures(measured, document),
    }


def import_piece(measured: MeasuredSet, path: Path, timeout_s: float) -> Path:
    log = path.with_suffix(".mcap")
    call_pamctl(["log", "import", path, log, "--map", measured.folder / "map.yaml"], timeout_s)
    return log


def call_pamctl(
    arguments: Sequence[str | Path], timeout_s: float, allowed: tuple[int, ...] = (0,)
) -> str:
    command = [sys.executable, "-m", "pamctl", *map(str, arguments)]
    above = os.environ.get("PYTHONPATH")
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep + above if above else ''}"}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
    )
    if done.returncode not in allowed:
        words = done.stderr.strip() or done.stdout.strip()
        raise ValueError(f"pamctl {arguments[0]} left with {done.returncode}: {words[-2000:]}")
    return done.stdout


def describe_result(result: Mapping[str, Any]) -> str:
    """Return the verdict, for the progress line."""
    if "error" in result:
        return f"ERROR {result['error'].splitlines()[-1]}"
    return str(result["document"]["verdict"])


def format_results(results: Sequence[Mapping[str, Any]], absent: Mapping[str, list[str]]) -> str:
    """Return the table: verdict, names, held-out gaps, and the hand fit's figures."""
    lines = []
    for result in results:
        lines.append(f"{result['key']}: {describe_result(result)}")
        if "error" in result:
            continue
        document = result["document"]
        for effect in document["effects"]:
            lines.append(f"    {effect['name']}: {_format_numbers(effect['parameters'])}")
        if document.get("setup"):
            lines += [f"    set-up: {f['kind']} {f['number']} {f.get('value')}"
                      for f in document["setup"]]  # fmt: skip
        if document.get("recalibrated"):
            lines.append(f"    recalibrated: {_format_numbers(document['recalibrated'])}")
        for channel, gap in document.get("gap", {}).items():
            figures = " -> ".join(f"{gap[k]:.3g}" for k in ("nominal", "recalibrated", "extended"))
            lines.append(f"    held out {channel}: {figures}, floor {gap['floor']:.3g}")
        if result["hand_figures"]:
            lines.append(f"    by hand: {result['hand_figures']}")
        lines += [f"    FAILED: {words}" for words in result["failed"]]
    lines += [f"{name}: skipped, no {', '.join(files)}; state the folder by --data or {VARIABLE}"
              for name, files in absent.items()]  # fmt: skip
    return "\n".join(lines)


def _format_numbers(numbers: Mapping[str, Any]) -> str:
    parts = []
    for name, number in numbers.items():
        interval = number.get("ci90")
        span = f" ({interval[0]:.4g} to {interval[1]:.4g})" if interval else ""
        parts.append(f"{name} {number['value']:.4g}{span} {number.get('unit', '')}".rstrip())
    return ", ".join(parts)


if __name__ == "__main__":
    sys.exit(main())
