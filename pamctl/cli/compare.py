"""`pamctl compare`: how far a model is from a measurement."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pamctl.cli.config import JsonOption, config_errors_exit
from pamctl.cli.offline import bad_data_exits, print_json, require_place, write_page

if TYPE_CHECKING:
    from pamctl.compare.coupled_gap import Comparison, Gap
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
    require_place(plot, "--plot")
    with bad_data_exits(as_json=as_json), config_errors_exit(as_json=as_json):
        from pamctl.log import read

        log = read(path)
        found = _compared(log, plants or [])
    if plot is not None:
        from pamctl.compare.compare_page import page_of

        write_page(plot, page_of(path.name, found).html(), "--plot")
    if as_json:
        print_json(_document(path, found, plot))
    else:
        typer.echo("\n".join(_lines(path, found)))
        if plot is not None:
            typer.echo(f"plots: {plot}")


def _compared(log: Log, names: list[str]) -> dict[str, Comparison]:
    """Compare with each plant, by its name on the command line. Raises ConfigError, LogError."""
    from pamctl.compare.coupled_gap import compare as compared
    from pamctl.plant.model import plant_parameters
    from pamctl.settings.resolve import SECTIONS, Raw, find, validated

    if not names and "plant" in log.config:
        raws = {"the log's own": Raw(log.config["plant"], {(): f"{log.path}:config.json"})}
    else:
        raws = {name: Raw.read(find("plant", name)) for name in names or ["paper"]}
    return {
        name: compared(log, plant_parameters(validated(SECTIONS["plant"], raw, "plant")))
        for name, raw in raws.items()
    }


def _lines(path: Path, found: dict[str, Comparison]) -> list[str]:
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
                f"{name:<{width}}{way.way:<16}{_cells(position, _UM)}{_cells(pressure, _KPA)}"
            )
    lines += ["", "each block alone, driven by the other's measured signal, RMS", ""]
    tables = [comparison.regimes() for comparison in found.values()]
    names = "".join(f"{name[:18]:>21}" for name in found) if len(found) > 1 else ""
    if names:
        lines.append(f"{'':<26}{names}")
    lines.append(f"{'':<18}{'ticks':>8}" + f"{'um':>12}{'kPa':>9}" * len(found))
    for regimes in zip(*tables, strict=True):
        cells = "".join(
            f"{_cell(r.position_m.rms * _UM, 12)}{_cell(r.pressure_pa.rms * _KPA, 9)}"
            for r in regimes
        )
        lines.append(f"{regimes[0].name:<18}{regimes[0].ticks:>8}{cells}")
    return [*lines, "", f"next: {_next(path, found)}"]


def _next(path: Path, found: dict[str, Comparison]) -> str:
    plants = [f" --plant {name}" for name in found if name != "the log's own"]
    return f"pamctl diagnose {path}{plants[0] if plants else ''}  # names what the model lacks"


def _cells(gap: Gap, scale: float) -> str:
    return _cell(gap.rms * scale, 12) + _cell(gap.max * scale, 9)


def _cell(value: float, width: int) -> str:
    return f"{'-':>{width}}" if value != value else f"{value:>{width}.{1 if value >= 10 else 3}f}"


def _document(path: Path, found: dict[str, Comparison], plot: Path | None) -> dict[str, Any]:
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
                        signal: _gap(comparison.gap(way, signal))
                        for signal in ("position_m", "pressure_pa")
                    }
                    for way in comparison.ways
                },
                "regimes": [
                    {
                        "regime": regime.name,
                        "ticks": regime.ticks,
                        "position_m": _gap(regime.position_m),
                        "pressure_pa": _gap(regime.pressure_pa),
                    }
                    for regime in comparison.regimes()
                ],
            }
            for name, comparison in found.items()
        ],
        "plot": plot and str(plot),
        "next": _next(path, found),
    }


def _gap(gap: Gap) -> dict[str, float | None]:
    return {name: None if value != value else value for name, value in gap._asdict().items()}
