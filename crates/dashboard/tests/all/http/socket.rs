//! The WebSocket.

use super::{DEADLINE, Site};
use futures_util::StreamExt;
use serde_json::{Value, json};

#[tokio::test(flavor = "multi_thread")]
async fn socket_sends_the_present_state_and_then_each_new_point() {
    let site = Site::start().await;
    site.put(1, 1.0).await;
    site.wait("the first point", |found| found["time_s"] == 1.0)
        .await;
    let address = format!("ws://{}/api/live?structure=demo", site.address);
    let (mut socket, _) = tokio_tungstenite::connect_async(address).await.unwrap();
    let mut next = async || -> Value {
        loop {
            let message = tokio::time::timeout(DEADLINE, socket.next());
            let message = message.await.unwrap().unwrap().unwrap();
            if !message.is_ping() {
                return serde_json::from_str(message.to_text().unwrap()).unwrap();
            }
        }
    };
    let overview = next().await;
    assert_eq!(
        (&overview["type"], &overview["structures"][0]["name"]),
        (&json!("overview"), &json!("demo"))
    );
    let standing = next().await;
    assert_eq!(
        (
            &standing["type"],
            &standing["standing"]["parameters"]["storey-2"]["mean"]
        ),
        (&json!("structure"), &json!(1.0))
    );
    site.put(2, 0.9).await;
    let points = loop {
        let message = next().await;
        if message["type"] == "points" {
            break message;
        }
    };
    // The client fetches the earlier point from the history interface.
    assert_eq!(
        points["series"]["parameter/storey-2"]["data"][0],
        json!([2.0])
    );
    assert_eq!(
        points["series"]["parameter/storey-2"]["data"][1],
        json!([0.9])
    );
    site.end().await;
    // A stop of the dashboard closes the socket.
    let ended = async { while let Some(Ok(_)) = socket.next().await {} };
    tokio::time::timeout(DEADLINE, ended)
        .await
        .expect("the socket ends");
}
