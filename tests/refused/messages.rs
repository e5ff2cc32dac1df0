//! Wrong messages on the topics of running services, among sound ones: they are dropped and
//! counted, and nothing else changes.

use super::table::{Table, code};
use crate::support::{
    DEADLINE, Drops, EstimateReader, Process, Sensors, Site, assert_same_bits, put_raw,
    two_storeys, within,
};
use spandrel_bus::{
    Acknowledgement, Bus, EstimateBlock, FrameBlock, Header, Keys, Message, Name, SampleBlock,
    Service, Status, StreamState, Subscription,
};
use std::collections::BTreeMap;

/// Number of rows of the record. Wrong messages come after the first [`BEFORE`].
const ROWS: usize = 600;
const BEFORE: usize = 300;
const SAMPLES: &str = "application/postcard;spandrel.samples.v1";
const SAMPLES_IN_JSON: &str = "application/json;spandrel.samples.v1";

/// Running services, sound sensors, and the published counts.
struct Running {
    site: Site,
    keys: Keys,
    services: Process,
    bus: Bus,
    statuses: Subscription<Status>,
    counted: BTreeMap<(String, String), u64>,
    sensors: Sensors,
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

impl Running {
    async fn start() -> Self {
        let site = Site::with(&two_storeys(
            "[ingest]\nlateness-s = 3600\ntolerance-s = 0.002\n",
        ));
        let record = site.simulate(ROWS as f64 / 100.0);
        let services = Process::start(site.listening("run").args(["--http", "127.0.0.1:0"]));
        services.wait_for_log("ready structures=1");
        let (bus, keys) = (site.join().await, site.keys());
        site.wait_for_services(&bus).await;
        let statuses = bus.subscribe(keys.all_statuses(), 256).await.unwrap();
        let sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
        Self {
            site,
            keys,
            services,
            bus,
            statuses,
            counted: BTreeMap::new(),
            sensors,
        }
    }

    /// Returns the block that `floor-1` will publish next.
    fn next_block(&mut self) -> SampleBlock {
        let record = self.sensors.record().clone();
        self.sensors
            .node("floor-1")
            .block(&record, BEFORE..BEFORE + 100)
    }

    /// Waits until a count of a service has increased. Returns the increase, or 0 after the
    /// deadline.
    async fn more_of(&mut self, service: &str, reason: &str) -> u64 {
        let key = (service.to_owned(), reason.to_owned());
        let before = self.counted.get(&key).copied().unwrap_or(0);
        let grown = async {
            loop {
                let (_, status) = self.statuses.messages().recv_async().await.unwrap();
                let count = status.drops.get(reason).copied().unwrap_or(0);
                if status.service.as_str() == service && count > before {
                    return count;
                }
            }
        };
        let count = tokio::time::timeout(DEADLINE, grown)
            .await
            .unwrap_or(before);
        self.counted.insert(key, count);
        count - before
    }

