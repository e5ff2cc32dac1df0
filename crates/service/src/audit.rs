//! The audit log: what was refused, to whom, when and how often.

use std::collections::BTreeMap;
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tracing::warn;

/// Period after which the count of a client and of the whole log starts again.
const PERIOD: Duration = Duration::from_secs(60);
/// Maximum number of log lines about one client and reason in a period.
const LINES_OF_ONE: u32 = 5;
/// Maximum number of log lines about all clients in a period, without the summaries.
const LINES_OF_ALL: u32 = 100;
/// Maximum number of clients that are counted separately in a period. Further clients share one
/// count.
const MOST_CLIENTS: usize = 256;
/// Name of the shared count.
const OTHERS: &str = "others";
/// Maximum number of disconnected readers that are remembered.
const MOST_READERS: usize = 64;
/// Maximum number of characters of a client or reason in the log. Others choose these texts.
const MOST_CHARACTERS: usize = 200;

/// Kind of a refusal. It is a label of a metric, so the set is closed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Refused {
    /// A token that the page does not know.
    WrongToken,
    /// A wrong token after too many others from the same address.
    RepeatedToken,
    /// A request that the role of the token does not permit.
    Forbidden,
    /// A request under a host name that is not a name of this machine.
    ForeignHost,
    /// A request from a page of another site.
    ForeignOrigin,
    /// A request that is not well-formed HTTP.
    Malformed,
    /// A connection to the page without a valid TLS handshake.
    Handshake,
    /// A connection that had to make room for others.
    Connection,
    /// An acknowledgement that this page may not publish.
    Acknowledgement,
    /// An annotation that this page may not publish, or one after too many of the same visitor.
    Annotation,
    /// A connection to the bus without a valid handshake, mostly because of its certificate.
    BusHandshake,
    /// A message or declaration that the role of a party does not permit on the bus.
    BusRight,
    /// A peer on the bus that stopped reading, and was disconnected.
    BusReader,
}

impl Refused {
    /// All kinds.
    pub const ALL: [Self; 13] = [
        Self::WrongToken,
        Self::RepeatedToken,
        Self::Forbidden,
        Self::ForeignHost,
        Self::ForeignOrigin,
        Self::Malformed,
        Self::Handshake,
        Self::Connection,
        Self::Acknowledgement,
        Self::Annotation,
        Self::BusHandshake,
        Self::BusRight,
        Self::BusReader,
    ];

    /// Returns the name of the kind in the log and in the metrics.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::WrongToken => "wrong-token",
            Self::RepeatedToken => "repeated-wrong-token",
            Self::Forbidden => "forbidden",
            Self::ForeignHost => "foreign-host",
            Self::ForeignOrigin => "foreign-origin",
            Self::Malformed => "malformed-request",
            Self::Handshake => "tls-handshake",
            Self::Connection => "connection",
            Self::Acknowledgement => "acknowledgement",
            Self::Annotation => "annotation",
            Self::BusHandshake => "bus-handshake",
            Self::BusRight => "bus-right",
            Self::BusReader => "bus-reader",
        }
    }
}

/// A line of the audit log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AuditLine {
    /// What was refused.
    pub refused: Refused,
    /// The client: its address or the name of its certificate.
    pub who: String,
    /// The reason for the last refusal.
    pub why: String,
    /// Number of refusals that this line reports.
    pub times: u64,
}

/// Decides which refusals are logged one by one, and which are summarised.
///
/// Each client and kind has a few lines per period. At the end of its period, one more line gives
/// the number of the other refusals. Times count from an arbitrary start.
#[derive(Debug, Default)]
pub struct AuditLog {
    counts: BTreeMap<Refused, u64>,
    clients: BTreeMap<(Refused, String), Client>,
    lines: u32,
    since: Duration,
    lost_readers: Vec<LostReader>,
}

/// A reader of the bus that was disconnected.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LostReader {
    /// Its address, or the identifier of its session.
    pub who: String,
    /// The reason.
    pub why: String,
}

