"""Which gains each law has, and between which bounds they are sought.

All on a logarithmic scale: a gain that is twice as large is as different as one half as
large. Only lambda^q enters the sliding laws, so q stays where the paper has it.

The sliding laws are sought by what their gains do at rest, not by K_p and phi. With the reaching
law saturated the command is

    u = -K_p / g (l^3 + 3 eta l^2) e - ...,    l = lambda^q, g = 1 in Eq. 17, g-hat in Eq. 18,

so that gains which differ by little in what they do lie decades apart in K_p when lambda or eta
differ. Its place takes the factor of e, in V/mm, which is what K_P is to a PID: all three
laws are sought between the same bounds of it. The place of phi takes the error, in mm, at which
the term 3 l^2 e of s alone reaches it.

SMC has one gain more, the mass in f-hat and g-hat. At rest its law amounts to

    u = -K_p / g ((3 l - c / M) e'' + (3 l^2 - d / M) e' + l^3 e),    c = 570 N s/m, d = 1.6e4 N/m,

because f-hat cancels the muscle's own damping and stiffness. With the 0.05 kg of Table I c / M is
1e4 1/s: any lambda below 3800 1/s feeds the acceleration back with the wrong sign, any below
320 1/s the velocity too, and a late valve makes that an oscillation. The moved mass acts within
0.1 ms, so that no rig will ever tell it: to the law it is a gain, and it is sought as one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from pamctl.control.law import ControllerSettings
from pamctl.control.smc import linearise_model
from pamctl.plant.model import PlantSettings, plant_parameters

Floats = NDArray[np.float64]
Numbers = dict[str, float]

_CONTROLLER: TypeAdapter[Any] = TypeAdapter(ControllerSettings)
_DIGITS = 4


class GainAxis(NamedTuple):
    """One of the numbers that are sought."""

    name: str
    low: float
    high: float
    usual: float
    """Where a search begins unless told."""


def _copy_numbers(numbers: Numbers) -> dict[str, Any]:
    return dict(numbers)


def _read_numbers(gains: dict[str, Any]) -> Numbers:
    return {name: float(value) for name, value in gains.items() if isinstance(value, int | float)}


def _round_gains(gains: dict[str, Any]) -> dict[str, Any]:
    return {
        name: _round_gains(value) if isinstance(value, dict) else float(f"{value:.{_DIGITS}g}")
        for name, value in gains.items()
    }


class Space(NamedTuple):
    """The gains of a law in mm, and what stays fixed."""

    fixed: dict[str, Any]
    axes: tuple[GainAxis, ...]
    gains_of: Callable[[Numbers], dict[str, Any]] = _copy_numbers
    """What is sought, as a controller file has it."""
    sought_of: Callable[[dict[str, Any]], Numbers] = _read_numbers
    """The way back."""

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Bounds of the search, in powers of ten."""
        return [(float(np.log10(a.low)), float(np.log10(a.high))) for a in self.axes]

    @property
    def usual(self) -> Floats:
        """The point where a search begins unless told."""
        return np.log10([a.usual for a in self.axes])

    def gains(self, point: Floats) -> dict[str, Any]:
        """Return a point (powers of ten, shape (axes,)) as a controller file has it.

        Rounded as the file will be: what is scored is what is written.
        """
        values = (10.0 ** np.asarray(point, dtype=np.float64)).tolist()
        sought = dict(zip((a.name for a in self.axes), values, strict=True))
        return {**self.fixed, **_round_gains(self.gains_of(sought))}

    def controller(self, point: Floats) -> Any:
        """Return a point as validated settings."""
        return _CONTROLLER.validate_python(self.gains(point))

    def point(self, gains: dict[str, Any]) -> Floats:
        """Return a controller file's gains as a point, moved inside the bounds."""
        sought = self.sought_of(gains)
        found = [np.log10(max(sought[a.name], a.low)) for a in self.axes]
        low, high = np.array(self.bounds).T
        inside: Floats = np.clip(found, low, high)
        return inside


def _stiffness_per_s3(numbers: Numbers, q: float) -> float:
    """Factor of e in the sliding laws, over K_p / g."""
    pole: float = numbers["lambda_per_s"] ** q
    return pole**2 * (pole + 3.0 * numbers["eta"])


def _phi_per_mm(numbers: Numbers, q: float) -> float:
    pole: float = numbers["lambda_per_s"] ** q
    return 3.0 * pole**2


