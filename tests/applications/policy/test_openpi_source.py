"""A server of openpi is a policy; one that stalls, dies or sends nonsense is one line and never blocks."""

import asyncio
import re
from contextlib import suppress

import msgpack
import numpy as np
import pytest

from applications.policy.decoding import decode
from applications.policy.interface import PolicyFailed
from applications.policy.sources import openpi, source
from applications.policy.sources.msgpack_numpy import MAX_BYTES, WrongMessage, pack, unpack
from applications.policy.sources.settings import SourceConfig
from common.errors import ConfigError
from tests.applications.policy.openpi_server import Server, packed, running, unpacked
from tests.applications.policy.panda import READY, observation, panda, panda_cell

SEEN = observation("top")
ACTIONS = np.tile([*READY, 0.04], (10, 1))
# Of openpi_client.msgpack_numpy 0.1.2: packb({"actions": np.arange(6, dtype=np.float32).reshape(2, 3)})
RECORDED = bytes.fromhex(
    "81a7616374696f6e7384c40b5f5f6e6461727261795f5fc3c40464617461c418000000000000803f00000040000040400000804000"
    "00a040c4056474797065a33c6634c40573686170659202" "03")


def made(address, cameras=("top",), timeout=30.0, actions=None, **keys):
    config = SourceConfig(openpi=address, timeout=timeout, actions=actions or {}, keys=keys)
    return source(config, panda_cell(*cameras))


async def failure(policy):
    with pytest.raises(PolicyFailed) as raised:
        await policy.infer(SEEN)
    text = str(raised.value)
    assert "\n" not in text and len(text) < 400
    return text


# --- the protocol


def test_bytes_are_those_of_the_client_of_openpi():
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    assert pack({"actions": array}) == RECORDED
    np.testing.assert_array_equal(unpack(RECORDED)["actions"], array)


@pytest.mark.parametrize("dtype", ["uint8", "int64", "float16", ">f4", "float64", "bool"])
def test_arrays_of_numbers_are_read_back(dtype):
    array = np.arange(24).reshape(2, 3, 4).astype(dtype)
    found = unpack(pack({"a": array, "b": [array[0], np.float32(2.5)], "c": "text"}))
    np.testing.assert_array_equal(found["a"], array)
    assert found["a"].dtype == array.dtype and found["b"][1] == 2.5 and found["c"] == "text"


async def test_observation_and_actions_travel():
    async with running(Server(lambda seen: {"actions": ACTIONS, "server_timing": {"infer_ms": 1.0}})) as server:
        policy = made(server.address)
        for _ in range(2):
            rows, widths = decode(await policy.infer(SEEN), SEEN, panda())
        await policy.close()
    np.testing.assert_allclose(rows, ACTIONS[:, :7])
    np.testing.assert_allclose(widths, 0.04)
    seen = server.seen[0]
    assert sorted(seen) == ["observation/image", "observation/state", "prompt"] and seen["prompt"] == "pick the ball"
    np.testing.assert_array_equal(seen["observation/image"], SEEN.images["top"])
    np.testing.assert_allclose(seen["observation/state"], [*READY, 0.06], rtol=1e-6)
    assert len(server.connections) == 1 and server.headers == [""]


async def test_keys_of_droid_and_velocities():
    velocities = np.tile([0.1, 0, 0, 0, 0, 0, -0.2, 1.0], (5, 1)).astype(np.float32)
    async with running(Server(lambda seen: {"actions": velocities})) as server:
        policy = made(
            server.address, ("top", "wrist"), images={"top": "observation/exterior_image_1_left", "wrist": "wrist"},
            state="", joints="observation/joint_position", gripper="observation/gripper_position", api_key="secret",
            actions={"kind": "joint_steps", "rate": 15, "cumulative": True, "scale": [1 / 15], "gripper_open": 0,
                     "gripper_closed": 1})
        seen = observation("top", "wrist", gripper=0.08)
        rows, widths = decode(await policy.infer(seen), seen, panda())
        await policy.close()
    np.testing.assert_allclose(rows[-1] - READY, np.array([0.1, 0, 0, 0, 0, 0, -0.2]) / 3, atol=1e-6)
    np.testing.assert_allclose(widths, 0.0)
    assert sorted(server.seen[0]) == ["observation/exterior_image_1_left", "observation/gripper_position",
                                      "observation/joint_position", "prompt", "wrist"]
    assert server.seen[0]["observation/gripper_position"].tolist() == [0.0] and server.headers == ["Api-Key secret"]


