//! Limits on the number of connections, in total and per address.
//!
//! If the limit is reached, a new connection replaces the slowest connection of the address with
//! the most connections. It is rejected only if no connection is slow. Connections that send
//! nothing, or only a part of a request, can therefore not keep others out. WebSockets have a
//! separate limit with the same rule, and are slow if they do not answer.

use crate::gate::network_of;
use spandrel_service::{Audit, Refused};
use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::Instant;

/// Maximum number of concurrent connections, including handshakes. Active WebSockets have a
/// separate limit.
const MOST_CONNECTIONS: usize = 256;
/// Maximum number of connections from one address (for IPv6, from one /64 network). The loopback
/// interface has no such limit, because a local proxy serves many clients.
const MOST_OF_ONE_ADDRESS: usize = 32;
/// Time after which a connection whose request is being processed is slow. A connection that has no
/// complete request is always slow, because its client can repeat the request.
const SLOW_AFTER: Duration = Duration::from_secs(10);
/// Maximum number of concurrent WebSockets, from one address or many.
const MOST_SOCKETS: usize = 64;
/// Time after the last answer of a client to a ping after which its WebSocket is slow.
const SILENT_AFTER: Duration = Duration::from_secs(6);

/// Limits on one kind of connection.
#[derive(Clone, Copy, Debug)]
struct Limits {
    most: usize,
    most_of_one_address: usize,
    slow_after: Duration,
    /// Reason for closing a connection that must make room, for the audit log.
    why: &'static str,
}

const CONNECTIONS: Limits = Limits {
    most: MOST_CONNECTIONS,
    most_of_one_address: MOST_OF_ONE_ADDRESS,
    slow_after: SLOW_AFTER,
    why: "too many connections to the page; closed the slowest one",
};

const SOCKETS: Limits = Limits {
    most: MOST_SOCKETS,
    most_of_one_address: MOST_SOCKETS,
    slow_after: SILENT_AFTER,
    why: "too many WebSockets; closed one whose client does not answer",
};

/// A shared list of open connections. Clones share the list.
#[derive(Clone, Debug)]
pub(crate) struct Places(Arc<Mutex<Taken>>);

#[derive(Debug)]
struct Taken {
    limits: Limits,
    /// Connections by number. A later connection has a higher number.
    connections: BTreeMap<u64, Connection>,
    next: u64,
}

#[derive(Debug)]
struct Connection {
    address: IpAddr,
    stage: Stage,
    /// Start of the stage.
    since: Instant,
    /// Dropped when the connection must make room.
    _room: watch::Sender<()>,
}

/// Progress of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// The client has not yet completed its handshake, or its next request. Or it receives a reply.
    Waiting,
    /// A request has arrived with its body, and the reply is not yet ready. Or the client of a
    /// WebSocket has answered.
    Active,
}

/// A place for one connection. It becomes free when dropped.
#[derive(Debug)]
pub(crate) struct Place {
    places: Places,
    number: u64,
    /// Receives nothing. Its sender is dropped when the connection must make room.
    room: watch::Receiver<()>,
}

impl Places {
    /// Returns the places of connections.
    pub(crate) fn of_connections() -> Self {
        Self::new(CONNECTIONS)
    }

    /// Returns the places of WebSockets.
    pub(crate) fn of_sockets() -> Self {
        Self::new(SOCKETS)
    }

    fn new(limits: Limits) -> Self {
        Self(Arc::new(Mutex::new(Taken {
            limits,
            connections: BTreeMap::new(),
            next: 0,
        })))
    }

    /// Reserves a place for a connection from an address.
    ///
    /// If all places are taken, the slowest connection of the address with most connections must
    /// make room. Returns `None` if no connection is slow.
    pub(crate) fn take(&self, address: IpAddr, now: Instant) -> Option<Place> {
        let address = network_of(address);
        let mut taken = self.lock();
        let leaver = match taken.is_full_for(address) {
            Some(Full::OfAddress) => Some(taken.slowest_of(address, now)?),
            Some(Full::OfAll) => Some(taken.slowest(now)?),
            None => None,
        };
        let closed = leaver.and_then(|number| taken.connections.remove(&number));
        let (sender, room) = watch::channel(());
        let number = taken.next;
        taken.next += 1;
        let connection = Connection {
            address,
            stage: Stage::Waiting,
            since: now,
            _room: sender,
        };
        taken.connections.insert(number, connection);
        let why = taken.limits.why;
        drop(taken);
        if let Some(closed) = closed {
            Audit::of_process().refuse(Refused::Connection, &closed.address.to_string(), why);
        }
        Some(Place {
            places: self.clone(),
            number,
            room,
        })
    }