/// The refusals of one client and kind in its period.
#[derive(Debug)]
struct Client {
    since: Duration,
    lines: u32,
    held_back: u64,
    why: String,
}

impl Client {
    /// Returns the line that summarises the refusals without a line of their own.
    fn summary(self, refused: Refused, who: String) -> AuditLine {
        AuditLine {
            refused,
            who,
            why: self.why,
            times: self.held_back,
        }
    }
}

impl AuditLog {
    /// Counts a refusal, and appends the line to log now, if any.
    pub fn refuse(
        &mut self,
        refused: Refused,
        who: &str,
        why: &str,
        now: Duration,
        lines: &mut Vec<AuditLine>,
    ) {
        self.pass(now, lines);
        *self.counts.entry(refused).or_default() += 1;
        let (who, why) = (legible(who), legible(why));
        if refused == Refused::BusReader && self.lost_readers.len() < MOST_READERS {
            let (who, why) = (who.clone(), why.clone());
            self.lost_readers.push(LostReader { who, why });
        }
        let is_known = self.clients.contains_key(&(refused, who.clone()));
        let who = match is_known || self.clients.len() < MOST_CLIENTS {
            true => who,
            false => OTHERS.to_owned(),
        };
        let client = self
            .clients
            .entry((refused, who.clone()))
            .or_insert_with(|| Client {
                since: now,
                lines: 0,
                held_back: 0,
                why: String::new(),
            });
        if client.lines < LINES_OF_ONE && self.lines < LINES_OF_ALL {
            client.lines += 1;
            self.lines += 1;
            lines.push(AuditLine {
                refused,
                who,
                why,
                times: 1,
            });
        } else {
            client.held_back += 1;
            client.why = why;
        }
    }

    /// Appends the summaries of the periods that have ended.
    pub fn pass(&mut self, now: Duration, lines: &mut Vec<AuditLine>) {
        if now.saturating_sub(self.since) >= PERIOD {
            (self.since, self.lines) = (now, 0);
        }
        let is_over = |client: &Client| now.saturating_sub(client.since) >= PERIOD;
        let over = self.clients.extract_if(.., |_, client| is_over(client));
        let summed_up = over.filter(|(_, client)| client.held_back > 0);
        lines.extend(summed_up.map(|((refused, who), client)| client.summary(refused, who)));
    }

    /// Appends the summaries of all periods, before the process ends.
    pub fn finish(&mut self, lines: &mut Vec<AuditLine>) {
        let clients = std::mem::take(&mut self.clients).into_iter();
        let summed_up = clients.filter(|(_, client)| client.held_back > 0);
        lines.extend(summed_up.map(|((refused, who), client)| client.summary(refused, who)));
    }

    /// Returns the readers that were disconnected since the last call, at most 64.
    pub fn take_lost_readers(&mut self) -> Vec<LostReader> {
        std::mem::take(&mut self.lost_readers)
    }

    /// Returns the number of refusals since the start, by kind.
    #[must_use]
    pub fn counts(&self) -> &BTreeMap<Refused, u64> {
        &self.counts
    }
}

/// Cuts a text, and replaces characters that would change the log or a terminal.
fn legible(text: &str) -> String {
    let visible = |c: char| if c.is_control() { '?' } else { c };
    text.chars().take(MOST_CHARACTERS).map(visible).collect()
}

/// The audit log of this process.
#[derive(Debug)]
pub struct Audit {
    log: Mutex<AuditLog>,
    started: Instant,
}

