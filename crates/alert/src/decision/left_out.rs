//! The reference of a parameter while a sensor is left out, learnt from the estimates without it.
//!
//! If the model is wrong, the estimate changes as soon as a sensor is left out. A reference that
//! was learnt with this sensor then no longer applies, so the rule learns another one from a span
//! without it. A later loss is a loss against this reference.
//!
//! A loss that has occurred together with the fault of the sensor looks like the change that the
//! model causes. A span whose estimates may show a loss of the rule is therefore no reference.

use spandrel_bus::Excluded;

use crate::{Learning, ParameterEstimate, Reference};

/// The reference without some sensors, or the span from which it is being learnt.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct LeftOut {
    excluded: Excluded,
    span: Option<Span>,
    reference: Option<Reference>,
}

/// The estimates of a span so far.
#[derive(Debug, Clone, PartialEq)]
struct Span {
    started_ns: i64,
    learning: Learning,
}

impl LeftOut {
    /// Starts again if other sensors are left out than before.
    pub(super) fn enter(&mut self, excluded: Excluded) {
        if self.excluded != excluded {
            *self = Self {
                excluded,
                ..Self::default()
            };
        }
    }

    /// Returns `true` if estimates count as less certain, because no reference without the sensors
    /// is known.
    pub(super) fn widens(&self) -> bool {
        self.excluded != Excluded::None && self.reference.is_none()
    }

    /// Interrupts the span. A reference that is known remains.
    pub(super) fn interrupt(&mut self) {
        self.span = None;
    }

    /// Returns the reference without the sensors. `None` if it is not known.
    pub(super) fn reference(&self) -> Option<Reference> {
        self.reference
    }

    /// Takes an estimate without the sensors, until a span of `span_ns` is over.
    ///
    /// If `accepts` rejects the reference of a span, the next span begins.
    pub(super) fn learn(
        &mut self,
        estimate: &ParameterEstimate,
        span_ns: i64,
        accepts: impl Fn(&Reference) -> bool,
    ) {
        if self.reference.is_some() {
            return;
        }
        let time_ns = estimate.time_ns;
        // A replayed record starts at an earlier time.
        let running = self.span.take().filter(|span| span.started_ns <= time_ns);
        let mut span = running.unwrap_or(Span {
            started_ns: time_ns,
            learning: Learning::new(),
        });
        span.learning.add(estimate.mean, estimate.std);
        if time_ns.saturating_sub(span.started_ns) < span_ns {
            self.span = Some(span);
            return;
        }
        let summary = span.learning.summary();
        let found = summary.and_then(|span| Reference::new(span.mean, span.variance().sqrt()).ok());
        self.reference = found.filter(accepts);
    }
}
