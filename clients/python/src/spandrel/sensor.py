"""A sensor node: publishes samples, and keeps them for services that missed some."""

from __future__ import annotations

import array
import logging
import threading
import time
from types import TracebackType
from typing import Any, Iterable, List, Optional, Sequence, Type, Union

import zenoh

from .blocks import MAX_RATE_HZ, MIN_RATE_HZ, Block, Ring, most_samples, time_after_ns
from .bus import DEFAULT_ENDPOINT, DEFAULT_ROOT, DEFAULT_TIMEOUT_S, Certificate, Connect
from .bus import check_name, key, owned_or_shared
from .errors import Closed, InvalidMessage, InvalidSamples
from .postcard import (
    CAUGHT_UP_ENCODING,
    PROGRESS_ENCODING,
    SAMPLES_ENCODING,
    Progress,
    decode_progress,
    encode_caught_up,
)

_log = logging.getLogger("spandrel")

#: Number of samples that a node keeps for services that missed some, like simulated nodes.
SAMPLES_KEPT = 16_384
#: Maximum number of channels of a node.
MAX_CHANNELS = 4096
#: Deviation of the computed sample times from the clock of the computer above which the sample
#: times follow the clock again. It is longer than the usual delay of a busy computer.
MAX_DEVIATION_NS = 500_000_000
#: Number of items in a reply if the query does not specify a limit.
_DEFAULT_LIMIT = 1000
#: Time to wait for the liveliness tokens of ingest when a sensor is closed, in seconds.
_TOKENS_TIMEOUT_S = 2.0

#: Samples: rows with one number per channel, or a plain list for a node with one channel. `None`
#: and NaN are missing samples. NumPy arrays are sequences as well.
Samples = Union[Sequence[Optional[float]], Sequence[Sequence[Optional[float]]], Any]


