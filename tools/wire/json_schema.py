"""JSON Schema (2020-12) of messages as they are on the wire: msgpack maps with these names.

JSON has no bytes. A msgpack bin is a string of the format "binary" here, as in OpenAPI: a validator has to accept bytes
where `type` is "string".
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue, models_json_schema
from pydantic_core import core_schema

from common.messages import SCHEMA_VERSION, Message
from common.transport.codec import encoding_of

DIALECT = "https://json-schema.org/draft/2020-12/schema"
BIN = "msgpack bin: raw bytes, no text"

Schema = dict[str, Any]


class WireSchema(GenerateJsonSchema):
    """Schemas of messages without a title for each field, and of messages that leave out defaults when sent."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        """Return False: the name of a field is its title."""
        return False

    def bytes_schema(self, schema: core_schema.BytesSchema) -> JsonSchemaValue:
        """Return the schema of a msgpack bin."""
        return {**super().bytes_schema(schema), "description": BIN}

    def function_plain_schema(self, schema: core_schema.PlainValidatorFunctionSchema) -> JsonSchemaValue:
        """Return the schema of any value: such fields hold any JSON value."""
        return {}

    def ser_schema(self, schema: Any) -> JsonSchemaValue | None:
        """Return None for functions: a serializer of a message leaves out defaults and adds nothing."""
        return None if schema["type"].startswith("function-") else super().ser_schema(schema)


def message_schema(model: type[Message]) -> Schema:
    """Return the complete schema of one message, with the nested messages in `$defs`."""
    model.model_rebuild()
    found = model.model_json_schema(mode="serialization", schema_generator=WireSchema)
    return {
        "$schema": DIALECT, "$id": f"urn:zencell:message:{model.__name__}:{SCHEMA_VERSION}",
        "x-zenoh-encoding": encoding_of(model), "x-max-bytes": model.max_bytes, **found,
    }


def shared_schemas(models: Iterable[type[Message]], place: str) -> tuple[dict[type[Message], Schema], Schema]:
    """Return a reference to the schema of each message, and all schemas by name; nested ones are shared.

    Args:
        models: the messages.
        place: where the schemas will be in a document, such as "#/components/schemas/".
    """
    known = list(models)
    for model in known:
        model.model_rebuild()
    references, found = models_json_schema(
        [(model, "serialization") for model in known], schema_generator=WireSchema, ref_template=f"{place}{{model}}")
    return {model: references[model, "serialization"] for model in known}, found.get("$defs", {})


def to_draft_07(value: Any) -> Any:
    """Return a schema for tools of draft 07, such as those of AsyncAPI: tuples as lists of items, no discriminators."""
    if isinstance(value, list):
        return [to_draft_07(item) for item in value]
    if not isinstance(value, dict):
        return value
    found = {name: to_draft_07(item) for name, item in value.items() if not _is_discriminator(name, item)}
    if isinstance(items := found.pop("prefixItems", None), list):
        found |= {"items": items, "additionalItems": False}
    return found


def _is_discriminator(name: str, item: Any) -> bool:
    return name == "discriminator" and isinstance(item, dict) and "propertyName" in item
