"""A union of models of which a process builds only the one that a key of the data names.

A run has one law, one rig and one experiment. To build the models of all that there are took a
third of the start of every process.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable
from functools import cache, wraps
from threading import RLock
from typing import Annotated, Any, ParamSpec, TypeVar, Union

from pydantic import BaseModel, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, TypeAdapter
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import PydanticKnownError, SchemaValidator, core_schema

_P = ParamSpec("_P")
_R = TypeVar("_R")
_building = RLock()


def build_once(build: Callable[_P, _R]) -> Callable[_P, _R]:
    """Keep what a function builds; threads that ask for the same at once get the same."""
    built: Any = cache(build)

    @wraps(build)
    def find(*args: _P.args, **options: _P.kwargs) -> _R:
        with _building:
            found: _R = built(*args, **options)
            return found

    return find


class AnyModel:
    """Makes pydantic read data by one of several models, which are found when they are needed.

    The key `key` of the data names the model. Use it as the annotation of the models' base:
    `Annotated[Drawn, AnyModel("kind", list_kinds, find_model)]`.
    """

    def __init__(
        self,
        key: str,
        list_names: Callable[[], Iterable[str]],
        find: Callable[[str], type[BaseModel] | None],
    ) -> None:
        """`list_names` gives all values of the key, and `find` the model of one; None: no value."""
        self._key = key
        self._list_names = list_names
        self._find = find

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return handler.generate_schema(self._make_union())

    def _make_union(self) -> Any:
        found = (self._find(name) for name in self._list_names())
        models = tuple(model for model in found if model is not None)
        union: Any = Union[models]  # noqa: UP007  (made at run time)
        return Annotated[union, Field(discriminator=self._key)] if len(models) > 1 else union


class ChosenModel(AnyModel):
    """Reads the same data with the same errors, and builds the model that they name alone.

    JSON is read strictly. The JSON schema still has every model.
    """

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.with_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return handler(TypeAdapter(self._make_union()).core_schema)

    def _read(self, value: Any, info: core_schema.ValidationInfo) -> Any:
        key = self._key
        if not isinstance(value, dict | BaseModel):
            raise PydanticKnownError("model_attributes_type")
        name = value.get(key) if isinstance(value, dict) else getattr(value, key, None)
        if name is None and not (isinstance(value, dict) and key in value):
            raise PydanticKnownError("union_tag_not_found", {"discriminator": f"'{key}'"})
        chosen = self._find(name) if isinstance(name, str) else None
        if chosen is None:
            expected = ", ".join(f"'{one}'" for one in self._list_names())
            tag = {"discriminator": f"'{key}'", "tag": str(name), "expected_tags": expected}
            raise PydanticKnownError("union_tag_invalid", tag)
        validator = _make_validator(chosen, key, str(name))
        if info.mode == "json":  # a list is a tuple only in JSON
            return validator.validate_json(json.dumps(value), strict=True)
        return validator.validate_python(value)


@build_once
def _make_validator(model: type[BaseModel], key: str, name: str) -> SchemaValidator:
    """Return a union of one model: its errors begin with the name, as in any union."""
    model.model_rebuild()
    choices: dict[Hashable, core_schema.CoreSchema] = {name: model.__pydantic_core_schema__}
    return SchemaValidator(core_schema.tagged_union_schema(choices, key))
