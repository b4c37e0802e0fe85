"""The methods of the control socket, each with its parameters. SI throughout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from pamctl.daemon.protocol import (
    LONGEST_MOTION_S,
    Method,
    NoParams,
    Params,
    RequestRefusedError,
)
from pamctl.daemon.service import Service
from pamctl.log.annotation import (
    LONGEST_NAME,
    LONGEST_NOTE,
    MOST_TAGS,
    SWEEP,
    AnnotationError,
    make_annotation,
)
from pamctl.plain_text import LONGEST_REMARK, clean_text
from pamctl.realtime.gain_ramp import DEFAULT_RAMP_S

Ramp = Annotated[float, Field(ge=0, le=60, description="s")]
Operator = Annotated[str, AfterValidator(clean_text), Field(max_length=LONGEST_NAME)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,60}$")]


_MOST_SWEPT = 8


def _refuse_many(swept: Any) -> Any:
    """Count first: to check thousands of entries would keep an emergency stop waiting."""
    if isinstance(swept, dict) and len(swept) > _MOST_SWEPT:
        raise ValueError(f"more than {_MOST_SWEPT} entries")
    return swept


class StartParams(Params):
    """An experiment, as its file holds it."""

    experiment: dict[str, Any]
    name: Name
    duration_s: Annotated[float | None, Field(gt=0)] = None
    note: Annotated[str, Field(max_length=LONGEST_NOTE)] = ""
    operator: Annotated[str, Field(max_length=LONGEST_NAME)] = ""
    sample: Annotated[str, Field(max_length=LONGEST_NAME)] = ""
    tags: Annotated[list[str], Field(default_factory=list, max_length=MOST_TAGS)]
    sweep: Annotated[dict[str, str] | None, BeforeValidator(_refuse_many)] = None


class GotoParams(Params):
    """A position to hold."""

    position_m: float
    within_s: Annotated[float | None, Field(gt=0, le=LONGEST_MOTION_S)] = None


class ChangeParams(Params):
    """Keys of the controller: `controller.lambda_per_s=12`."""

    changes: Annotated[list[str], Field(min_length=1, max_length=32)]
    ramp_s: Ramp = DEFAULT_RAMP_S
    operator: Operator = ""


class UndoParams(Params):
    """How the last change of gains is taken back, and by whom."""

    ramp_s: Ramp = DEFAULT_RAMP_S
    operator: Operator = ""


class LoadParams(Params):
    """A controller, as its file holds it."""

    controller: dict[str, Any]
    name: Name
    ramp_s: Ramp = DEFAULT_RAMP_S


class MarkParams(Params):
    """A remark for the log."""

    text: Annotated[str, AfterValidator(clean_text), Field(min_length=1, max_length=LONGEST_REMARK)]


class RecentParams(Params):
    """Ticks that are newer than one."""

    after_tick: int = -1
    every: Annotated[int, Field(ge=1, le=100_000)] = 10
    fields: Annotated[list[str] | None, Field(max_length=100)] = None


def _start(service: Service, asked: StartParams) -> Path:
    try:
        said = make_annotation(asked.tags, asked.note, asked.operator, asked.sample)
    except AnnotationError as error:
        raise RequestRefusedError(str(error)) from error
    records = {} if asked.sweep is None else {SWEEP: asked.sweep}
    return service.start(asked.experiment, asked.name, asked.duration_s, said, records)


def methods_of(service: Service) -> dict[str, Method]:
    """Return every method of a service by its name."""
    return {
        "status": Method(NoParams, lambda _: service.status(), changes=False),
        "settings": Method(NoParams, lambda _: service.settings(), changes=False),
        "recent": Method(
            RecentParams, lambda p: service.recent(p.after_tick, p.every, p.fields), changes=False
        ),
        "estop": Method(NoParams, lambda _: service.estop(), changes=False),
        "start": Method(StartParams, lambda p: {"log": str(_start(service, p))}),
        "stop": Method(NoParams, lambda _: service.stop()),
        "disarm": Method(NoParams, lambda _: service.disarm()),
        "ack": Method(NoParams, lambda _: {"fault": service.ack()}),
        "set": Method(ChangeParams, lambda p: service.set_gains(p.changes, p.ramp_s, p.operator)),
        "undo": Method(UndoParams, lambda p: service.undo_gains(p.ramp_s, p.operator)),
        "load": Method(LoadParams, lambda p: service.load_gains(p.controller, p.name, p.ramp_s)),
        "goto": Method(GotoParams, lambda p: {"log": str(service.goto(p.position_m, p.within_s))}),
        "mark": Method(MarkParams, lambda p: service.mark(p.text)),
    }
