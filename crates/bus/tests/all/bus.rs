//! Two real Zenoh sessions over TCP on the loopback interface, without multicast.

use std::net::TcpListener;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use spandrel_bus::{
    Block, Bus, BusConfig, BusError, Delivery, Event, EventKind, Forget, FrameBlock, Gap, Header,
    Keep, Keys, Message, Mode, Name, NumberedPublisher, NumberedStream, SampleBlock, Service,
    Start, Stream, StreamSettings, StreamState,
};
use tokio::time::timeout;
use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::query::Query;

/// Limits the duration of a hanging test.
const DEADLINE: Duration = Duration::from_secs(180);

fn free_endpoint() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    format!("tcp/{}", listener.local_addr().unwrap())
}

fn listening(endpoint: &str) -> BusConfig {
    BusConfig {
        listen: vec![endpoint.into()],
        ..BusConfig::default()
    }
}

fn connecting(endpoint: &str) -> BusConfig {
    BusConfig {
        connect: vec![endpoint.into()],
        ..BusConfig::default()
    }
}

async fn pair() -> (Bus, Bus) {
    let endpoint = free_endpoint();
    let first = Bus::open(&listening(&endpoint)).await.unwrap();
    let second = Bus::open(&connecting(&endpoint)).await.unwrap();
    (first, second)
}

fn keys() -> Keys {
    Keys::parse("test", "tower").unwrap()
}

fn frames(epoch: u64, sequence: u64, count: u64) -> FrameBlock {
    FrameBlock {
        header: Header {
            source: "source".into(),
            epoch,
            sequence,
            time_ns: (sequence * 5_000_000) as i64,
        },
        t0_ns: 0,
        sampling_rate_hz: 200.0,
        channels: 1,
        values: (sequence..sequence + count).map(|v| v as f64).collect(),
        state: StreamState::Running,
    }
}

async fn publisher(bus: &Bus, capacity: u64) -> NumberedPublisher<FrameBlock> {
    publisher_that_keeps(bus, Keep::last(capacity)).await
}

async fn publisher_that_keeps(bus: &Bus, keep: Keep) -> NumberedPublisher<FrameBlock> {
    let stream = NumberedStream {
        key: keys().frames(),
        buffer_key: keys().recording(),
        source: "source".into(),
        epoch: 1,
        first: 0,
        state: StreamState::Running,
        keep,
    };
    bus.publish_numbered(stream).await.unwrap()
}

async fn reader(bus: &Bus, settings: StreamSettings) -> Stream<FrameBlock> {
    bus.follow(keys().frames(), keys().recording(), settings)
        .await
        .unwrap()
}

/// Reads up to item `end`. All items must arrive, in order.
async fn read_all(stream: &Stream<FrameBlock>, end: u64) {
    read_from(0, stream, end).await;
}

