"""Times, shapes and the ring: without network."""

import array
import math
import struct

import pytest

import spandrel
from spandrel.blocks import BLOCK_BYTES, Block, Ring, most_samples, time_after_ns
from spandrel.postcard import decode_progress, encode_samples
from spandrel.sensor import MAX_DEVIATION_NS, SampleClock, samples_to_array

S = 1_000_000_000


def block(sequence, values, time_ns=None, ended=False, channels=1):
    return Block(
        source="roof",
        epoch=7,
        sequence=sequence,
        time_ns=sequence * 10_000_000 if time_ns is None else time_ns,
        rate_hz=100.0,
        channels=channels,
        values=array.array("d", values),
        ended=ended,
    )


def test_a_third_of_a_nanosecond_does_not_add_up():
    assert [time_after_ns(1000, 120.0, count) for count in (0, 1, 2)] == [
        1000,
        8_334_333,
        16_667_667,
    ]
    assert time_after_ns(0, 120.0, 120_000_000_000) == 10**18


def test_samples_may_be_lists_rows_or_arrays():
    numpy = pytest.importorskip("numpy")
    assert list(samples_to_array([1, 2.5], 1)) == [1.0, 2.5]
    assert list(samples_to_array([[1], (2.5,)], 1)) == [1.0, 2.5]
    assert list(samples_to_array([[1, 2], [3, 4]], 2)) == [1.0, 2.0, 3.0, 4.0]
    assert list(samples_to_array(numpy.array([[1, 2], [3, 4]], dtype="float32"), 2)) == [
        1.0,
        2.0,
        3.0,
        4.0,
    ]
    assert list(samples_to_array([numpy.float32(0.5), numpy.int16(2)], 1)) == [0.5, 2.0]
    assert list(samples_to_array(array.array("d", [0.1]), 1)) == [0.1]
    assert list(samples_to_array((x for x in [0.1, 0.2]), 1)) == [0.1, 0.2]


def test_none_is_a_missing_sample():
    found = samples_to_array([[1.0, None], [float("nan"), 4.0]], 2)
    assert [math.isnan(value) for value in found] == [False, True, True, False]


@pytest.mark.parametrize(
    ("samples", "channels", "told"),
    [
        ([1.0, 2.0], 2, "sample 0 is 1.0, must be a row of 2 numbers"),
        ([[1.0, 2.0], [3.0]], 2, "sample 1 has 1 values, must have 2"),
        ([[1.0, 2.0]], 1, "sample 0 has 2 values, must have 1"),
        (["1.0"], 1, "contains '1.0', must be a number"),
        ([[1.0, "2"]], 2, "sample 0 contains '2', must be a number"),
        ([1j], 1, "must be a number"),
        ("12", 1, "must be a list of samples"),
        (1.0, 1, "must be a list of samples"),
        ([[[1.0]]], 1, "must be a number"),
    ],
)
def test_samples_of_another_shape_are_rejected_with_what_is_wrong(samples, channels, told):
    with pytest.raises(spandrel.InvalidSamples, match=None) as raised:
        samples_to_array(samples, channels)
    assert told in str(raised.value)


def test_numbers_from_the_page_are_encoded_as_the_page_states():
    # Each byte follows from the tables of docs/topics.md.
    found = encode_samples("roof", 300, 5, 1, 100.0, 2, array.array("d", [0.5, -1.0]), False)
    header = b"\x04roof" + b"\xac\x02" + b"\x05" + b"\x02"
    rest = (
        struct.pack("<d", 100.0)
        + b"\x00"
        + b"\x02"
        + b"\x02"
        + struct.pack("<2d", 0.5, -1.0)
        + b"\x00"
    )
    assert found == header + rest


def test_progress_is_read_and_damaged_progress_is_rejected():
    whole = b"\x06ingest" + b"\x07" + b"\x0c" + b"\xc8\x01" + b"\x0c" + b"\x0a"
    found = decode_progress(whole)
    assert (found.epoch, found.done, found.time_ns) == (7, 12, 100)
    for damaged in (whole[:-1], whole + b"\x00", b"", b"\xff" * 30):
        with pytest.raises(spandrel.InvalidMessage):
            decode_progress(damaged)


