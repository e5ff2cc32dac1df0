//! Decoding of received samples, within limits.

use std::time::{Duration, Instant};

use zenoh::bytes::ZBytes;
use zenoh::sample::Sample;

use crate::flood::{FloodGate, Flooded};
use crate::message::{DecodeError, MAX_LABEL_BYTES, MAX_MESSAGE_BYTES, Message};

/// Decodes a message. Checks its size before its fragments are joined.
pub(crate) fn read<M: Message>(sample: &Sample) -> Result<M, DecodeError> {
    let bytes = sample.payload().len();
    if bytes > MAX_MESSAGE_BYTES {
        return Err(DecodeError::TooLarge { bytes });
    }
    let mut message = M::decode(&sample.encoding().to_string(), &sample.payload().to_bytes())?;
    let attachment = sample.attachment();
    let attachment = attachment.filter(|attachment| attachment.len() <= MAX_LABEL_BYTES);
    if let Some(Ok(text)) = attachment.map(ZBytes::try_to_string) {
        message.attach(&text);
    }
    Ok(message)
}

/// A [`FloodGate`] that uses the monotonic clock.
#[derive(Debug)]
pub(crate) struct Intake {
    gate: FloodGate,
    start: Instant,
}

impl Intake {
    pub(crate) fn new() -> Self {
        #[expect(
            clippy::disallowed_methods,
            reason = "floods are detected with the monotonic clock"
        )]
        let start = Instant::now();
        Self {
            gate: FloodGate::default(),
            start,
        }
    }

    /// Accepts a sample, or returns the reason for dropping it.
    pub(crate) fn take(&mut self, sample: &Sample) -> Result<(), Flooded> {
        let since: Duration = self.start.elapsed();
        self.gate.take(sample.key_expr().as_str(), since)
    }
}
