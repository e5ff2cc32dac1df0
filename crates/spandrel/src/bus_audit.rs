//! The part of the audit log that concerns the bus: what Zenoh refuses.
//!
//! Zenoh rejects connections and messages inside its own threads, and offers no interface to learn
//! of them. It logs them, however, below the level that `spandrel` shows. This module reads these
//! log events and passes them to the audit log ([`Audit`]).
//!
//! The texts are those of Zenoh 1.10. If another version words them differently, nothing is
//! reported; the end-to-end tests notice.

use spandrel_service::{Audit, Refused};
use std::cell::Cell;
use std::collections::{BTreeMap, VecDeque};
use std::fmt::{self, Write as _};
use std::sync::OnceLock;
use std::time::Duration;
use tokio::time::Instant;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::Context;

/// Maximum number of events that wait. Further ones are not reported.
const EVENTS_WAITING: usize = 4096;
/// Maximum number of characters of an event that are read.
const MOST_CHARACTERS: usize = 1024;
/// Maximum number of connections whose party is remembered.
const MOST_PARTIES: usize = 4096;
/// Maximum number of refusals that wait for the name of their party.
const MOST_WAITING: usize = 4096;
/// Maximum time for which a refusal waits for the name of its party.
const LONGEST_WAIT: Duration = Duration::from_secs(5);
/// Interval between summaries.
const PASS_EVERY: Duration = Duration::from_secs(1);

/// Failed handshakes, in every process that listens on the network.
const HANDSHAKES: &str = "zenoh_link_commons::quic";
/// Accepted connections with the name of the certificate.
const CERTIFICATES: &str = "zenoh_link_quic::unicast";
/// Accepted connections with the identifier of the session.
const SESSIONS: &str = "zenoh_transport::unicast::establishment::accept";
/// Connections that Zenoh closes because the peer takes no messages.
const BLOCKED: &str = "zenoh_transport::unicast::universal::tx";
/// Connections that Zenoh closes because the peer sends nothing, not even a keep-alive message.
const EXPIRED: &str = "zenoh_transport::unicast::universal::link";
/// Decisions on access, in a router and in an isolated process. The permitted ones are among them.
const DECISIONS: &str = "zenoh::net::routing::interceptor::access_control";

/// What a process reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// Failed handshakes, and peers that stopped reading.
    Peers,
    /// The same, and messages that a router or an isolated process does not permit.
    Router,
}

impl Scope {
    /// Returns the log events of Zenoh that are read.
    pub fn targets(self) -> Targets {
        let peers = Targets::new()
            .with_target(HANDSHAKES, Level::WARN)
            .with_target(BLOCKED, Level::ERROR)
            .with_target(EXPIRED, Level::DEBUG);
        match self {
            Self::Peers => peers,
            Self::Router => peers
                .with_target(CERTIFICATES, Level::DEBUG)
                .with_target(SESSIONS, Level::DEBUG)
                .with_target(DECISIONS, Level::TRACE),
        }
    }
}

/// Time that the end of the process waits for the thread.
const LONGEST_END: Duration = Duration::from_secs(1);

/// The thread that reads log events of Zenoh.
static READER: OnceLock<flume::Sender<Task>> = OnceLock::new();

/// What the thread does next.
#[derive(Debug)]
enum Task {
    /// Reads the text of an event.
    Read(String),
    /// Reports everything that still waits for the name of its party, and answers.
    Finish(flume::Sender<()>),
}

/// Reports the refusals that still wait for the name of their party. Call it before the process
/// exits.
pub fn finish() {
    let (done, is_done) = flume::bounded(1);
    let asked = READER
        .get()
        .map(|reader| reader.try_send(Task::Finish(done)));
    if let Some(Ok(())) = asked {
        let _ = is_done.recv_timeout(LONGEST_END);
    }
}

/// Takes log events of Zenoh to a thread that reads them.
#[derive(Debug)]
pub struct BusAudit {
    events: flume::Sender<Task>,
}

