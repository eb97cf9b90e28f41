"""The files of viser's client, unpacked so that a browser can cache them, and messages from any thread."""

import asyncio
import gzip
import re
from pathlib import Path

import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st
from viser._messages import RunJavascriptMessage
from viser.infra._async_message_buffer import AsyncMessageBuffer

from page.viser_client import ALPHABET, client_files, decode_base88, overlay, unpack_client

PAGE = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text(encoding="utf-8")


def encoded(data: bytes) -> str:
    """Encode as viser's build does."""
    text = ""
    for start in range(0, len(data), 4):
        group = data[start : start + 4]
        value, letters = int.from_bytes(group, "big"), ""
        for _ in range(len(group) + 1):
            value, digit = divmod(value, len(ALPHABET))
            letters = ALPHABET[digit] + letters
        text += letters
    return text


@given(st.binary(max_size=40))
def test_decoding_inverts_encoding(data: bytes) -> None:
    assert decode_base88(encoded(data)) == data


def test_client_of_the_installed_viser_is_unpacked() -> None:
    files = client_files()
    page = gzip.decompress(files["/"].body).decode()
    parts = set(re.findall(r'"(/[0-9a-f]+\.(?:css|js|wasm))"', page))
    contents = {path.rsplit(".")[1]: gzip.decompress(files[path].body) for path in parts}
    assert set(contents) == {"css", "js", "wasm"} and parts | {"/", "/index.html"} == set(files)
    assert len(page) < 10_000 + len(overlay()) < len(PAGE) and "data-p=" not in page
    assert 'id="zc-stop"' in page and "STOP" in page
    assert b"WebSocket" in contents["js"] and contents["wasm"].startswith(b"\0asm") and b"mantine" in contents["css"]
    assert all(files[path].immutable for path in parts) and not files["/"].immutable


def test_path_of_a_file_depends_on_its_content() -> None:
    changed = PAGE.replace('data-ss="', 'data-ss="0', 1)
    assert set(unpack_client(changed)) == set(client_files())  # the bar is in the page itself
    size = int(re.search(r'data-ss="(\d+)"', PAGE)[1])
    other = PAGE.replace(f'data-ss="{size}"', f'data-ss="{size - 1}"', 1)
    assert not {path for path in unpack_client(other) if path.endswith("css")} & set(client_files())


@pytest.mark.parametrize("page", ["<html><head><title>x</title></head></html>", PAGE.replace("data-p=", "data-q=")])
def test_page_with_an_unknown_packing_is_sent_unchanged(page: str) -> None:
    files = unpack_client(page)
    assert set(files) == {"/", "/index.html"}
    sent = gzip.decompress(files["/"].body).decode()
    assert re.sub(r"<head><script>.*?</script>", "<head>", sent, count=1, flags=re.DOTALL) == page


async def test_message_from_another_thread_wakes_waiting_tasks_on_their_loop() -> None:
    buffer = AsyncMessageBuffer(asyncio.get_running_loop(), persistent_messages=False)

    def push(number: int, woken: list[asyncio.Future[bool]]) -> list[bool]:
        """Return whether this thread woke the waiting tasks instead of the loop."""
        buffer.message_event.set()
        found = [future.done() for future in woken]
        buffer.push(RunJavascriptMessage(f"{number}"))
        return found

    for number in range(20):
        waiting = asyncio.create_task(buffer.message_event.wait())
        await asyncio.sleep(0)
        woken = list(buffer.message_event._waiters)
        assert await asyncio.to_thread(push, number, woken) == [False]
        await asyncio.wait_for(waiting, 10.0)
        buffer.message_event.clear()
