"""Stub."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Explanation:
    name: str
    plant: object = None


def list_explanations(found):
    return ()