impl BusAudit {
    /// Starts the thread. Returns `None` if the operating system cannot start one.
    pub fn start() -> Option<Self> {
        let (events, tasks) = flume::bounded(EVENTS_WAITING);
        let read = move || {
            let mut parties = Parties::default();
            loop {
                let task = tasks.recv_timeout(PASS_EVERY);
                let mut now = Instant::now();
                let mut done = None;
                match task {
                    Ok(Task::Read(text)) => parties.read(&text, now),
                    Ok(Task::Finish(answer)) => {
                        now += LONGEST_WAIT;
                        done = Some(answer);
                    }
                    Err(flume::RecvTimeoutError::Timeout) => {}
                    Err(flume::RecvTimeoutError::Disconnected) => return,
                }
                for Refusal { refused, who, why } in parties.found(now) {
                    Audit::of_process().refuse(refused, &who, &why);
                }
                Audit::of_process().pass();
                if let Some(done) = done {
                    let _ = done.send(());
                }
            }
        };
        let thread = std::thread::Builder::new().name("audit".to_owned());
        thread.spawn(read).ok()?;
        let _ = READER.set(events.clone());
        Some(Self { events })
    }
}

impl<S: Subscriber> Layer<S> for BusAudit {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let mut message = Message::default();
        event.record(&mut message);
        if message.is_notable() {
            // If the queue is full, the log would be full as well.
            let _ = self.events.try_send(Task::Read(message.0));
        }
    }
}

thread_local! {
    /// Decisions that Zenoh makes in advance, on the thread that makes them.
    static IN_ADVANCE: Cell<InAdvance> = const { Cell::new(InAdvance(None)) };
}

/// Decisions on all actions that Zenoh makes when it learns of a key. None of them concerns a
/// message.
///
/// Contains the number of the next action in [`ACTIONS`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct InAdvance(Option<usize>);

/// Actions in the order of the decisions in advance.
const ACTIONS: [&str; 9] = [
    "Query",
    "Reply",
    "Put",
    "Delete",
    "Declare/Undeclare Subscriber",
    "Declare/Undeclare Queryable",
    "Declare/Undeclare Liveliness Token",
    "Liveliness Query",
    "Declare Liveliness Subscriber",
];

impl InAdvance {
    /// Reads an event. Returns `true` if it does not concern a message.
    fn read(&mut self, text: &str) -> bool {
        if text.starts_with("ACL (ingress): caching permissions") {
            self.0 = Some(0);
            return true;
        }
        let (Some(next), Some((_, action))) = (self.0, text.split_once("authorized to ")) else {
            return false;
        };
        let is = |place: usize| {
            let name = ACTIONS.get(place);
            name.is_some_and(|name| action.starts_with(&format!("{name} (")))
        };
        self.0 = match next {
            // A party that fits several entries of the router file has one decision for each.
            next if next > 0 && is(next - 1) => Some(next),
            next if is(next) => Some(next + 1),
            _ => None,
        };
        self.0.is_some()
    }
}

/// The beginning of the text of an event.
#[derive(Debug, Default)]
struct Message(String);

impl Message {
    /// Returns `true` for an event that [`Parties::read`] uses. A router decides on every message,
    /// so that most events are not.
    fn is_notable(&self) -> bool {
        if self.0.contains("(egress)") {
            return false;
        }
        let mut in_advance = IN_ADVANCE.get();
        let is_in_advance = in_advance.read(&self.0);
        IN_ADVANCE.set(in_advance);
        !is_in_advance && !self.0.contains(" is authorized to ")
    }
}

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            // A longer text ends with an error, and its beginning remains.
            let _ = write!(Limited(&mut self.0), "{value:?}");
        }
    }
}

/// A text that accepts no more than [`MOST_CHARACTERS`].
struct Limited<'t>(&'t mut String);

impl fmt::Write for Limited<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let left = MOST_CHARACTERS.saturating_sub(self.0.len());
        self.0.push_str(&text[..text.floor_char_boundary(left)]);
        if text.len() > left {
            return Err(fmt::Error);
        }
        Ok(())
    }
}

/// Something that Zenoh refused.
#[derive(Debug, PartialEq, Eq)]
struct Refusal {
    refused: Refused,
    who: String,
    why: String,
}

/// A refusal of a session whose party is not known yet.
///
/// Zenoh names the party of a new session in a thread of its own. On a busy machine hundreds of
/// messages come before.
#[derive(Debug)]
struct Waiting {
    since: Instant,
    session: String,
    why: String,
}

