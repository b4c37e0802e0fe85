"""A comparison as text tables, or as one document."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pamctl.compare.compare_plants import OWN_PLANT
from pamctl.compare.coupled_gap import Comparison, ComparisonGap

_UM, _KPA = 1e6, 1e-3


def format_comparison(path: Path, found: Mapping[str, Comparison]) -> str:
    """Return the gaps of every model as tables."""
    first = next(iter(found.values()))
    measured = first.measured
    width = max(len(name) for name in found) + 2
    head = f"{'RMS':>12}{'max':>9}"
    gaps = (
        f"{name:<{width}}{driven:<16}{a:>12}{b:>9}{c:>12}{d:>9}"
        for name, driven, a, b, c, d in list_gaps(found)[1]
    )
    lines = [
        f"{path}: {len(measured)} ticks from {measured.t_s[0]:.3f} s on, model minus measurement",
        "",
        f"{'':<{width + 16}}{'position um':>21}{'pressure kPa':>21}",
        f"{'model':<{width}}{'driven':<16}{head}{head}",
        *gaps,
        "",
        "each block alone, driven by the other's measured signal, RMS",
        "",
    ]
    cell = max(21, *(len(name) + 2 for name in found)) if len(found) > 1 else 21
    names = "".join(f"{name:>{cell}}" for name in found) if len(found) > 1 else ""
    if names:
        lines.append(f"{'':<26}{names}")
    lines.append(f"{'':<18}{'ticks':>8}" + f"{'um':>{cell - 9}}{'kPa':>9}" * len(found))
    for name, ticks, *rms in list_regimes(found)[1]:
        pairs = zip(rms[::2], rms[1::2], strict=True)
        cells = "".join(f"{um:>{cell - 9}}{kpa:>9}" for um, kpa in pairs)
        lines.append(f"{name:<18}{ticks:>8}{cells}")
    unused = dict.fromkeys(text for comparison in found.values() for text in comparison.unused)
    return "\n".join([*lines, "", *unused, f"next: {_suggest_next(path, found)}"])


def list_gaps(found: Mapping[str, Comparison]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: the gaps of every model, however it is driven."""
    header = ["model", "driven", "position RMS, µm", "max, µm", "pressure RMS, kPa", "max, kPa"]
    rows = [
        [
            name,
            way.way,
            *(_format_cell(value * _UM) for value in comparison.gap(way, "position_m")),
            *(_format_cell(value * _KPA) for value in comparison.gap(way, "pressure_pa")),
        ]
        for name, comparison in found.items()
        for way in comparison.ways
    ]
    return header, rows


def list_regimes(found: Mapping[str, Comparison]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: the gaps of each block alone in each part of the run, RMS."""
    header = ["regime", "ticks"]
    for name in found:
        of = f"{name}: " if len(found) > 1 else ""
        header += [f"{of}position, µm", f"{of}pressure, kPa"]
    rows = []
    for regimes in zip(*(comparison.regimes() for comparison in found.values()), strict=True):
        cells = [
            _format_cell(value)
            for regime in regimes
            for value in (regime.position_m.rms * _UM, regime.pressure_pa.rms * _KPA)
        ]
        rows.append([regimes[0].name, str(regimes[0].ticks), *cells])
    return header, rows


def _suggest_next(path: Path, found: Mapping[str, Comparison]) -> str:
    plants = [f" --plant {name}" for name in found if name != OWN_PLANT]
    log, plant = shlex.quote(str(path)), plants[0] if plants else ""
    return f"pamctl diagnose {log}{plant} --out diagnosis  # names what the model lacks"


def _format_cell(value: float) -> str:
    return "-" if value != value else f"{value:.{1 if value >= 10 else 3}f}"


def make_comparison_document(path: Path, found: Mapping[str, Comparison]) -> dict[str, Any]:
    """Return the gaps of every model as one document; SI, None where there is no gap."""
    measured = next(iter(found.values())).measured
    return {
        "schema": 1,
        "path": str(path),
        "from_t_s": float(measured.t_s[0]),
        "ticks": len(measured),
        "plants": [
            {
                "plant": name,
                "unused": [*comparison.unused],
                "gap": {
                    way.way.replace(" ", "_"): {
                        signal: _gap_fields(comparison.gap(way, signal))
                        for signal in ("position_m", "pressure_pa")
                    }
                    for way in comparison.ways
                },
                "regimes": [
                    {
                        "regime": regime.name,
                        "ticks": regime.ticks,
                        "position_m": _gap_fields(regime.position_m),
                        "pressure_pa": _gap_fields(regime.pressure_pa),
                    }
                    for regime in comparison.regimes()
                ],
            }
            for name, comparison in found.items()
        ],
        "next": _suggest_next(path, found),
    }


def _gap_fields(gap: ComparisonGap) -> dict[str, float | None]:
    return {name: None if value != value else value for name, value in gap._asdict().items()}
