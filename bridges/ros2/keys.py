"""Keys, liveliness tokens and attachments of rmw_zenoh.

Formats: ros2/rmw_zenoh, docs/design.md and rmw_zenoh_cpp/src/detail/{liveliness_utils,qos,attachment_helpers}.cpp; the
exact commits are in docs/ros2.md.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Literal

import xxhash

ADMIN_SPACE = "@ros2_lv"
RELIABLE, BEST_EFFORT = 1, 2  # rmw_qos_reliability_policy_e
TRANSIENT_LOCAL, VOLATILE = 1, 2  # rmw_qos_durability_policy_e
DEFAULT_DEPTH = 42  # of rmw_zenoh: a token leaves out what is the default
GID_BYTES = 16

Kind = Literal["NN", "MP", "MS", "SS", "SC"]  # node, publisher, subscription, service, client


@dataclass(frozen=True)
class Qos:
    """The part of a QoS profile that a bridge chooses; history is always KEEP_LAST."""

    depth: int = 10
    reliability: int = RELIABLE
    durability: int = VOLATILE

    @property
    def text(self) -> str:
        """The profile as the last part of a token."""
        reliability = "" if self.reliability == RELIABLE else str(self.reliability)
        durability = "" if self.durability == VOLATILE else str(self.durability)
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


STREAM = Qos()
SENSOR = Qos(depth=5, reliability=BEST_EFFORT)  # as rmw_qos_profile_sensor_data
LATCHED = Qos(depth=1, durability=TRANSIENT_LOCAL)
LATEST = Qos(depth=1)


@dataclass(frozen=True)
class Node:
    """A node in the graph of a domain."""

    domain: int
    session: str  # id of its Zenoh session
    namespace: str  # such as /cell
    name: str

    def token(self) -> str:
        """Return the token of the node itself."""
        return self._token(0, "NN")

    def entity_token(self, number: int, kind: Kind, name: str, dds_type: str, type_hash: str, qos: Qos) -> str:
        """Return the token of a publisher, subscription, service or client.

        Args:
            number: unique in the session.
            kind: of the entity.
            name: of the topic or service, such as /cell/joint_states.
            dds_type: such as sensor_msgs::msg::dds_::JointState_.
            type_hash: RIHS01 of the type.
            qos: its profile.
        """
        return f"{self._token(number, kind)}/{mangle(name)}/{dds_type}/{type_hash}/{qos.text}"

    def _token(self, number: int, kind: Kind) -> str:
        return (f"{ADMIN_SPACE}/{self.domain}/{self.session}/0/{number}/{kind}/{mangle('/')}/{mangle(self.namespace)}/"
                f"{mangle(self.name)}")


def mangle(name: str) -> str:
    """Return a name as one part of a token."""
    return name.replace("/", "%") or "%"


def data_key(domain: int, name: str, dds_type: str, type_hash: str) -> str:
    """Return the key of the messages of a topic, or of the requests of a service."""
    return f"{domain}/{name.strip('/')}/{dds_type}/{type_hash}"


def gid_of(token: str) -> bytes:
    """Return the id of an entity: the XXH3 hash of its token, low half first, both little-endian."""
    return bytes(xxhash.xxh3_128_digest(token.encode())[::-1])


@dataclass(frozen=True)
class Attachment:
    """Metadata of a message, request or response."""

    sequence: int
    stamp: int  # [ns since the Unix epoch]
    gid: bytes

    def encoded(self) -> bytes:
        """Return it as Zenoh serializes two int64 and an array with its length."""
        return struct.pack("<qqB", self.sequence, self.stamp, len(self.gid)) + self.gid

    @classmethod
    def decoded(cls, data: bytes) -> Attachment:
        """Return the attachment of a payload.

        Raises:
            ValueError: it is none.
        """
        if len(data) != 17 + GID_BYTES or data[16] != GID_BYTES:
            raise ValueError(f"attachment has {len(data)} bytes, not {17 + GID_BYTES}")
        sequence, stamp = struct.unpack_from("<qq", data)
        return cls(sequence, stamp, data[17:])


def ros_name(text: str) -> str:
    """Return a name of a cell or key as a valid name of ROS: letters, digits and underscores in each part."""
    parts = [re.sub(r"[^A-Za-z0-9_]", "_", part) for part in text.split("/") if part]
    return "/".join(f"_{part}" if part[0].isdigit() else part for part in parts)