def _sliding_gains(sought: Numbers, q: float, kp_name: str, gain_mm_per_s3_v: float) -> Numbers:
    kp = sought["stiffness_v_per_mm"] * gain_mm_per_s3_v / _stiffness_per_s3(sought, q)
    return {
        "lambda_per_s": sought["lambda_per_s"],
        kp_name: kp,
        "eta": sought["eta"],
        "phi": sought["boundary_mm"] * _phi_per_mm(sought, q),
        "lpf1_hz": sought["lpf1_hz"],
        "lpf2_hz": sought["lpf2_hz"],
    }


def _sliding_numbers(gains: Numbers, q: float, kp_name: str, gain_mm_per_s3_v: float) -> Numbers:
    return {
        **gains,
        "stiffness_v_per_mm": gains[kp_name] * _stiffness_per_s3(gains, q) / gain_mm_per_s3_v,
        "boundary_mm": gains["phi"] / _phi_per_mm(gains, q),
    }


# --- qSMC ------------------------------------------------------------------------------------

_QSMC = (1.75, "kp_v_s3_per_length", 1.0)


def _qsmc_gains(sought: Numbers) -> dict[str, Any]:
    return dict(_sliding_gains(sought, *_QSMC))


def _qsmc_numbers(gains: dict[str, Any]) -> Numbers:
    return _sliding_numbers(_read_numbers(gains), *_QSMC)


# --- SMC -------------------------------------------------------------------------------------


def _smc_constants(mass_kg: float) -> tuple[float, str, float]:
    """Return q, K_p's name, and g-hat with this mass: resting, half filled, at mid-stroke."""
    p = plant_parameters(PlantSettings()).paper._replace(mass_kg=mass_kg)
    half_filled_pa = 0.5 * (p.tank_pressure_pa + p.atmospheric_pressure_pa)
    return 1.0, "kp", 1e3 * linearise_model(p, 11.8e-3, 0.0, 0.0, half_filled_pa).fill_gain


def _smc_gains(sought: Numbers) -> dict[str, Any]:
    mass_kg = sought["model_mass_kg"]
    model = {"parameters": {"mass_kg": mass_kg}}
    return {**_sliding_gains(sought, *_smc_constants(mass_kg)), "model": model}


def _smc_numbers(gains: dict[str, Any]) -> Numbers:
    parameters = gains["model"].get("parameters", {})
    mass_kg = float(parameters.get("mass_kg", PlantSettings().parameters.mass_kg))
    return {
        **_sliding_numbers(_read_numbers(gains), *_smc_constants(mass_kg)),
        "model_mass_kg": mass_kg,
    }


# --- between which bounds --------------------------------------------------------------------

_SLIDING: dict[str, Any] = {"length_unit": "mm", "reaching_law": "eta_abs_s"}
_STIFFNESS = (0.3, 100.0)
_SHARED = (GainAxis("eta", 1e-3, 1e3, 2.0), GainAxis("boundary_mm", 1e-5, 10.0, 1e-4))
_LPF1 = (40.0, 440.0)
_LPF2 = (10.0, 440.0)

SPACES: dict[str, Space] = {
    "qsmc": Space(
        {"law": "qsmc", **_SLIDING, "q": 1.75},
        (
            GainAxis("lambda_per_s", 5.0, 80.0, 30.0),
            GainAxis("stiffness_v_per_mm", *_STIFFNESS, 25.0),
            *_SHARED,
            GainAxis("lpf1_hz", *_LPF1, 200.0),
            GainAxis("lpf2_hz", *_LPF2, 430.0),
        ),
        _qsmc_gains,
        _qsmc_numbers,
    ),
    "smc": Space(
        {"law": "smc", **_SLIDING, "q": 1.0},
        (
            GainAxis("lambda_per_s", 20.0, 3000.0, 250.0),
            GainAxis("stiffness_v_per_mm", *_STIFFNESS, 15.0),
            GainAxis("model_mass_kg", 0.05, 20.0, 1.5),
            *_SHARED,
            GainAxis("lpf1_hz", *_LPF1, 300.0),
            GainAxis("lpf2_hz", *_LPF2, 430.0),
        ),
        _smc_gains,
        _smc_numbers,
    ),
    "pid": Space(
        {"law": "pid", "length_unit": "mm"},
        (
            GainAxis("kp_v_per_length", *_STIFFNESS, 17.0),
            GainAxis("ki_v_per_length_s", 1e-3, 1e3, 20.0),
            GainAxis("kd_v_s_per_length", 1e-4, 2.0, 0.18),
            GainAxis("lpf1_hz", *_LPF1, 430.0),
            GainAxis("lpf2_hz", *_LPF2, 430.0),
        ),
    ),
}
