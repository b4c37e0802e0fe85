"""An order is a method, described once; and the lines of JSON in which orders travel.

    class RigSession(OrderTaker):
        @order(on_page=True)
        def goto(self, position_m: Annotated[float, Field(description="Position to hold")]) -> ...

The signature, with its limits, is what the socket checks; the decorator says who may give the
order, and how often. Each is a method of the protocol, JSON-RPC 2.0 with one document a line;
`daemon/client.py`, the Python session, the page and the verbs ask for the same
ones by their names. Nothing here opens a socket or knows a rig. Any bytes get an answer.
"""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, TypeVar, cast, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from pamctl.base.errors import ExitCode

LARGEST_REQUEST = 1 << 18
"""Bytes of a line. The largest sensible request is an experiment of a few thousand steps."""

PARSE_ERROR = -32700
INVALID_REQUEST = -32600
METHOD_NOT_FOUND = -32601
INVALID_PARAMS = -32602
INTERNAL_ERROR = -32603
REFUSED = 1
TOO_MANY = 2

_Body = TypeVar("_Body", bound=Callable[..., Any])


class Params(BaseModel):
    """Parameters of a method. An unknown one is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class RequestRefusedError(Exception):
    """A request that cannot be met in this state, or is wrong. It changed nothing."""

    exit_code = ExitCode.CHECK_FAILED


class RequestError(Exception):
    """A request that is not carried out, with the code of its answer."""

    def __init__(self, code: int, message: str, request_id: int | str | None = None) -> None:
        """`message` is for people."""
        super().__init__(message)
        self.code = code
        self.request_id = request_id


# --- what can be asked -----------------------------------------------------------------------


@dataclass(frozen=True)
class Order:
    """What is known of an order beside its signature."""

    body: Callable[..., Any]
    changes: bool
    at_once: bool
    on_page: bool
    said: str

    @property
    def name(self) -> str:
        """Its name, everywhere."""
        return self.body.__name__

    @cached_property
    def signature(self) -> inspect.Signature:
        """The parameters without the session itself, each with its limits and its help."""
        hints = get_type_hints(self.body, include_extras=True)
        own = list(inspect.signature(self.body).parameters.values())[1:]
        return inspect.Signature([one.replace(annotation=hints[one.name]) for one in own])

    @cached_property
    def params(self) -> type[Params]:
        """The model that checks the parameters."""
        fields: dict[str, Any] = {
            name: (one.annotation, ... if one.default is one.empty else one.default)
            for name, one in self.signature.parameters.items()
        }
        return create_model(self.name, __base__=Params, **fields)

    def carry_out(self, taker: OrderTaker, params: Params) -> Any:
        """Give the order to a session, with parameters that are checked."""
        given = {name: getattr(params, name) for name in type(params).model_fields}
        return getattr(taker, self.name)(**given)


class OrderTaker:
    """Whatever takes orders: its methods that are marked with `@order`."""

    def admit(self, order: Order) -> AbstractContextManager[None]:
        """Return what an order that changes something is carried out in; may raise its refusal."""
        return nullcontext()


def order(
    *, changes: bool = True, at_once: bool = False, on_page: bool = False, said: str = ""
) -> Callable[[_Body], _Body]:
    """Make an order of a method of an `OrderTaker`.

    Without `changes` it only tells, and waits for no other order. `at_once` goes before all
    others, and no rate limits it: the emergency stop. `on_page` lets the page of `watch --web
    --allow-control` give it; who may use the socket may give each. `said` is what its verb prints,
    filled with the answer.
    """

    def mark(body: _Body) -> _Body:
        told = Order(body, changes, at_once, on_page, said)

        @functools.wraps(body)
        def carry_out(taker: OrderTaker, *args: Any, **options: Any) -> Any:
            with taker.admit(told) if changes else nullcontext():
                return body(taker, *args, **options)

        carry_out.told = told  # type: ignore[attr-defined]
        return cast("_Body", carry_out)

    return mark


def list_orders(taker: type[OrderTaker]) -> dict[str, Order]:
    """Return every order of a kind of session by its name."""
    members = {
        name: member for kind in reversed(taker.__mro__) for name, member in vars(kind).items()
    }
    return {name: member.told for name, member in members.items() if hasattr(member, "told")}


# --- lines -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Request:
    """One valid request."""

    id: int | str | None
    order: Order
    params: Params


def parse_request(line: bytes, orders: Mapping[str, Order]) -> Request:
    """Parse one line; raise `RequestError`."""
    try:
        document = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise RequestError(PARSE_ERROR, f"not JSON: {error}") from None
    if not isinstance(document, dict) or document.get("jsonrpc") != "2.0":
        raise RequestError(INVALID_REQUEST, 'not a request: {"jsonrpc": "2.0", "method": ...}')
    request_id = document.get("id")
    if not isinstance(request_id, int | str | None) or isinstance(request_id, bool):
        raise RequestError(INVALID_REQUEST, "id must be a number or a text")
    name = document.get("method")
    asked = orders.get(name) if isinstance(name, str) else None
    if asked is None:
        known = ", ".join(orders)
        raise RequestError(METHOD_NOT_FOUND, f"no method {name!r}; there are {known}", request_id)
    params = check_params(asked.params, document.get("params", {}), request_id)
    return Request(request_id, asked, params)


def check_params(model: type[Params], given: object, request_id: int | str | None = None) -> Params:
    """Return checked parameters; raise `RequestError`."""
    if isinstance(given, dict):
        # One unknown name is told: to tell thousands would keep an emergency stop waiting.
        given = dict(islice(given.items(), len(model.model_fields) + 1))
    try:
        return model.model_validate(given)
    except ValidationError as error:
        places = [".".join(map(str, each["loc"])) for each in error.errors()]
        wrong = zip(places, error.errors(), strict=True)
        message = "; ".join(f"{at}: {e['msg']}" if at else str(e["msg"]) for at, e in wrong)
        raise RequestError(INVALID_PARAMS, message, request_id) from None


def encode_result(request_id: int | str | None, value: object) -> bytes:
    """Return the answer to a request that was carried out."""
    return _encode_line({"jsonrpc": "2.0", "id": request_id, "result": value})


def encode_failure(error: RequestError) -> bytes:
    """Return the answer to a request that was not carried out."""
    body = {"code": error.code, "message": str(error)}
    return _encode_line({"jsonrpc": "2.0", "id": error.request_id, "error": body})


def _encode_line(document: Mapping[str, object]) -> bytes:
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode() + b"\n"