impl Audit {
    /// Returns the audit log of this process. There is one, because parts below the services, such
    /// as Zenoh, refuse clients as well.
    #[must_use]
    pub fn of_process() -> &'static Self {
        static AUDIT: LazyLock<Audit> = LazyLock::new(|| {
            #[expect(
                clippy::disallowed_methods,
                reason = "the rate limit uses the monotonic clock"
            )]
            let started = Instant::now();
            Audit {
                log: Mutex::default(),
                started,
            }
        });
        &AUDIT
    }

    /// Counts a refusal and logs it, at a limited rate.
    pub fn refuse(&self, refused: Refused, who: &str, why: &str) {
        let mut lines = Vec::new();
        let now = self.started.elapsed();
        self.lock().refuse(refused, who, why, now, &mut lines);
        lines.iter().for_each(write);
    }

    /// Logs the summaries that are due. Call it every few seconds.
    pub fn pass(&self) {
        let mut lines = Vec::new();
        self.lock().pass(self.started.elapsed(), &mut lines);
        lines.iter().for_each(write);
    }

    /// Logs the summaries that are not due yet. Call it before the process ends.
    pub fn finish(&self) {
        let mut lines = Vec::new();
        self.lock().finish(&mut lines);
        lines.iter().for_each(write);
    }

    /// Returns the readers that were disconnected since the last call, at most 64.
    pub fn take_lost_readers(&self) -> Vec<LostReader> {
        self.lock().take_lost_readers()
    }

    /// Returns the number of refusals since the start, by kind.
    #[must_use]
    pub fn counts(&self) -> BTreeMap<Refused, u64> {
        self.lock().counts().clone()
    }

    fn lock(&self) -> MutexGuard<'_, AuditLog> {
        // A panic leaves consistent counts, because each change is one call.
        self.log.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn write(line: &AuditLine) {
    let (what, who, why) = (line.refused.as_str(), line.who.as_str(), line.why.as_str());
    warn!(what, who, why, times = line.times, "refused");
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn one_client_gets_a_few_lines_and_then_a_sum() {
        let (mut log, mut lines) = (AuditLog::default(), Vec::new());
        for _ in 0..40 {
            log.refuse(
                Refused::WrongToken,
                "10.0.0.7",
                "no such token",
                at(1),
                &mut lines,
            );
        }
        assert_eq!(lines.len(), LINES_OF_ONE as usize);
        assert!(lines.iter().all(|line| line.times == 1));
        lines.clear();
        log.pass(at(60), &mut lines);
        assert!(lines.is_empty(), "the period of this client is not over");
        log.pass(at(61), &mut lines);
        let sum: Vec<u64> = lines.iter().map(|line| line.times).collect();
        assert_eq!(sum, [35]);
        assert_eq!(log.counts()[&Refused::WrongToken], 40);
    }

    #[test]
    fn another_client_is_still_named() {
        let (mut log, mut lines) = (AuditLog::default(), Vec::new());
        for who in ["10.0.0.7"; 40].into_iter().chain(["10.0.0.8"]) {
            log.refuse(Refused::Handshake, who, "no certificate", at(1), &mut lines);
        }
        assert_eq!(lines.last().map(|line| line.who.as_str()), Some("10.0.0.8"));
    }

    #[test]
    fn many_clients_fill_neither_memory_nor_log() {
        let (mut log, mut lines) = (AuditLog::default(), Vec::new());
        for client in 0..100_000 {
            let who = format!("client {client}");
            log.refuse(Refused::Connection, &who, "too slow", at(1), &mut lines);
        }
        assert!(log.clients.len() <= MOST_CLIENTS + 1);
        assert_eq!(lines.len(), LINES_OF_ALL as usize);
        lines.clear();
        log.pass(at(100), &mut lines);
        assert!(log.clients.is_empty() && lines.len() <= MOST_CLIENTS + 1);
        let summed: u64 = lines.iter().map(|line| line.times).sum();
        assert_eq!(summed + u64::from(LINES_OF_ALL), 100_000);
    }

    #[test]
    fn what_others_choose_cannot_forge_a_line() {
        let (mut log, mut lines) = (AuditLog::default(), Vec::new());
        let long = format!("\u{1b}[2J\nrefused{}", "x".repeat(10_000));
        log.refuse(Refused::ForeignHost, &long, &long, at(0), &mut lines);
        let line = &lines[0];
        assert!(!line.who.contains(['\n', '\u{1b}']) && line.why.len() <= MOST_CHARACTERS);
    }
}
