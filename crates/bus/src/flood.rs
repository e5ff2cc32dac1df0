//! Rate limit per key, which drops excess messages before they are decoded.
//!
//! A source that floods the network thus does not take the time of its readers.

use std::collections::BTreeMap;
use std::time::Duration;

/// Maximum number of messages of one key per second, and in one burst.
///
/// The limits are far above the rate of a record at full speed, which is a few thousand per second.
/// They are far below the decoding rate of a reader.
const PER_SECOND: u32 = 10_000;
const AT_ONCE: u32 = 20_000;
/// Maximum number of keys per reader. Names come from structure files, so that no site has nearly
/// as many keys.
const MOST_KEYS: usize = 16_384;
/// Maximum length of a key, in bytes. All keys of names with at most 64 bytes are shorter.
pub(crate) const MAX_KEY_BYTES: usize = 512;

/// Remaining number of messages of a key, and the time at which it was computed.
#[derive(Clone, Copy, Debug)]
struct Allowance {
    left: u32,
    as_of: Duration,
}

/// Reason for dropping a message before it is decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Flooded {
    /// This key has too many messages.
    TooOften,
    /// There are too many keys.
    TooManyKeys,
    /// The key is longer than any valid key.
    KeyTooLong,
}

impl Flooded {
    /// Returns the reason under which the message is counted.
    pub(crate) fn reason(self) -> &'static str {
        match self {
            Self::TooOften => "flood",
            Self::TooManyKeys => "too-many-keys",
            Self::KeyTooLong => "key-too-long",
        }
    }
}

/// Allowances of all keys. Times count from an arbitrary start.
#[derive(Debug, Default)]
pub(crate) struct FloodGate {
    keys: BTreeMap<String, Allowance>,
}

impl FloodGate {
    /// Accepts a message of a key, or returns the reason for dropping it.
    pub(crate) fn take(&mut self, key: &str, now: Duration) -> Result<(), Flooded> {
        if key.len() > MAX_KEY_BYTES {
            return Err(Flooded::KeyTooLong);
        }
        if let Some(allowance) = self.keys.get_mut(key) {
            return allowance.take(now);
        }
        if self.keys.len() >= MOST_KEYS {
            // Inactive keys have a full allowance, so that they need no entry.
            self.keys
                .retain(|_, allowance| allowance.gained(now) < AT_ONCE);
            if self.keys.len() >= MOST_KEYS {
                return Err(Flooded::TooManyKeys);
            }
        }
        self.keys.insert(
            key.to_owned(),
            Allowance {
                left: AT_ONCE - 1,
                as_of: now,
            },
        );
        Ok(())
    }
}

impl Allowance {
    /// Returns the number of messages that the key may send now.
    fn gained(&self, now: Duration) -> u32 {
        let gained = now.saturating_sub(self.as_of).as_secs_f64() * f64::from(PER_SECOND);
        // The cast saturates at the limit of u32.
        self.left.saturating_add(gained as u32).min(AT_ONCE)
    }

    fn take(&mut self, now: Duration) -> Result<(), Flooded> {
        let left = self.gained(now);
        if left > self.left {
            *self = Self { left, as_of: now };
        }
        self.left = self.left.checked_sub(1).ok_or(Flooded::TooOften)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taken(gate: &mut FloodGate, key: &str, count: u32, now: Duration) -> u32 {
        (0..count).filter(|_| gate.take(key, now).is_ok()).count() as u32
    }

    #[test]
    fn burst_passes_up_to_its_limit() {
        let mut gate = FloodGate::default();
        assert_eq!(taken(&mut gate, "a", 30_000, Duration::ZERO), AT_ONCE);
        assert_eq!(gate.take("a", Duration::ZERO), Err(Flooded::TooOften));
        assert_eq!(taken(&mut gate, "b", 5, Duration::ZERO), 5);
    }

    #[test]
    fn steady_rate_passes_and_a_flood_is_limited_to_the_rate() {
        let mut gate = FloodGate::default();
        for tick in 0..100_u32 {
            let now = Duration::from_millis(10) * tick;
            assert_eq!(
                taken(&mut gate, "steady", PER_SECOND / 100, now),
                PER_SECOND / 100
            );
        }
        let mut flooding = 0;
        for tick in 0..1000_u32 {
            flooding += taken(&mut gate, "flood", 1000, Duration::from_millis(10) * tick);
        }
        assert!(
            flooding <= AT_ONCE + 10 * PER_SECOND && flooding > 9 * PER_SECOND,
            "{flooding}"
        );
    }

    #[test]
    fn allowance_accumulates_between_frequent_messages() {
        let mut gate = FloodGate::default();
        taken(&mut gate, "a", AT_ONCE, Duration::ZERO);
        let often = (1..=10_000_u32)
            .filter(|tick| gate.take("a", Duration::from_micros(50) * *tick).is_ok())
            .count();
        assert!((4_000..=5_000).contains(&often), "{often} in half a second");
    }

    #[test]
    fn number_of_keys_is_bounded_and_quiet_keys_are_replaced() {
        let mut gate = FloodGate::default();
        for key in 0..MOST_KEYS {
            gate.take(&key.to_string(), Duration::ZERO).unwrap();
        }
        assert_eq!(
            gate.take("one more", Duration::ZERO),
            Err(Flooded::TooManyKeys)
        );
        assert_eq!(gate.keys.len(), MOST_KEYS);
        assert_eq!(gate.take("one more", Duration::from_secs(60)), Ok(()));
        assert_eq!(
            gate.take(&"k".repeat(MAX_KEY_BYTES + 1), Duration::ZERO),
            Err(Flooded::KeyTooLong)
        );
    }
}
