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
    lines = [
        f"{path}: {len(measured)} ticks from {measured.t_s[0]:.3f} s on, model minus measurement",
        "",
        f"{'':<{width + 16}}{'position um':>21}{'pressure kPa':>21}",
        f"{'model':<{width}}{'driven':<16}{head}{head}",
    ]
    for name, comparison in found.items():
        for way in comparison.ways:
            position = comparison.gap(way, "position_m")
            pressure = comparison.gap(way, "pressure_pa")
            lines.append(
                f"{name:<{width}}{way.way:<16}"
                f"{_format_cells(position, _UM)}{_format_cells(pressure, _KPA)}"
            )
    lines += ["", "each block alone, driven by the other's measured signal, RMS", ""]
    tables = [comparison.regimes() for comparison in found.values()]
    cell = max(21, *(len(name) + 2 for name in found)) if len(found) > 1 else 21
    names = "".join(f"{name:>{cell}}" for name in found) if len(found) > 1 else ""
    if names:
        lines.append(f"{'':<26}{names}")
    lines.append(f"{'':<18}{'ticks':>8}" + f"{'um':>{cell - 9}}{'kPa':>9}" * len(found))
    for regimes in zip(*tables, strict=True):
        cells = "".join(
            _format_cell(r.position_m.rms * _UM, cell - 9)
            + _format_cell(r.pressure_pa.rms * _KPA, 9)
            for r in regimes
        )
        lines.append(f"{regimes[0].name:<18}{regimes[0].ticks:>8}{cells}")
    return "\n".join([*lines, "", f"next: {_suggest_next(path, found)}"])


def _suggest_next(path: Path, found: Mapping[str, Comparison]) -> str:
    plants = [f" --plant {name}" for name in found if name != OWN_PLANT]
    log, plant = shlex.quote(str(path)), plants[0] if plants else ""
    return f"pamctl diagnose {log}{plant} --out diagnosis  # names what the model lacks"


def _format_cells(gap: ComparisonGap, scale: float) -> str:
    return _format_cell(gap.rms * scale, 12) + _format_cell(gap.max * scale, 9)


def _format_cell(value: float, width: int) -> str:
    return f"{'-':>{width}}" if value != value else f"{value:>{width}.{1 if value >= 10 else 3}f}"


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
