//! The WebSocket: how things stand first, then what is new.
//!
//! Nothing is queued for a client. Each has a place in the series it reads, and gets at every tick what lies behind that
//! place; who is slow gets it combined to fewer points, and who takes nothing for [`SEND_WITHIN`] is dropped.

use crate::gate::SessionEnd;
use crate::history::columns;
use crate::server::{Server, now_s};
use crate::store::Store;
use crate::view::Standing;
use axum::extract::ws::{CloseFrame, Message, WebSocket, close_code};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::MissedTickBehavior;

/// How often points are sent: as often as an eye follows, whatever the display rate.
const TICK: Duration = Duration::from_millis(100);
/// Every so many ticks how things stand is sent.
const TICKS_PER_STANDING: u32 = 5;
/// Most new points of a series in one message; more are combined.
const MOST_POINTS: usize = 200;
/// A client that takes no message for so long is dropped.
const SEND_WITHIN: Duration = Duration::from_secs(10);

/// Serves one client until it goes, is too slow, its session ends, or the dashboard stops.
pub(crate) async fn serve(
    mut socket: WebSocket,
    server: Arc<Server>,
    structure: Option<String>,
    session: Option<SessionEnd>,
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
        read: BTreeMap::new(),
        last_standing: String::new(),
    };
    loop {
        tokio::select! {
            _ = &mut ended => return,
            () = &mut session_ended => {
                let why = CloseFrame { code: close_code::POLICY, reason: "the session is over".into() };
                // who does not take it is gone
                let _ = tokio::time::timeout(SEND_WITHIN, socket.send(Message::Close(Some(why)))).await;
                return;
            }
            incoming = socket.recv() => match incoming {
                Some(Ok(Message::Close(_)) | Err(_)) | None => return,
                Some(Ok(_)) => {} // nothing is asked of the server here
            },
            _ = tick.tick() => for text in client.messages(&server) {
                let sent = tokio::time::timeout(SEND_WITHIN, socket.send(Message::text(text))).await;
                if !matches!(sent, Ok(Ok(()))) {
                    return;
                }
            },
        }
    }
}

/// What a client has been told.
#[derive(Debug)]
struct Client {
    ticks: u32,
    structure: Option<String>,
    read: BTreeMap<crate::topic::SeriesName, u64>,
    last_standing: String,
}

impl Client {
    /// What is to be told at this tick.
    fn messages(&mut self, server: &Server) -> Vec<String> {
        let mut messages = Vec::new();
        let is_first = self.ticks == 0;
        if self.ticks.is_multiple_of(TICKS_PER_STANDING) {
            messages.push(
                json!({"type": "overview", "now_s": now_s(), "structures": server.overviews()})
                    .to_string(),
            );
        }
        if let Some(structure) = &self.structure
            && let Some(store) = server.store(structure)
        {
            if self.ticks.is_multiple_of(TICKS_PER_STANDING) {
                let standing = standing(&store);
                if standing != self.last_standing {
                    messages.push(standing.clone());
                    self.last_standing = standing;
                }
            }
            let news = store.news(&mut self.read, MOST_POINTS);
            // what was there before is asked for as history
            if !is_first && !news.is_empty() {
                messages.push(points(news).to_string());
            }
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
