//! Strong motion: a structure softens while it shakes, and most of the stiffness returns.
//!
//! In strong motion and until the structure has settled, a loss is therefore reported as softening
//! in motion, and raises no alert. Earlier motions show whether it is usual at this amplitude.

use serde::{Deserialize, Serialize};
use spandrel_earthquake::amplitude::compare;
use spandrel_earthquake::{Expected, Softened};
use std::collections::VecDeque;

use crate::{ParameterEstimate, Reference};

/// Time after strong motion until the structure has settled, ns of measurement time.
///
/// It is that of the reports of earthquakes.
const SETTLES_NS: i64 = 300_000_000_000;
/// Maximum number of earlier motions in memory. More would hardly change the prediction.
const MOST_EARLIER: usize = 32;

/// The motion of the structure, and the softening of one parameter in it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Motion {
    /// The last strong motion. `None` once the structure has settled.
    present: Option<Present>,
    /// Time since which the loss has been credible in this motion, ns.
    softening_since_ns: Option<i64>,
    /// Earlier strong motions, oldest first.
    earlier: VecDeque<Shaken>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Present {
    /// Time of the last frame in strong motion, ns.
    last_ns: i64,
    is_strong: bool,
    /// Largest acceleration, m/s².
    peak_m_per_s2: f64,
    /// The softest estimate in strong motion. `None` if there was none.
    softest: Option<Soft>,
}

/// An earlier strong motion, and the softest estimate in it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Shaken {
    peak_m_per_s2: f64,
    softest: Soft,
}

/// Mean and standard deviation of an estimate, ratios to nominal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Soft {
    mean: f64,
    std: f64,
}

/// The present strong motion, for the words of an alert.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Shaking {
    /// Largest acceleration, m/s².
    pub(crate) peak_m_per_s2: f64,
    /// Softening predicted from earlier motions. `None` without an earlier motion.
    pub(crate) expected: Option<Expected>,
}

impl Motion {
    /// Takes the largest acceleration (m/s²) of the present strong motion at a frame, `None` in
    /// weak motion. Returns `true` if the strong motion has just ended.
    pub(crate) fn take(&mut self, strong_m_per_s2: Option<f32>, time_ns: i64) -> bool {
        let since_ns = self
            .present
            .map(|present| time_ns.saturating_sub(present.last_ns));
        // A replayed record starts at an earlier time.
        if since_ns.is_some_and(|since_ns| !(0..SETTLES_NS).contains(&since_ns)) {
            self.settle();
        }
        let Some(peak) = strong_m_per_s2.map(f64::from) else {
            let was_strong = self.present.as_mut();
            return was_strong
                .is_some_and(|present| std::mem::replace(&mut present.is_strong, false));
        };
        // Further strong motion before the structure has settled belongs to the same one.
        let present = self.present.get_or_insert(Present {
            last_ns: time_ns,
            is_strong: true,
            peak_m_per_s2: peak,
            softest: None,
        });
        present.last_ns = time_ns;
        present.is_strong = true;
        present.peak_m_per_s2 = present.peak_m_per_s2.max(peak);
        false
    }

    /// Returns `true` in strong motion, and until the structure has settled.
    pub(crate) fn is_unsettled(&self) -> bool {
        self.present.is_some()
    }

    /// Returns the time since which a loss has been credible in the present motion, ns.
    pub(crate) fn softening_since_ns(&self) -> Option<i64> {
        self.softening_since_ns
    }

    /// Takes an estimate that the data support, and whether its loss is credible.
    pub(crate) fn soften(&mut self, estimate: &ParameterEstimate, is_credible: bool) {
        self.softening_since_ns =
            is_credible.then(|| self.softening_since_ns.unwrap_or(estimate.time_ns));
        let present = self.present.as_mut().filter(|present| present.is_strong);
        if let Some(present) = present
            && estimate.mean > 0.0
            && present.softest.is_none_or(|soft| estimate.mean < soft.mean)
        {
            present.softest = Some(Soft {
                mean: estimate.mean,
                std: estimate.std,
            });
        }
    }

    /// Forgets that a loss is credible, because nothing is decided.
    pub(crate) fn suspend(&mut self) {
        self.softening_since_ns = None;
    }

    /// Returns the present motion compared with the earlier motions. `limit_m_per_s2` is the
    /// acceleration above which motion is strong.
    pub(crate) fn shaking(&self, reference: &Reference, limit_m_per_s2: f64) -> Option<Shaking> {
        let present = self.present.as_ref()?;
        let softened = |peak_m_per_s2: f64, soft: &Soft| Softened {
            decades: (peak_m_per_s2 / limit_m_per_s2).log10().max(0.0),
            change: (soft.mean / reference.mean()).ln(),
            variance: (soft.std / soft.mean).powi(2) + (reference.std() / reference.mean()).powi(2),
        };
        let earlier: Vec<Softened> = self
            .earlier
            .iter()
            .map(|shaken| softened(shaken.peak_m_per_s2, &shaken.softest))
            .collect();
        let expected = present
            .softest
            .and_then(|soft| compare(&earlier, &softened(present.peak_m_per_s2, &soft)));
        Some(Shaking {
            peak_m_per_s2: present.peak_m_per_s2,
            expected,
        })
    }

    /// Ends the present motion, which is an earlier one from now on.
    fn settle(&mut self) {
        self.softening_since_ns = None;
        if let Some(Present {
            peak_m_per_s2,
            softest: Some(softest),
            ..
        }) = self.present.take()
        {
            self.earlier.push_back(Shaken {
                peak_m_per_s2,
                softest,
            });
            let surplus = self.earlier.len().saturating_sub(MOST_EARLIER);
            self.earlier.drain(..surplus);
        }
    }
}
