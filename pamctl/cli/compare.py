"""`pamctl compare`: how far a model is from a measurement."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pamctl.cli.config import JsonOption, exit_on_config_errors
from pamctl.cli.offline import exit_on_bad_data, print_json, require_writable, write_page

if TYPE_CHECKING:
    from pamctl.compare.coupled_gap import Comparison, ComparisonGap
    from pamctl.log import Log

_UM, _KPA = 1e6, 1e-3


def compare(
    path: Annotated[Path, typer.Argument(metavar="LOG")],
    plants: Annotated[
        list[str] | None,
        typer.Option(
            "--plant", metavar="NAME|FILE", help="Model; the log's own, or paper. Repeats."
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE", help="Write an HTML page with plots.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Drive models by the logged command, and hold them against the measurement."""
    require_writable(plot, "--plot")
    with exit_on_bad_data(as_json=as_json), exit_on_config_errors(as_json=as_json):
        from pamctl.log import read

        log = read(path)
        found = _compare_plants(log, plants or [])
    if plot is not None:
        from pamctl.compare.compare_page import draw_comparison_page

        write_page(plot, draw_comparison_page(path.name, found).html(), "--plot")
    if as_json:
        print_json(_make_document(path, found, plot))
    else:
        typer.echo("\n".join(_format_lines(path, found)))
        if plot is not None:
            typer.echo(f"plots: {plot}")


def _compare_plants(log: Log, names: list[str]) -> dict[str, Comparison]:
    """Compare with each plant, by its name on the command line. Raises ConfigError, LogError."""
    from pamctl.compare.coupled_gap import compare_model as compared
    from pamctl.plant.model import plant_parameters
    from pamctl.settings.resolve import SECTIONS, RawSettings, find_config_file, validate_settings

    if not names and "plant" in log.config:
        raws = {"the log's own": RawSettings(log.config["plant"], {(): f"{log.path}:config.json"})}
    else:
        raws = {
            name: RawSettings.read(find_config_file("plant", name)) for name in names or ["paper"]
        }
    return {
        name: compared(log, plant_parameters(validate_settings(SECTIONS["plant"], raw, "plant")))
        for name, raw in raws.items()
    }


def _format_lines(path: Path, found: dict[str, Comparison]) -> list[str]:
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
    names = "".join(f"{name[:18]:>21}" for name in found) if len(found) > 1 else ""
    if names:
        lines.append(f"{'':<26}{names}")
    lines.append(f"{'':<18}{'ticks':>8}" + f"{'um':>12}{'kPa':>9}" * len(found))
    for regimes in zip(*tables, strict=True):
        cells = "".join(
            f"{_format_cell(r.position_m.rms * _UM, 12)}{_format_cell(r.pressure_pa.rms * _KPA, 9)}"
            for r in regimes
        )
        lines.append(f"{regimes[0].name:<18}{regimes[0].ticks:>8}{cells}")
    return [*lines, "", f"next: {_suggest_next(path, found)}"]


def _suggest_next(path: Path, found: dict[str, Comparison]) -> str:
    plants = [f" --plant {name}" for name in found if name != "the log's own"]
    return f"pamctl diagnose {path}{plants[0] if plants else ''}  # names what the model lacks"


def _format_cells(gap: ComparisonGap, scale: float) -> str:
    return _format_cell(gap.rms * scale, 12) + _format_cell(gap.max * scale, 9)


def _format_cell(value: float, width: int) -> str:
    return f"{'-':>{width}}" if value != value else f"{value:>{width}.{1 if value >= 10 else 3}f}"


def _make_document(path: Path, found: dict[str, Comparison], plot: Path | None) -> dict[str, Any]:
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
        "plot": plot and str(plot),
        "next": _suggest_next(path, found),
    }


def _gap_fields(gap: ComparisonGap) -> dict[str, float | None]:
    return {name: None if value != value else value for name, value in gap._asdict().items()}
