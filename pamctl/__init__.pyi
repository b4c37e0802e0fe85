# What `import pamctl` offers, for type checkers; `__init__.py` loads it.

from pamctl import aio as aio
from pamctl import gym as gym
from pamctl.session.daemon_rig import DaemonRig as DaemonRig
from pamctl.session.daemon_rig import connect as connect
from pamctl.session.experiment_form import ExperimentForm as ExperimentForm
from pamctl.session.model_search import find_gains as find_gains
from pamctl.session.model_search import find_missing_effects as find_missing_effects
from pamctl.session.motion_sequence import Gains as Gains
from pamctl.session.motion_sequence import Mark as Mark
from pamctl.session.motion_sequence import MotionSequence as MotionSequence
from pamctl.session.motion_sequence import Move as Move
from pamctl.session.motion_sequence import Pause as Pause
from pamctl.session.motion_sequence import Repeats as Repeats
from pamctl.session.motion_sequence import ValveMove as ValveMove
from pamctl.session.pamctl_error import PamctlError as PamctlError
from pamctl.session.reference_forms import Chirp as Chirp
from pamctl.session.reference_forms import ExcitationProgram as ExcitationProgram
from pamctl.session.reference_forms import Hold as Hold
from pamctl.session.reference_forms import Multisine as Multisine
from pamctl.session.reference_forms import Ramps as Ramps
from pamctl.session.reference_forms import Random as Random
from pamctl.session.reference_forms import RoundedSquare as RoundedSquare
from pamctl.session.reference_forms import Sine as Sine
from pamctl.session.reference_forms import Square as Square
from pamctl.session.reference_forms import Staircase as Staircase
from pamctl.session.reference_forms import Steps as Steps
from pamctl.session.reference_forms import Table as Table
from pamctl.session.reference_forms import Tracking as Tracking
from pamctl.session.reference_forms import Triangle as Triangle
from pamctl.session.reference_forms import ValveChirp as ValveChirp
from pamctl.session.reference_forms import ValveMultisine as ValveMultisine
from pamctl.session.reference_forms import ValveRamps as ValveRamps
from pamctl.session.reference_forms import ValveRandom as ValveRandom
from pamctl.session.reference_forms import ValveRoundedSquare as ValveRoundedSquare
from pamctl.session.reference_forms import ValveSine as ValveSine
from pamctl.session.reference_forms import ValveStaircase as ValveStaircase
from pamctl.session.reference_forms import ValveTable as ValveTable
from pamctl.session.reference_forms import ValveTriangle as ValveTriangle
from pamctl.session.run import Run as Run
from pamctl.session.run import RunMetrics as RunMetrics
from pamctl.session.simulated_rig import SimulatedRig as SimulatedRig
from pamctl.session.simulated_rig import simulate as simulate
from pamctl.session.steered_rig import SteeredRig as SteeredRig

__version__: str
