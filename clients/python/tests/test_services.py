"""The package against the built program, over Zenoh on the loopback interface."""

import json
import logging
import math
import threading
import time

import pytest
import zenoh

import spandrel
from services import DEADLINE_S

RATE_HZ = 100.0
STEP_NS = 10_000_000
#: Time of the first sample: a frame of the record has this time exactly.
START_NS = 1_790_000_000_000_000_000


def ground(index):
    return 0.1 * math.sin(0.37 * index)


def roof(index):
    # The velocity has missing samples. They occur in the recording at the same places.
    velocity = None if index % 7 == 3 else 0.01 * math.cos(0.11 * index)
    return (0.3 * math.sin(0.21 * index), velocity)


def wait_until(what, is_there):
    """Waits for an event that the network does not announce."""
    deadline = time.monotonic() + DEADLINE_S
    while not is_there():
        assert time.monotonic() < deadline, f"waited {DEADLINE_S} s in vain: {what}"
        time.sleep(0.02)


def wait_for_ingest(statuses, is_reached):
    """Returns the first status of ingest that fulfils a condition."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        status = statuses.receive(1.0)
        if status is not None and status.service == "ingest" and is_reached(status):
            return status
    raise AssertionError(f"waited {DEADLINE_S} s in vain for ingest")


def assert_recorded(rows, count):
    assert len(rows) == count
    for index, row in enumerate(rows):
        acceleration, velocity = roof(index)
        expected = (ground(index), acceleration, math.nan if velocity is None else velocity)
        found = tuple(row[name] for name in ("ground", "roof", "roof-velocity"))
        same = [a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(found, expected)]
        assert all(same), f"row {index}: published {expected}, recorded {found}"


class Nodes:
    """Both nodes of the structure, with a known motion."""

    def __init__(self, site):
        settings = {"connect": site.endpoint, "root": site.root}
        self.ground = spandrel.Sensor("house", "ground", channels=1, rate=RATE_HZ, **settings)
        names = ["roof", "roof-velocity"]
        self.roof = spandrel.Sensor("house", "roof", channels=names, rate=RATE_HZ, **settings)

    def publish(self, first, count):
        indices = range(first, first + count)
        start_ns = START_NS + first * STEP_NS
        self.ground.publish([ground(index) for index in indices], start_ns)
        self.roof.publish([roof(index) for index in indices], start_ns)

    def __enter__(self):
        return self

    def close(self):
        # Frames wait for both nodes. If one ended first, its buffer would disappear too early.
        ending = threading.Thread(target=self.ground.close, args=[DEADLINE_S])
        ending.start()
        self.roof.close(DEADLINE_S)
        ending.join()

    def __exit__(self, *_):
        self.close()


def test_the_recording_contains_the_published_samples(site, caplog):
    with site.start("ingest") as ingest:
        with Nodes(site) as nodes:
            for first in range(0, 500, 25):
                nodes.publish(first, 25)
        ingest.stop()
    assert_recorded(site.recorded(), 500)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_nothing_is_lost_while_ingest_is_killed_and_restarts(site):
    ingest = site.start("ingest")
    with (
        Nodes(site) as nodes,
        spandrel.subscribe(
            "house", [spandrel.Status], connect=site.endpoint, root=site.root
        ) as statuses,
    ):
        nodes.publish(0, 200)
        wait_for_ingest(statuses, lambda status: status.done >= 200)
        ingest.kill()
        for first in range(200, 400, 50):
            nodes.publish(first, 50)
        with site.start("ingest") as ingest:
            for first in range(400, 600, 50):
                nodes.publish(first, 50)
            wait_for_ingest(statuses, lambda status: status.done >= 600)
            nodes.close()
            ingest.stop()
    assert_recorded(site.recorded(), 600)


def test_a_service_that_starts_late_receives_earlier_samples(site):
    """A session without ingest accepts the sensors first, as a router does."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([site.endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    settings = {"connect": site.endpoint, "root": site.root}
    with zenoh.open(config), Nodes(site) as nodes:
        nodes.publish(0, 300)
        nodes.publish(300, 100)
        with spandrel.subscribe("house", [spandrel.Status], **settings) as statuses:
            with site.connecting("ingest") as ingest:
                wait_for_ingest(statuses, lambda status: status.done >= 400)
                nodes.close()
                ingest.stop()
    assert_recorded(site.recorded(), 400)


