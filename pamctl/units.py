"""Units that measured files and datasheets may use, with their SI values: the one table of them.

The suffix of a name says what it measures: `position_m` has the units of a length.
"""

from __future__ import annotations

from collections.abc import Mapping

_UNITS_OF_SUFFIX: Mapping[str, Mapping[str, float]] = {
    "_n_s_per_m": {"N s/m": 1.0, "N s/mm": 1e3, "kN s/m": 1e3, "N s/cm": 1e2},
    "_n_per_m": {"N/m": 1.0, "N/mm": 1e3, "N/cm": 1e2, "kN/m": 1e3},
    "_j_per_kg_k": {"J/(kg K)": 1.0},
    "_m2_per_v": {"m2/V": 1.0, "mm2/V": 1e-6},
    "_per_m": {"1/m": 1.0, "1/mm": 1e3},
    "_kg": {"kg": 1.0, "g": 1e-3, "lb": 0.45359237, "t": 1e3},
    "_m3": {"m3": 1.0, "l": 1e-3, "dm3": 1e-3, "ml": 1e-6, "cm3": 1e-6, "mm3": 1e-9},
    "_m2": {"m2": 1.0, "cm2": 1e-4, "mm2": 1e-6},
    "_pa": {
        "Pa": 1.0,
        "kPa": 1e3,
        "MPa": 1e6,
        "hPa": 1e2,
        "bar": 1e5,
        "mbar": 1e2,
        "psi": 6894.757293168,
        "atm": 101325.0,
        "Torr": 101325.0 / 760.0,
        "mmHg": 133.322387415,
        "inHg": 3386.388640341,
        "kgf/cm2": 98066.5,
    },
    "_k": {"K": 1.0},
    "_m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "in": 25.4e-3},
    "_n": {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605, "kgf": 9.80665},
    "_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "_v": {"V": 1.0, "mV": 1e-3},
}
"""The first suffix that ends a name counts."""


def find_units(name: str) -> Mapping[str, float]:
    """Return the units of a quantity with their SI values; empty for a plain number."""
    return next((units for end, units in _UNITS_OF_SUFFIX.items() if name.endswith(end)), {})