    fn lock(&self) -> MutexGuard<'_, Taken> {
        // No code that holds this lock panics.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A limit that has been reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Full {
    OfAddress,
    OfAll,
}

impl Taken {
    fn is_full_for(&self, address: IpAddr) -> Option<Full> {
        let of_address = || self.connections.values().filter(|c| c.address == address);
        if !address.is_loopback() && of_address().count() >= self.limits.most_of_one_address {
            return Some(Full::OfAddress);
        }
        (self.connections.len() >= self.limits.most).then_some(Full::OfAll)
    }

    /// Returns the slowest connection of the address with most connections, or of the next address
    /// if none of them is slow.
    fn slowest(&self, now: Instant) -> Option<u64> {
        let mut counts: HashMap<IpAddr, usize> = HashMap::new();
        for connection in self.connections.values() {
            *counts.entry(connection.address).or_default() += 1;
        }
        let mut addresses: Vec<(usize, IpAddr)> =
            counts.into_iter().map(|(ip, count)| (count, ip)).collect();
        addresses.sort_unstable_by(|a, b| b.cmp(a));
        let mut busiest_first = addresses.iter();
        busiest_first.find_map(|(_, ip)| self.slowest_of(*ip, now))
    }

    /// Returns the connection of an address that has waited longest. An active one comes last, and
    /// only once it is slow.
    fn slowest_of(&self, address: IpAddr, now: Instant) -> Option<u64> {
        let is_slow = |connection: &Connection| match connection.stage {
            Stage::Waiting => true,
            Stage::Active => {
                now.saturating_duration_since(connection.since) >= self.limits.slow_after
            }
        };
        let slow = self
            .connections
            .iter()
            .filter(|(_, connection)| connection.address == address && is_slow(connection));
        let slowest = slow.min_by_key(|(number, connection)| {
            let is_active = connection.stage == Stage::Active;
            (is_active, connection.since, **number)
        });
        slowest.map(|(number, _)| *number)
    }
}

impl Place {
    /// Notes that a request has arrived with its body.
    pub(crate) fn begin_request(&self, now: Instant) {
        self.enter(Stage::Active, now);
    }

    /// Notes that the client of a WebSocket has answered.
    pub(crate) fn note_answer(&self, now: Instant) {
        self.enter(Stage::Active, now);
    }

    /// Notes that the reply is ready.
    pub(crate) fn end_request(&self, now: Instant) {
        self.enter(Stage::Waiting, now);
    }

    fn enter(&self, stage: Stage, now: Instant) {
        let mut taken = self.places.lock();
        if let Some(connection) = taken.connections.get_mut(&self.number) {
            (connection.stage, connection.since) = (stage, now);
        }
    }

