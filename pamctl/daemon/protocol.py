"""JSON-RPC 2.0, one document a line: requests and answers.

Nothing here opens a socket or knows a rig. Any bytes get an answer.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from pamctl.exit_codes import ExitCode

LARGEST_REQUEST = 1 << 18
"""Bytes of a line. The largest sensible request is an experiment of a few thousand steps."""

LONGEST_MOTION_S = 3600

PARSE_ERROR = -32700
INVALID_REQUEST = -32600
METHOD_NOT_FOUND = -32601
INVALID_PARAMS = -32602
INTERNAL_ERROR = -32603
REFUSED = 1
TOO_MANY = 2


class Params(BaseModel):
    """Parameters of a method. An unknown one is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class NoParams(Params):
    """A method without parameters."""


@dataclass(frozen=True)
class Method:
    """A method: its parameters, and what it calls."""

    params: type[Params]
    call: Callable[[Any], Any]
    changes: bool = True
    """It may block for a while; such methods are carried out one after the other."""


@dataclass(frozen=True)
class Request:
    """One valid request."""

    id: int | str | None
    name: str
    method: Method
    params: Params


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


def parse_request(line: bytes, methods: Mapping[str, Method]) -> Request:
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
    method = methods.get(name) if isinstance(name, str) else None
    if method is None:
        known = ", ".join(methods)
        raise RequestError(METHOD_NOT_FOUND, f"no method {name!r}; there are {known}", request_id)
    given = document.get("params", {})
    if isinstance(given, dict):
        # One unknown name is told: to tell thousands would keep an emergency stop waiting.
        given = dict(islice(given.items(), len(method.params.model_fields) + 1))
    try:
        params = method.params.model_validate(given)
    except ValidationError as error:
        messages = "; ".join(f"{_format_place(e['loc'])}{e['msg']}" for e in error.errors())
        raise RequestError(INVALID_PARAMS, messages, request_id) from None
    return Request(request_id, str(name), method, params)


def encode_result(request_id: int | str | None, value: object) -> bytes:
    """Return the answer to a request that was carried out."""
    return _encode_line({"jsonrpc": "2.0", "id": request_id, "result": value})


def encode_failure(error: RequestError) -> bytes:
    """Return the answer to a request that was not carried out."""
    body = {"code": error.code, "message": str(error)}
    return _encode_line({"jsonrpc": "2.0", "id": error.request_id, "error": body})


def _encode_line(document: Mapping[str, object]) -> bytes:
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def _format_place(location: tuple[int | str, ...]) -> str:
    return f"{'.'.join(map(str, location))}: " if location else ""