def test_a_restarted_sensor_begins_a_new_epoch_and_its_samples_count(site):
    with site.start("ingest") as ingest:
        with Nodes(site) as nodes:
            nodes.publish(0, 100)
            before = nodes.ground.epoch
        with Nodes(site) as nodes:
            nodes.publish(100, 100)
            assert nodes.ground.epoch > before
        ingest.stop()
    assert_recorded(site.recorded(), 200)


def test_json_samples_of_a_plain_script_are_recorded(site):
    """Both nodes publish JSON without the package and without a buffer."""
    with (
        site.start("ingest") as ingest,
        spandrel.subscribe(
            "house", [spandrel.Status], connect=site.endpoint, root=site.root
        ) as statuses,
    ):
        session = spandrel.open_session(site.endpoint)
        epoch = time.time_ns()
        publishers = {}
        for node in ("ground", "roof"):
            key = f"{site.root}/house/sensor/{node}/samples"
            publishers[node] = session.declare_publisher(key, encoding="application/json")
            wait_until(f"a reader of {key}", lambda: publishers[node].matching_status.matching)
        for first in range(0, 200, 20):
            for node, motion in (("ground", ground), ("roof", roof)):
                block = {
                    "source": node,
                    "epoch": epoch,
                    "sequence": first,
                    "time_ns": START_NS + first * STEP_NS,
                    "sampling_rate_hz": RATE_HZ,
                    "samples": [motion(index) for index in range(first, first + 20)],
                }
                publishers[node].put(json.dumps(block))
        publishers["roof"].put('{"source": "roof", "sample": [1]}')
        wait_for_ingest(statuses, lambda status: status.drops.get("refused-undecodable") == 1)
        wait_for_ingest(statuses, lambda status: status.done >= 200)
        ingest.wait_for("unknown field `sample`")
        session.close()
        ingest.stop()
    assert_recorded(site.recorded(), 200)


def test_a_closed_sensor_rejects_samples_and_an_empty_list_publishes_nothing(site):
    with site.start("ingest"):
        sensor = spandrel.Sensor(
            "house", "ground", 1, RATE_HZ, connect=site.endpoint, root=site.root
        )
        sensor.publish([])
        assert sensor.published == 0
        with pytest.raises(spandrel.InvalidSamples):
            sensor.publish([[1.0, 2.0]])
        assert sensor.published == 0
        sensor.close()
        sensor.close()
        with pytest.raises(spandrel.Closed):
            sensor.publish([1.0])


def test_the_error_names_an_endpoint_without_program():
    with pytest.raises(spandrel.NotConnected) as raised:
        spandrel.open_session("tcp/127.0.0.1:1", timeout=0.3)
    assert "tcp/127.0.0.1:1" in str(raised.value) and "spandrel run" in str(raised.value)


def test_the_error_names_a_missing_certificate(tmp_path):
    with pytest.raises(spandrel.NotConnected) as raised:
        spandrel.open_session("quic/127.0.0.1:1", certificate=tmp_path / "viewer.ada.pem")
    assert "authority.pem" in str(raised.value)


DAMAGED = """
[[alert]]
parameters = "all"
reference.design-std = 1e-9
loss = 0.05
credibility = 0.99
sustain-s = 5
[[simulation.damage]]
parameter = "storey-2"
at-s = 20
loss = 0.15
"""