    /// Completes when the connection must make room for another one.
    pub(crate) fn must_leave(&self) -> impl Future<Output = ()> + use<> {
        let mut room = self.room.clone();
        async move { while room.changed().await.is_ok() {} }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.places.lock().connections.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures_util::FutureExt as _;

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    fn has_left(place: &Place) -> bool {
        place.must_leave().now_or_never().is_some()
    }

    /// Returns as many requests in progress as one address may have.
    fn busy(places: &Places, from: &str, count: usize, now: Instant) -> Vec<Place> {
        let take = |_| {
            let place = places.take(address(from), now).unwrap();
            place.begin_request(now);
            place
        };
        (0..count).map(take).collect()
    }

    #[test]
    fn connections_of_one_address_are_limited_and_other_addresses_are_admitted() {
        let (places, now) = (Places::of_connections(), Instant::now());
        let mut held = busy(&places, "10.0.0.7", MOST_OF_ONE_ADDRESS, now);
        assert!(places.take(address("10.0.0.7"), now).is_none());
        assert!(
            places.take(address("::ffff:10.0.0.7"), now).is_none(),
            "it is the same"
        );
        assert!(places.take(address("10.0.0.8"), now).is_some());
        held.pop();
        assert!(places.take(address("10.0.0.7"), now).is_some());
        drop(held);
        assert!(
            places.lock().connections.is_empty(),
            "who is gone is forgotten"
        );
    }

    #[test]
    fn addresses_of_one_ipv6_network_share_one_limit() {
        let (places, now) = (Places::of_connections(), Instant::now());
        let held: Vec<Place> = (0..MOST_OF_ONE_ADDRESS)
            .flat_map(|host| busy(&places, &format!("2001:db8::{host:x}"), 1, now))
            .collect();
        assert!(places.take(address("2001:db8::ffff"), now).is_none());
        assert!(places.take(address("2001:db8:0:1::1"), now).is_some());
        drop(held);
    }

    #[test]
    fn total_number_of_connections_is_limited() {
        let (places, now) = (Places::of_connections(), Instant::now());
        let here = address("127.0.0.1");
        let held = busy(&places, "127.0.0.1", MOST_CONNECTIONS, now);
        assert!(
            places.take(here, now).is_none() && places.take(address("10.0.0.7"), now).is_none()
        );
        drop(held);
        assert!(places.take(here, now).is_some());
    }

    /// Regression: 300 connections that sent nothing kept everybody out for up to 25 s.
    #[test]
    fn the_slowest_connection_of_the_busiest_address_makes_room() {
        let (places, start) = (Places::of_connections(), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        let others: Vec<Place> = (1..=10)
            .map(|host| {
                places
                    .take(address(&format!("10.0.0.{host}")), at(0))
                    .unwrap()
            })
            .collect();
        let slow: Vec<Place> = (1..=MOST_CONNECTIONS as u64 - 10)
            .map(|second| places.take(address("127.0.0.1"), at(second)).unwrap())
            .collect();
        slow[0].begin_request(at(300));
        let new = places.take(address("10.0.1.1"), at(301)).unwrap();
        assert!(
            has_left(&slow[1]),
            "it has waited longest, because the first one has sent a request"
        );
        assert!(!slow.iter().skip(2).any(has_left) && !others.iter().any(has_left));
        assert!(!has_left(&slow[0]) && !has_left(&new));
        assert_eq!(places.lock().connections.len(), MOST_CONNECTIONS);
    }

    #[test]
    fn a_request_that_takes_too_long_makes_room_last() {
        let (places, start) = (Places::of_connections(), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        let busy = busy(&places, "10.0.0.7", MOST_OF_ONE_ADDRESS, at(0));
        busy[5].end_request(at(9));
        let _first = places.take(address("10.0.0.7"), at(9)).unwrap();
        assert!(has_left(&busy[5]), "it has no request");
        let second = places.take(address("10.0.0.7"), at(9)).unwrap();
        second.begin_request(at(9));
        assert!(places.take(address("10.0.0.7"), at(9)).is_none());
        assert!(places.take(address("10.0.0.7"), at(10)).is_some());
        assert!(has_left(&busy[0]), "its request has taken 10 s");
    }

    /// Regression: 64 WebSockets whose clients read nothing kept others out for 60 s.
    #[test]
    fn a_socket_makes_room_once_its_client_does_not_answer() {
        let (places, start) = (Places::of_sockets(), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        let sockets = busy(&places, "127.0.0.1", MOST_SOCKETS, at(0));
        let other = address("10.0.0.7");
        for second in (2..=20).step_by(2) {
            sockets[1..]
                .iter()
                .for_each(|one| one.note_answer(at(second)));
            if second < 6 {
                assert!(places.take(other, at(second)).is_none(), "{second} s");
            }
        }
        let new = places.take(other, at(21)).unwrap();
        new.note_answer(at(21));
        assert!(has_left(&sockets[0]) && !sockets.iter().skip(1).any(has_left));
        assert!(
            places.take(other, at(21)).is_none(),
            "all others have answered"
        );
    }
}
