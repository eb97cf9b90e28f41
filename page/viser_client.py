"""The files of viser's client, which starts fast: all code that depends on how viser packs it.

viser's client is one packed file, which a browser unpacks and compiles at each start. Sent as script, style sheet and
decoder, each under a name derived from its content, it compiles while it loads and the browser caches the result.
Upstream requests: a client build in separate files; `configure_environment_map` and antialiasing as options that apply
before the client starts.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import viser
import zstandard

_PACKED = re.compile(r'<script data-p="([^"]*)" data-ss="(\d+)" data-cs="(\d+)">(.*?)</script>', re.DOTALL)
_DECODER = re.compile(r'const gzWasm=("[^"]*")')
# Base 88: printable characters that need no escaping in an attribute. Five characters encode four bytes.
ALPHABET = "".join(chr(code) for code in range(0x21, 0x7F) if chr(code) not in "\"&<>'`")

# Runs before the client. The client starts with an environment map and decodes it before the first message removes it.
# It draws with antialiasing, which takes a quarter of the frame time if the browser renders in software.
_PRELUDE = """<script>
(() => {
  const load = window.fetch, context = HTMLCanvasElement.prototype.getContext;
  window.fetch = (what, ...more) => String(what?.url ?? what).startsWith("data:image/jpeg")
    ? new Promise(() => {}) : load(what, ...more);
  let software;
  const rendersInSoftware = () => {
    const gl = context.call(document.createElement("canvas"), "webgl2");
    const info = gl?.getExtension("WEBGL_debug_renderer_info");
    const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|softpipe|software/i.test(name);
  };
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    if (kind === "webgl2" && options?.antialias && (software ??= rendersInSoftware()))
      options = {...options, antialias: false};
    return context.call(this, kind, options);
  };
})();
</script>"""
_START = """<link rel="stylesheet" href="{style}"><link rel="modulepreload" href="{script}">
<script type="module">
globalThis.__viserZstdWasm = await WebAssembly.compileStreaming(fetch("{decoder}"));
await import("{script}");
</script>"""


@dataclass(frozen=True)
class ClientFile:
    """A file of the page.

    Attributes:
        media_type: for the header.
        body: compressed by gzip.
        immutable: the path depends on the content, so that a browser may cache it for good.
    """

    media_type: str
    body: bytes
    immutable: bool


@cache
def client_files() -> Mapping[str, ClientFile]:
    """Return the files of the installed viser's client by path; the first call takes a third of a second."""
    page = Path(viser.__file__).parent / "client" / "build" / "index.html"
    return unpack_client(page.read_text(encoding="utf-8"), overlay())


def overlay() -> str:
    """Return style sheet and script of the bar above the page, as HTML for the head."""
    style, script = (Path(__file__).with_name(f"overlay.{end}").read_text(encoding="utf-8") for end in ("css", "js"))
    return f"<style>{style}</style><script>{script}</script>"


def unpack_client(page: str, head: str = "") -> Mapping[str, ClientFile]:
    """Return the files of a packed client by path, with `head` added; an unknown packing stays in one file."""
    packed = _PACKED.search(page)
    decoder = _DECODER.search(packed[4]) if packed else None
    files: dict[str, ClientFile] = {}
    start = ""
    if packed is not None and decoder is not None:
        style_size, script_size = int(packed[2]), int(packed[3])
        both = zstandard.decompress(decode_base88(packed[1]), max_output_size=style_size + script_size)
        paths = {}
        for name, suffix, media_type, content in (
            ("style", "css", "text/css; charset=utf-8", both[:style_size]),
            ("script", "js", "text/javascript; charset=utf-8", both[style_size:]),
            ("decoder", "wasm", "application/wasm", gzip.decompress(decode_base88(json.loads(decoder[1])))),
        ):
            paths[name] = f"/{hashlib.sha256(content).hexdigest()[:20]}.{suffix}"
            files[paths[name]] = ClientFile(media_type, gzip.compress(content, 6), immutable=True)
        start = _START.format(**paths)
        page = page.replace(packed[0], "")
    page = page.replace("<head>", f"<head>{_PRELUDE}{head}", 1).replace("</head>", f"{start}</head>", 1)
    index = ClientFile("text/html; charset=utf-8", gzip.compress(page.encode(), 6), immutable=False)
    return files | {"/": index, "/index.html": index}


def decode_base88(text: str) -> bytes:
    """Return the encoded bytes: five characters encode four bytes, the last k characters k - 1 bytes."""
    digits = np.zeros(128, np.int64)
    digits[[ord(c) for c in ALPHABET]] = np.arange(len(ALPHABET))
    missing = -len(text) % 5
    values = digits[np.frombuffer(text.encode("ascii"), np.uint8)]
    full = len(text) // 5
    weights = len(ALPHABET) ** np.arange(4, -1, -1)
    found = (values[: 5 * full].reshape(-1, 5) @ weights).astype(">u4").tobytes()
    if missing:
        rest = 0
        for digit in values[5 * full :]:
            rest = len(ALPHABET) * rest + int(digit)
        found += rest.to_bytes(4 - missing, "big")
    return found
