//! Time spans of the series, as JSON and CSV, from the page, the history and the recording. Another
//! test reads the log of a period.

use super::{DEADLINE, Site, name};
use serde_json::{Value, json};
use spandrel_bus::{
    AlertState, FrameBlock, Header, HistoryRows, HistorySpan, Keep, NumberedStream, StreamState,
};
use spandrel_service::ServiceInstance;

#[tokio::test(flavor = "multi_thread")]
async fn history_is_served_as_json_and_csv() {
    let site = Site::start().await;
    for second in 1..=10 {
        site.put(second, 1.0 - 0.01 * second as f64).await;
    }
    site.wait("all points", |found| found["time_s"] == 10.0)
        .await;
    let path = "/api/structures/demo/history?series=parameter/storey-2&from=3&to=5";
    let span = site.get(path).await.json();
    assert_eq!(span["series"][0]["data"][0], json!([3.0, 4.0, 5.0]));
    assert_eq!(span["kept_from_s"], 1.0);
    let csv = site.get(&format!("{path}&format=csv")).await;
    assert!(
        csv.head.contains("content-type: text/csv") && csv.head.contains("filename=\"demo.csv\""),
        "{}",
        csv.head
    );
    let lines: Vec<&str> = csv.body.lines().collect();
    assert_eq!((lines.len(), &lines[1][..7]), (4, "3,0.97,"));
    site.end().await;
}

/// Regression test: waveforms from before the start of the page were empty, without a reason.
#[tokio::test(flavor = "multi_thread")]
async fn waveforms_from_before_the_start_are_those_of_the_recording() {
    const CHANNELS: u16 = 6;
    let site = Site::start().await;
    let path = "/api/structures/demo/history?series=waveform/floor-1&from=0.5&to=1.5&points=10";
    let span = site.get(path).await.json();
    assert_eq!(span["series"][0]["data"], json!([[], [], []]));
    assert_eq!(
        span["unread_waveforms"],
        "the service ingest does not answer"
    );
    site.get(&format!("{path}&format=csv"))
        .await
        .expect_refused(503, "the service ingest does not answer");

    let stream = NumberedStream {
        key: site.keys.frames(),
        buffer_key: site.keys.recording(),
        source: "ingest".to_owned(),
        epoch: 1,
        first: 0,
        state: StreamState::Running,
        keep: Keep::last(1_000),
    };
    let frames = site.bus.publish_numbered(stream).await.unwrap();
    let value = |frame: u32, channel: u16| f64::from(frame) + 1e3 * f64::from(channel);
    let of_frame = |frame| (0..CHANNELS).map(move |channel| value(frame, channel));
    let block = FrameBlock {
        header: Header {
            source: "ingest".to_owned(),
            epoch: 1,
            sequence: 0,
            time_ns: 0,
        },
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        channels: CHANNELS,
        values: (0..200).flat_map(of_frame).collect(),
        state: StreamState::Running,
    };
    frames.put(block).await.unwrap();
    let span = site.get(path).await.json();
    assert_eq!(span["unread_waveforms"], json!(null));
    let data = &span["series"][0]["data"];
    // Ten samples in each interval. Those of floor-1 are the second channel.
    assert_eq!(data[0].as_array().unwrap().len(), 10);
    assert_eq!(
        (&data[0][1], &data[1][1], &data[2][1]),
        (&json!(0.6), &json!(1060.0), &json!(1069.0))
    );
    assert_eq!(span["kept_from_s"], 0.5);
    let csv = site.get(&format!("{path}&format=csv")).await;
    let lines: Vec<&str> = csv.body.lines().collect();
    assert_eq!((lines.len(), lines[2]), (11, "0.6,1060,1069"));
    // The page reads the samples itself.
    let span = site.get(&format!("{path}&recorded=false")).await.json();
    assert_eq!(span["series"][0]["data"], json!([[], [], []]));

    let at = |from: u32, to: u32| {
        format!(
            "/api/structures/demo/history?series=waveform/floor-1&from={from}&to={to}&format=csv"
        )
    };
    site.get(&at(100, 200))
        .await
        .expect_refused(404, "no samples in this range");
    site.get(&at(0, 10_000))
        .await
        .expect_refused(400, "the range is 10000 s long");

    // A range without an end ends at the newest data.
    site.put(2, 1.0).await;
    site.wait("the newest data", |found| found["time_s"] == 2.0)
        .await;
    let open = "/api/structures/demo/history?series=waveform/floor-1&from=0.5&points=10";
    let span = site.get(open).await.json();
    assert_eq!(span["unread_waveforms"], json!(null));
    let times = span["series"][0]["data"][0].as_array().unwrap();
    assert_eq!((times.len(), &times[0]), (10, &json!(0.5)));
    site.end().await;
}

/// Regression test: replies that came too late were left out, so that a comparison of two ranges
/// without data was a comparison without a difference.
#[tokio::test(flavor = "multi_thread")]
async fn history_states_that_a_service_has_not_replied() {
    let site = Site::start().await;
    let both = "/api/structures/demo/history?series=parameter/storey-2,loss/storey-2&from=0&to=5";
    assert_eq!(site.get(both).await.json()["incomplete"], false);
    let questions = site.bus.questions(site.keys.all_history(), 64).await;
    let questions = questions.unwrap();
    let key = site.keys.history(&name("storey-2"));
    // This service replies to queries for the parameter only.
    let answering = tokio::spawn(async move {
        while let Some(question) = questions.next().await {
            if question.parameters().contains("kind=parameter") {
                question.answer(&key, &past()).await.unwrap();
            }
        }
    });
    let instance = ServiceInstance::new(&site.bus, name("history"));
    let history = spandrel_bus::Service::History;
    let token = instance.announce(history, &site.keys).await.unwrap();
    let replied = async {
        loop {
            let span = site.get(both).await.json();
            if span["incomplete"] == true && span["series"][0]["data"][0] == json!([1.0]) {
                return;
            }
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(DEADLINE, replied)
        .await
        .expect("the reply for the parameter, and none for its loss");
    let one = "/api/structures/demo/history?series=parameter/storey-2&from=0&to=5";
    let span = site.get(one).await.json();
    assert_eq!(span["incomplete"], false, "{span}");
    site.get(&format!("{both}&format=csv"))
        .await
        .expect_refused(503, "the history did not answer in time");
    assert_eq!(site.get(&format!("{one}&format=csv")).await.status, 200);
    drop(token);
    answering.abort();
    site.end().await;
}

/// One value of storey 2, as the history replies.
fn past() -> HistorySpan {
    HistorySpan {
        structure: name("demo"),
        kind: "parameter".to_owned(),
        name: "storey-2".to_owned(),
        resolution_s: None,
        kept_from_s: Some(1.0),
        rows: HistoryRows {
            time_s: vec![1.0],
            count: vec![1],
            mean: vec![0.9],
            std: vec![0.02],
            spread: vec![0.0],
            least: vec![0.9],
            largest: vec![0.9],
            low: vec![0.86],
            high: vec![0.94],
            probability_of_loss: vec![0.0],
        },
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn log_of_a_period_states_that_no_history_was_read() {
    let site = Site::start().await;
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    let log = site.get("/api/structures/demo/log").await.json();
    assert_eq!(log["history"], "absent");
    assert_eq!(log["cut_at_s"], Value::Null);
    assert_eq!(log["changes"][0]["parameter"], "storey-2");
    let before = site.get("/api/structures/demo/log?to=-1").await.json();
    assert_eq!(before["changes"], json!([]));
    site.end().await;
}
