"""How far a replayed field may differ from the log: not at all, or by another CPU's rounding.

On the machine that made a log, every field must be equal to the bit. Another CPU or C library
may round `tan`, `pow` and `acos` differently in the last bit: IEEE 754 prescribes only the four
operations and the square root. The tick uses these functions here:

    tan   cut-off frequencies of the filters: every estimate, and all results of a law
    pow   lambda^q of a gains file; Psi of the valve in safety's model of the pressure
    acos  angle of the braid in the model within SMC

Zeros, measurements and references use none of them and stay exact; so do phases, verdicts and
flags.
"""

from __future__ import annotations

from collections.abc import Mapping

Tolerances = Mapping[str, float]
"""The largest permitted difference by field, in its unit."""

EXACT: Tolerances = {}
"""Every field equal to the bit; NaN equals NaN."""

OTHER_CPU_NAME = "default-for-other-cpu"
"""The name of `OTHER_CPU` on the command line."""

OTHER_CPU: Tolerances = {
    "position_filtered_m": 1e-14,
    "error_m": 1e-14,
    "error_rate_m_per_s": 1e-11,
    "error_acceleration_m_per_s2": 1e-8,
    "surface_m_per_s2": 1e-8,
    "command_v": 1e-9,
    "equivalent_v": 1e-9,
    "robust_v": 1e-9,
    "valve_v": 1e-9,
    # A command between two codes of the output may be rounded to either.
    "applied_v": 20.0 / 65536.0,
    "filters.position.pole": 1e-14,
    "filters.position.pair_rate": 1e-14,
    "filters.position.pair_level": 1e-14,
    "filters.rate.pole": 1e-11,
    "filters.rate.pair_rate": 1e-11,
    "filters.rate.pair_level": 1e-11,
    "filters.acceleration.pole": 1e-8,
    "filters.acceleration.pair_rate": 1e-8,
    "filters.acceleration.pair_level": 1e-8,
    "filters.error_m": 1e-14,
    "filters.error_rate_m_per_s": 1e-11,
    "law.absement_m_s": 1e-15,
    "safety.valve_v": 1e-9,
    "safety.model_pressure_pa": 1e-6,
}
"""About a thousand times the effect of one wrong last bit in each of these functions, in runs of
40 s under every law. For comparison: a hundredth of an encoder count is 3e-8 m.
`tests/replay/test_replay.py` checks the golden logs with such functions.
"""