def test_the_first_samples_end_now_and_the_next_ones_follow_without_a_gap():
    clock = SampleClock(100.0)
    assert clock.take(100, None, 10 * S) == (10 * S - 990_000_000, None)
    # The next call is 0.2 s late.
    assert clock.take(100, None, 11 * S + S // 5) == (10 * S + 10_000_000, None)


def test_times_follow_the_clock_again_after_a_pause():
    clock = SampleClock(100.0)
    clock.take(1, None, 10 * S)
    pause_ns = MAX_DEVIATION_NS + 1
    start_ns, deviation_ns = clock.take(1, None, 10 * S + 10_000_000 + pause_ns)
    assert (start_ns, deviation_ns) == (10 * S + 10_000_000 + pause_ns, pause_ns)


def test_a_stated_time_holds_and_later_samples_follow_it():
    clock = SampleClock(100.0)
    assert clock.take(2, 5 * S, 10 * S) == (5 * S, None)
    assert clock.take(2, None, 5 * S + 40_000_000) == (5 * S + 20_000_000, None)


def test_the_ring_joins_blocks_from_the_requested_sample_on():
    ring = Ring(keep=100)
    for sequence in range(0, 30, 10):
        ring.push(block(sequence, range(sequence, sequence + 10)))
    found = ring.answer(after=5, limit=1000)
    assert found.sequence == 5 and found.time_ns == 50_000_000
    assert list(found.values) == list(range(5, 30))
    assert list(ring.answer(after=12, limit=3).values) == [12, 13, 14]
    assert ring.answer(after=30, limit=10) is None


def test_the_ring_does_not_join_blocks_across_a_gap_in_time():
    ring = Ring(keep=100)
    ring.push(block(0, [0, 1]))
    ring.push(block(2, [2, 3], time_ns=S))
    assert list(ring.answer(0, 1000).values) == [0, 1]
    assert ring.answer(2, 1000).time_ns == S


def test_a_full_ring_drops_the_oldest_blocks_and_keeps_the_promised_samples():
    ring = Ring(keep=15)
    for sequence in range(0, 50, 10):
        ring.push(block(sequence, range(sequence, sequence + 10)))
    found = ring.answer(after=0, limit=1000)
    assert found.sequence == 30 and found.end == 50


def test_the_end_of_the_stream_is_part_of_the_last_reply_and_a_reply_itself():
    ring = Ring(keep=100)
    ring.push(block(0, [0, 1]))
    ring.push(block(2, [], ended=True))
    assert ring.answer(0, 1000).ended
    assert not ring.answer(0, 1).ended
    end = ring.answer(2, 1000)
    assert (end.sequence, end.count, end.ended) == (2, 0, True)


def test_no_block_exceeds_the_size_that_the_network_forwards():
    assert most_samples(1) * 8 <= BLOCK_BYTES
    assert most_samples(4096) == 8
    ring = Ring(keep=10**6)
    for sequence in range(0, 60_000, 10_000):
        ring.push(block(sequence, range(sequence, sequence + 10_000)))
    assert ring.answer(0, 10**6).count == most_samples(1)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"node": "Roof"}, "node is 'Roof'"),
        ({"structure": "a/b"}, "structure is 'a/b'"),
        ({"root": ""}, "root is ''"),
        ({"channels": 0}, "channels is 0"),
        ({"channels": ["x", "x"]}, "twice"),
        ({"channels": "x"}, "must be a number or a list of names"),
        ({"rate": 0}, "rate is 0"),
        ({"keep": 0}, "keep is 0"),
    ],
)
def test_arguments_are_checked_before_a_connection_is_opened(arguments, told):
    valid = {
        "structure": "house",
        "node": "roof",
        "channels": 1,
        "rate": 100.0,
        "connect": "tcp/127.0.0.1:1",
    }
    with pytest.raises(ValueError) as raised:
        spandrel.Sensor(**{**valid, **arguments})
    assert told in str(raised.value)
