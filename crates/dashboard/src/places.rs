//! Limits on the number of connections, in total and per address.

use crate::gate::network_of;
use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tracing::warn;

/// Maximum number of concurrent connections, including handshakes. Active WebSockets have a
/// separate limit.
const MOST_CONNECTIONS: usize = 256;
/// Maximum number of connections from one address (for IPv6, from one /64 network). The loopback
/// interface has no such limit, because a local proxy serves many clients.
const MOST_OF_ONE_ADDRESS: usize = 32;

/// A shared count of open connections. Clones share the count.
#[derive(Clone, Debug, Default)]
pub(crate) struct Places(Arc<Mutex<Taken>>);

#[derive(Debug, Default)]
struct Taken {
    all: usize,
    by_address: HashMap<IpAddr, usize>,
    refused: u64,
}

/// A place for one connection. It becomes free when dropped.
#[derive(Debug)]
pub(crate) struct Place {
    places: Places,
    address: IpAddr,
}

impl Places {
    /// Reserves a place for a connection from an address. Returns `None` if all places are taken.
    pub(crate) fn take(&self, address: IpAddr) -> Option<Place> {
        let address = network_of(address);
        let mut taken = self.lock();
        let of_address = taken.by_address.get(&address).copied().unwrap_or(0);
        let is_full = taken.all >= MOST_CONNECTIONS
            || (of_address >= MOST_OF_ONE_ADDRESS && !address.is_loopback());
        if is_full {
            taken.refused += 1;
            let refused = taken.refused;
            if refused.is_power_of_two() {
                warn!(%address, of_address, in_all = taken.all, refused, "too many connections to the page; closing the new connection");
            }
            return None;
        }
        taken.all += 1;
        taken.by_address.insert(address, of_address + 1);
        drop(taken);
        Some(Place {
            places: self.clone(),
            address,
        })
    }

    fn lock(&self) -> MutexGuard<'_, Taken> {
        // No code that holds this lock panics.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.lock();
        taken.all -= 1;
        if let Some(of_address) = taken.by_address.get_mut(&self.address) {
            *of_address -= 1;
            if *of_address == 0 {
                taken.by_address.remove(&self.address);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    #[test]
    fn connections_of_one_address_are_limited_and_other_addresses_are_admitted() {
        let places = Places::default();
        let mut held: Vec<Place> = (0..MOST_OF_ONE_ADDRESS)
            .map(|_| places.take(address("10.0.0.7")).unwrap())
            .collect();
        assert!(places.take(address("10.0.0.7")).is_none());
        assert!(
            places.take(address("::ffff:10.0.0.7")).is_none(),
            "it is the same"
        );
        assert!(places.take(address("10.0.0.8")).is_some());
        held.pop();
        assert!(places.take(address("10.0.0.7")).is_some());
        drop(held);
        assert_eq!(places.lock().all, 0);
        assert!(
            places.lock().by_address.is_empty(),
            "who is gone is forgotten"
        );
    }

    #[test]
    fn addresses_of_one_ipv6_network_share_one_limit() {
        let places = Places::default();
        let of_host = |host: usize| address(&format!("2001:db8::{host:x}"));
        let held: Vec<Place> = (0..MOST_OF_ONE_ADDRESS)
            .map(|host| places.take(of_host(host)).unwrap())
            .collect();
        assert!(places.take(address("2001:db8::ffff")).is_none());
        assert!(places.take(address("2001:db8:0:1::1")).is_some());
        drop(held);
    }

    #[test]
    fn total_number_of_connections_is_limited() {
        let places = Places::default();
        let here = address("127.0.0.1");
        let held: Vec<Place> = (0..MOST_CONNECTIONS)
            .map(|_| places.take(here).unwrap())
            .collect();
        assert!(places.take(here).is_none() && places.take(address("10.0.0.7")).is_none());
        drop(held);
        assert!(places.take(here).is_some());
    }
}
