//! The WebSocket. It sends the current state first, and then new data.
//!
//! The server queues nothing for a client. Each client has a position in every series it reads. At
//! every tick it receives the points after that position. A slow client receives fewer, combined
//! points. A client that accepts no message for [`SEND_WITHIN`] is disconnected. The server sends
//! pings. A client that does not answer them must make room if there are too many clients.

use crate::gate::SessionEnd;
use crate::history::columns;
use crate::places::Place;
use crate::server::{Server, now_s};
use crate::store::Store;
use crate::topic::Kind;
use crate::view::Standing;
use axum::body::Bytes;
use axum::extract::ws::{CloseFrame, Message, WebSocket, close_code};
use serde::Deserialize;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::{Instant, MissedTickBehavior};

/// Interval between messages with points, short enough for smooth motion at any display rate.
const TICK: Duration = Duration::from_millis(100);
/// Number of ticks between messages with the current state.
const TICKS_PER_STANDING: u32 = 5;
/// Number of ticks between pings, a third of the time within which a client must answer to keep its
/// place.
const TICKS_PER_PING: u32 = 20;
/// Maximum number of new points of a series in one message. More points are combined.
const MOST_POINTS: usize = 200;
/// Time limit for sending a message, after which the client is disconnected.
const SEND_WITHIN: Duration = Duration::from_secs(10);

/// Serves one client until it disconnects, is too slow, its session ends, or the dashboard stops.
pub(crate) async fn serve(
    mut socket: WebSocket,
    server: Arc<Server>,
    structure: Option<String>,
    session: Option<SessionEnd>,
    place: &Place,
) {
    let mut stopped = server.stopped();
    let ended = async move { stopped.wait_for(|stopped| *stopped).await.map(|_| ()) };
    tokio::pin!(ended);
    let now = server.since_start();
    let session_ended = async move {
        match session {
            Some(session) => session.wait(now).await,
            None => std::future::pending().await,
        }
    };
    tokio::pin!(session_ended);
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut client = Client {
        ticks: 0,
        structure,
        wish: Wish::default(),
        read: BTreeMap::new(),
        last_standing: String::new(),
    };
    loop {
        tokio::select! {
            _ = &mut ended => return,
            () = &mut session_ended => {
                let why = CloseFrame { code: close_code::POLICY, reason: "the session has ended".into() };
                // A client that does not accept the message is disconnected anyway.
                let _ = tokio::time::timeout(SEND_WITHIN, socket.send(Message::Close(Some(why)))).await;
                return;
            }
            incoming = socket.recv() => match incoming {
                Some(Ok(Message::Close(_)) | Err(_)) | None => return,
                Some(Ok(Message::Text(text))) => client.ask(&text),
                Some(Ok(Message::Pong(_))) => place.note_answer(Instant::now()),
                Some(Ok(_)) => {} // pings, and messages without a meaning
            },
            _ = tick.tick() => for message in client.messages(&server) {
                let sent = tokio::time::timeout(SEND_WITHIN, socket.send(message)).await;
                if !matches!(sent, Ok(Ok(()))) {
                    return;
                }
            },
        }
    }
}

/// Optional data that a client requests. Waveforms are large, and few views show them.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Wish {
    waveforms: bool,
}

/// State of a client: the data already sent.
#[derive(Debug)]
struct Client {
    ticks: u32,
    structure: Option<String>,
    wish: Wish,
    read: BTreeMap<crate::topic::SeriesName, u64>,
    last_standing: String,
}

impl Client {
    /// Takes a message of the client. One without a meaning is ignored.
    fn ask(&mut self, text: &str) {
        if let Ok(wish) = serde_json::from_str(text) {
            self.wish = wish;
        }
    }

    /// Returns the messages of this tick.
    fn messages(&mut self, server: &Server) -> Vec<Message> {
        let mut messages = Vec::new();
        let is_first = self.ticks == 0;
        if self.ticks.is_multiple_of(TICKS_PER_STANDING) {
            let overview =
                json!({"type": "overview", "now_s": now_s(), "structures": server.overviews()});
            messages.push(Message::text(overview.to_string()));
        }
        if let Some(structure) = &self.structure
            && let Some(store) = server.store(structure)
        {
            if self.ticks.is_multiple_of(TICKS_PER_STANDING) {
                let standing = standing(&store);
                if standing != self.last_standing {
                    messages.push(Message::text(standing.clone()));
                    self.last_standing = standing;
                }
            }
            let wants = |kind| kind != Kind::Waveform || self.wish.waveforms;
            let news = store.news(&mut self.read, MOST_POINTS, wants);
            // The client fetches earlier points from the history interface.
            if !is_first && !news.is_empty() {
                messages.push(Message::text(points(news).to_string()));
            }
        }
        if self.ticks.is_multiple_of(TICKS_PER_PING) {
            messages.push(Message::Ping(Bytes::new()));
        }
        self.ticks = self.ticks.wrapping_add(1);
        messages
    }
}

fn standing(store: &Store) -> String {
    json!({"type": "structure", "standing": Standing::of(store)}).to_string()
}

fn points(news: Vec<(crate::topic::SeriesName, u64, crate::series::Table)>) -> Value {
    let series: serde_json::Map<String, Value> = news
        .into_iter()
        .map(|(name, generation, table)| {
            let data = columns(&table, name.kind.columns().len());
            (
                name.to_string(),
                json!({"generation": generation, "data": data}),
            )
        })
        .collect();
    json!({"type": "points", "series": series})
}
