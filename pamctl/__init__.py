"""The real-time controller daemon of a pneumatic artificial muscle rig.

The rooms are layers: [tool.importlinter] in pyproject.toml lists them from top to bottom.
Read `realtime/tick.py` first: one step from a sample to a decision.

A program steers a rig by the names below; `pamctl manual use-from-python` shows how. They are
loaded when they are first used: no verb of the shell waits for them.

    with pamctl.simulate("paper") as rig:
        run = rig.run(pamctl.Sine(offset_mm=12, amplitude_mm=2, frequency_hz=1))
"""

__version__ = "0.1.0"

_HOMES = {
    name: home
    for home, names in {
        "daemon_rig": "DaemonRig connect",
        "experiment_form": "Chirp ExcitationProgram ExperimentForm Gains Hold Mark MotionSequence "
        "Move Multisine Pause Ramps Random Repeats RoundedSquare Sine Square Staircase Steps Table "
        "Tracking Triangle ValveChirp ValveMove ValveMultisine ValveRamps ValveRandom "
        "ValveRoundedSquare ValveSine ValveStaircase ValveTable ValveTriangle",
        "pamctl_error": "PamctlError",
        "run": "Run RunMetrics find_gains find_missing_effects",
        "simulated_rig": "SimulatedRig simulate",
        "steered_rig": "SteeredRig",
    }.items()
    for name in names.split()
}
"""The module of `pamctl.session` that each public name comes from; `__init__.pyi` has them too."""
__all__ = sorted((*_HOMES, "gym"))


def __getattr__(name: str) -> object:
    """Load a public name; other modules of the house need none of them."""
    from importlib import import_module

    if name == "aio":
        fix = "await asyncio.to_thread(rig.run, ...), and so each method of a rig"
        raise AttributeError(f"pamctl.aio is gone; {fix}")
    if name == "gym":
        return import_module(f"pamctl.session.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pamctl.session.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """List the public names, for completion."""
    return [*globals(), *__all__]
