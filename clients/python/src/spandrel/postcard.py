"""The postcard encoding of the messages that a sensor exchanges with the services.

docs/topics.md describes the encoding. All functions are pure.
"""

from __future__ import annotations

import array
import struct
import sys
from dataclasses import dataclass
from typing import Tuple

from .errors import InvalidMessage

SAMPLES_ENCODING = "application/postcard;spandrel.samples.v1"
CAUGHT_UP_ENCODING = "application/postcard;spandrel.caught-up.v1"
PROGRESS_ENCODING = "application/postcard;spandrel.progress.v2"

#: Longest varint of a 64-bit number, in bytes.
_VARINT_BYTES = 10


def _varint(number: int) -> bytes:
    out = bytearray()
    while number >= 0x80:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _zigzag(number: int) -> bytes:
    return _varint((number << 1) ^ (number >> 63))


def _text(text: str) -> bytes:
    encoded = text.encode()
    return _varint(len(encoded)) + encoded


def _header(source: str, epoch: int, sequence: int, time_ns: int) -> bytes:
    return _text(source) + _varint(epoch) + _varint(sequence) + _zigzag(time_ns)


def encode_samples(
    source: str,
    epoch: int,
    sequence: int,
    time_ns: int,
    rate_hz: float,
    channels: int,
    values: "array.array[float]",
    ended: bool,
) -> bytes:
    """Encodes a block of live samples. `values` contains sample by sample."""
    little_endian = values
    if sys.byteorder == "big":
        little_endian = array.array("d", values)
        little_endian.byteswap()
    return b"".join(
        [
            _header(source, epoch, sequence, time_ns),
            struct.pack("<d", rate_hz),
            _varint(0),  # live
            _varint(channels),
            _varint(len(values)),
            little_endian.tobytes(),
            _varint(int(ended)),
        ]
    )


def encode_caught_up(source: str, epoch: int, sequence: int, ended: bool) -> bytes:
    """Encodes the reply that a buffer has no item at or after the requested number."""
    return _header(source, epoch, sequence, 0) + _varint(int(ended))


@dataclass(frozen=True)
class Progress:
    """The progress of a service: it has processed all frames below `done`."""

    epoch: int
    done: int
    #: Time of the last processed frame, ns since the Unix epoch.
    time_ns: int


def decode_progress(payload: bytes) -> Progress:
    """Decodes the progress of a service, or raises `InvalidMessage`."""
    length, at = _read_varint(payload, 0)
    at += length  # the source
    epoch, at = _read_varint(payload, at)
    _sequence, at = _read_varint(payload, at)
    time, at = _read_varint(payload, at)
    done, at = _read_varint(payload, at)
    _kept, at = _read_varint(payload, at)
    if at != len(payload):
        raise InvalidMessage(f"progress has {len(payload)} bytes, its fields end at byte {at}")
    return Progress(epoch=epoch, done=done, time_ns=(time >> 1) ^ -(time & 1))


def _read_varint(payload: bytes, at: int) -> Tuple[int, int]:
    number = 0
    for index, byte in enumerate(payload[at : at + _VARINT_BYTES]):
        number |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return number, at + index + 1
    raise InvalidMessage("the message ends within a number")