async def test_state_of_libero():
    async with running(Server(lambda seen: {"actions": np.zeros((5, 7))})) as server:
        policy = made(server.address, state_parts=["tcp_vector", "gripper"], actions={
            "kind": "tcp_steps", "cumulative": True, "scale": [0.05] * 3 + [0.5] * 3, "gripper_open": -1,
            "gripper_closed": 1})
        rows, widths = decode(await policy.infer(SEEN), SEEN, panda())
        await policy.close()
    np.testing.assert_allclose(rows, np.tile(READY, (5, 1)), atol=1e-4)
    np.testing.assert_allclose(widths, 0.04)
    assert server.seen[0]["observation/state"].shape == (7,)


# --- servers that fail


async def stall(seen):
    await asyncio.sleep(1000)


def crash(seen):
    raise ValueError("the checkpoint is broken")


BOMB = b"\x91" * 500_000 + b"\xc0"  # lists in lists
WRONG = [  # name, answer, text
    ("traceback", crash, "the server failed: ValueError: the checkpoint is broken"),
    ("text", lambda seen: "", "the server failed: without a reason"),
    ("no msgpack", lambda seen: b"\xc1\xc1", "no msgpack of openpi"),
    ("truncated", lambda seen: RECORDED[:-5], "no msgpack of openpi"),
    ("trailing", lambda seen: RECORDED + b"\x00", "no msgpack of openpi"),
    ("no map", lambda seen: b"\x93\x01\x02\x03", "a message is list, not a map"),
    ("no actions", lambda seen: {"state": 1, "action": 2}, "the answer has no actions, but state, action"),
    ("nothing", lambda seen: b"\x80", "the answer has no actions, but nothing"),
    ("text as actions", lambda seen: {"actions": "up"}, "must be an array"),
    ("columns", lambda seen: {"actions": np.zeros((10, 32))}, "they are 10x32"),
    ("batch", lambda seen: {"actions": np.zeros((1, 10, 8))}, "they are 1x10x8"),
    ("rows", lambda seen: {"actions": np.zeros((1001, 8), np.uint8)}, "n at most 1000; they are 1001x8"),
    ("no rows", lambda seen: {"actions": np.zeros((0, 8))}, "they are 0x8"),
    ("nested", lambda seen: BOMB, "no msgpack of openpi: StackError"),
    ("many maps", lambda seen: b"\x81\xa1a\xdc\x27\x10" + b"\x80" * 10_000, "more than 2000 lists and maps"),
    ("too large", lambda seen: bytes(MAX_BYTES + 1), "the connection ended: .*too big|message too big"),
]


@pytest.mark.parametrize("infer,text", [row[1:] for row in WRONG], ids=[row[0] for row in WRONG])
async def test_answer_that_is_none_is_one_line_and_the_next_one_may_be_right(infer, text):
    async with running(Server(infer)) as server:
        policy = made(server.address)
        assert re.search(text, await failure(policy))
        server.infer = lambda seen: {"actions": ACTIONS}
        await policy.infer(SEEN)
        await policy.close()


@pytest.mark.parametrize("metadata,text", [
    (None, "no connection within"), ("not a policy", "the server failed: not a policy"),
    (b"\xc1", "no msgpack of openpi"), (packed([1]), "a message is list, not a map")])
async def test_server_of_something_else_is_named(metadata, text):
    async with running(Server(crash, metadata)) as server:
        policy = made(server.address, timeout=0.2 if metadata is None else 30.0)
        assert text in await failure(policy)
        await policy.close()