def test_messages_history_and_acknowledgement_of_a_damaged_building(site):
    site.structure_file.write_text(site.structure_file.read_text() + DAMAGED)
    settings = {"connect": site.endpoint, "root": site.root}
    with site.start("run", "--http", "none"), spandrel.subscribe("house", **settings) as messages:
        with pytest.raises(spandrel.NoReply):
            spandrel.acknowledge("house", "storey-2", "Ada", timeout=0.5, **settings)
        with site.simulate("--speed", "max", "--duration", "60") as simulation:
            simulation.wait()
        kinds, raised = set(), None
        wanted = {
            spandrel.Parameter,
            spandrel.Loss,
            spandrel.Noise,
            spandrel.Alert,
            spandrel.Fit,
            spandrel.Event,
            spandrel.Status,
        }
        deadline = time.monotonic() + DEADLINE_S
        while not (wanted <= kinds and raised) and time.monotonic() < deadline:
            message = messages.receive(1.0)
            if message is not None:
                kinds.add(type(message))
                if isinstance(message, spandrel.Alert) and message.state == "raised":
                    raised = message
        assert wanted <= kinds, f"lacks {wanted - kinds}"
        assert (
            raised.parameter == "storey-2"
            and raised.loss > 0.05
            and "storey-2 has lost" in raised.why
        )

        confirmed = spandrel.acknowledge("house", "storey-2", "Ada", "seen", **settings)
        assert (confirmed.state, confirmed.acknowledged_by) == ("acknowledged", "Ada")
        latest = {alert.parameter: alert for alert in spandrel.latest_alerts("house", **settings)}
        assert latest["storey-2"] == confirmed and latest["storey-1"].state == "normal"

        def past():
            return spandrel.history("house", "storey-2", points=20_000, **settings)

        wait_until(
            "the damage in the history", lambda: past().points and past().points[-1].mean < 0.9
        )
        found = past()
        assert (found.structure, found.kind, found.name) == ("house", "parameter", "storey-2")
        times = [point.time_s for point in found.points]
        assert times == sorted(times) and found.points[0].probability_of_loss is None
        middle = found.points[len(times) // 2].time
        later = spandrel.history("house", "storey-2", start=middle, points=20_000, **settings)
        assert 0 < len(later.points) < len(times)
        assert later.points[0].time_s >= middle.timestamp() - 1e-3

        def probability_of_loss():
            losses = spandrel.history("house", "storey-2", kind="loss", **settings).points
            return losses[-1].probability_of_loss if losses else 0.0

        # Alert can be later than identify.
        wait_until("the loss in the history", lambda: probability_of_loss() > 0.99)
        with pytest.raises(spandrel.QueryRejected, match="storey-9"):
            spandrel.history("house", "storey-9", **settings)


def test_a_published_condition_is_received_and_kept(site, caplog):
    settings = {"connect": site.endpoint, "root": site.root}
    measured_ns = time.time_ns() - 60_000_000_000
    with site.start("run", "--http", "none"):
        with (
            spandrel.subscribe("house", [spandrel.Condition], **settings) as messages,
            spandrel.ConditionPublisher(
                "house", "air", "degC", interval=60, instrument="mast", **settings
            ) as air,
        ):
            air.publish(21.5, measured_ns)
            air.publish(-3, measured_ns + 1_000_000_000)
            with pytest.raises(ValueError):
                air.publish(math.nan)
            expected = spandrel.Condition("house", "air", measured_ns, 21.5, "degC", 60.0, "mast")
            assert messages.receive(DEADLINE_S) == expected
            assert messages.receive(DEADLINE_S).value == -3.0

        def past():
            return spandrel.history("house", "air", kind="condition", **settings).points

        wait_until("both values in the history", lambda: len(past()) == 2)
        assert [point.mean for point in past()] == [21.5, -3.0]
        assert past()[0].time_s == pytest.approx(measured_ns / 1e9, abs=1e-6)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    with pytest.raises(spandrel.Closed):
        air.publish(1.0)


def test_a_condition_has_a_known_unit_and_a_name(site):
    for unit, name in (("°C", "air"), ("degC", "air temperature")):
        with pytest.raises(ValueError):
            spandrel.ConditionPublisher("house", name, unit, connect=site.endpoint)


def test_the_error_states_that_no_history_replies(site):
    with site.start("ingest"):
        with pytest.raises(spandrel.NoReply, match="spandrel history"):
            spandrel.history(
                "house", "storey-1", timeout=2.0, connect=site.endpoint, root=site.root
            )


@pytest.fixture
def pair():
    """Two sessions that are connected without the program."""
    from services import free_endpoint

    endpoint = free_endpoint()
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as publisher:
        yield publisher, endpoint


def parameter(mean):
    return json.dumps(
        {
            "structure": "house",
            "parameter": "storey-1",
            "time_ns": 5,
            "mean": mean,
            "std": 0.1,
            "interval": {"level": 0.95, "low": 0.8, "high": 1.2},
        }
    )


def publisher_of(session, version):
    publisher = session.declare_publisher(
        "spandrel/house/parameter/storey-1",
        encoding=f"application/json;spandrel.parameter.v{version}",
    )
    wait_until("a subscriber", lambda: publisher.matching_status.matching)
    return publisher


def test_an_iteration_raises_unsupported_versions_and_continues(pair):
    session, endpoint = pair
    with spandrel.subscribe("house", [spandrel.Parameter], connect=endpoint) as messages:
        publisher_of(session, 9).put(parameter(1.0))
        with pytest.raises(spandrel.UnsupportedVersion):
            messages.receive(DEADLINE_S)
        publisher_of(session, 2).put(parameter(2.0))
        assert next(messages).mean == 2.0
        assert messages.receive(timeout=0.01) is None
    assert list(messages) == []


def test_a_full_queue_drops_the_oldest_message_and_counts_it(pair, caplog):
    session, endpoint = pair
    with spandrel.subscribe("house", [spandrel.Parameter], connect=endpoint, queue=2) as messages:
        publisher = publisher_of(session, 2)
        for mean in range(5):
            publisher.put(parameter(float(mean)))
        wait_until("three dropped messages", lambda: messages.dropped == 3)
        assert [next(messages).mean, next(messages).mean] == [3.0, 4.0]
    assert "dropped because the queue was full" in caplog.text


def test_a_callback_receives_messages_and_its_errors_go_elsewhere(pair, caplog):
    session, endpoint = pair
    received, errors = [], []

    def receive(message):
        received.append(message.mean)
        if message.mean == 1.0:
            raise RuntimeError("an error of the caller")

    with spandrel.subscribe(
        "house", [spandrel.Parameter], receive, connect=endpoint, on_error=errors.append
    ) as messages:
        good, bad = publisher_of(session, 2), publisher_of(session, 9)
        good.put(parameter(1.0))
        bad.put(parameter(2.0))
        good.put(parameter(3.0))
        wait_until("two messages and an error", lambda: received == [1.0, 3.0] and errors)
        assert isinstance(errors[0], spandrel.UnsupportedVersion)
        assert "the callback of a subscription failed" in caplog.text
        with pytest.raises(ValueError):
            messages.receive()


def test_only_the_acknowledged_alert_confirms_an_acknowledgement(pair):
    session, endpoint = pair
    alert = {
        "structure": "house",
        "parameter": "storey-1",
        "time_ns": 5,
        "since_ns": 4,
        "rule_loss": 0.05,
        "rule_credibility": 0.99,
        "credibility": 1.0,
        "loss": 0.1,
        "loss_interval": {"level": 0.95, "low": 0.09, "high": 0.11},
        "mean": 0.9,
        "std": 0.003,
        "reference": 1.0,
        "reference_std": 0.0,
        "why": "it has lost 10 %",
    }
    key = "spandrel/house/alert/storey-1"
    received = []

    def confirm(sample):
        message = json.loads(sample.payload.to_string())
        received.append((message["who"], message["note"], str(sample.encoding)))
        # The alert service revises the alert at the same time.
        for state, who in (("raised", None), ("acknowledged", message["who"])):
            text = json.dumps({**alert, "state": state, "acknowledged_by": who})
            session.put(key, text, encoding="application/json;spandrel.alert.v2")

    subscriber = session.declare_subscriber(f"{key}/acknowledge", confirm)
    found = spandrel.acknowledge("house", "storey-1", "Ada", "seen", connect=endpoint)
    assert (found.state, found.acknowledged_by) == ("acknowledged", "Ada")
    assert received == [("Ada", "seen", "application/json;spandrel.acknowledgement.v1")]
    subscriber.undeclare()
