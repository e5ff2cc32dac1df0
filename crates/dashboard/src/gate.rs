//! Admission to the page: tokens, browser sessions, and a limit for wrong tokens.

use crate::error::DashboardError;
use crate::tokens::{PageRole, Tokens, hash, hexadecimal, random};
use axum::http::header::{AUTHORIZATION, COOKIE};
use axum::http::{HeaderMap, HeaderValue};
use spandrel_bus::Name;
use std::collections::{BTreeMap, VecDeque};
use std::net::IpAddr;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::watch;

/// Duration of a browser session. After it, the browser must present its token again.
const SESSION_LASTS: Duration = Duration::from_secs(12 * 3600);
/// Maximum number of concurrent sessions. A further session replaces the oldest.
const MOST_SESSIONS: usize = 1024;
/// Number of wrong tokens that one address may present in a row before the reply asks it to wait,
/// and the interval after which it may present one more.
const WRONG_AT_ONCE: u32 = 10;
const ONE_MORE_EVERY: Duration = Duration::from_secs(6);
/// Maximum number of addresses with recorded wrong tokens. If the record is full, addresses outside
/// it are rejected.
const MOST_ADDRESSES: usize = 4096;
/// Maximum number of annotations of one visitor in this time. They cannot be deleted.
const MOST_NOTES: usize = 30;
const NOTES_WITHIN: Duration = Duration::from_secs(3600);
/// Name of the session cookie.
const COOKIE_NAME: &str = "spandrel-session";

/// An admitted person or program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Visitor {
    pub(crate) name: Name,
    pub(crate) role: PageRole,
}

/// The end of a browser session, for connections that outlast a request.
#[derive(Clone, Debug)]
pub(crate) struct SessionEnd {
    until: Duration,
    /// Receives nothing. Its sender is dropped with the session.
    left: watch::Receiver<()>,
}

impl SessionEnd {
    /// Waits until the session expires, is ended by its user, or is replaced by a newer one.
    pub(crate) async fn wait(mut self, now: Duration) {
        let left = async { while self.left.changed().await.is_ok() {} };
        // Both outcomes mean the end of the session.
        let _ = tokio::time::timeout(self.until.saturating_sub(now), left).await;
    }
}

/// Reason for a rejection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    /// The request has no token, or a session that has ended.
    Unknown,
    /// The token is wrong.
    Wrong,
    /// The token is wrong, as were too many before it. After this time, the gate counts again from
    /// one less.
    Later(Duration),
}

/// Admits or rejects requests. Times count from the start of the page.
#[derive(Debug, Default)]
pub(crate) struct Gate {
    tokens: Tokens,
    /// Whether browsers must send the cookie over TLS only.
    is_secure: bool,
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    /// Sessions by the hash of the cookie's value.
    sessions: BTreeMap<String, Session>,
    wrong: BTreeMap<IpAddr, Wrong>,
    /// Times of the last annotations by name on the token, or by address without tokens.
    notes: BTreeMap<String, VecDeque<Duration>>,
}

#[derive(Debug)]
struct Session {
    visitor: Visitor,
    until: Duration,
    left: watch::Sender<()>,
}

/// Wrong tokens of one address: the number of remaining attempts, and the time of that count.
#[derive(Clone, Copy, Debug)]
struct Wrong {
    left: u32,
    as_of: Duration,
}

impl Wrong {
    fn now(self, now: Duration) -> Self {
        let gained = now.saturating_sub(self.as_of).as_secs() / ONE_MORE_EVERY.as_secs();
        let left = u64::from(self.left)
            .saturating_add(gained)
            .min(u64::from(WRONG_AT_ONCE));
        let as_of =
            self.as_of + ONE_MORE_EVERY.saturating_mul(u32::try_from(gained).unwrap_or(u32::MAX));
        // At most WRONG_AT_ONCE, which is a u32.
        Self {
            left: u32::try_from(left).unwrap_or(WRONG_AT_ONCE),
            as_of: as_of.min(now),
        }
    }
}

impl Gate {
    pub(crate) fn new(tokens: Tokens, is_secure: bool) -> Self {
        Self {
            tokens,
            is_secure,
            inner: Mutex::default(),
        }
    }

    /// Returns `true` if everybody may do everything, because there are no tokens.
    pub(crate) fn is_open(&self) -> bool {
        self.tokens.is_empty()
    }

    /// Returns `true` if browsers connect over TLS.
    pub(crate) fn is_secure(&self) -> bool {
        self.is_secure
    }