/// The parties of the present connections, as the events of Zenoh name them, and what was refused
/// to them.
#[derive(Debug, Default)]
struct Parties {
    /// Names of certificates by the address of their connection.
    names: BTreeMap<String, String>,
    /// Parties by the identifier of their session.
    sessions: BTreeMap<String, String>,
    /// Refusals that wait for the party of their session, the oldest first.
    waiting: VecDeque<Waiting>,
    /// Refusals to report.
    found: Vec<Refusal>,
}

impl Parties {
    /// Reads an event that arrives at time `now`.
    fn read(&mut self, text: &str, now: Instant) {
        if let Some(failure) = text.strip_prefix("QUIC acceptor failed: ") {
            self.found.push(Refusal {
                refused: Refused::BusHandshake,
                who: "unknown address".to_owned(),
                why: reason(failure),
            });
        } else if let Some(closed) = self.read_closed(text) {
            self.found.push(closed);
        } else if let Some(accepted) = text.strip_prefix("Accepted QUIC connection on ") {
            self.take_certificate(accepted);
        } else if let Some(accepted) = text.strip_prefix("New transport link accepted from ") {
            self.take_session(accepted);
        } else if let Some((session, _)) =
            text.split_once(" did not match any configured ACL subject")
        {
            let why = "the router file does not name this party; it has no rights";
            self.refuse(session, why.to_owned(), now);
        } else {
            self.take_decision(text, now);
        }
    }

    /// Returns what Zenoh refused since the last call. A refusal whose party is unknown appears
    /// [`LONGEST_WAIT`] later, with the identifier of the session.
    fn found(&mut self, now: Instant) -> Vec<Refusal> {
        let is_overdue = |waiting: &Waiting| now.duration_since(waiting.since) >= LONGEST_WAIT;
        while let Some(waiting) = self.waiting.pop_front_if(|waiting| is_overdue(waiting)) {
            self.found.push(right(waiting.session, waiting.why));
        }
        std::mem::take(&mut self.found)
    }

    fn refuse(&mut self, session: &str, why: String, now: Instant) {
        if let Some(who) = self.sessions.get(session) {
            self.found.push(right(who.clone(), why));
        } else if self.waiting.len() < MOST_WAITING {
            self.waiting.push_back(Waiting {
                since: now,
                session: session.to_owned(),
                why,
            });
        } else {
            self.found.push(right(session.to_owned(), why));
        }
    }

    /// Reads `Unable to push non droppable network message to SESSION. …` or `RX task failed: HERE
    /// => ADDRESS:CONFIGURATION: expired after …`.
    fn read_closed(&self, text: &str) -> Option<Refusal> {
        let closed = |who: String, why: &str| Refusal {
            refused: Refused::BusReader,
            who,
            why: why.to_owned(),
        };
        let blocked = text.strip_prefix("Unable to push non droppable network message to ");
        if let Some((session, _)) = blocked.and_then(|rest| rest.split_once(". ")) {
            let who = self.sessions.get(session).map_or(session, String::as_str);
            return Some(closed(who.to_owned(), "it took no messages"));
        }
        let (link, _) = text
            .strip_prefix("RX task failed: ")?
            .split_once(": expired after ")?;
        let address = link.rsplit(" => ").next().unwrap_or(link);
        let end = address.find(":TransportLink").unwrap_or(address.len());
        let who = address[..end].to_owned();
        Some(closed(
            who,
            "it sent no keep-alive message, or this process was suspended",
        ))
    }

    /// Reads `SERVER: CLIENT. NAME.`
    fn take_certificate(&mut self, accepted: &str) {
        let Some((_, client)) = accepted.split_once(": ") else {
            return;
        };
        let Some((address, name)) = client.split_once(". ") else {
            return;
        };
        let name = name
            .trim_end_matches('.')
            .trim_start_matches("Common Name: ");
        if self.names.len() >= MOST_PARTIES {
            self.names.clear(); // the next connections are named again
        }
        self.names.insert(address.to_owned(), name.to_owned());
    }

