"""Retuning on the rig: better gains stay, all others are taken back, whatever ends it."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from support.patience import PATIENCE_S  # noqa: F401

import pamctl
from pamctl.cli.analyse.on_rig import OnRigTask, diagnose_on_rig, end_on_signals
from pamctl.on_rig import decide_on_rig, retune
from pamctl.on_rig.decide_on_rig import Investigation
from pamctl.on_rig.retune import retune_on_rig
from pamctl.on_rig.retune_search import MotionTrial
from pamctl.on_rig.rig_plan import Budget, make_rig_plan
from pamctl.plant.model import PlantSettings
from pamctl.session.simulated_rig import SimulatedRig, simulate
