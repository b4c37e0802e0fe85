"""The real-time controller daemon of a pneumatic artificial muscle rig.

The rooms are layers: [tool.importlinter] in pyproject.toml lists them from top to bottom.
Read `realtime/tick.py` first: one step from a sample to a decision.

A program steers a rig by the names below; `pamctl manual use-from-python` shows how. They are
loaded when they are first used: no verb of the shell waits for them.

    with pamctl.simulate("paper") as rig:
        run = rig.run(pamctl.Sine(offset_mm=12, amplitude_mm=2, frequency_hz=1))
"""

__version__ = "0.1.0"

__all__ = [
    "Chirp",
    "DaemonRig",
    "ExcitationProgram",
    "ExperimentForm",
    "Gains",
    "Hold",
    "Mark",
    "MotionSequence",
    "Move",
    "Multisine",
    "PamctlError",
    "Pause",
    "Ramps",
    "Random",
    "Repeats",
    "RoundedSquare",
    "Run",
    "RunMetrics",
    "SimulatedRig",
    "Sine",
    "Square",
    "Staircase",
    "SteeredRig",
    "Steps",
    "Table",
    "Tracking",
    "Triangle",
    "ValveChirp",
    "ValveMove",
    "ValveMultisine",
    "ValveRamps",
    "ValveRandom",
    "ValveRoundedSquare",
    "ValveSine",
    "ValveStaircase",
    "ValveTable",
    "ValveTriangle",
    "aio",
    "connect",
    "find_gains",
    "find_missing_effects",
    "gym",
    "simulate",
]

_MODULES = ("aio", "gym")
_HOMES = {
    "Chirp": "muscle_motions",
    "DaemonRig": "daemon_rig",
    "ExcitationProgram": "valve_commands",
    "ExperimentForm": "experiment_form",
    "Gains": "motion_sequence",
    "Hold": "muscle_motions",
    "Mark": "motion_sequence",
    "MotionSequence": "motion_sequence",
    "Move": "motion_sequence",
    "Multisine": "muscle_motions",
    "PamctlError": "pamctl_error",
    "Pause": "motion_sequence",
    "Ramps": "muscle_motions",
    "Random": "muscle_motions",
    "Repeats": "motion_sequence",
    "RoundedSquare": "muscle_motions",
    "Run": "run",
    "RunMetrics": "run",
    "SimulatedRig": "simulated_rig",
    "Sine": "muscle_motions",
    "Square": "valve_commands",
    "Staircase": "muscle_motions",
    "SteeredRig": "steered_rig",
    "Steps": "valve_commands",
    "Table": "muscle_motions",
    "Tracking": "muscle_motions",
    "Triangle": "muscle_motions",
    "ValveChirp": "valve_commands",
    "ValveMove": "motion_sequence",
    "ValveMultisine": "valve_commands",
    "ValveRamps": "valve_commands",
    "ValveRandom": "valve_commands",
    "ValveRoundedSquare": "valve_commands",
    "ValveSine": "valve_commands",
    "ValveStaircase": "valve_commands",
    "ValveTable": "valve_commands",
    "ValveTriangle": "valve_commands",
    "connect": "daemon_rig",
    "find_gains": "model_search",
    "find_missing_effects": "model_search",
    "simulate": "simulated_rig",
}


def __getattr__(name: str) -> object:
    """Load a public name; other modules of the house need none of them."""
    from importlib import import_module

    if name in _MODULES:
        return import_module(f"pamctl.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pamctl.session.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """List the public names, for completion."""
    return [*globals(), *__all__]