    /// Returns the visitor from the token or cookie of a request.
    pub(crate) fn admit(
        &self,
        headers: &HeaderMap,
        address: IpAddr,
        now: Duration,
    ) -> Result<Visitor, Refusal> {
        self.admit_for_long(headers, address, now)
            .map(|(visitor, _)| visitor)
    }

    /// Returns the visitor and the end of the session.
    ///
    /// The end is `None` for a token, which remains valid as long as the page runs.
    pub(crate) fn admit_for_long(
        &self,
        headers: &HeaderMap,
        address: IpAddr,
        now: Duration,
    ) -> Result<(Visitor, Option<SessionEnd>), Refusal> {
        if let Some(secret) = bearer(headers) {
            return self
                .check(secret, address, now)
                .map(|visitor| (visitor, None));
        }
        let inner = self.lock();
        let session = cookie(headers).and_then(|cookie| inner.sessions.get(&hash(cookie)));
        let session = session
            .filter(|session| session.until > now)
            .ok_or(Refusal::Unknown)?;
        let end = SessionEnd {
            until: session.until,
            left: session.left.subscribe(),
        };
        Ok((session.visitor.clone(), Some(end)))
    }

    /// Returns the visitor of a token. Each wrong token counts against the address.
    ///
    /// The count decides only how a wrong token is answered. A right token always admits, because
    /// others at the same address, such as a proxy or a forgotten script, may send wrong ones. A
    /// token has 256 random bits, so nobody finds one by trying.
    pub(crate) fn check(
        &self,
        secret: &str,
        address: IpAddr,
        now: Duration,
    ) -> Result<Visitor, Refusal> {
        if let Some(token) = self.tokens.find(secret) {
            return Ok(Visitor {
                name: token.name.clone(),
                role: token.role,
            });
        }
        let address = network_of(address);
        let mut inner = self.lock();
        let fresh = Wrong {
            left: WRONG_AT_ONCE,
            as_of: now,
        };
        let wrong = inner.wrong.get(&address).copied().unwrap_or(fresh).now(now);
        if wrong.left == 0 {
            return Err(Refusal::Later(
                (wrong.as_of + ONE_MORE_EVERY).saturating_sub(now),
            ));
        }
        inner
            .wrong
            .retain(|_, wrong| wrong.now(now).left < WRONG_AT_ONCE);
        if inner.wrong.len() >= MOST_ADDRESSES && !inner.wrong.contains_key(&address) {
            return Err(Refusal::Later(ONE_MORE_EVERY));
        }
        inner.wrong.insert(
            address,
            Wrong {
                left: wrong.left - 1,
                ..wrong
            },
        );
        Err(Refusal::Wrong)
    }

    /// Counts an annotation. Returns the time to wait if the visitor has sent too many.
    pub(crate) fn note(
        &self,
        visitor: Option<&Visitor>,
        address: IpAddr,
        now: Duration,
    ) -> Result<(), Duration> {
        let who = match visitor {
            Some(visitor) => visitor.name.to_string(),
            None => network_of(address).to_string(),
        };
        let mut inner = self.lock();
        for times in inner.notes.values_mut() {
            times.retain(|time| now.saturating_sub(*time) < NOTES_WITHIN);
        }
        inner.notes.retain(|_, times| !times.is_empty());
        if inner.notes.len() >= MOST_ADDRESSES && !inner.notes.contains_key(&who) {
            return Err(NOTES_WITHIN);
        }
        let times = inner.notes.entry(who).or_default();
        match times.front() {
            Some(first) if times.len() >= MOST_NOTES => {
                Err((*first + NOTES_WITHIN).saturating_sub(now))
            }
            _ => {
                times.push_back(now);
                Ok(())
            }
        }
    }

    /// Starts a browser session and returns the header that sets the cookie.
    pub(crate) fn begin(
        &self,
        visitor: Visitor,
        now: Duration,
    ) -> Result<HeaderValue, DashboardError> {
        let secret = hexadecimal(&random()?);
        let mut inner = self.lock();
        inner.sessions.retain(|_, session| session.until > now);
        if inner.sessions.len() >= MOST_SESSIONS {
            let oldest = inner
                .sessions
                .iter()
                .min_by_key(|(_, session)| session.until)
                .map(|(hash, _)| hash.clone());
            oldest.and_then(|oldest| inner.sessions.remove(&oldest));
        }
        inner.sessions.insert(
            hash(&secret),
            Session {
                visitor,
                until: now + SESSION_LASTS,
                left: watch::Sender::new(()),
            },
        );
        drop(inner);
        self.cookie(&secret, SESSION_LASTS)
    }

