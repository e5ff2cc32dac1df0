//! Faulty messages on the bus: the services drop and count them, and continue with the right
//! numbers.
//!
//! In each test, sound sensors send a record to a running `spandrel run`, and a fault occurs in the
//! middle. The estimates must be bit-identical to those of `spandrel estimate` for the record
//! without the lost samples.

use crate::support::{
    Drops, EstimateReader, Node, Process, Record, Sensors, Site, assert_same_bits, put_raw,
    two_storeys, within,
};
use spandrel_bus::{
    Acknowledgement, Bus, EstimateBlock, Event, EventKind, FrameBlock, Header, Keys, Message, Name,
    Pace, SampleBlock, Service, StreamState,
};
use std::collections::BTreeMap;
use std::ops::Range;

/// Encoding of sample blocks.
const SAMPLES: &str = "application/postcard;spandrel.samples.v1";
/// Number of rows of the record. The fault comes after the first [`BEFORE`].
const ROWS: usize = 800;
const BEFORE: usize = 400;

/// Running services, sound sensors, and a reader of the estimates.
struct Faulty {
    site: Site,
    keys: Keys,
    services: Process,
    bus: Bus,
    drops: Drops,
    reader: EstimateReader,
    sensors: Sensors,
    /// The record without the lost samples.
    equivalent: Record,
}

impl Faulty {
    /// Starts services that have identified the first [`BEFORE`] rows of the record.
    async fn start() -> Self {
        let mut faulty = Self::start_without_samples().await;
        faulty.put(0..BEFORE).await;
        faulty.identified(BEFORE).await;
        faulty
    }

    async fn start_without_samples() -> Self {
        let site = Site::with(&two_storeys(""));
        let record = site.simulate(ROWS as f64 / 100.0);
        let services = site.run();
        let (bus, keys) = (site.join().await, site.keys());
        site.wait_for_services(&bus).await;
        let drops = Drops::watch(&bus, &keys).await;
        let reader = EstimateReader::join(&bus, &keys).await;
        let sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
        Self {
            site,
            keys,
            services,
            bus,
            drops,
            reader,
            sensors,
            equivalent: record,
        }
    }

    /// Sends these rows from all nodes.
    async fn put(&mut self, rows: Range<usize>) {
        self.sensors.put(rows).await;
    }

    /// Publishes bytes on the sample topic of `floor-1`.
    async fn put_raw(&self, encoding: &str, payload: Vec<u8>) {
        put_raw(&self.bus, &self.floor_1(), encoding, payload).await;
    }

    fn floor_1(&self) -> String {
        self.keys.samples(&Name::new("floor-1").unwrap())
    }

    /// Returns the block that `floor-1` will publish next.
    fn next_block(&mut self) -> SampleBlock {
        let record = self.sensors.record().clone();
        self.sensors
            .node("floor-1")
            .block(&record, BEFORE..BEFORE + 100)
    }

    /// Waits until `count` frames have been identified.
    async fn identified(&mut self, count: usize) {
        self.reader.read_frames(count).await;
    }

    /// Waits until `alert` has decided on the whole record.
    async fn wait_for_decisions(&self) {
        let mut decided = self
            .bus
            .watch_progress(self.keys.progress(Service::Alert))
            .await
            .unwrap();
        within(
            "decision on all frames",
            decided.wait_for(|progress| progress.done >= ROWS as u64),
        )
        .await;
    }

    /// Sends the rest of the record, and compares all estimates with those of the equivalent
    /// record.
    async fn assert_goes_on(mut self, fault: &str) {
        self.put(BEFORE..ROWS).await;
        self.assert_sound(fault).await;
    }