    /// Adds a published message that a service must count `expected` times under a reason.
    async fn add(
        &mut self,
        table: &mut Table,
        given: &str,
        (service, reason, expected): (&str, &str, u64),
    ) {
        let more = self.more_of(service, reason).await;
        let observed = format!("{service}: {reason} +{more}");
        let expected_text = format!(
            "dropped; {service} counts {} {expected} times",
            code(reason)
        );
        table.add(given, &expected_text, &observed, more == expected);
    }
}

pub async fn all(table: &mut Table) {
    let mut running = Running::start().await;
    let mut reader = EstimateReader::join(&running.bus, &running.keys).await;
    running.sensors.put(0..BEFORE).await;
    reader.read_frames(BEFORE).await;
    table.section("Messages on `sensor/NODE/samples`");
    samples(table, &mut running).await;
    table.section("Samples of a node among sound ones");
    let lost = values(table, &mut running).await;
    table.section("Messages on `frames` and `estimates`");
    frames(table, &mut running).await;
    table.section("Messages of people and for people");
    json(table, &mut running).await;
    table.section("Queries");
    queries(table, &running).await;

    // All samples that were not lost are identified as if nothing had happened.
    running.sensors.put(lost.end..ROWS).await;
    let mut equivalent = running.sensors.record().clone();
    let expected = running
        .site
        .estimate(equivalent.remove("floor-1", lost).save_as("equivalent.csv"));
    assert_same_bits(
        "bad messages",
        &expected.parameters,
        &expected.frames,
        reader.read_frames(ROWS).await,
    );
    estimates(table, &mut running).await;
    let log = running.services.log();
    assert!(!log.contains("panicked"), "{log}");
    assert!(
        ["spandrel.samples.v1", "spandrel.samples.v2"]
            .iter()
            .all(|version| log.contains(version)),
        "{log}"
    );
    running.services.stop().expect_code(0);
}

async fn samples(table: &mut Table, running: &mut Running) {
    let sound = running.next_block();
    let whole = sound.encode().unwrap();
    let changed = |change: &dyn Fn(&mut SampleBlock)| {
        let mut block = sound.clone();
        change(&mut block);
        postcard::to_stdvec(&block).unwrap()
    };
    let long = [whole.clone(), vec![0]].concat();
    let cut = whole[..whole.len() - 3].to_vec();
    let huge = vec![0; (8 << 20) + 1000];
    let ragged = changed(&|block| {
        block.channels = 3;
    });
    let foreign =
        changed(&|block| (block.header.source, block.header.epoch) = ("floor-7".into(), 7));
    let text = serde_json::to_string(&sound).unwrap();
    let rewritten = |from: &str, to: &str| {
        assert!(text.contains(from), "{text}");
        text.replacen(from, to, 1).into_bytes()
    };
    let key = running.keys.samples(&name("floor-1"));
    for (given, encoding, payload, counted) in [
        (
            "another version",
            "application/postcard;spandrel.samples.v2",
            whole.clone(),
            ("refused-encoding", 1),
        ),
        (
            "another type of message",
            "application/postcard;spandrel.frames.v1",
            whole.clone(),
            ("refused-encoding", 1),
        ),
        ("no encoding", "", whole.clone(), ("refused-encoding", 1)),
        ("nothing", SAMPLES, Vec::new(), ("refused-undecodable", 1)),
        (
            "three bytes too few",
            SAMPLES,
            cut,
            ("refused-undecodable", 1),
        ),
        ("one extra byte", SAMPLES, long, ("refused-undecodable", 1)),
        (
            "text",
            SAMPLES,
            b"{\"samples\": [1, 2, 3]}".to_vec(),
            ("refused-undecodable", 1),
        ),
        (
            "1 kB more than 8 MiB",
            SAMPLES,
            huge,
            ("refused-too-large", 1),
        ),
        (
            "a sampling rate of 0",
            SAMPLES,
            changed(&|block| block.sampling_rate_hz = 0.0),
            ("refused-malformed", 1),
        ),
        (
            "a sampling rate of NaN",
            SAMPLES,
            changed(&|block| block.sampling_rate_hz = f64::NAN),
            ("refused-malformed", 1),
        ),
        (
            "no channels",
            SAMPLES,
            changed(&|block| block.channels = 0),
            ("refused-malformed", 1),
        ),
        (
            "a number of samples that is not a multiple of the channels",
            SAMPLES,
            ragged,
            ("refused-malformed", 1),
        ),
        (
            "sequence numbers beyond the largest one",
            SAMPLES,
            changed(&|block| block.header.sequence = u64::MAX),
            ("refused-malformed", 1),
        ),
        (
            "another node, which started later",
            SAMPLES,
            foreign,
            ("foreign-blocks", 1),
        ),
        (
            "an earlier run of the node",
            SAMPLES,
            changed(&|block| block.header.epoch = 0),
            ("stale-blocks", 1),
        ),
        (
            "an epoch after the year 2262",
            SAMPLES,
            changed(&|block| block.header.epoch = u64::MAX),
            ("impossible-blocks", 1),
        ),
        (
            "a sequence number far ahead",
            SAMPLES,
            changed(&|block| block.header.sequence = 1 << 60),
            ("impossible-blocks", 1),
        ),
        (
            "JSON of another version",
            "application/json;spandrel.samples.v2",
            text.clone().into_bytes(),
            ("refused-encoding", 1),
        ),
        (
            "JSON with a misspelt field",
            SAMPLES_IN_JSON,
            rewritten("channels", "chanels"),
            ("refused-undecodable", 1),
        ),
        (
            "JSON whose rows have different lengths",
            SAMPLES_IN_JSON,
            rewritten("[[", "[[1.0,"),
            ("refused-undecodable", 1),
        ),
        (
            "JSON with `NaN`, as Python writes it",
            "application/json",
            rewritten("[[", "[[NaN],["),
            ("refused-undecodable", 1),
        ),
        (
            "JSON with a sampling rate of 0",
            "application/json",
            rewritten("\"sampling_rate_hz\":100.0", "\"sampling_rate_hz\":0"),
            ("refused-malformed", 1),
        ),
    ] {
        put_raw(&running.bus, &key, encoding, payload).await;
        running
            .add(table, given, ("ingest", counted.0, counted.1))
            .await;
    }
}

/// A change that makes a block wrong.
type Change<'a> = &'a dyn Fn(&mut SampleBlock);

/// Publishes samples of `floor-1` that no frame can use. Returns the lost rows.
async fn values(table: &mut Table, running: &mut Running) -> std::ops::Range<usize> {
    let mut row = BEFORE;
    // The number of rows for each kind. The other nodes are sound.
    const EACH: usize = 10;
    let kinds: [(&str, Change<'_>, (&str, u64)); 4] = [
        (
            "infinite values",
            &|block| block.samples.fill(f64::INFINITY),
            ("not-finite-values", 10),
        ),
        (
            "values beyond the range of the channel",
            &|block| block.samples.fill(1e6),
            ("out-of-range-values", 10),
        ),
        (
            "two channels instead of one",
            &|block| {
                block.channels = 2;
                block.samples = block
                    .samples
                    .iter()
                    .flat_map(|sample| [*sample; 2])
                    .collect();
            },
            ("wrong-channels", 1),
        ),
        (
            "times between two frames",
            &|block| block.header.time_ns += 4_000_000,
            ("off-grid-samples", 10),
        ),
    ];
    for (given, change, (reason, count)) in kinds {
        running
            .sensors
            .put_changed("floor-1", row..row + EACH, change)
            .await;
        running
            .sensors
            .put_all_but(&["floor-1"], row..row + EACH)
            .await;
        row += EACH;
        running.add(table, given, ("ingest", reason, count)).await;
    }
    // A block that is repeated after the next one.
    let again = {
        let record = running.sensors.record().clone();
        running
            .sensors
            .node("ground")
            .block(&record, row..row + EACH)
            .encode()
            .unwrap()
    };
    let key = running.keys.samples(&name("ground"));
    running
        .sensors
        .put_changed("floor-1", row..row + EACH, |block| {
            block.samples.fill(f64::NEG_INFINITY)
        })
        .await;
    running
        .sensors
        .put_all_but(&["floor-1"], row..row + EACH)
        .await;
    row += EACH;
    running
        .add(
            table,
            "negative infinities",
            ("ingest", "not-finite-values", 10),
        )
        .await;
    put_raw(&running.bus, &key, SAMPLES, again).await;
    running
        .add(
            table,
            "a duplicate block",
            ("ingest", "duplicate-items", 10),
        )
        .await;
    // A clock that was set forward and then back.
    running
        .sensors
        .put_changed("floor-1", row..row + EACH, |block| {
            block.header.time_ns += 86_400_000_000_000
        })
        .await;
    running
        .sensors
        .put_all_but(&["floor-1"], row..row + EACH)
        .await;
    row += EACH;
    running
        .sensors
        .put_changed("floor-1", row..row + EACH, |block| {
            block.samples.fill(f64::INFINITY)
        })
        .await;
    running
        .sensors
        .put_all_but(&["floor-1"], row..row + EACH)
        .await;
    row += EACH;
    running
        .add(
            table,
            "times of tomorrow, until the clock is right again",
            ("ingest", "retracted-samples", 10),
        )
        .await;
    BEFORE..row
}

async fn frames(table: &mut Table, running: &mut Running) {
    let key = running.keys.frames();
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
    let whole = block.encode().unwrap();
    let endless = postcard::to_stdvec(&FrameBlock {
        sampling_rate_hz: f64::INFINITY,
        ..block.clone()
    })
    .unwrap();
    for (given, encoding, payload, reason) in [
        (
            "frames of another version",
            "application/postcard;spandrel.frames.v9".to_owned(),
            whole.clone(),
            "refused-encoding",
        ),
        (
            "truncated frames",
            FrameBlock::encoding(),
            whole[..whole.len() - 5].to_vec(),
            "refused-undecodable",
        ),
        (
            "frames of an infinite rate",
            FrameBlock::encoding(),
            endless,
            "refused-malformed",
        ),
        (
            "frames of another structure",
            FrameBlock::encoding(),
            whole,
            "frames-of-another-structure",
        ),
    ] {
        put_raw(&running.bus, &key, &encoding, payload).await;
        running.add(table, given, ("identify", reason, 1)).await;
    }
    put_raw(
        &running.bus,
        &running.keys.estimates(),
        SAMPLES,
        vec![0; 40],
    )
    .await;
    running
        .add(
            table,
            "samples on the topic of estimates",
            ("alert", "refused-encoding", 1),
        )
        .await;
}

/// Runs last, because the reader of this test would accept an epoch that `alert` rejects.
async fn estimates(table: &mut Table, running: &mut Running) {
    table.section("Messages on `estimates` of a later life");
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
        &running.bus,
        &running.keys.estimates(),
        &EstimateBlock::encoding(),
        block.encode().unwrap(),
    )
    .await;
    running
        .add(
            table,
            "estimates of another structure",
            ("alert", "estimates-of-another-structure", 1),
        )
        .await;
    let parameters = running.site.structure().parameters().len();
    let forged = EstimateBlock {
        term: u64::MAX,
        parameters: parameters as u16,
        ..block
    };
    put_raw(
        &running.bus,
        &running.keys.estimates(),
        &EstimateBlock::encoding(),
        forged.encode().unwrap(),
    )
    .await;
    running
        .add(
            table,
            "estimates in a term after the year 2262",
            ("alert", "impossible-blocks", 1),
        )
        .await;
    // The message does not end anything.
    let drops = Drops::watch(&running.bus, &running.keys).await;
    let status = drops.when_done(Service::Alert, 0).await;
    assert_eq!(status.restarts, 0, "{status:?}");
}

async fn json(table: &mut Table, running: &mut Running) {
    let of = |parameter: &str| {
        let (structure, parameter) = (running.keys.structure().clone(), name(parameter));
        Acknowledgement {
            structure,
            parameter,
            time_ns: 0,
            who: "Ada".to_owned(),
            note: String::new(),
        }
        .encode()
        .unwrap()
    };
    let key = running.keys.acknowledge(&name("storey-1"));
    let elsewhere = running.keys.acknowledge(&name("storey-9"));
    let value = running.keys.parameter(&name("storey-1"));
    let status = running.keys.status(Service::Ingest, &name("ingest"));
    let mut long_key = running.keys.parameter(&name("storey-1"));
    long_key.push_str(&"-1".repeat(300));
    let json = "application/json";
    for (given, key, payload, (service, reason)) in [
        (
            "a displayed value that is not JSON",
            &value,
            b"0.85".to_vec(),
            ("dashboard", "refused-undecodable"),
        ),
        (
            "a displayed value with NaN",
            &value,
            b"{\"mean\": NaN}".to_vec(),
            ("dashboard", "refused-undecodable"),
        ),
        (
            "a status that is not JSON",
            &status,
            vec![0xff; 10],
            ("dashboard", "refused-undecodable"),
        ),
        (
            "a key of more than 512 bytes",
            &long_key,
            b"{}".to_vec(),
            ("dashboard", "refused-key-too-long"),
        ),
        (
            "an incomplete acknowledgement",
            &key,
            b"{\"who\": ".to_vec(),
            ("alert", "acknowledgement-undecodable"),
        ),
        (
            "an acknowledgement with a number instead of a name",
            &key,
            b"{\"who\": 7}".to_vec(),
            ("alert", "acknowledgement-undecodable"),
        ),
        (
            "an acknowledgement for another parameter",
            &key,
            of("storey-2"),
            ("alert", "acknowledgement-on-another-key"),
        ),
        (
            "an acknowledgement for an unknown parameter",
            &elsewhere,
            of("storey-9"),
            ("alert", "acknowledgement-on-another-key"),
        ),
        (
            "an acknowledgement without alert",
            &key,
            of("storey-1"),
            ("alert", "acknowledgement-without-alert"),
        ),
    ] {
        put_raw(&running.bus, key, json, payload).await;
        running.add(table, given, (service, reason, 1)).await;
    }
}

/// Sends invalid queries, which must be answered with the reason.
async fn queries(table: &mut Table, running: &Running) {
    let of_history = running.keys.history(&name("storey-1"));
    for (given, selector, told) in [
        (
            "frames after an invalid number",
            format!("{}?after=-1", running.keys.recording()),
            &["after", "-1"][..],
        ),
        (
            "frames up to an invalid limit",
            format!("{}?limit=many", running.keys.recording()),
            &["limit", "many"],
        ),
        (
            "estimates after an invalid number",
            format!("{}?after=x", running.keys.estimates_buffer()),
            &["after", "x"],
        ),
        (
            "a history with an invalid number of points",
            format!("{of_history}?points=none"),
            &["points", "none"],
        ),
        (
            "a history of an unknown kind",
            format!("{of_history}?kind=colour"),
            &["kind", "parameter, loss, noise"],
        ),
    ] {
        let replies = running
            .bus
            .session()
            .get(&selector)
            .timeout(DEADLINE)
            .await
            .unwrap();
        let refusal = match within("an answer", replies.recv_async()).await {
            Ok(reply) => match reply.result() {
                Err(refusal) => refusal.payload().try_to_string().unwrap().into_owned(),
                Ok(_) => "an answer as if nothing were wrong".to_owned(),
            },
            Err(_) => "no answer".to_owned(),
        };
        let is_right = told.iter().all(|part| refusal.contains(part));
        let named: Vec<String> = told.iter().map(|part| code(part)).collect();
        table.add(
            given,
            &format!("refused, naming {}", named.join(", ")),
            &refusal,
            is_right,
        );
    }
}