    /// Ends a browser session and returns the header that deletes the cookie.
    pub(crate) fn end(&self, headers: &HeaderMap) -> Result<HeaderValue, DashboardError> {
        if let Some(cookie) = cookie(headers) {
            self.lock().sessions.remove(&hash(cookie));
        }
        self.cookie("", Duration::ZERO)
    }

    fn cookie(&self, value: &str, lasts: Duration) -> Result<HeaderValue, DashboardError> {
        let secure = if self.is_secure { "; Secure" } else { "" };
        let lasts = lasts.as_secs();
        let text = format!(
            "{COOKIE_NAME}={value}; Path=/; HttpOnly; SameSite=Strict; Max-Age={lasts}{secure}"
        );
        // The text consists of digits and letters.
        HeaderValue::try_from(text).map_err(|_| DashboardError::NoRandom)
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // A panic leaves consistent data, because each change is one call.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns the /64 network of an IPv6 address, because its holder can use all 2⁶⁴ addresses of the
/// network.
pub(crate) fn network_of(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6((address.to_bits() & !u128::from(u64::MAX)).into()),
        address @ IpAddr::V4(_) => address,
    }
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    let (scheme, secret) = headers.get(AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then(|| secret.trim())
}

fn cookie(headers: &HeaderMap) -> Option<&str> {
    let all = headers
        .get_all(COOKIE)
        .iter()
        .filter_map(|value| value.to_str().ok());
    let mut pairs = all
        .flat_map(|value| value.split(';'))
        .filter_map(|pair| pair.trim().split_once('='));
    pairs
        .find(|(name, _)| *name == COOKIE_NAME)
        .map(|(_, value)| value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures_util::FutureExt as _;

    const HERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 7));

    fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    /// Returns a gate with the token of one viewer.
    fn gate() -> (Gate, String) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens.json");
        let secret =
            Tokens::issue(&path, Name::new("ada").unwrap(), PageRole::Viewer, false).unwrap();
        (Gate::new(Tokens::read(&path).unwrap(), true), secret)
    }

    fn header(name: axum::http::HeaderName, text: &str) -> HeaderMap {
        HeaderMap::from_iter([(name, HeaderValue::from_str(text).unwrap())])
    }

    #[test]
    fn only_a_valid_token_is_admitted() {
        let (gate, secret) = gate();
        let bearer = |secret: &str| header(AUTHORIZATION, &format!("Bearer {secret}"));
        assert_eq!(
            gate.admit(&bearer(&secret), HERE, at(0))
                .unwrap()
                .name
                .as_str(),
            "ada"
        );
        assert_eq!(
            gate.admit(&HeaderMap::new(), HERE, at(0)),
            Err(Refusal::Unknown)
        );
        for wrong in ["", "spandrel-", "x"] {
            assert_eq!(
                gate.admit(&bearer(wrong), HERE, at(0)),
                Err(Refusal::Wrong),
                "{wrong}"
            );
        }
        assert_eq!(
            gate.admit(&header(AUTHORIZATION, &secret), HERE, at(0)),
            Err(Refusal::Unknown)
        );
    }

    #[test]
    fn a_session_lasts_until_its_end() {
        let (gate, secret) = gate();
        let visitor = gate.check(&secret, HERE, at(0)).unwrap();
        let told = gate
            .begin(visitor, at(0))
            .unwrap()
            .to_str()
            .unwrap()
            .to_owned();
        for part in ["HttpOnly", "SameSite=Strict", "Secure", "Path=/"] {
            assert!(told.contains(part), "{told}");
        }
        let cookie = header(
            COOKIE,
            &format!("theme=dark; {}", told.split(';').next().unwrap()),
        );
        assert!(gate.admit(&cookie, HERE, at(12 * 3600 - 1)).is_ok());
        assert_eq!(
            gate.admit(&cookie, HERE, at(12 * 3600)),
            Err(Refusal::Unknown)
        );
        gate.end(&cookie).unwrap();
        assert_eq!(gate.admit(&cookie, HERE, at(1)), Err(Refusal::Unknown));
    }

