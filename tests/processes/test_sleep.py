"""A PC that goes to sleep while a valve depends on it, and what keeps it awake."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.made_up import meta
from support.patience import BUSY_PC, PATIENCE_S, await_true
from support.processes.card_runs import AT_ONCE, OWN_SAFE_V, await_writes, log_of, own, start
from support.processes.children import PARTS, await_children, list_children
from support.processes.daemons import AO_STEP_V, NOT_HOMED, SAFE_V, daemon
from support.processes.rings import await_tick
from support.processes.sleeping import SleepingPc
from support.runs import MS

from hal.sim import peek_v
from pamctl.commissioning.bench import LimitError, open_workplace
from pamctl.commissioning.pc_checks import check_sleep
from pamctl.daemon.client import DaemonDeclinedError
from pamctl.processes import guardian, interrupts
from pamctl.processes.backends import ao_path
from pamctl.processes.guardian import Silence
from pamctl.realtime.clock import SleepWatch
from pamctl.recording.ring import LoopStage, Ring
from pamctl.settings.resolve import resolve

assert own  # a fixture

PAMCTL = str(Path(sys.executable).with_name("pamctl"))
DEVICE = f"sleep{os.getpid()}"
SETTINGS = (f"rig.sim.device={DEVICE}", NOT_HOMED, *BUSY_PC)
RUN = [PAMCTL, "run", "--json", "--quiet", "--log", "run.mcap", "--rt", "off"]
RUN += [part for setting in SETTINGS for part in ("--set", setting)]
SLEEP_S = 1.5
"""Longer than a loop may be silent on a busy PC."""
FAKE_INHIBIT = """#!/bin/sh
echo "$@" >> inhibited
{then}
echo released >> inhibited
"""


@pytest.fixture
def pc(tmp_path: Path) -> SleepingPc:
    return SleepingPc(tmp_path)


def start_run(folder: Path, environment: dict[str, str]) -> subprocess.Popen[str]:
    out = subprocess.PIPE
    return subprocess.Popen(RUN, cwd=folder, env=environment, stdout=out, stderr=out, text=True)


@pytest.mark.long
def test_a_card_is_at_its_safe_voltage_after_the_pc_slept(pc, own):
    timed = ("--set", "rig.nidaq.timing=hardware_timed", "--rt", "off")
    front = start(own, *AT_ONCE, *timed, **pc.environment)
    await_writes(own, front, 300)
    pc.sleep([front.pid, *await_children(front.pid, *PARTS).values()], SLEEP_S)
    _, said = front.communicate(timeout=PATIENCE_S)
    assert front.returncode == 4, said
    assert "safety trip: the PC slept for 1." in said
    assert own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)
    outcome = log_of(own).events[-1]
    assert outcome["event"] == "outcome"
    assert "the PC slept for 1." in outcome["reason"]


@pytest.mark.long
def test_a_daemon_forbids_sleep_while_it_holds_and_a_sleep_is_a_fault_to_acknowledge(
    pc, tmp_path, monkeypatch
):
    monkeypatch.setenv("PATH", put_inhibit(tmp_path, "exec cat")["PATH"])
    for name, value in pc.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(tmp_path)

    def count_holders() -> int:
        children = list_children(made.process.pid)
        return sum(Path(f"/proc/{child}/comm").read_text() == "cat\n" for child in children)

    with daemon(tmp_path, "asleep", NOT_HOMED) as made:
        assert count_holders() == 0
        made.ask("goto", position_m=8e-3, within_s=0.5)
        made.wait_until(lambda s: s["state"] == "ready" and not made.is_safe())
        assert count_holders() == 1
        pc.sleep([made.process.pid, *list_children(made.process.pid)], SLEEP_S)
        made.wait_safe()
        assert "the PC slept for 1." in made.wait_for("fault")["fault"]
        with pytest.raises(DaemonDeclinedError, match="acknowledge"):
            made.ask("goto", position_m=8e-3, within_s=0.5)
        made.wait_until(lambda s: not s["pids"])
        assert count_holders() == 0


@pytest.mark.parametrize(
    ("heartbeat_ms", "lead_ms", "period_ms"),
    [(20, 0, 1), (20, 40, 1), (100, 0, 10)],
    ids=["guardian", "front", "slow loop"],
)
def test_a_loop_that_goes_on_after_the_pc_slept_is_killed_once_it_had_its_time(
    tmp_path, monkeypatch, heartbeat_ms, lead_ms, period_ms
):
    """The loop trips within a heartbeat; the front leaves it to the guardian for longer."""
    now_ns, looked_ms = 10**9, []
    monkeypatch.setattr(SleepWatch, "slept_ns", lambda watch: 20_000_000_000)
    monkeypatch.setattr(guardian, "time", SimpleNamespace(monotonic_ns=lambda: now_ns))
    with Ring.create(tmp_path / "a.ring", meta(tmp_path / "a.mcap"), rows=256) as ring:
        silence = Silence(ring, 0, heartbeat_ms * MS, 0, lead_ms * MS)
        ring.loop_stage, fault = LoopStage.TICKING, ""
        while not fault:
            if not (now_ns - 10**9) % (period_ms * MS):
                ring.loop_beat_ns = now_ns
            fault = silence.find_fault()
            looked_ms.append((now_ns - 10**9) // MS)
            now_ns += MS
    assert fault == "the loop went on after the PC had slept for 20.0 s"
    assert 0 < looked_ms[-1] - (heartbeat_ms + lead_ms) <= period_ms


def test_a_pc_that_stands_still_after_its_sleep_does_not_cost_the_loop_its_time(
    tmp_path, monkeypatch
):
    """Neither loop nor guardian ran: at most two periods of looking count."""
    looked_ns = [10**9, 10**9 + 5 * MS, 10**9 + 3000 * MS, 10**9 + 3005 * MS]
    now = SimpleNamespace(ns=looked_ns[0])
    monkeypatch.setattr(SleepWatch, "slept_ns", lambda watch: 20_000_000_000)
    monkeypatch.setattr(guardian, "time", SimpleNamespace(monotonic_ns=lambda: now.ns))
    with Ring.create(tmp_path / "a.ring", meta(tmp_path / "a.mcap"), rows=256) as ring:
        silence = Silence(ring, 0, 100 * MS, 0)
        ring.loop_stage = LoopStage.TICKING
        for now.ns in looked_ns:
            ring.loop_beat_ns = now.ns
            assert not silence.find_fault()


def test_a_calibration_over_which_the_pc_slept_ends(monkeypatch):
    settings = resolve(overrides=[f"rig.sim.device={DEVICE}"])
    with open_workplace(settings) as bench:
        bench.step(1.0)
        monkeypatch.setattr(SleepWatch, "slept_ns", lambda watch: 20_000_000_000)
        with pytest.raises(LimitError, match=r"the PC slept for 20\.0 s"):
            bench.step(1.0)
    assert peek_v(ao_path(DEVICE)) == SAFE_V


def test_a_pc_that_did_not_sleep_did_not():
    watch = SleepWatch()
    assert max(watch.slept_ns() for _ in range(100_000)) < 1_000_000


# --- keeping it awake --------------------------------------------------------------------


def put_inhibit(folder: Path, then: str) -> dict[str, str]:
    """Put a `systemd-inhibit` first on the path; return the environment."""
    program = folder / "bin/systemd-inhibit"
    program.parent.mkdir()
    program.write_text(FAKE_INHIBIT.format(then=then))
    program.chmod(0o755)
    return {**os.environ, "PATH": f"{program.parent}:{os.environ['PATH']}"}


def test_a_run_forbids_sleep_until_it_ends_however_it_ends(tmp_path):
    environment = put_inhibit(tmp_path, "cat")
    with start_run(tmp_path, environment) as front:
        await_tick(front.pid, lambda tick: tick["tick"] > 10)
        (line,) = (tmp_path / "inhibited").read_text().splitlines()
        assert "--what=sleep" in line
        assert "--mode=block" in line
        front.kill()
        front.communicate(timeout=PATIENCE_S)
    await_true(lambda: (tmp_path / "inhibited").read_text().endswith("released\n"))


@pytest.fixture
def sleepy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A PC that can be put to sleep."""
    (tmp_path / "state").write_text("freeze mem disk\n")
    monkeypatch.setattr(interrupts, "_STATES", tmp_path / "state")
    monkeypatch.setattr(interrupts, "_TARGET", tmp_path / "sleep.target")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("then", "why"),
    [
        ("echo Access denied >&2; exit 1", "Access denied"),
        ("exit 1", "it failed"),
        (None, "No such"),
    ],
)
def test_one_line_says_that_nothing_keeps_the_pc_awake(sleepy, monkeypatch, then, why):
    path = str(sleepy / "none") if then is None else put_inhibit(sleepy, then)["PATH"]
    monkeypatch.setenv("PATH", path)
    with interrupts.keep_awake() as risk:
        assert why in risk
        assert "systemctl mask" in risk
        assert len(risk.splitlines()) == 1
    finding = check_sleep()
    assert (finding.level, finding.data["may_suspend"]) == ("warning", True)
    assert "systemctl mask" in finding.fix


def test_the_doctor_is_content_where_runs_forbid_sleep_or_the_pc_cannot(sleepy, monkeypatch):
    monkeypatch.setenv("PATH", put_inhibit(sleepy, "exec cat")["PATH"])
    assert check_sleep().message == "may be suspended, but not during a run"
    (sleepy / "sleep.target").symlink_to("/dev/null")
    assert check_sleep().message == "this PC cannot be suspended"