    /// Reads `SESSION to ROUTER: LINK`.
    fn take_session(&mut self, accepted: &str) {
        let Some((session, link)) = accepted.split_once(" to ") else {
            return;
        };
        let address = link.rsplit("quic/").next().unwrap_or(link);
        let is_of_address = |c: char| c.is_ascii_hexdigit() || ".:[]".contains(c);
        let end = address.find(|c| !is_of_address(c)).unwrap_or(address.len());
        let address = &address[..end];
        let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
        let who = match self.names.remove(address) {
            Some(name) => format!("{name} ({host})"),
            None => host.to_owned(),
        };
        if self.sessions.len() >= MOST_PARTIES {
            self.sessions.clear(); // later refusals state the identifier of the session
        }
        let waiting = std::mem::take(&mut self.waiting).into_iter();
        let (named, others): (VecDeque<_>, _) = waiting.partition(|w| w.session == session);
        self.waiting = others;
        let named = named.into_iter().map(|w| right(who.clone(), w.why));
        self.found.extend(named);
        self.sessions.insert(session.to_owned(), who);
    }

    /// Reads `SESSION on SUBJECT is unauthorized to ACTION on KEY`, or the same for a decision that
    /// was made before.
    fn take_decision(&mut self, text: &str, now: Instant) {
        let Some((who, action)) = text.split_once(" is unauthorized to ") else {
            return;
        };
        let who = who.strip_prefix("Using cached result: ").unwrap_or(who);
        let session = who.split(" on ").next().unwrap_or(who);
        self.refuse(session, action.replacen(" (ingress)", "", 1), now);
    }
}

/// Returns the refusal of a right.
fn right(who: String, why: String) -> Refusal {
    Refusal {
        refused: Refused::BusRight,
        who,
        why,
    }
}

