"""Turn an order of the page into a method of the daemon; the daemon checks the values."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from pamctl.live.page_control.bench_forms import load_shipped_experiment
from pamctl.realtime.gain_ramp import DEFAULT_RAMP_S
from pamctl.settings.problems import ConfigError

_Key = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,60}$")]
_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]

_Ramp = Annotated[float, Field(strict=True, ge=0, le=60)]
_Operator = Annotated[str, Field(max_length=100)]


class OrderNotUnderstood(ValueError):
    """The order is not one of the page's. The message says what is."""


class _Order(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _Plain(_Order):
    do: Literal["estop", "stop", "ack", "disarm"]


class _Undo(_Order):
    do: Literal["undo"]
    ramp_s: _Ramp = DEFAULT_RAMP_S
    operator: _Operator = ""


class _Goto(_Order):
    do: Literal["goto"]
    position_mm: _Number


class _Set(_Order):
    do: Literal["set"]
    gains: Annotated[dict[_Key, _Number], Field(min_length=1, max_length=32)]
    ramp_s: _Ramp = DEFAULT_RAMP_S
    operator: _Operator = ""


class _Mark(_Order):
    do: Literal["mark"]
    text: Annotated[str, Field(min_length=1, max_length=1000)]


class _Start(_Order):
    do: Literal["start"]
    experiment: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,60}$")]
    numbers: Annotated[dict[_Key, _Number], Field(max_length=32)] = {}
    operator: _Operator = ""


_ORDERS: TypeAdapter[_Plain | _Undo | _Goto | _Set | _Mark | _Start] = TypeAdapter(
    Annotated[_Plain | _Undo | _Goto | _Set | _Mark | _Start, Field(discriminator="do")]
)


def translate_order(order: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return method and parameters. Raises `OrderNotUnderstood`."""
    try:
        asked = _ORDERS.validate_python(order)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the order"
        raise OrderNotUnderstood(f"{where}: {first['msg']}") from None
    match asked:
        case _Goto():
            return "goto", {"position_m": asked.position_mm * 1e-3}
        case _Set():
            changes = [f"controller.{name}={value!r}" for name, value in asked.gains.items()]
            return "set", {"changes": changes, "ramp_s": asked.ramp_s, "operator": asked.operator}
        case _Undo():
            return "undo", {"ramp_s": asked.ramp_s, "operator": asked.operator}
        case _Mark():
            return "mark", {"text": asked.text}
        case _Start():
            return "start", _fill_start(asked)
    return asked.do, {}


def _fill_start(asked: _Start) -> dict[str, Any]:
    changes = tuple(f"{name}={_spell(value)}" for name, value in asked.numbers.items())
    try:
        experiment = load_shipped_experiment(asked.experiment, changes)
    except ConfigError as error:
        raise OrderNotUnderstood(str(error)) from None
    return {"experiment": experiment, "name": asked.experiment, "operator": asked.operator}


def _spell(value: float) -> str:
    """Whole numbers without a point: some keys count."""
    return str(int(value)) if value.is_integer() else repr(value)