async fn read_from(first: u64, stream: &Stream<FrameBlock>, end: u64) {
    let mut next = first;
    while next < end {
        let delivery = timeout(DEADLINE, stream.deliveries().recv_async()).await;
        match delivery.expect("the stream hangs").unwrap() {
            Delivery::Block(block) => {
                assert_eq!(block.header.sequence, next);
                let expected: Vec<f64> = (next..block.end()).map(|v| v as f64).collect();
                assert_eq!(block.values, expected);
                next = block.end();
            }
            Delivery::Gap(gap) => panic!("{gap:?}"),
        }
    }
    assert_eq!(next, end);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_that_joins_late_gets_everything() {
    let (first, second) = pair().await;
    let publisher = publisher(&first, 10_000).await;
    for block in 0..100 {
        publisher.put(frames(1, block * 10, 10)).await.unwrap();
    }
    let stream = reader(&second, StreamSettings::new(Start::Beginning)).await;
    read_all(&stream, 1000).await;
    publisher.put(frames(1, 1000, 5)).await.unwrap();
    let last = timeout(DEADLINE, stream.deliveries().recv_async()).await;
    assert_eq!(last.unwrap(), Ok(Delivery::Block(frames(1, 1000, 5))));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_that_stalls_loses_nothing() {
    let (first, second) = pair().await;
    let publisher = publisher(&first, 100_000).await;
    let settings = StreamSettings {
        queue: 2,
        deliveries: 1,
        fetch_limit: 500,
        ..StreamSettings::new(Start::Beginning)
    };
    let stream = reader(&second, settings).await;
    for block in 0..5_000 {
        publisher.put(frames(1, block * 10, 10)).await.unwrap();
    }
    read_all(&stream, 50_000).await;
    assert!(stream.counts().follow.fetched_items > 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_in_the_same_session_that_stalls_loses_nothing() {
    let bus = Bus::open(&listening(&free_endpoint())).await.unwrap();
    let publisher = publisher(&bus, 100_000).await;
    let settings = StreamSettings {
        queue: 2,
        deliveries: 1,
        ..StreamSettings::new(Start::Beginning)
    };
    let stream = reader(&bus, settings).await;
    for block in 0..1_000 {
        publisher.put(frames(1, block * 10, 10)).await.unwrap();
    }
    read_all(&stream, 10_000).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_returning_reader_receives_all_unread_items_although_the_ring_drops_read_ones() {
    let (first, second) = pair().await;
    let keep = Keep {
        released: Some(Forget {
            at_least: 0,
            after: Duration::ZERO,
        }),
        ..Keep::last(10_000)
    };
    let publisher = publisher_that_keeps(&first, keep).await;
    for block in 0..100 {
        publisher.release(1, 10 * block.min(30));
        publisher.put(frames(1, block * 10, 10)).await.unwrap();
    }
    let back = StreamSettings::new(Start::At {
        epoch: 1,
        sequence: 300,
    });
    read_from(300, &reader(&second, back).await, 1000).await;
    let new = reader(&second, StreamSettings::new(Start::Beginning)).await;
    let delivery = timeout(DEADLINE, new.deliveries().recv_async()).await;
    let forgotten = Gap {
        epoch: 1,
        from: 0,
        to: 300,
    };
    assert_eq!(
        delivery.unwrap(),
        Ok(Delivery::Gap(forgotten)),
        "items that every reader has released"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn items_that_the_ring_has_dropped_are_a_gap() {
    let endpoint = free_endpoint();
    let first = Bus::open(&listening(&endpoint)).await.unwrap();
    let publisher = publisher(&first, 10).await;
    for block in 0..10 {
        publisher.put(frames(1, block * 10, 10)).await.unwrap();
    }
    let second = Bus::open(&connecting(&endpoint)).await.unwrap();
    let stream = reader(&second, StreamSettings::new(Start::Beginning)).await;
    let delivery = timeout(DEADLINE, stream.deliveries().recv_async()).await;
    let Ok(Ok(Delivery::Gap(gap))) = delivery else {
        panic!("{delivery:?}");
    };
    assert_eq!((gap.epoch, gap.from, gap.to), (1, 0, 90));
}

/// Declares the publisher of a foreign program, which stores nothing. Waits for a reader.
async fn publisher_by_hand(bus: &Bus) -> Publisher<'static> {
    let declared = bus
        .session()
        .declare_publisher(keys().frames())
        .encoding(FrameBlock::encoding());
    let publisher = declared
        .congestion_control(CongestionControl::Block)
        .await
        .unwrap();
    let readers = publisher.matching_listener().await.unwrap();
    while !timeout(DEADLINE, readers.recv_async())
        .await
        .expect("no reader")
        .unwrap()
        .matching()
    {}
    publisher
}

/// Returns the numbers of the received items up to item `end`, or `None` for each lost number.
async fn numbers_up_to(stream: &Stream<FrameBlock>, end: u64) -> Vec<Option<u64>> {
    let mut numbers = Vec::new();
    while (numbers.len() as u64) < end {
        let delivery = timeout(DEADLINE, stream.deliveries().recv_async()).await;
        match delivery.expect("the stream hangs").unwrap() {
            Delivery::Block(block) => {
                numbers.extend(block.values.iter().map(|value| Some(*value as u64)))
            }
            Delivery::Gap(gap) => numbers.extend((gap.from..gap.to).map(|_| None)),
        }
    }
    numbers
}

#[tokio::test(flavor = "multi_thread")]
async fn a_source_without_buffer_loses_only_the_blocks_that_it_did_not_send() {
    let (first, second) = pair().await;
    let stream = reader(&second, StreamSettings::new(Start::Beginning)).await;
    let publisher = publisher_by_hand(&first).await;
    // The number of blocks fits into the reader's queue and into its buffer after a gap.
    for block in (0..100).filter(|block| ![3, 70].contains(block)) {
        publisher
            .put(frames(1, block * 10, 10).encode().unwrap())
            .await
            .unwrap();
    }
    let numbers = numbers_up_to(&stream, 1_000).await;
    let is_lost = |number: u64| [3, 70].contains(&(number / 10));
    let lost = |numbers: &[Option<u64>]| numbers.iter().filter(|number| number.is_none()).count();
    assert_eq!(lost(&numbers), 20, "items lost");
    assert_eq!(
        numbers,
        (0..1_000)
            .map(|number| (!is_lost(number)).then_some(number))
            .collect::<Vec<_>>()
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_source_that_does_not_reply_at_first_loses_nothing() {
    const UNANSWERED: usize = 5;
    let (first, second) = pair().await;
    let asked = Arc::new(AtomicUsize::new(0));
    let (counted, missed) = (asked.clone(), frames(1, 5, 5).encode().unwrap());
    let answer = move |query: Query| {
        // A dropped query ends without a reply, as if there were no source.
        if counted.fetch_add(1, Ordering::Relaxed) >= UNANSWERED {
            let key = query.key_expr().clone();
            query
                .reply(key, missed.clone())
                .encoding(FrameBlock::encoding())
                .wait()
                .unwrap();
        }
    };
    let _buffer = first
        .session()
        .declare_queryable(keys().recording())
        .callback(answer)
        .await
        .unwrap();
    let stream = reader(&second, StreamSettings::new(Start::Beginning)).await;
    let publisher = publisher_by_hand(&first).await;
    publisher
        .put(frames(1, 0, 5).encode().unwrap())
        .await
        .unwrap();
    publisher
        .put(frames(1, 10, 5).encode().unwrap())
        .await
        .unwrap();
    read_all(&stream, 15).await;
    assert!(asked.load(Ordering::Relaxed) > UNANSWERED);
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_versions_and_damaged_messages_are_counted_and_dropped() {
    let (first, second) = pair().await;
    let publisher = publisher(&first, 1000).await;
    let stream = reader(&second, StreamSettings::new(Start::Beginning)).await;
    publisher.put(frames(1, 0, 5)).await.unwrap();
    read_all(&stream, 5).await;
    let payload = frames(1, 5, 5).encode().unwrap();
    let truncated = payload[..payload.len() - 3].to_vec();
    let put = |payload: Vec<u8>, encoding: String| {
        let put = first.session().put(keys().frames(), payload);
        put.encoding(encoding)
            .congestion_control(CongestionControl::Block)
    };
    put(payload, "application/postcard;spandrel.frames.v9".into())
        .await
        .unwrap();
    put(truncated, FrameBlock::encoding()).await.unwrap();
    put(vec![0xff; 300], FrameBlock::encoding()).await.unwrap();
    publisher.put(frames(1, 5, 5)).await.unwrap();
    let delivery = timeout(DEADLINE, stream.deliveries().recv_async()).await;
    assert_eq!(delivery.unwrap(), Ok(Delivery::Block(frames(1, 5, 5))));
    // Messages of two publishers may overtake each other.
    let counted = async {
        loop {
            let refused = stream.counts().refused;
            if refused.get("encoding") == Some(&1) && refused.get("undecodable") == Some(&2) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    let counted = timeout(DEADLINE, counted).await;
    assert!(counted.is_ok(), "{:?}", stream.counts().refused);
}

/// Returns one block of a script, with one channel and the samples `sequence`, `sequence + 1`, …
fn text_of_samples(sequence: u64, count: u64) -> String {
    let samples: Vec<u64> = (sequence..sequence + count).collect();
    format!(
        r#"{{"source":"roof","epoch":1,"sequence":{sequence},"time_ns":{},"sampling_rate_hz":100,"samples":{samples:?}}}"#,
        sequence * 10_000_000
    )
}

#[tokio::test(flavor = "multi_thread")]
async fn a_script_that_publishes_and_replies_in_json_loses_nothing() {
    let (first, second) = pair().await;
    let roof = Name::new("roof").unwrap();
    let answer = move |query: Query| {
        let parameters = query.parameters().as_str().to_owned();
        let after = parameters.split(['=', ';']).nth(1).unwrap();
        let (text, kind) = match after.parse::<u64>().unwrap() {
            5..10 => (text_of_samples(5, 5), "samples"),
            _ => (
                r#"{"source":"roof","epoch":1,"sequence":15}"#.to_owned(),
                "caught-up",
            ),
        };
        let key = query.key_expr().clone();
        let reply = query.reply(key, text);
        reply
            .encoding(format!("application/json;spandrel.{kind}.v1"))
            .wait()
            .unwrap();
    };
    let buffer = first.session().declare_queryable(keys().buffer(&roof));
    let _buffer = buffer.callback(answer).await.unwrap();
    let settings = StreamSettings::new(Start::Beginning);
    let (key, buffer_key) = (keys().samples(&roof), keys().buffer(&roof));
    let stream = second
        .follow::<SampleBlock>(key.clone(), buffer_key, settings)
        .await
        .unwrap();
    let publisher = first.session().declare_publisher(key);
    let publisher = publisher.encoding("application/json").await.unwrap();
    let readers = publisher.matching_listener().await.unwrap();
    let matching = timeout(DEADLINE, readers.recv_async()).await;
    assert!(matching.expect("no reader").unwrap().matching());
    publisher.put(text_of_samples(0, 5)).await.unwrap();
    publisher
        .put("{\"source\":\"roof\",\"samples\":[1]}")
        .await
        .unwrap();
    publisher.put(text_of_samples(10, 5)).await.unwrap();
    let mut found = Vec::new();
    while found.len() < 15 {
        let delivery = timeout(DEADLINE, stream.deliveries().recv_async()).await;
        match delivery.expect("the stream hangs").unwrap() {
            Delivery::Block(block) => found.extend(block.samples),
            Delivery::Gap(gap) => panic!("{gap:?}"),
        }
    }
    assert_eq!(found, (0..15).map(f64::from).collect::<Vec<_>>());
    let refused = stream.counts().refused;
    assert_eq!(refused.get("undecodable"), Some(&1), "{refused:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restarted_source_starts_a_new_epoch() {
    let (first, second) = pair().await;
    let stream = reader(&second, StreamSettings::new(Start::Beginning)).await;
    let publisher_1 = publisher(&first, 1000).await;
    publisher_1.put(frames(1, 0, 5)).await.unwrap();
    read_all(&stream, 5).await;
    drop(publisher_1);
    let publisher_2 = publisher(&first, 1000).await;
    publisher_2.put(frames(2, 0, 3)).await.unwrap();
    let delivery = timeout(DEADLINE, stream.deliveries().recv_async()).await;
    assert_eq!(delivery.unwrap(), Ok(Delivery::Block(frames(2, 0, 3))));
}

#[tokio::test(flavor = "multi_thread")]
async fn tokens_appear_and_disappear() {
    let (first, second) = pair().await;
    let id = "one".parse().unwrap();
    let all = keys().all_live(Service::Ingest);
    let mut watch = second.watch_live(all).await.unwrap();
    assert!(watch.present().is_empty());
    let key = keys().live(Service::Ingest, &id);
    let token = first.announce(key.clone()).await.unwrap();
    timeout(DEADLINE, watch.some()).await.unwrap();
    assert_eq!(watch.present().into_iter().collect::<Vec<_>>(), [key]);
    token.withdraw().await.unwrap();
    timeout(DEADLINE, watch.none()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn tokens_are_seen_in_the_session_that_holds_them() {
    let bus = Bus::open(&listening(&free_endpoint())).await.unwrap();
    let mut early = bus
        .watch_live(keys().all_live(Service::Ingest))
        .await
        .unwrap();
    let key = keys().live(Service::Ingest, &"one".parse().unwrap());
    let token = bus.announce(key).await.unwrap();
    timeout(DEADLINE, early.some()).await.unwrap();
    let mut late = bus
        .watch_live(keys().all_live(Service::Ingest))
        .await
        .unwrap();
    timeout(DEADLINE, late.some()).await.unwrap();
    token.withdraw().await.unwrap();
    timeout(DEADLINE, early.none()).await.unwrap();
    timeout(DEADLINE, late.none()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn progress_reaches_a_subscriber_that_joins_later() {
    let (first, second) = pair().await;
    let key = keys().progress(Service::Identify);
    let publisher = first.publish_progress(key.clone(), "identify-1".into());
    let publisher = publisher.await.unwrap();
    publisher.set(1, 7, 1234);
    let mut watch = second.watch_progress(key).await.unwrap();
    let progress = timeout(DEADLINE, watch.wait_for(|p| p.done >= 7)).await;
    assert_eq!(progress.unwrap().header.time_ns, 1234);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_query_returns_the_latest_value_under_its_own_key() {
    let (first, second) = pair().await;
    let name = "storey-2".parse().unwrap();
    let publisher = first.publish_latest::<Event>(keys().alert(&name));
    let publisher = publisher.await.unwrap();
    let event = Event {
        structure: "tower".parse().unwrap(),
        time_ns: 1,
        kind: EventKind::Restart,
        subject: "filter".into(),
        what: "restarted".into(),
        why: "diverged".into(),
    };
    publisher.put(&event).await.unwrap();
    let ask_until_answered = async {
        loop {
            // Without a reply, the declaration of the queryable has not yet arrived.
            let found = second
                .ask::<Event>(&keys().all_alerts(), DEADLINE)
                .await
                .unwrap();
            if !found.is_empty() {
                return found;
            }
        }
    };
    let found = timeout(DEADLINE, ask_until_answered).await.unwrap();
    assert_eq!(found, [(keys().alert(&name), event)]);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_error_names_a_port_in_use() {
    let endpoint = free_endpoint();
    let _first = Bus::open(&listening(&endpoint)).await.unwrap();
    let opened = timeout(DEADLINE, Bus::open(&listening(&endpoint))).await;
    match opened.expect("opening hangs") {
        Err(BusError::Listen {
            endpoint: found, ..
        }) => assert_eq!(found, endpoint),
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_error_names_an_endpoint_without_reply() {
    let endpoint = free_endpoint();
    for mode in [Mode::Peer, Mode::Client] {
        let config = BusConfig {
            mode,
            connect_timeout_s: Some(0.5),
            ..connecting(&endpoint)
        };
        let opened = timeout(DEADLINE, Bus::open(&config)).await;
        match opened.expect("opening hangs") {
            Err(BusError::Unreachable {
                endpoint: found, ..
            }) => assert_eq!(found, endpoint),
            other => panic!("{other:?}"),
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_talks_to_another_through_a_router() {
    let endpoint = free_endpoint();
    let router = BusConfig {
        mode: Mode::Router,
        ..listening(&endpoint)
    };
    let _router = Bus::open(&router).await.unwrap();
    let client = BusConfig {
        mode: Mode::Client,
        ..connecting(&endpoint)
    };
    let first = Bus::open(&client).await.unwrap();
    let second = Bus::open(&client).await.unwrap();
    let publisher = publisher(&first, 1000).await;
    let stream = reader(&second, StreamSettings::new(Start::Beginning)).await;
    publisher.put(frames(1, 0, 5)).await.unwrap();
    read_all(&stream, 5).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_of_a_flooding_source_are_dropped_and_counted() {
    const PUT: u64 = 150_000;
    let bus = Bus::open(&listening(&free_endpoint())).await.unwrap();
    let key = keys().event();
    let reader = bus
        .subscribe::<Event>(key.clone(), PUT as usize)
        .await
        .unwrap();
    let event = Event {
        structure: keys().structure().clone(),
        time_ns: 0,
        kind: EventKind::Gap,
        subject: "tower".into(),
        what: "flood".into(),
        why: "it can".into(),
    };
    let publisher = bus.publish_display::<Event>(key).await.unwrap();
    #[expect(clippy::disallowed_methods, reason = "the limit uses the wall clock")]
    let start = std::time::Instant::now();
    for _ in 0..PUT {
        publisher.put(&event).await.unwrap();
    }
    let flooded = reader.refused().get("flood").copied().unwrap_or(0);
    let taken = reader.messages().len() as u64;
    // The limit is 20,000 at once and 10,000 per elapsed second. One second covers the rounding at
    // both ends.
    let allowed = 30_000 + 10_000 * start.elapsed().as_secs() + 10_000;
    assert_eq!(taken + flooded, PUT);
    assert!(
        taken <= allowed,
        "{taken} messages were taken, {allowed} are allowed"
    );
    bus.close().await.unwrap();
}