    /// Compares all estimates with those of the equivalent record, and waits until they have been
    /// decided on.
    async fn assert_sound(mut self, fault: &str) {
        let expected = self
            .site
            .estimate(self.equivalent.save_as("equivalent.csv"));
        let found = self.reader.read_frames(ROWS).await;
        assert_same_bits(fault, &expected.parameters, &expected.frames, found);
        self.wait_for_decisions().await;
        let log = self.services.log();
        assert!(
            !log.contains("panicked"),
            "{fault}: a service panicked:\n{log}"
        );
        self.services.stop().expect_code(0);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_of_another_version_is_refused_on_every_stream() {
    let mut faulty = Faulty::start().await;
    let payload = faulty.next_block().encode().unwrap();
    let (frames, estimates) = (faulty.keys.frames(), faulty.keys.estimates());
    faulty
        .put_raw("application/postcard;spandrel.samples.v2", payload.clone())
        .await;
    put_raw(
        &faulty.bus,
        &frames,
        "application/postcard;spandrel.frames.v9",
        payload.clone(),
    )
    .await;
    put_raw(&faulty.bus, &estimates, SAMPLES, payload).await;
    for service in [Service::Ingest, Service::Identify, Service::Alert] {
        faulty.drops.expect(service, "refused-encoding", 1).await;
    }
    let log = faulty.services.log();
    let both = ["spandrel.samples.v1", "spandrel.samples.v2"];
    assert!(
        both.iter().all(|version| log.contains(version)),
        "the log names both versions:\n{log}"
    );
    faulty.assert_goes_on("message of another version").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_truncated_message_is_refused() {
    let mut faulty = Faulty::start().await;
    let mut payload = faulty.next_block().encode().unwrap();
    payload.truncate(payload.len() - 3);
    faulty.put_raw(SAMPLES, payload).await;
    faulty
        .drops
        .expect(Service::Ingest, "refused-undecodable", 1)
        .await;
    faulty.assert_goes_on("truncated message").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_with_trailing_bytes_is_refused() {
    let mut faulty = Faulty::start().await;
    let mut payload = faulty.next_block().encode().unwrap();
    payload.extend([0, 1, 2]);
    faulty.put_raw(SAMPLES, payload).await;
    faulty
        .drops
        .expect(Service::Ingest, "refused-undecodable", 1)
        .await;
    faulty.assert_goes_on("trailing bytes").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn random_bytes_are_refused() {
    const MESSAGES: u64 = 50;
    let faulty = Faulty::start().await;
    let mut state = 20_061_u32;
    let mut random = || {
        // The linear congruential generator of Numerical Recipes. Its upper bits are random enough
        // for this purpose.
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    for length in 0..MESSAGES {
        let payload = (0..40 * length).map(|_| random()).collect();
        faulty.put_raw(SAMPLES, payload).await;
    }
    faulty
        .drops
        .expect(Service::Ingest, "refused-undecodable", MESSAGES)
        .await;
    faulty.assert_goes_on("random bytes").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_block_without_a_rate_is_refused() {
    let mut faulty = Faulty::start().await;
    for sampling_rate_hz in [0.0, -100.0, f64::NAN, f64::INFINITY] {
        let block = SampleBlock {
            sampling_rate_hz,
            ..faulty.next_block()
        };
        faulty
            .put_raw(SAMPLES, postcard::to_stdvec(&block).unwrap())
            .await;
    }
    faulty
        .drops
        .expect(Service::Ingest, "refused-malformed", 4)
        .await;
    faulty.assert_goes_on("block without a rate").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_of_nine_megabytes_does_not_get_past_the_link() {
    let mut faulty = Faulty::start().await;
    faulty.put_raw(SAMPLES, vec![0; 9 << 20]).await;
    faulty.put(BEFORE..ROWS).await;
    // Zenoh drops the message before any service can count it. The samples behind it used the same
    // link, so a count of the message would be published with them.
    let status = faulty.drops.when_done(Service::Ingest, ROWS as u64).await;
    let refused = status
        .drops
        .iter()
        .filter(|(reason, _)| reason.starts_with("refused"));
    assert_eq!(refused.collect::<Vec<_>>(), [], "the message has arrived");
    faulty.assert_sound("message of 9 MiB").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_block_with_a_wrong_number_of_channels_is_missing() {
    let mut faulty = Faulty::start().await;
    let wrong = |block: &mut SampleBlock| {
        block.channels = 2;
        block.samples.extend_from_slice(&block.samples.clone());
    };
    faulty.sensors.put_changed("floor-1", 400..500, wrong).await;
    faulty.sensors.put_all_but(&["floor-1"], 400..500).await;
    faulty
        .drops
        .expect(Service::Ingest, "wrong-channels", 1)
        .await;
    faulty.equivalent.remove("floor-1", 400..500);
    faulty.put(500..ROWS).await;
    faulty.assert_sound("wrong number of channels").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn impossible_samples_are_missing() {
    let mut faulty = Faulty::start().await;
    let wrong = |block: &mut SampleBlock| {
        let values = [
            f64::NAN,
            f64::INFINITY,
            f64::NEG_INFINITY,
            1e6,
            -1e300,
            200.1,
        ];
        for (sample, value) in block.samples.iter_mut().zip(values) {
            *sample = value;
        }
    };
    faulty.sensors.put_changed("floor-1", 400..500, wrong).await;
    faulty.sensors.put_all_but(&["floor-1"], 400..500).await;
    faulty
        .drops
        .expect(Service::Ingest, "not-finite-values", 2)
        .await;
    faulty
        .drops
        .expect(Service::Ingest, "out-of-range-values", 3)
        .await;
    faulty.equivalent.remove("floor-1", 400..406);
    faulty.put(500..ROWS).await;
    faulty
        .assert_sound("samples that nobody can have measured")
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_block_of_a_foreign_node_is_refused() {
    let mut faulty = Faulty::start().await;
    let mut block = faulty.next_block();
    block.header.source = "floor-7".to_owned();
    faulty.put_raw(SAMPLES, block.encode().unwrap()).await;
    faulty
        .drops
        .expect(Service::Ingest, "foreign-blocks", 1)
        .await;
    faulty.assert_goes_on("foreign node").await;
}

/// The event gives the developer of a sensor the reason.
#[tokio::test(flavor = "multi_thread")]
async fn rejected_messages_of_a_node_are_an_event_with_the_reason() {
    let mut faulty = Faulty::start().await;
    let keys = faulty.keys.clone();
    let events = faulty
        .bus
        .subscribe::<Event>(keys.event(), 1024)
        .await
        .unwrap();
    let mut foreign = faulty.next_block();
    foreign.header.source = "floor-7".to_owned();
    faulty.put_raw(SAMPLES, foreign.encode().unwrap()).await;
    let mut wide = faulty.next_block();
    wide.channels = 3;
    wide.samples = wide.samples.repeat(3);
    wide.header.source = "roof".to_owned();
    let sent = [
        ("roof", SAMPLES, wide.encode().unwrap()),
        ("ground", "application/json", b"{\"channels\": 1}".to_vec()),
    ];
    for (node, encoding, payload) in sent {
        let key = keys.samples(&Name::new(node).unwrap());
        put_raw(&faulty.bus, &key, encoding, payload).await;
    }
    let mut reasons = BTreeMap::new();
    within("the events of three nodes", async {
        while reasons.len() < 3 {
            let (_, event) = events.messages().recv_async().await.unwrap();
            if event.kind == EventKind::SamplesDropped {
                assert_eq!(event.what, "messages of the node were rejected, 1 at first");
                reasons.insert(event.subject, event.why);
            }
        }
    })
    .await;
    println!("{reasons:#?}");
    let why = |node: &str| reasons[node].as_str();
    assert_eq!(
        why("floor-1"),
        "another source publishes on the topic of this node"
    );
    assert_eq!(
        why("roof"),
        "its blocks have another number of channels than the structure file states"
    );
    assert!(why("ground").contains("missing field"), "{}", why("ground"));
}

// A higher epoch in a foreign node's block must not make the node itself stale.
#[tokio::test(flavor = "multi_thread")]
async fn a_block_of_a_foreign_node_that_started_later_is_refused() {
    let mut faulty = Faulty::start().await;
    let mut block = faulty.next_block();
    (block.header.source, block.header.epoch) = ("floor-7".to_owned(), 7);
    faulty.put_raw(SAMPLES, block.encode().unwrap()).await;
    faulty
        .drops
        .expect(Service::Ingest, "foreign-blocks", 1)
        .await;
    faulty
        .assert_goes_on("foreign node that started later")
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_repeated_block_counts_once() {
    let mut faulty = Faulty::start().await;
    let again = faulty.next_block().encode().unwrap();
    faulty.put(BEFORE..BEFORE + 100).await;
    for _ in 0..3 {
        faulty.put_raw(SAMPLES, again.clone()).await;
    }
    faulty
        .drops
        .expect(Service::Ingest, "duplicate-items", 300)
        .await;
    faulty.put(BEFORE + 100..ROWS).await;
    faulty.assert_sound("blocks that come again").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_block_of_a_lower_epoch_is_refused() {
    let mut faulty = Faulty::start().await;
    let mut block = faulty.next_block();
    block.header.epoch = 0;
    faulty.put_raw(SAMPLES, block.encode().unwrap()).await;
    faulty
        .drops
        .expect(Service::Ingest, "stale-blocks", 1)
        .await;
    faulty.assert_goes_on("lower epoch").await;
}

// A node with a sequence number far ahead must not be given up, and its further blocks must not
// count as old.
#[tokio::test(flavor = "multi_thread")]
async fn a_block_numbered_far_ahead_of_its_node_is_refused() {
    let mut faulty = Faulty::start().await;
    let mut block = faulty.next_block();
    block.header.sequence = 1 << 60;
    faulty.put_raw(SAMPLES, block.encode().unwrap()).await;
    faulty
        .drops
        .expect(Service::Ingest, "impossible-blocks", 1)
        .await;
    faulty.assert_goes_on("block numbered far ahead").await;
}

// Frames of another structure file must not cause the filter to panic.
#[tokio::test(flavor = "multi_thread")]
async fn frames_of_another_structure_are_refused() {
    let faulty = Faulty::start().await;
    let block = FrameBlock {
        header: Header {
            source: "ingest".to_owned(),
            epoch: u64::MAX - 1,
            sequence: 0,
            time_ns: 0,
        },
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        channels: 2,
        values: vec![0.0; 20],
        state: StreamState::Running,
    };
    put_raw(
        &faulty.bus,
        &faulty.keys.frames(),
        &FrameBlock::encoding(),
        block.encode().unwrap(),
    )
    .await;
    faulty
        .drops
        .expect(Service::Identify, "frames-of-another-structure", 1)
        .await;
    faulty.assert_goes_on("frames of another structure").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn estimates_of_another_structure_are_refused() {
    let mut faulty = Faulty::start().await;
    let block = EstimateBlock {
        header: Header {
            source: "identify".to_owned(),
            epoch: u64::MAX - 1,
            sequence: 0,
            time_ns: 0,
        },
        term: 0,
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        parameters: 7,
        noise_parameters: 0,
        channels: 0,
        estimates: Vec::new(),
        state: StreamState::Running,
    };
    put_raw(
        &faulty.bus,
        &faulty.keys.estimates(),
        &EstimateBlock::encoding(),
        block.encode().unwrap(),
    )
    .await;
    faulty
        .drops
        .expect(Service::Alert, "estimates-of-another-structure", 1)
        .await;
    // The reader of this test accepts every epoch. The test checks that `alert` does not.
    faulty.put(BEFORE..ROWS).await;
    faulty.wait_for_decisions().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_failed_sensor_is_missing_until_it_returns() {
    let mut faulty = Faulty::start().await;
    let node = faulty.sensors.remove("floor-1");
    let (name, channels) = (node.name.clone(), node.channels().to_vec());
    drop(node);
    faulty.put(400..600).await;
    faulty.identified(600).await;
    let node = Node::start(&faulty.bus, &faulty.keys, name, channels, 2).await;
    faulty.sensors.add(node);
    // The samples stored during the outage arrive too late. The last one counts as a duplicate in
    // the frame just closed. Its count shows that the node is awaited again.
    faulty
        .sensors
        .put_changed("floor-1", 550..600, |_| {})
        .await;
    faulty
        .sensors
        .put_changed("floor-1", 600..650, |_| {})
        .await;
    faulty
        .drops
        .expect(Service::Ingest, "late-samples", 49)
        .await;
    faulty.sensors.put_all_but(&["floor-1"], 600..650).await;
    faulty.equivalent.remove("floor-1", 400..600);
    faulty.put(650..ROWS).await;
    faulty.assert_sound("sensor that dies and comes back").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lost_block_of_a_node_without_buffer_affects_no_other_samples() {
    const LOST: usize = 30;
    /// Number of samples that the node has published before the services start.
    const EARLIER: u64 = 5000;
    let site = Site::with(&two_storeys("[ingest]\nlateness-s = 3\n"));
    let mut record = site.simulate(8.0);
    let _services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let keys = site.keys();
    let drops = Drops::watch(&bus, &keys).await;
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let name = |text: &str| Name::new(text).unwrap();
    let channels = |names: &[&str]| {
        names
            .iter()
            .map(|name| (*name).to_owned())
            .collect::<Vec<_>>()
    };
    let mut ground = Node::start(&bus, &keys, name("ground"), channels(&["ground"]), 1).await;
    let mut roof = Node::start(
        &bus,
        &keys,
        name("roof"),
        channels(&["roof", "roof-velocity"]),
        1,
    )
    .await;
    // A hand-written node publishes its samples in this way: lost blocks cannot be queried.
    let key = keys.samples(&name("floor-1"));
    let rows = |block: usize| 10 * block..10 * block + 10;
    let bare = |block: usize| SampleBlock {
        header: Header {
            source: "floor-1".to_owned(),
            epoch: 1,
            sequence: EARLIER + rows(block).start as u64,
            time_ns: record.time_ns(rows(block).start),
        },
        sampling_rate_hz: 100.0,
        pace: Pace::Live,
        channels: 1,
        samples: rows(block)
            .map(|row| record.value(row, "floor-1"))
            .collect(),
        state: StreamState::Running,
        clock_quality: None,
    };
    // Live samples arrive in real time, a block every 100 ms.
    let start = tokio::time::Instant::now();
    for block in 0..80 {
        tokio::time::sleep_until(start + std::time::Duration::from_millis(100 * block as u64))
            .await;
        for node in [&mut ground, &mut roof] {
            let put = node.block(&record, rows(block));
            node.put(put).await;
        }
        if block != LOST {
            put_raw(&bus, &key, SAMPLES, bare(block).encode().unwrap()).await;
        }
    }
    // The last frames wait for samples that may still arrive.
    let streamed = reader.read_frames(750).await;
    record.remove("floor-1", rows(LOST)).save_as("without.csv");
    let offline = site.estimate(&record);
    assert_same_bits(
        "the services",
        &offline.parameters,
        &offline.frames[..750],
        &streamed[..750],
    );
    let drops = drops.expect(Service::Ingest, "lost-items", 10).await;
    // Regression: ingest counted the earlier samples as lost.
    assert_eq!(drops["lost-items"], 10, "{drops:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn ingest_waits_for_a_silent_sensor_for_the_declared_lateness() {
    let site = Site::with(&two_storeys("[ingest]\nlateness-s = 0.5\n"));
    let record = site.simulate(4.0);
    let _services = site.run();
    let (bus, keys) = (site.join().await, site.keys());
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let mut sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
    sensors.put(0..200).await;
    sensors.put_all_but(&["floor-1"], 200..400).await; // its token still exists
    let mut equivalent = record.clone();
    let expected = site.estimate(
        equivalent
            .remove("floor-1", 200..400)
            .save_as("equivalent.csv"),
    );
    assert_same_bits(
        "silent sensor",
        &expected.parameters,
        &expected.frames,
        reader.read_frames(400).await,
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sensor_is_missing_while_its_clock_is_wrong() {
    let shifted = |seconds: i64| {
        move |block: &mut SampleBlock| block.header.time_ns += seconds * 1_000_000_000
    };
    let mut faulty = Faulty::start().await;
    for (rows, seconds) in [
        (400..420, 5),
        (420..440, -2),
        (440..460, -100_000),
        (460..480, 100_000),
    ] {
        faulty
            .sensors
            .put_changed("floor-1", rows.clone(), shifted(seconds))
            .await;
        faulty.sensors.put_all_but(&["floor-1"], rows).await;
    }
    // Once its clock is right, the node withdraws its samples from the future and is awaited again.
    faulty
        .sensors
        .put_changed("floor-1", 480..ROWS, |_| {})
        .await;
    faulty
        .drops
        .expect(Service::Ingest, "retracted-samples", 40)
        .await;
    faulty.sensors.put_all_but(&["floor-1"], 480..ROWS).await;
    faulty
        .drops
        .expect(Service::Ingest, "late-samples", 40)
        .await;
    faulty.equivalent.remove("floor-1", 400..480);
    faulty.assert_sound("clock that jumps").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn times_at_the_ends_of_the_range_give_no_frame() {
    let mut faulty = Faulty::start().await;
    for (rows, time_ns) in [
        (400..410, i64::MAX),
        (410..420, i64::MIN),
        (420..430, i64::MAX - 50_000_000),
    ] {
        faulty
            .sensors
            .put_changed("floor-1", rows.clone(), |block| {
                block.header.time_ns = time_ns
            })
            .await;
        faulty.sensors.put_all_but(&["floor-1"], rows).await;
    }
    faulty
        .sensors
        .put_changed("floor-1", 430..ROWS, |_| {})
        .await;
    faulty
        .drops
        .expect(Service::Ingest, "retracted-samples", 20)
        .await;
    faulty.sensors.put_all_but(&["floor-1"], 430..ROWS).await;
    faulty.equivalent.remove("floor-1", 400..430);
    faulty.assert_sound("times at the ends of the scale").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_acknowledgement_without_alert_is_counted() {
    let faulty = Faulty::start().await;
    let name = |text: &str| Name::new(text).unwrap();
    let of = |parameter: &str| Acknowledgement {
        structure: faulty.keys.structure().clone(),
        parameter: name(parameter),
        time_ns: 0,
        who: "anna".to_owned(),
        note: String::new(),
    };
    let (known, unknown) = (
        faulty.keys.acknowledge(&name("storey-1")),
        faulty.keys.acknowledge(&name("storey-9")),
    );
    // PostgreSQL rejects text with a zero byte and names of several kilobytes.
    let of_structure = |who: &str| {
        let structure = faulty.keys.structure();
        format!("{{\"structure\":\"{structure}\",\"parameter\":\"storey-1\",\"time_ns\":0,\"who\":\"{who}\"}}")
            .into_bytes()
    };
    for (key, payload, reason) in [
        (
            &unknown,
            of("storey-9").encode().unwrap(),
            "acknowledgement-on-another-key",
        ),
        (
            &known,
            of("storey-2").encode().unwrap(),
            "acknowledgement-on-another-key",
        ),
        (
            &known,
            of("storey-1").encode().unwrap(),
            "acknowledgement-without-alert",
        ),
        (
            &known,
            b"{\"who\": ".to_vec(),
            "acknowledgement-undecodable",
        ),
        (
            &known,
            b"{\"who\": 7}".to_vec(),
            "acknowledgement-undecodable",
        ),
        (
            &known,
            of_structure("Ada\\u0000"),
            "acknowledgement-malformed",
        ),
        (
            &known,
            of_structure(&"a".repeat(600)),
            "acknowledgement-malformed",
        ),
    ] {
        put_raw(&faulty.bus, key, "application/json", payload).await;
        faulty.drops.expect(Service::Alert, reason, 1).await;
    }
    faulty.assert_goes_on("acknowledgement of nothing").await;
}

// By default, a failed write to the log panics.
#[tokio::test(flavor = "multi_thread")]
async fn a_log_without_reader_stops_no_service() {
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(8.0);
    let services = Process::start_with_closed_log(&mut site.listening("run"));
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    site.replay(&record, "max").wait().expect_code(0);
    assert_eq!(
        reader.read_to_end(1).await.len(),
        record.len(),
        "frames identified"
    );
    services.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_error_names_an_invalid_range_in_a_query_for_frames() {
    let faulty = Faulty::start().await;
    let selector = format!("{}?after=-1;limit=many", faulty.keys.recording());
    let replies = faulty.bus.session().get(&selector).await.unwrap();
    let reply = within("answer to a query", replies.recv_async())
        .await
        .unwrap();
    let refusal = reply
        .result()
        .unwrap_err()
        .payload()
        .try_to_string()
        .unwrap()
        .into_owned();
    assert!(
        refusal.contains("after") && refusal.contains("-1"),
        "expected after and -1, found {refusal}"
    );
    faulty.assert_goes_on("query that is no range").await;
}
