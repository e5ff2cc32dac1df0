"""Sample blocks, their times, and the ring of the latest blocks. Pure: no network and no clock."""

from __future__ import annotations

import array
import collections
from dataclasses import dataclass
from typing import Deque, Optional

from .postcard import encode_samples

#: Approximate maximum size of one block, in bytes. The network rarely drops such a block.
BLOCK_BYTES = 256 << 10
#: Maximum number of samples in one block.
MAX_ITEMS = 65_536
#: Sampling rates that the services accept, in Hz.
MIN_RATE_HZ, MAX_RATE_HZ = 1e-3, 1e6

#: 10⁹ ns/s times 10⁶ µHz/Hz.
_NANOSECONDS_MICROHERTZ = 10**15


def time_after_ns(start_ns: int, rate_hz: float, count: int) -> int:
    """Returns the time of a sample, `count` samples after `start_ns`.

    The result is exact if the rate is a whole number of microhertz, so that times do not drift.
    """
    microhertz = round(rate_hz * 1e6)
    if microhertz / 1e6 == rate_hz:
        return start_ns + (count * _NANOSECONDS_MICROHERTZ + microhertz // 2) // microhertz
    return start_ns + round(count * 1e9 / rate_hz)


@dataclass(frozen=True)
class Block:
    """Consecutive samples of all channels of a node."""

    source: str
    epoch: int
    #: Number of the first sample.
    sequence: int
    #: Time of the first sample, ns since the Unix epoch.
    time_ns: int
    rate_hz: float
    channels: int
    #: Sample by sample; NaN is missing.
    values: "array.array[float]"
    #: Whether no further sample follows in this epoch.
    ended: bool = False

    @property
    def count(self) -> int:
        """Number of samples."""
        return len(self.values) // self.channels

    @property
    def end(self) -> int:
        """Number of the sample after this block."""
        return self.sequence + self.count

    def encode(self) -> bytes:
        """Encodes the block as postcard."""
        return encode_samples(
            self.source,
            self.epoch,
            self.sequence,
            self.time_ns,
            self.rate_hz,
            self.channels,
            self.values,
            self.ended,
        )

    def part(self, first: int, count: int) -> Block:
        """Returns at most `count` samples from sample number `first` on."""
        skipped = max(0, first - self.sequence)
        values = self.values[skipped * self.channels : (skipped + count) * self.channels]
        is_last = skipped * self.channels + len(values) >= len(self.values)
        return Block(
            source=self.source,
            epoch=self.epoch,
            sequence=self.sequence + skipped,
            time_ns=time_after_ns(self.time_ns, self.rate_hz, skipped),
            rate_hz=self.rate_hz,
            channels=self.channels,
            values=values,
            ended=self.ended and is_last,
        )


def most_samples(channels: int) -> int:
    """Returns the maximum number of samples in a block of a node."""
    return max(1, min(MAX_ITEMS, BLOCK_BYTES // (8 * channels)))


class Ring:
    """The latest blocks of a node, for services that missed some.

    When the ring is full, it drops the oldest block. A reply then starts with the oldest remaining
    block, and the service detects the gap from its number.
    """

    def __init__(self, keep: int) -> None:
        self._keep = keep
        self._blocks: Deque[Block] = collections.deque()
        self._items = 0

    def push(self, block: Block) -> None:
        """Adds the next block. Keeps at least the last `keep` samples."""
        self._blocks.append(block)
        self._items += block.count
        while len(self._blocks) > 1 and self._items - self._blocks[0].count >= self._keep:
            self._items -= self._blocks.popleft().count

    def answer(self, after: int, limit: int) -> Optional[Block]:
        """Returns samples from number `after` on, or from the oldest remaining sample.

        Joins blocks up to `limit` samples and `BLOCK_BYTES`. Returns `None` if there are no such
        samples. Returns the end of the stream if only the end is new.
        """
        found = [block for block in self._blocks if block.end > after]
        if not found:
            last = self._blocks[-1] if self._blocks else None
            return last.part(after, 0) if last and last.ended and last.end == after else None
        most = max(1, min(limit, most_samples(found[0].channels)))
        answer = found[0].part(after, most)
        values = array.array("d", answer.values)
        ended = answer.ended
        for block in found[1:]:
            count = len(values) // answer.channels
            # Both times are rounded, so that a difference of 1 ns is not a gap.
            expected_ns = time_after_ns(answer.time_ns, answer.rate_hz, count)
            if count >= most or abs(block.time_ns - expected_ns) > 1:
                break
            taken = block.part(block.sequence, most - count)
            values.extend(taken.values)
            ended = taken.ended
        return Block(
            source=answer.source,
            epoch=answer.epoch,
            sequence=answer.sequence,
            time_ns=answer.time_ns,
            rate_hz=answer.rate_hz,
            channels=answer.channels,
            values=values,
            ended=ended,
        )