class Sensor:
    """A sensor node of a structure.

    The node numbers its samples, announces that it is present, and replies to services that missed
    samples. Each start begins a new epoch of numbers. Use it in a `with` statement, so that the
    stream ends properly:

        with Sensor("demo", "storey-1", channels=1, rate=100.0) as sensor:
            sensor.publish([0.12, 0.11, None, 0.13])

    - `structure`, `node`: the names in the structure file
    - `channels`: the number of channels of the node, or their names, in the order of the structure
      file
    - `rate`: the sampling rate of the node, in Hz
    - `connect`: an endpoint, or a session from `open_session`
    - `certificate`: the path of `sensor.STRUCTURE.NODE.pem` for an endpoint `quic/...`
    - `root`: the first chunk of all keys (`bus.root`)
    - `keep`: the number of samples to keep for services that missed some
    - `timeout`: the time to wait for the connection, in seconds

    Raises `NotConnected` if no program replies, and `InvalidName` or `ValueError` if an argument is
    not allowed. `publish` and `close` can be called from several threads.
    """

    def __init__(
        self,
        structure: str,
        node: str,
        channels: Union[int, Sequence[str]],
        rate: float,
        connect: Connect = DEFAULT_ENDPOINT,
        certificate: Optional[Certificate] = None,
        root: str = DEFAULT_ROOT,
        *,
        keep: int = SAMPLES_KEPT,
        timeout: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        check_name("node", node)
        samples_key = key(root, structure, f"sensor/{node}/samples")
        self._channels = _channel_count(channels)
        self._rate_hz = float(rate)
        if not MIN_RATE_HZ <= self._rate_hz <= MAX_RATE_HZ:
            raise ValueError(f"rate is {rate} Hz, must lie between {MIN_RATE_HZ} and {MAX_RATE_HZ}")
        if keep < 1:
            raise ValueError(f"keep is {keep} samples, must be at least 1")
        self._node = node
        self._epoch = time.time_ns()
        self._lock = threading.Lock()
        self._ring = Ring(keep)
        self._next = 0
        self._clock = SampleClock(self._rate_hz)
        self._next_time_ns = 0
        self._is_closed = False
        self._progress: Optional[Progress] = None
        self._progress_changed = threading.Condition(self._lock)
        self._ingest_tokens = key(root, structure, "live/ingest/*")
        self._session, self._owns_session = owned_or_shared(connect, certificate, timeout)
        # The buffer comes first, because services assume that it exists once a block has arrived.
        self._buffer = self._session.declare_queryable(
            key(root, structure, f"sensor/{node}/@buffer"), self._answer
        )
        self._progress_reader = self._session.declare_subscriber(
            key(root, structure, "progress/ingest"), self._note_progress
        )
        self._publisher = self._session.declare_publisher(
            samples_key,
            encoding=SAMPLES_ENCODING,
            # Publishing never waits. Services fetch the blocks that the network drops.
            congestion_control=zenoh.CongestionControl.DROP,
        )
        self._token = self._session.liveliness().declare_token(
            key(root, structure, f"live/sensor/{node}")
        )

    @property
    def epoch(self) -> int:
        """The epoch of the sample numbers: the time of the start, ns since the Unix epoch."""
        return self._epoch

    @property
    def published(self) -> int:
        """The number of samples published so far."""
        return self._next

    def publish(self, samples: Samples, time_ns: Optional[int] = None) -> None:
        """Publishes consecutive samples of all channels, in SI units.

        `samples` contains one row per sample with one number per channel. For a node with one
        channel it may be a plain list of numbers. `None` or NaN marks a missing sample. An empty
        list publishes nothing.

        `time_ns` is the measurement time of the first sample, in ns since the Unix epoch (UTC).
        Without it, the last sample of the first call was measured now, and later samples follow at
        the sampling rate. If these times deviate from the clock of the computer by more than
        0.5 s, for example after a pause, the last sample was measured now again. A warning is
        logged.

        Raises `InvalidSamples` if the samples do not have the shape of the node, and `Closed` after
        `close`.
        """
        values = samples_to_array(samples, self._channels)
        count = len(values) // self._channels
        with self._lock:
            if self._is_closed:
                raise Closed(f"sensor {self._node} is closed")
            if count == 0:
                return
            start_ns, deviation_ns = self._clock.take(count, time_ns, time.time_ns())
            if deviation_ns is not None:
                _log.warning(
                    "sensor %s: the clock is %.3f s ahead of the computed sample times; "
                    "the times follow the clock again",
                    self._node,
                    deviation_ns / 1e9,
                )
            whole = self._block(start_ns, values)
            most = most_samples(self._channels)
            for first in range(whole.sequence, whole.end, most):
                self._put(whole.part(first, most))
            self._next = whole.end
            self._next_time_ns = time_after_ns(start_ns, self._rate_hz, count)

    def close(self, timeout: float = 5.0) -> None:
        """Ends the stream and withdraws the node. Further calls have no effect.

        Waits at most `timeout` seconds until ingest has processed the last sample, because services
        can fetch missed samples only while the sensor exists. Logs a warning if ingest is not
        present or does not finish.
        """
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
            last_ns = self._next_time_ns - round(1e9 / self._rate_hz)
            self._put(self._block(self._next_time_ns, array.array("d"), ended=True))
        try:
            if self._next > 0:
                self._wait_for_ingest(last_ns, timeout)
        finally:
            self._token.undeclare()
            self._progress_reader.undeclare()
            self._buffer.undeclare()
            self._publisher.undeclare()
            if self._owns_session:
                self._session.close()

    def __enter__(self) -> Sensor:
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        self.close()

    def _block(self, time_ns: int, values: "array.array[float]", ended: bool = False) -> Block:
        return Block(
            source=self._node,
            epoch=self._epoch,
            sequence=self._next,
            time_ns=time_ns,
            rate_hz=self._rate_hz,
            channels=self._channels,
            values=values,
            ended=ended,
        )

    def _put(self, block: Block) -> None:
        # The ring comes first, so that a service that detects a gap finds the block.
        self._ring.push(block)
        self._publisher.put(block.encode())

    def _answer(self, query: zenoh.Query) -> None:
        """Replies to a query for missed samples, on a thread of Zenoh."""
        with query:
            parameters = query.parameters
            try:
                after = int(parameters.get("after") or 0)
                limit = int(parameters.get("limit") or _DEFAULT_LIMIT)
                epoch = parameters.get("epoch")
                is_other_epoch = epoch is not None and int(epoch) != self._epoch
            except ValueError as error:
                query.reply_err(f"query parameter is not a whole number: {error}")
                return
            with self._lock:
                block = self._ring.answer(0 if is_other_epoch else after, limit)
                caught_up = encode_caught_up(self._node, self._epoch, self._next, self._is_closed)
            if block is None:
                query.reply(query.key_expr, caught_up, encoding=CAUGHT_UP_ENCODING)
            else:
                query.reply(query.key_expr, block.encode(), encoding=SAMPLES_ENCODING)

    def _note_progress(self, sample: zenoh.Sample) -> None:
        if str(sample.encoding) != PROGRESS_ENCODING:
            _log.warning(
                "progress of ingest has the encoding %s, not %s", sample.encoding, PROGRESS_ENCODING
            )
            return
        try:
            progress = decode_progress(sample.payload.to_bytes())
        except InvalidMessage as error:
            _log.warning("progress of ingest cannot be read: %s", error)
            return
        with self._progress_changed:
            self._progress = progress
            self._progress_changed.notify_all()

    def _wait_for_ingest(self, last_ns: int, timeout: float) -> None:
        tokens = self._session.liveliness().get(self._ingest_tokens, timeout=_TOKENS_TIMEOUT_S)
        if not any(reply.ok is not None for reply in tokens):
            _log.warning(
                "sensor %s: ingest is not present; samples that it has not fetched are lost",
                self._node,
            )
            return
        # A sample belongs to the nearest frame, which is at most half a step earlier.
        done_ns = last_ns - round(0.5e9 / self._rate_hz) - 1

        def is_done() -> bool:
            return self._progress is not None and self._progress.time_ns >= done_ns

        with self._progress_changed:
            if not self._progress_changed.wait_for(is_done, timeout):
                _log.warning(
                    "sensor %s: ingest has not processed all samples after %g s",
                    self._node,
                    timeout,
                )


class SampleClock:
    """Computes the times of samples whose times the caller does not state. Pure: no clock."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._start_ns: Optional[int] = None
        self._count = 0

    def take(
        self, count: int, stated_ns: Optional[int], now_ns: int
    ) -> "tuple[int, Optional[int]]":
        """Returns the time of the first of `count` samples, the last of which was measured now.

        If the times follow the clock again, also returns the deviation, in ns.
        """
        deviation_ns = None
        if stated_ns is not None:
            self._start_ns, self._count = int(stated_ns), 0
        else:
            by_clock_ns = time_after_ns(now_ns, self._rate_hz, 1 - count)
            if self._start_ns is None:
                self._start_ns, self._count = by_clock_ns, 0
            else:
                ahead_ns = by_clock_ns - time_after_ns(self._start_ns, self._rate_hz, self._count)
                if abs(ahead_ns) > MAX_DEVIATION_NS:
                    deviation_ns = ahead_ns
                    self._start_ns, self._count = by_clock_ns, 0
        first_ns = time_after_ns(self._start_ns, self._rate_hz, self._count)
        self._count += count
        return first_ns, deviation_ns


def _channel_count(channels: Union[int, Sequence[str]]) -> int:
    if isinstance(channels, str):
        raise ValueError(f"channels is {channels!r}, must be a number or a list of names")
    if isinstance(channels, int):
        count = channels
    else:
        names = [check_name("channel", name) for name in channels]
        if len(set(names)) != len(names):
            raise ValueError(f"channels contains a name twice: {', '.join(names)}")
        count = len(names)
    if not 1 <= count <= MAX_CHANNELS:
        raise ValueError(f"channels is {count}, must lie between 1 and {MAX_CHANNELS}")
    return count


def samples_to_array(samples: Samples, channels: int) -> "array.array[float]":
    """Returns samples in one list, sample by sample, or raises `InvalidSamples`."""
    rows = _as_list(samples)
    if rows is None:
        raise InvalidSamples(f"samples is {samples!r}, must be a list of samples")
    values: List[float] = []
    for number, row in enumerate(rows):
        cells = _as_list(row)
        if cells is None and channels == 1:
            cells = [row]
        if cells is None:
            raise InvalidSamples(
                f"sample {number} is {row!r}, must be a row of {channels} numbers, one for each channel"
            )
        if len(cells) != channels:
            raise InvalidSamples(
                f"sample {number} has {len(cells)} values, must have {channels}, one for each channel"
            )
        values.extend(_number(number, cell) for cell in cells)
    return array.array("d", values)


def _as_list(value: Any) -> Optional[List[Any]]:
    """Returns the items of a sequence or array, or `None` for a single number."""
    if isinstance(value, (list, tuple, array.array)):
        return list(value)
    if hasattr(value, "tolist"):  # arrays of NumPy and similar packages
        items = value.tolist()
        return items if isinstance(items, list) else None
    if isinstance(value, (str, bytes, bytearray)) or not isinstance(value, Iterable):
        return None
    return list(value)


def _number(sample: int, value: Any) -> float:
    if value is None:
        return float("nan")
    if hasattr(value, "__float__"):  # not a text, which `float` would parse
        try:
            return float(value)
        except (TypeError, ValueError):
            pass
    raise InvalidSamples(
        f"sample {sample} contains {value!r}, must be a number, or None if it is missing"
    )