async def test_stalled_server_fails_in_time_and_its_late_answer_is_not_used(monkeypatch):
    failed, late = asyncio.Event(), asyncio.Event()

    async def infer(seen):
        if len(server.seen) != 2:
            return {"actions": np.zeros((1, 8))}
        await failed.wait()
        late.set()
        return {"actions": np.ones((1, 8))}

    async with running(Server(infer)) as server:
        policy = made(server.address)
        await policy.infer(SEEN)  # connects, which a busy machine cannot do in time
        with monkeypatch.context() as patch:
            patch.setattr(policy, "_timeout", 0.15)
            assert "no answer within 0.15 s" in await failure(policy)
        failed.set()
        await late.wait()
        assert (await policy.infer(SEEN)).values[0, 0] == 0.0
        assert len(server.connections) == 2
        await policy.close()


async def test_cancelled_request_leaves_no_answer_for_the_next_one():
    asked, cancelled = asyncio.Event(), asyncio.Event()

    async def infer(seen):
        if cancelled.is_set():
            return {"actions": np.zeros((1, 8))}
        asked.set()
        await cancelled.wait()
        return {"actions": np.ones((1, 8))}

    async with running(Server(infer)) as server:
        policy = made(server.address)
        asking = asyncio.create_task(policy.infer(SEEN))
        await asked.wait()
        asking.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asking
        cancelled.set()
        assert (await policy.infer(SEEN)).values[0, 0] == 0.0
        await policy.close()


async def test_second_answer_is_not_taken_for_the_next_observation():
    async with running(Server(lambda seen: {"actions": ACTIONS})) as server:
        policy = made(server.address)
        await policy.infer(SEEN)
        await server.connections[0].send(packed({"actions": np.zeros((1, 8))}))
        await asyncio.sleep(0.05)
        assert "it sent a message that was not requested" in await failure(policy)
        await policy.infer(SEEN)
        await policy.close()


async def test_server_that_dies_is_named_and_one_that_starts_again_is_used(monkeypatch):
    async with running(Server(lambda seen: server.connections[-1].transport.abort())) as server:
        policy = made(server.address)
        assert "the connection ended: ConnectionClosedError" in await failure(policy)
    port = int(server.address.rpartition(":")[2])
    with monkeypatch.context() as patch:
        patch.setattr(openpi, "RETRY", 30.0)  # the first attempt is the last one
        assert re.search("no connection: .*refused|Connect call failed", await failure(policy))
    waiting = asyncio.create_task(policy.infer(SEEN))
    await asyncio.sleep(0.05)
    async with running(Server(lambda seen: {"actions": ACTIONS}), port):
        await waiting
        await policy.close()


async def test_server_that_speaks_no_websocket_is_named():
    async def answer(reader, writer):
        writer.write(b"SSH-2.0-OpenSSH\r\n" * 100)
        await writer.drain()
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as listening:
        port = listening.sockets[0].getsockname()[1]
        policy = made(f"ws://127.0.0.1:{port}")
        assert "the connection ended" in await failure(policy)
        await policy.close()


@pytest.mark.parametrize("address", ["http://localhost:8000", "localhost:8000", "ws://", "ws://host:port"])
def test_wrong_address_is_named(address):
    with pytest.raises(ConfigError, match=r"source\.openpi: .* must be ws://host:port"):
        made(address)


def test_unknown_camera_is_named():
    with pytest.raises(ConfigError, match=r"keys\.images: 'side' is no camera of the observation; choices: top"):
        made("ws://localhost:8000", images={"side": "observation/image"})


# --- hostile arrays


def array(data=b"\0" * 8, dtype="<f4", shape=(2,), **changed):
    fields = {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}
    return msgpack.packb({"actions": {**fields, **{key.encode(): value for key, value in changed.items()}}})


