"""A run from its settings to its figures; it needs Linux, but for `--fast`."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from hal.backend import find_backends
from hal.calibration import Zero, calibration
from pamctl.base.errors import Ending, ExitCode
from pamctl.base.texts import escape_name
from pamctl.control.experiment import plan_experiment
from pamctl.control.filters import warp_cutoff
from pamctl.control.law_registry import describe_law, law_of
from pamctl.kernel import build
from pamctl.log.run_meta import (
    NOTHING_SAID,
    Annotation,
    RunMeta,
    annotate_meta,
    bare_name,
    make_dated_path,
)
from pamctl.processes.backends import (
    SHARED_MEMORY,
    build_clock,
    build_rig,
    make_plant,
    new_ring_path,
    require_backend,
    require_open_files,
    secure_device,
)
from pamctl.processes.front import conduct_run
from pamctl.processes.interrupts import keep_awake
from pamctl.processes.loop_main import compose_loop, run_to_ending
from pamctl.processes.loop_supervisor import LoopSupervisor
from pamctl.realtime.clock import LoopSettings
from pamctl.realtime.many_ticks import find_many_ticks
from pamctl.realtime.orders import MARK_SLOT_BYTES
from pamctl.realtime.tick import first_state, keyframe_fields
from pamctl.realtime.tick_runner import TickRunner
from pamctl.recording.journal import RingJournal, wait_for_recorder
from pamctl.recording.recorded_run import LogReport, ThreadRecordedRun
from pamctl.recording.recorder import finish_orphans
from pamctl.recording.ring import Ring
from pamctl.report.progress_line import ProgressLine
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import RunSettings, settings_to_json, settings_to_yaml
from pamctl.signals import list_tick_fields


class FinishedRun(NamedTuple):
    """A run whose log is on disk."""

    code: int
    """Exit code of the command."""
    reason: str
    """Why the run ended with an error or by a signal; empty where it did not."""
    note: str
    """What the user must know of the log; empty where all is well."""
    document: dict[str, Any]
    """All figures, for `--json`."""
    text: str
    """The figures for people."""


def run_once(
    settings: RunSettings,
    names: dict[str, str],
    log: Path | None,
    *,
    quiet: bool,
    shows_progress: bool,
    said: Annotation = NOTHING_SAID,
) -> FinishedRun:
    """Run once; `names` are those of the configuration files, by section.

    What is `said` of the run goes into its log. Standard error gets a line of progress, and what is
    worth a note unless `quiet`.

    Raises `LogPathError`, and `RigError` or `RingError` where the device cannot be had.
    """
    # Wrong input is found before the valve is touched.
    require_open_files()
    require_backend(settings.rig)
    build_machine_code(settings, quiet=quiet)
    path = choose_log_path(log, names["controller"], names["experiment"])
    meta = annotate_meta(make_run_meta(settings, names, path), said)
    length_s = plan_experiment(settings.experiment).duration_s
    length_s = min(length_s, settings.duration_s or length_s)
    progress = ProgressLine(quiet=not shows_progress, length_s=length_s)
    if settings.fast:
        finish_orphans(SHARED_MEMORY, quiet=quiet)
        report = run_here(meta, settings, lambda tick: progress(tick, 0.0))
    else:
        report = _run_guarded(meta, settings, progress, quiet=quiet)
    progress.end_line()
    return _conclude_run(settings, names, path, report)


def _run_guarded(
    meta: RunMeta, settings: RunSettings, progress: ProgressLine, *, quiet: bool
) -> LogReport:
    """Run on the clock, in processes that watch each other."""
    pace = settings.rig.loop
    with secure_device(settings.rig) as rig:
        finish_orphans(SHARED_MEMORY, quiet=quiet)
        ring_of_run = Ring.create(new_ring_path(), meta, pace.ring_rows, slot_bytes=MARK_SLOT_BYTES)
        with ring_of_run as ring, keep_awake() as risk:
            if risk and not quiet:
                print(f"note: {risk}", file=sys.stderr, flush=True)
            try:
                return conduct_run(ring, rig, progress, settings.rt, pace)
            except BaseException:
                if not ring.head:
                    ring.unlink()
                raise


# --- without a clock: in this one process, as no valve depends on it ----------------------------


_TELL_EVERY_S = 0.05


class _Watch(LoopSupervisor):
    """Tells the progress, too."""

    def __init__(
        self, ring: Ring, pace: LoopSettings, tell: Callable[[Mapping[str, float]], None]
    ) -> None:
        super().__init__(ring, None, pace, patient=True)
        self._tell = tell
        self._told_s = 0.0

    def find_stop(self, tick: int) -> Ending | None:
        now_s = time.monotonic()
        if now_s - self._told_s >= _TELL_EVERY_S and (newest := self._ring.latest_tick()):
            self._told_s = now_s
            self._tell(newest)
        return super().find_stop(tick)


def run_here(
    meta: RunMeta,
    settings: RunSettings,
    tell: Callable[[Mapping[str, float]], None],
) -> LogReport:
    """Run a simulation to its end, with its log at `meta.log_path`; return how it ended.

    It is the same loop, with ring and recorder as everywhere; the recorder is a thread. If this
    process dies, the next start finishes the log. Where there are no rings in shared memory, the
    log ends with the last whole chunk.

    `tell` is called with the newest tick's columns from time to time. Takes over the signals that
    end a run: call it within `restore_signals`. Raise `RecorderError` if there can be no log.
    """
    rows = settings.rig.loop.ring_rows
    has_rings = sys.platform == "linux"
    ring = Ring.create(new_ring_path(), meta, rows) if has_rings else Ring.in_memory(meta, rows)
    wait_for_recorder(ring)
    run = ThreadRecordedRun("run", ring)
    watch = _Watch(ring, settings.rig.loop, tell)
    watch.listen()
    ending = run_to_ending(lambda: compose_loop(settings, RingJournal(ring), watch).run())
    report = run.finish(ending)
    ring.close()
    return report


# --- the log, and what is said of it ------------------------------------------------------------


def make_run_meta(settings: RunSettings, names: Mapping[str, str], path: Path) -> RunMeta:
    """Return the head of the log of a run that begins now."""
    clock, setup = build_clock(settings, may_spin=False), build_tick_setup(settings)
    mono_ns = 0 if settings.fast else time.monotonic_ns()
    cal = calibration(settings.rig.calibration)
    controller, nominal_dt_s = settings.controller, 1.0 / settings.rig.loop.rate_hz
    backend = settings.rig.backend
    run = {name: escape_name(said) for name, said in names.items()}
    run |= {"law": controller.law, "backend": backend}
    package = find_backends().packages.get(backend)
    if package is not None:  # whoever reads the log without it must know what is missing
        run["backend_package"] = package
    return RunMeta(
        log_path=str(path),
        start_wall_ns=mono_ns + clock.wall_offset_ns(),
        start_mono_ns=mono_ns,
        config=json.loads(settings_to_json(settings)),
        attachments={
            "config.yaml": settings_to_yaml(settings),
            "calibration.json": json.dumps(cal._asdict()),
            "filters.json": json.dumps(
                {
                    "kind": "Butterworth, third order, trapezoidal, on the measured dt",
                    "lpf1_hz": controller.lpf1_hz,
                    "lpf2_hz": controller.lpf2_hz,
                    "lpf1_tan_at_nominal_dt": warp_cutoff(controller.lpf1_hz, nominal_dt_s),
                    "lpf2_tan_at_nominal_dt": warp_cutoff(controller.lpf2_hz, nominal_dt_s),
                }
            ),
        },
        metadata={"run": run, "law": describe_law(law_of(controller))},
        keyframe_fields=keyframe_fields(first_state(setup, Zero(0.0, 0.0))),
        tick_fields=list_tick_fields(setup.compensation is not None),
    )


def _conclude_run(
    settings: RunSettings,
    names: dict[str, str],
    path: Path,
    report: LogReport,
) -> FinishedRun:
    ending = report.ending
    document: dict[str, Any] = {
        "exit_code": int(ending.code),
        "reason": ending.reason,
        "log": str(path),
        "log_is_whole": report.log_is_whole,
        **names,
        "law": settings.controller.law,
        "backend": settings.rig.backend,
    }
    lines = []
    if path.exists():
        figures, text = _compute_figures(settings, path, ending)
        document |= figures
        lines = [text] if text else []
        if ending.code and figures.get("ticks") == 0:
            path.unlink()  # nothing happened: leave nothing behind
        else:
            lines.append(f"log: {path}")
    code = int(ending.code or (ExitCode.OK if report.log_is_whole else ExitCode.CHECK_FAILED))
    reason, note = ending.reason if ending.code else "", report.note
    if reason and note.startswith(reason):  # the recorder says the same, and of which log
        reason, note = f"{note}; make room, or give another place with --log", ""
    return FinishedRun(code, reason, note, document, "\n".join(lines))


def _compute_figures(
    settings: RunSettings, path: Path, ending: Ending
) -> tuple[dict[str, Any], str]:
    # Slow imports: a run does not wait for them before its first tick.
    from pamctl.log.reader import LogError, read_some
    from pamctl.log.schema import TICK_TOPIC
    from pamctl.report.report import format_terminal
    from pamctl.report.reported_run import FIGURE_FIELDS, report_run, summarise_run

    try:
        log = read_some(path, FIGURE_FIELDS, TICK_TOPIC)
    except LogError as error:
        return {"log_error": str(error)}, f"error: {error}"
    if not len(log):
        return {"ticks": 0}, ""
    figures = summarise_run(log)
    text = format_terminal(report_run(figures, settings.controller.law))
    if ending.code in (ExitCode.SAFETY_TRIP, ExitCode.OVERRUNS):
        from pamctl.base.new_file import NewFileError
        from pamctl.log.export import dump_last_seconds
        from pamctl.log.reader import read_paged

        try:
            figures["flight_record"] = str(dump_last_seconds(read_paged(path)))
            text += f"\nlast two seconds: {figures['flight_record']}"
        except NewFileError as error:
            text += f"\nno table of the last two seconds: {error}"
    return figures, text


def build_machine_code(settings: RunSettings, *, quiet: bool = False) -> None:
    """Build what the loop of a run will load, where it is missing; say so unless `quiet`.

    Raise `NotInC` for a law that is no kernel.
    """
    if not quiet:
        said = "note: building machine code, once: some seconds"
        build.progress.begin = partial(print, said, file=sys.stderr, flush=True)
    setup = build_tick_setup(settings)
    TickRunner(setup)
    make_plant(settings)
    if settings.fast:
        parts = build_rig(settings, build_clock(settings, may_spin=False))
        find_many_ticks(setup, parts.rig, parts.clock)


_LOG_DIRECTORY = Path("logs")


class LogPathError(Exception):
    """The log cannot be written at the given path."""

    exit_code = ExitCode.USAGE


def choose_log_path(asked: Path | None, controller: str, experiment: str) -> Path:
    """Return a path that can be created and does not exist; raise `LogPathError`."""
    path = (
        _propose_log_path(f"{bare_name(controller)}-{bare_name(experiment)}")
        if asked is None
        else asked
    )
    try:
        if path.exists():
            raise LogPathError(f"--log {path}: exists, and a log is never overwritten")
        if not path.parent.is_dir():
            raise LogPathError(_explain_no_directory(path, by_default=asked is None))
        path.touch(exist_ok=False)
        path.unlink()
    except OSError as error:
        hint = "; give another place with --log" if asked is None else ""
        raise LogPathError(f"--log {path}: cannot be created: {error.strerror}{hint}") from None
    return path


def _propose_log_path(what: str) -> Path:
    with suppress(OSError):
        _LOG_DIRECTORY.mkdir(exist_ok=True)
    return make_dated_path(_LOG_DIRECTORY, what)


def _explain_no_directory(path: Path, *, by_default: bool) -> str:
    if by_default:
        return f"{path.parent}/ cannot be created here; give another place with --log"
    return f"--log {path}: there is no directory {path.parent}"