/// Returns the reason for a failed handshake.
fn reason(failure: &str) -> String {
    let quoted = failure.split_once("reason: \"");
    let quoted = quoted.and_then(|(_, rest)| rest.split_once('"'));
    match quoted.map(|(reason, _)| reason) {
        Some(reason) if !reason.is_empty() => reason.to_owned(),
        _ => {
            let error = failure.split(" at /").next().unwrap_or(failure);
            error.split(" Hint:").next().unwrap_or(error).to_owned()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(parties: &mut Parties, text: &str) -> Option<(Refused, String, String)> {
        let now = Instant::now();
        parties.read(text, now);
        let found = parties.found(now).into_iter().next();
        found.map(|Refusal { refused, who, why }| (refused, who, why))
    }

    #[test]
    fn a_refused_message_names_certificate_address_action_and_key() {
        let mut parties = Parties::default();
        for text in [
            "Accepted QUIC connection on 10.0.0.5:7447: 10.0.0.9:40001. Common Name: viewer.ada.",
            "New transport link accepted from ab12 to cd34: TransportLinkUnicast { link: Link { \
             src: quic/10.0.0.5:7447, dst: quic/10.0.0.9:40001, mtu: 65535 }, config: X } ",
        ] {
            assert_eq!(read(&mut parties, text), None, "{text}");
        }
        for text in [
            "Using cached result: ab12 is unauthorized to Put (ingress) on s/house/event",
            "ab12 on eth0+viewer.ada+quic is unauthorized to Put (ingress) on s/house/event",
        ] {
            let expected = (
                Refused::BusRight,
                "viewer.ada (10.0.0.9)".to_owned(),
                "Put on s/house/event".to_owned(),
            );
            assert_eq!(read(&mut parties, text), Some(expected), "{text}");
        }
    }

    /// Regression: the log named the session instead of the party on a busy machine.
    #[test]
    fn messages_that_come_before_the_name_of_their_party_wait_for_it() {
        let mut parties = Parties::default();
        let now = Instant::now();
        let refused = |session: &str, key: &str| {
            format!("Using cached result: {session} is unauthorized to Put (ingress) on {key}")
        };
        let found = |who: &str, key: &str| right(who.to_owned(), format!("Put on {key}"));
        for text in [
            "Accepted QUIC connection on 10.0.0.5:7447: 10.0.0.9:40001. Common Name: viewer.ada.",
            &refused("ab12", "first"),
            &refused("ef56", "other"),
            &refused("ab12", "second"),
        ] {
            parties.read(text, now);
            assert_eq!(parties.found(now), [], "{text}");
        }
        let accepted = "New transport link accepted from ab12 to cd34: Link { dst: \
                        quic/10.0.0.9:40001, mtu: 1 }";
        parties.read(accepted, now);
        let ada = "viewer.ada (10.0.0.9)";
        assert_eq!(
            parties.found(now),
            [found(ada, "first"), found(ada, "second")]
        );
        // The name of the other session never comes.
        let later = now + LONGEST_WAIT;
        assert_eq!(parties.found(later), [found("ef56", "other")]);
        assert_eq!(parties.found(later), []);
    }

    #[test]
    fn the_end_of_the_process_waits_for_no_name() {
        let audit = BusAudit::start().unwrap();
        let refused = "Using cached result: ab12 is unauthorized to Put (ingress) on s/house/event";
        audit.events.send(Task::Read(refused.to_owned())).unwrap();
        finish();
        let counts = Audit::of_process().counts();
        assert_eq!(counts.get(&Refused::BusRight), Some(&1));
    }

    #[test]
    fn a_party_that_the_router_file_does_not_name_is_reported_with_its_address() {
        let mut parties = Parties::default();
        let unnamed = "ab12 did not match any configured ACL subject. Default permission `Deny` \
                       will be applied on all messages";
        assert_eq!(read(&mut parties, unnamed), None);
        let accepted = "New transport link accepted from ab12 to cd34: Link { dst: \
                        quic/[fd00::1]:40001, mtu: 1 }";
        let (refused, who, _) = read(&mut parties, accepted).unwrap();
        assert_eq!((refused, who.as_str()), (Refused::BusRight, "[fd00::1]"));
    }

    #[test]
    fn a_failed_handshake_has_its_reason() {
        let mut parties = Parties::default();
        let failed = |error: &str| {
            format!(
                "QUIC acceptor failed: {error} at /x/zenoh-link-commons-1.10.2/src/quic/unicast.rs:\
                 688. Hint: increase the system open file limit."
            )
        };
        for (error, why) in [
            (
                "TransportError(Error { code: Code::crypto(30), frame: None, reason: \"invalid \
                 peer certificate: UnknownIssuer\" })",
                "invalid peer certificate: UnknownIssuer",
            ),
            ("TimedOut", "TimedOut"),
        ] {
            let (refused, _, found) = read(&mut parties, &failed(error)).unwrap();
            assert_eq!((refused, found.as_str()), (Refused::BusHandshake, why));
        }
    }

    #[test]
    fn a_peer_that_stopped_reading_is_named() {
        let mut parties = Parties::default();
        let blocked = "Unable to push non droppable network message to ab12. Closing transport!";
        let (refused, who, _) = read(&mut parties, blocked).unwrap();
        assert_eq!((refused, who.as_str()), (Refused::BusReader, "ab12"));
        let expired = "RX task failed: tcp/127.0.0.1:7447 => \
                       tcp/127.0.0.1:40001:TransportLinkUnicastConfig { batch: X }: expired after \
                       10000 milliseconds at /x/link.rs:531.";
        let (refused, who, _) = read(&mut parties, expired).unwrap();
        assert_eq!(
            (refused, who.as_str()),
            (Refused::BusReader, "tcp/127.0.0.1:40001")
        );
        assert_eq!(read(&mut parties, "RX task failed: closed"), None);
    }

    #[test]
    fn decisions_in_advance_are_no_messages() {
        let mut in_advance = InAdvance(None);
        assert!(in_advance.read("ACL (ingress): caching permissions for `s/house/event` ..."));
        for action in ACTIONS {
            let text = format!("ab12 on viewer.ada is unauthorized to {action} (ingress) on k");
            assert!(
                in_advance.read(&text) && in_advance.read(&text),
                "{action}, for two entries of the file"
            );
        }
        let put = "ab12 on viewer.ada is unauthorized to Put (ingress) on k";
        assert!(!in_advance.read(put), "it is over");
        assert!(in_advance.read("ACL (ingress): caching permissions for `k` ..."));
        assert!(
            !in_advance.read(put),
            "a party without an entry has no decisions"
        );
    }

    #[test]
    fn texts_are_cut() {
        let mut text = String::new();
        let long = "ä".repeat(MOST_CHARACTERS);
        assert!(write!(Limited(&mut text), "x{long}").is_err());
        assert_eq!(text.len(), MOST_CHARACTERS - 1);
    }
}
