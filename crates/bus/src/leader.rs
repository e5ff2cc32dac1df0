//! Election of the leader if several processes can publish one stream.
//!
//! A claim is a liveliness token with a term in its key. The highest term leads. Of equal terms,
//! the instance whose name sorts last leads. All processes that see the same claims therefore
//! agree, and a process that sees a higher claim than its own withdraws.
//!
//! Two processes that do not see each other may both lead. Their blocks contain the term, and
//! readers accept only the highest ([`Block::term`](crate::Block::term)).

use std::collections::BTreeSet;
use std::time::Duration;

use crate::BoxedFuture;
use crate::error::BusError;
use crate::keys::Keys;
use crate::live::{LiveToken, LiveWatch};
use crate::message::StateMessage;
use crate::name::Name;
use crate::receive::read;
use crate::session::Bus;
use tracing::debug;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::ConsolidationMode;

/// A claim to lead. The highest claim wins.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Claim {
    // The derived order depends on the order of the fields.
    term: u64,
    instance: Name,
}

impl Claim {
    /// Creates the claim of an instance of a service. The term should be higher than all terms that
    /// the instance knows.
    #[must_use]
    pub fn new(term: u64, instance: Name) -> Self {
        Self { term, instance }
    }

    /// Returns the term.
    #[must_use]
    pub fn term(&self) -> u64 {
        self.term
    }

    /// Parses the claim in a key of [`Keys::leader`]. Returns `None` if the key is not a claim.
    fn from_key(key: &str) -> Option<Self> {
        let (_, chunk) = key.rsplit_once('/')?;
        let (term, instance) = chunk.split_once('-')?;
        Some(Self {
            term: term.parse().ok()?,
            instance: Name::new(instance).ok()?,
        })
    }

    fn key(&self, keys: &Keys) -> Result<String, BusError> {
        let name = Name::new(format!("{}-{}", self.term, self.instance));
        Ok(keys.leader(&name.map_err(|reason| BusError::Claim { reason })?))
    }
}

impl std::fmt::Display for Claim {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} in term {}", self.instance, self.term)
    }
}

/// Returns the highest claim among these keys.
fn leading(keys: &BTreeSet<String>) -> Option<Claim> {
    keys.iter().filter_map(|key| Claim::from_key(key)).max()
}

/// The claims to lead one identification, with their changes.
#[derive(Debug)]
pub struct Claims {
    watch: LiveWatch,
}

impl Claims {
    /// Returns the highest claim that this process knows, including its own. Returns `None` if it
    /// knows no claim.
    #[must_use]
    pub fn leading(&self) -> Option<Claim> {
        leading(&self.watch.present())
    }

    /// Waits until a claim appears or disappears.
    pub async fn changed(&mut self) {
        self.watch.changed().await;
    }
}

impl Bus {
    /// Returns a unique name of this session.
    ///
    /// # Errors
    /// Fails if Zenoh's id is not a name. In practice it is, because it consists of at most 32
    /// hexadecimal digits.
    pub fn instance(&self) -> Result<Name, BusError> {
        Name::new(self.session().zid().to_string()).map_err(|reason| BusError::Claim { reason })
    }

    /// Watches the claims to lead the identification of a structure.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key expression or the session is closed.
    pub async fn watch_claims(&self, keys: &Keys) -> Result<Claims, BusError> {
        Ok(Claims {
            watch: self.watch_live(keys.all_leaders()).await?,
        })
    }

    /// Claims to lead the identification of a structure until the token is dropped.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub async fn claim(&self, keys: &Keys, claim: &Claim) -> Result<LiveToken, BusError> {
        self.announce(claim.key(keys)?).await
    }

    /// Queries the network for the highest current claim.
    ///
    /// The replies include all earlier claims of other processes, except those whose link is lost
    /// or which do not reply within `timeout`. Returns `None` without any claim.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key expression or the session is closed.
    pub async fn query_leader(
        &self,
        keys: &Keys,
        timeout: Duration,
    ) -> Result<Option<Claim>, BusError> {
        Ok(leading(
            &self.query_tokens(&keys.all_leaders(), timeout).await?,
        ))
    }

    /// Queries the identification services of a structure for their state, and returns the state
    /// with the highest term. Returns `None` without a valid reply within `timeout`.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub fn ask_for_state<'a>(
        &'a self,
        keys: &'a Keys,
        timeout: Duration,
    ) -> BoxedFuture<'a, Result<Option<StateMessage>, BusError>> {
        Box::pin(async move {
            let key = keys.state();
            let asked = self
                .session()
                .get(&key)
                .consolidation(ConsolidationMode::None)
                // States have several megabytes. They wait for all other messages, but must not be
                // dropped.
                .priority(Priority::DataLow)
                .congestion_control(CongestionControl::Block)
                .timeout(timeout)
                .await;
            let replies = match asked {
                Ok(replies) => replies,
                Err(source) => return Err(BusError::Put { key, source }),
            };
            let mut highest: Option<StateMessage> = None;
            while let Ok(reply) = replies.recv_async().await {
                match reply.result().map(read::<StateMessage>) {
                    Ok(Ok(state))
                        if highest.as_ref().is_none_or(|other| state.term > other.term) =>
                    {
                        highest = Some(state)
                    }
                    Ok(Ok(_superseded)) => {}
                    Ok(Err(error)) => debug!(key, %error, "state rejected"),
                    Err(error) => debug!(key, error = ?error.payload().try_to_string(), "no state"),
                }
            }
            Ok(highest)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn claim(term: u64, instance: &str) -> Claim {
        Claim::new(term, Name::new(instance).unwrap())
    }

    fn keys() -> Keys {
        Keys::parse("spandrel", "tower").unwrap()
    }

    #[test]
    fn highest_term_leads_and_then_the_last_name() {
        let of = |claims: &[Claim]| {
            leading(
                &claims
                    .iter()
                    .map(|claim| claim.key(&keys()).unwrap())
                    .collect(),
            )
        };
        assert_eq!(of(&[]), None);
        assert_eq!(
            of(&[claim(9, "b"), claim(10, "a")]),
            Some(claim(10, "a")),
            "numbers, not texts"
        );
        assert_eq!(
            of(&[claim(10, "a"), claim(10, "c"), claim(10, "b")]),
            Some(claim(10, "c"))
        );
    }

    #[test]
    fn claim_is_read_back_from_its_key_and_not_from_other_keys() {
        let highest = claim(u64::MAX, &"f".repeat(32));
        assert_eq!(
            Claim::from_key(&highest.key(&keys()).unwrap()),
            Some(highest)
        );
        for key in [
            "",
            "spandrel/tower/leader/identify/7",
            "leader/identify/x-a",
            "leader/identify/7-",
            "7-a",
        ] {
            assert_eq!(Claim::from_key(key), None, "{key}");
        }
    }
}
