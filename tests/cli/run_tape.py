"""Write recordings of runs whose numbers are known, and read their report."""

import re
from html.parser import HTMLParser

import numpy as np

from applications.pick_place.topics import PickPlaceStatus
from cli.main import app
from common import messages as m
from common.transport.codec import encode
from recording.sample import Sample
from recording.writer import RUN, RecordingWriter

BEGIN = 1_700_000_000_000_000_000  # [ns]
KINDS = {"joint_states": "stream", "detected_objects": "stream", "validated_targets": "stream", "log": "event",
         "rejected_targets": "event", "counters": "event"}


class Page(HTMLParser):
    """Sections of a report with their text, rows of tables, and everything that a browser would request."""

    def __init__(self, text):
        super().__init__()
        self.text = text
        self.sections, self.rows, self.requested, self.tags = {}, [], [], []
        self._section, self._cells = "", None
        self.feed(text)
        self.head = " ".join(self.sections["summary"].split())
        self.captions = re.findall(r"<figcaption[^>]*>(.*?) \(camera", text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.tags.append(tag)
        self.requested += [v for k, v in values.items() if k in ("src", "href", "xlink:href", "action") and v]
        if tag == "section":
            self._section = values["id"]
            self.sections[self._section] = ""
        elif tag == "tr":
            self.rows.append((self._section, []))
        elif tag == "td":
            self._cells = self.rows[-1][1]
            self._cells.append("")

    def handle_endtag(self, tag):
        if tag == "td":
            self._cells = None

    def handle_data(self, data):
        if self._section:
            self.sections[self._section] += f" {data}"
        if self._cells is not None:
            self._cells[-1] += data

    def table(self, section):
        return [row for name, row in self.rows if name == section and row]


def report(path, *options):
    """Return the report of a recording."""
    output = path.with_suffix(".html")
    assert app.execute(["report", str(path), "-o", str(output), *options]) == 0
    return Page(output.read_text(encoding="utf-8"))


class Tape:
    """A recording of a run; times are in seconds since its start."""

    def __init__(self, path, cell="panda", **run):
        self.path, self.cell = path, cell
        self.writer = RecordingWriter(path, {"cell": cell, "versions": {"zencell": "0.1.0"}})
        self.writer.describe(RUN, {"speed": 1.0, "epoch": BEGIN, "seed": 7, "world": "", "overrides": [], **run})

    def put(self, seconds, topic, message):
        self.writer.add(Sample(f"{self.cell}/{topic}", encode(message), BEGIN + round(seconds * 1e9),
                               message=type(message).__name__, kind=KINDS.get(topic, "state"), writer="w"))

    def header(self, seconds):
        return m.Header(stamp=BEGIN + round(seconds * 1e9), frame_id="world")

    def task(self, seconds, state, **values):
        status = PickPlaceStatus(header=self.header(seconds), state=state, **values)
        self.put(seconds, "pick_place_status", status)

    def image(self, seconds, left, width=720, height=400, camera="camera", data=None):
        """Put a black image with a white square whose left edge is at a pixel."""
        if data is None:
            pixels = np.zeros((height, width, 3), np.uint8)
            pixels[150:250, left : left + 100] = 255
            data = pixels.tobytes()
        self.put(seconds, f"{camera}/image_raw", m.Image(
            header=self.header(seconds), height=height, width=width, encoding="bgr8", data=data))

    def images(self, count, period):
        for k in range(count):
            self.image(period * k, 10 * k)

    def truncate(self):
        self.writer.flush()
        self.writer.abandon()

    def report(self, **ended):
        """Close the recording and return its report."""
        self.writer.close(ended)
        return report(self.path)
