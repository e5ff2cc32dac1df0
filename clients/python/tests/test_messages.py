"""Decoding of display messages: without network."""

import json
import logging

import pytest

import spandrel
from spandrel.messages import decode, encoding_of

PARAMETER = {
    "structure": "house",
    "parameter": "storey-2",
    "time_ns": 5,
    "mean": 1,
    "std": 0.2,
    "interval": {"level": 0.95, "low": 0.6, "high": 1.4},
}
KEY = "spandrel/house/parameter/storey-2"
ENCODING = "application/json;spandrel.parameter.v2"


def read(changes=(), key=KEY, encoding=ENCODING):
    return decode(
        spandrel.Parameter, key, encoding, json.dumps({**PARAMETER, **dict(changes)}).encode()
    )


def test_a_message_becomes_a_dataclass():
    expected = spandrel.Parameter(
        "house", "storey-2", 5, 1.0, 0.2, spandrel.Interval(0.95, 0.6, 1.4)
    )
    assert read() == expected
    assert read(encoding="application/json") == expected
    assert type(read().mean) is float


def test_another_version_is_rejected_with_both_versions():
    with pytest.raises(spandrel.UnsupportedVersion) as raised:
        read(encoding="application/json;spandrel.parameter.v3")
    assert "spandrel.parameter.v3" in str(raised.value) and "spandrel.parameter.v2" in str(
        raised.value
    )


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"mean": "1"}, "Parameter.mean is '1', must be float"),
        ({"mean": None}, "Parameter.mean is None"),
        ({"time_ns": 1.5}, "Parameter.time_ns is 1.5, must be int"),
        ({"time_ns": True}, "Parameter.time_ns is True, must be int"),
        ({"interval": 1}, "Parameter.interval is 1, must be an object"),
        ({"interval": {"level": 0.95}}, "Parameter.interval lacks low, high"),
        ({"parameter": "storey-1"}, "the message is about house/parameter/storey-1"),
        ({"structure": "tower"}, "the message is about tower/parameter/storey-2"),
    ],
)
def test_a_message_that_cannot_be_is_rejected_with_key_and_field(changes, told):
    with pytest.raises(spandrel.InvalidMessage) as raised:
        read(changes)
    assert KEY in str(raised.value) and told in str(raised.value)


def test_bytes_that_are_not_json_are_rejected():
    for payload in (b"", b"\xff\xfe", b"[", b"[1]"):
        with pytest.raises(spandrel.InvalidMessage):
            decode(spandrel.Parameter, KEY, ENCODING, payload)


def test_an_unknown_field_is_reported_once(caplog):
    with caplog.at_level(logging.WARNING, logger="spandrel"):
        for _ in range(3):
            read({"colour-of-the-test": 1})
    assert [
        record.message for record in caplog.records if "colour-of-the-test" in record.message
    ] == [
        "Parameter has the field colour-of-the-test, which this package does not know; it is ignored"
    ]


def test_nested_lists_objects_and_reserved_words_are_read():
    text = {
        "structure": "house",
        "time_ns": 5,
        "classes": [
            {"class": "baseline", "plausibility": 0.8},
            {"class": "soft", "plausibility": 0.2},
        ],
        "leading": "baseline",
        "believed": "baseline",
        "calibrations": 0,
        "calibration": None,
    }
    kind = spandrel.ModelClass
    found = decode(kind, "r/house/model-class", encoding_of(kind), json.dumps(text).encode())
    assert [(each.model_class, each.plausibility) for each in found.classes] == [
        ("baseline", 0.8),
        ("soft", 0.2),
    ]
    status = {
        "structure": "house",
        "service": "ingest",
        "id": "ingest",
        "time_ns": 5,
        "lag_s": None,
        "done": 12,
        "drops": {"lost-items": 1},
        "restarts": 0,
        "version": "0.1.0",
    }
    kind = spandrel.Status
    found = decode(
        kind, "r/house/status/ingest/ingest", encoding_of(kind), json.dumps(status).encode()
    )
    assert found.drops == {"lost-items": 1} and found.lag_s is None and found.pace is None


def test_the_statuses_of_feed_ingest_and_notify_have_no_unknown_fields(caplog):
    instrument = {"state": "failed", "since_ns": 1, "samples": 25, "errors": 2}
    error = {"last_error": "no time", "last_error_ns": 4}
    period = {
        "structure": "house",
        "parameter": None,
        "time_ns": 1,
        "until_ns": 9,
        "who": "Ada",
        "reason": "new bearings",
    }
    status = {
        "structure": "house",
        "service": "feed",
        "id": "feed",
        "time_ns": 5,
        "lag_s": 0.1,
        "done": 12,
        "drops": {},
        "restarts": 0,
        "version": "0.1.0",
        "instruments": {"shake": {**instrument, **error}, "logger": instrument},
        "clocks": {"roof": {"offset_s": 0.0, "jitter_s": 0.0, "quality_percent": 80}},
        "missing": {"ground": 0.75},
        "maintenance": [period],
    }
    kind = spandrel.Status
    with caplog.at_level(logging.WARNING, logger="spandrel"):
        found = decode(
            kind, "r/house/status/feed/feed", encoding_of(kind), json.dumps(status).encode()
        )
    assert [record.message for record in caplog.records] == []
    assert found.instruments is not None and found.maintenance is not None
    assert found.instruments["shake"].last_error == "no time"
    assert found.instruments["logger"].last_error is None
    assert found.missing == {"ground": 0.75}
    assert (found.maintenance[0].who, found.maintenance[0].parameter) == ("Ada", None)


def test_the_shape_of_a_mode_is_read():
    shape = {"channel": "floor-1", "value": [1.0, 0], "std": 0.0}
    estimate = {
        "frequency_hz": 3.9,
        "frequency_std_hz": 0.004,
        "damping": 0.01,
        "damping_std": 0.001,
        "shape": [shape],
        "amplitude": 0.02,
    }
    mode = {
        "structure": "house",
        "mode": "bending",
        "time_ns": 5,
        "epoch_s": 600,
        "epochs": 1,
        "state": "tracked",
        "partner": None,
        "estimate": estimate,
        "presence": 1,
        "machine": False,
        "declared_hz": 3.9,
    }
    kind = spandrel.Mode
    key = "spandrel/house/mode/bending"
    found = decode(kind, key, encoding_of(kind), json.dumps(mode).encode())
    assert found.estimate.frequency_hz == 3.9
    assert found.estimate.shape == (spandrel.ShapeValue("floor-1", (1.0, 0.0), 0.0),)
    missing = json.dumps({**mode, "state": "missing", "estimate": None}).encode()
    assert decode(kind, key, encoding_of(kind), missing).estimate is None


def test_a_waveform_has_gaps() -> None:
    channel = {
        "channel": "roof-x",
        "missing": 50,
        "level": {"mean": 0, "rms": 0.5, "last": -0.125},
        "extremes": [[-1.5, 0.75], None],
    }
    waveform = {
        "structure": "house",
        "node": "roof",
        "time_ns": 5,
        "frames": 100,
        "bucket_s": 0.5,
        "channels": [channel, {**channel, "level": None}],
    }
    kind = spandrel.Waveform
    key = "spandrel/house/sensor/roof/waveform"
    found = decode(kind, key, encoding_of(kind), json.dumps(waveform).encode())
    assert found.channels[0].extremes == ((-1.5, 0.75), None)
    assert found.channels[0].level == spandrel.SampleLevel(0.0, 0.5, -0.125)
    assert found.channels[1].level is None
