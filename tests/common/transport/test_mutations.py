"""Changed payloads of all messages: each gives a message or one clear line. `make fuzz` tries many more."""

import contextlib

from common.errors import DecodeError
from common.transport.codec import decode, decode_attachment, decode_error, encode
from tests.mutations import Mutations, models, real

PAYLOADS = 150  # of each message, and of each side


def test_mutations_start_from_valid_messages() -> None:
    for model in models():
        for value in real(model):
            assert model.model_validate(value).model_dump() == value


def test_changed_payloads_give_messages_or_one_clear_line() -> None:
    mutations = Mutations(seed=1)
    refused = read = 0
    for model in models():
        for _ in range(PAYLOADS):
            payload = mutations.payload(model)
            try:
                message = decode(model, payload)
            except DecodeError as error:
                refused += 1
                assert "\n" not in str(error) and len(str(error)) < 1000
            else:
                read += 1
                assert decode(model, encode(message)) == message
    assert refused > read > 100


def test_changed_attachments_and_error_replies_are_refused_or_read() -> None:
    mutations = Mutations(seed=2)
    for model in models():
        for _ in range(PAYLOADS // 10):
            payload = mutations.payload(model)
            decode_error(payload)
            with contextlib.suppress(DecodeError):
                decode_attachment(payload)
