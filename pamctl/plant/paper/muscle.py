"""Geometry of the braided muscle: length, volume and force area (Eq. 1 to 3)."""

from __future__ import annotations

from math import acos

from pamctl.plant.parameters import PaperParameters


def volume_m3(p: PaperParameters, position_m: float) -> float:
    """Return the volume V(x) of Eq. 2, with L = L_0 - x (Eq. 1)."""
    length = p.rest_length_m - position_m
    return length * (p.braid_length_m * p.braid_length_m - length * length) * p.volume_scale


def force_area_m2(p: PaperParameters, position_m: float) -> float:
    """Return A(x) = (3 L^2 - b^2) / (4 pi n^2): force per gauge pressure (Eq. 3), and dV/dx.

    The paper writes P. It is taken as gauge pressure: with absolute pressure the vented muscle
    would rest at 11.6 mm, and could not reach the set point of 6.4 mm.
    """
    length = p.rest_length_m - position_m
    return (3.0 * length * length - p.braid_length_m * p.braid_length_m) * p.volume_scale


def braid_lever_m(p: PaperParameters, position_m: float) -> float:
    """Return b theta cos(theta) of Eq. 5, where cos(theta) = L / b: L arccos(L / b)."""
    length = p.rest_length_m - position_m
    return length * acos(length / p.braid_length_m)