HOSTILE = [  # name, message, text
    ("objects", array(dtype="|O"), r"type '\|O' is refused"),
    ("structure", array(dtype="f4,f4"), "is refused"),
    ("void", array(dtype="V1000000000"), "is refused"),
    ("text", array(dtype="<U2"), "is refused"),
    ("complex", array(dtype="<c8"), "is refused"),
    ("date", array(dtype="<M8[s]"), "is refused"),
    ("long name", array(dtype="f" * 100_000), "is refused"),
    ("no type", array(dtype=None), "is refused"),
    ("type list", array(dtype=[["a", "f4"]]), "is refused"),
    ("huge", array(shape=(2**40, 2**40)), "no list of at most 8 sizes"),
    ("large", array(shape=(1_000_000, 1_000_000)), r"shape \(1000000, 1000000\) of float32 has 8 bytes"),
    ("overflow", array(shape=(2**62 + 2,)), "no list of at most 8 sizes"),
    ("negative", array(shape=(-1, -2)), "no list of at most 8 sizes"),
    ("dimensions", array(shape=(1,) * 9), "no list of at most 8 sizes"),
    ("fraction", array(shape=(2.0,)), "no list of at most 8 sizes"),
    ("logical", array(shape=(True, 2)), "no list of at most 8 sizes"),
    ("number", array(shape=2), "no list of at most 8 sizes"),
    ("short", array(data=b"\0" * 7), "has 7 bytes"),
    ("data text", array(data="00000000"), "are str, not bytes"),
    ("no data", array(data=None), "are NoneType, not bytes"),
    ("scalar text", msgpack.packb({b"__npgeneric__": True, b"data": "1", b"dtype": "<f4"}), "a scalar is str"),
    ("scalar object", msgpack.packb({b"__npgeneric__": True, b"data": 1, b"dtype": "O"}), "is refused"),
    ("integer too large", msgpack.packb({b"__npgeneric__": True, b"data": 300, b"dtype": "|u1"}), "no msgpack"),
    ("extension", msgpack.packb(msgpack.ExtType(5, b"12")), "no msgpack"),
    ("time", msgpack.packb(msgpack.Timestamp(1, 2)), "no msgpack"),
    ("long list", b"\xdd\xff\xff\xff\xff", "no msgpack"),
    ("long map", b"\xdf\xff\xff\xff\xff", "no msgpack"),
    ("long bytes", b"\xc6\xff\xff\xff\xff", "no msgpack"),
    ("list as key", b"\x81\x90\x01", "no msgpack"),
    ("number as key", b"\x81\x01\x01", "no msgpack"),
    ("no text", b"\xa1\xff", "no msgpack"),
    ("empty", b"", "no msgpack"),
]


@pytest.mark.parametrize("data,text", [row[1:] for row in HOSTILE], ids=[row[0] for row in HOSTILE])
def test_hostile_message_is_refused(data, text):
    with pytest.raises(WrongMessage, match=text) as raised:
        unpack(data)
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 300


def test_pickle_of_another_msgpack_numpy_is_never_read():
    # msgpack_numpy 0.4.8 (lebedov) writes object arrays as a pickle in b"data", with kind b"O".
    message = unpack(msgpack.packb({"actions": {b"nd": True, b"type": "|O", b"kind": b"O", b"shape": [1], b"data":
                                                b"cos\nsystem\n(S'exit 1'\ntR."}}))
    assert isinstance(message["actions"], dict)


def test_random_bytes_never_raise_anything_else():
    rng = np.random.default_rng(0)
    whole = pack({"actions": ACTIONS, "more": [1, {"a": np.float32(1)}]})
    for number in range(3000):
        data = bytearray(whole if number % 2 else rng.bytes(60))
        for at in rng.integers(len(data), size=rng.integers(1, 6)):
            data[at] = rng.integers(256)
        with suppress(WrongMessage):
            unpack(bytes(data))


def test_double_reads_what_is_sent():
    np.testing.assert_array_equal(unpacked(pack({"a": ACTIONS}))["a"], ACTIONS)