    #[tokio::test]
    async fn session_ends_at_its_expiry_or_at_sign_out() {
        let (gate, secret) = gate();
        let enter = || {
            let visitor = gate.check(&secret, HERE, at(0)).unwrap();
            let told = gate
                .begin(visitor, at(0))
                .unwrap()
                .to_str()
                .unwrap()
                .to_owned();
            header(COOKIE, told.split(';').next().unwrap())
        };
        let (first, second) = (enter(), enter());
        let end = |cookie: &HeaderMap| gate.admit_for_long(cookie, HERE, at(0)).unwrap().1.unwrap();
        let (of_first, of_second) = (end(&first), end(&second));
        assert!(
            of_first.clone().wait(at(0)).now_or_never().is_none(),
            "it goes on"
        );
        gate.end(&first).unwrap();
        of_first.wait(at(0)).await;
        assert!(
            of_second
                .clone()
                .wait(at(12 * 3600 - 1))
                .now_or_never()
                .is_none(),
            "it is another one"
        );
        of_second.wait(at(12 * 3600)).await;
        let bearer = header(AUTHORIZATION, &format!("Bearer {secret}"));
        assert!(
            gate.admit_for_long(&bearer, HERE, at(0))
                .unwrap()
                .1
                .is_none(),
            "a token is no session"
        );
    }

    #[test]
    fn sessions_are_bounded() {
        let (gate, secret) = gate();
        let visitor = gate.check(&secret, HERE, at(0)).unwrap();
        for second in 0..2000 {
            gate.begin(visitor.clone(), at(second)).unwrap();
        }
        assert_eq!(gate.lock().sessions.len(), MOST_SESSIONS);
    }

    #[test]
    fn wrong_tokens_are_limited_by_address() {
        let (gate, _) = gate();
        for _ in 0..WRONG_AT_ONCE {
            assert_eq!(gate.check("wrong", HERE, at(0)), Err(Refusal::Wrong));
        }
        assert_eq!(gate.check("wrong", HERE, at(0)), Err(Refusal::Later(at(6))));
        assert_eq!(gate.check("wrong", HERE, at(5)), Err(Refusal::Later(at(1))));
        let elsewhere = "10.0.0.8".parse().unwrap();
        assert_eq!(gate.check("wrong", elsewhere, at(5)), Err(Refusal::Wrong));
        assert_eq!(gate.check("wrong", HERE, at(6)), Err(Refusal::Wrong));
        assert!(matches!(
            gate.check("wrong", HERE, at(6)),
            Err(Refusal::Later(_))
        ));
    }

    /// Regression: wrong tokens from one address also kept out right ones from it.
    #[test]
    fn a_right_token_admits_whatever_others_at_its_address_send() {
        let (gate, secret) = gate();
        for _ in 0..2 * WRONG_AT_ONCE {
            let _ = gate.check("wrong", HERE, at(0));
        }
        assert!(gate.check(&secret, HERE, at(0)).is_ok());
    }

    #[test]
    fn annotations_are_limited_by_visitor() {
        let (gate, secret) = gate();
        let ada = gate.check(&secret, HERE, at(0)).unwrap();
        for second in 0..30 {
            assert_eq!(gate.note(Some(&ada), HERE, at(second)), Ok(()));
        }
        assert_eq!(gate.note(Some(&ada), HERE, at(600)), Err(at(3000)));
        assert_eq!(gate.note(None, HERE, at(600)), Ok(()));
        assert_eq!(gate.note(Some(&ada), HERE, at(3600)), Ok(()));
        assert_eq!(gate.note(Some(&ada), HERE, at(3600)), Err(at(1)));
        assert_eq!(gate.note(None, HERE, at(7300)), Ok(()));
        assert_eq!(gate.lock().notes.len(), 1);
    }

    #[test]
    fn addresses_of_one_ipv6_network_count_together() {
        let (gate, _) = gate();
        for host in 0..WRONG_AT_ONCE {
            let address = format!("2001:db8::{host:x}").parse().unwrap();
            assert_eq!(gate.check("wrong", address, at(0)), Err(Refusal::Wrong));
        }
        let another = "2001:db8::ffff".parse().unwrap();
        assert!(matches!(
            gate.check("wrong", another, at(0)),
            Err(Refusal::Later(_))
        ));
    }

    #[test]
    fn number_of_addresses_is_bounded_and_old_addresses_are_removed() {
        let (gate, secret) = gate();
        let address = |number: u32| IpAddr::V4(std::net::Ipv4Addr::from_bits(number));
        for number in 0..=MOST_ADDRESSES as u32 {
            let _ = gate.check("wrong", address(number), at(0));
        }
        assert_eq!(gate.lock().wrong.len(), MOST_ADDRESSES);
        assert!(matches!(
            gate.check("wrong", address(1 << 20), at(0)),
            Err(Refusal::Later(_))
        ));
        assert!(gate.check(&secret, address(1 << 20), at(0)).is_ok());
        assert_eq!(
            gate.check("wrong", address(1 << 20), at(3600)),
            Err(Refusal::Wrong)
        );
        assert_eq!(gate.lock().wrong.len(), 1);
    }
}
