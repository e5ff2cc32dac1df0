//! Settings of a station.

use crate::error::FilterError;
use crate::fusion::compression::MotionExchange;
use crate::fusion::detector::GlobalDetector;
use crate::fusion::gaussian::Gaussian;
use crate::fusion::local::FeedbackRule;
use crate::fusion::mean_limits::MeanLimits;
use nalgebra::DVector;
use serde::{Deserialize, Serialize};

/// The rule that fuses densities.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FusionRule {
    /// The product of all densities, as published. Only for comparison.
    Published,
    /// Counts the shared density once and adds the information that each node has learnt.
    PriorCorrect(Sharing),
}

impl Default for FusionRule {
    fn default() -> Self {
        Self::PriorCorrect(Sharing::default())
    }
}

/// The assumed overlap of the information that nodes learn from shared excitation.
///
/// The information of each node is divided by `γ`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sharing {
    /// `γ = N_s`: never overconfident, for any correlation (covariance intersection with equal
    /// weights).
    #[default]
    All,
    /// `γ = 1`: the nodes learn independently.
    Nothing,
    /// Any `γ` of at least 1, limited to the number of nodes.
    Factor(f64),
}

impl Sharing {
    /// Returns `γ` for `nodes` nodes, or for the sum of their weights if weights are graded.
    pub(in crate::fusion) fn factor(self, nodes: f64) -> f64 {
        let most = nodes.max(1.0);
        match self {
            Self::All => most,
            Self::Nothing => 1.0,
            Self::Factor(factor) => factor.clamp(1.0, most),
        }
    }
}

/// Settings of a station.
#[derive(Debug, Clone, PartialEq)]
pub struct StationSettings {
    /// Number of nodes.
    pub nodes: usize,
    /// The parameter density from which all nodes start, one sample before their first sample.
    ///
    /// The prior of a filter applies to its first sample. This density is that prior with its
    /// covariance divided by `λ`.
    pub prior: Gaussian,
    /// Growth of a variance by fading in one fusion period, `λ^(r_s/r_c)`.
    pub growth_per_period: f64,
    /// Upper limits of the variances (N_θ), as at the nodes.
    pub variance_bound: DVector<f64>,
    /// The rule that fuses densities.
    pub rule: FusionRule,
    /// The nodes' use of feedback.
    pub feedback: FeedbackRule,
    /// The exchanged motion data.
    pub motion: MotionExchange,
    /// Maximum time difference of simultaneous motion (fusion periods): half a sample.
    pub same_instant: f64,
    /// The detector of faulty nodes; `None` disables it.
    pub detector: Option<GlobalDetector>,
    /// Maximum age of a message (fusion periods), 3 by default. Older messages are dropped.
    pub stale_periods: f64,
    /// Limits of the fused means. If a mean is outside, the station restarts from the prior.
    pub healthy: MeanLimits,
}

/// Largest factor by which information fades at once.
///
/// It makes any density wider than its bound. A larger factor would round the information to 0
/// after a long gap, and the means would be lost with it.
const LARGEST_GROWTH: f64 = 1e30;

impl StationSettings {
    /// Returns the growth of a variance by fading in this number of fusion periods, at most
    /// [`LARGEST_GROWTH`].
    pub(super) fn growth(&self, periods: f64) -> f64 {
        self.growth_per_period.powf(periods).min(LARGEST_GROWTH)
    }

    pub(super) fn check(&self) -> Result<(), FilterError> {
        let expected = self.prior.mean.len();
        FilterError::check_sizes([(
            "variance bound of the station",
            self.variance_bound.len(),
            expected,
        )])?;
        self.healthy.check(
            expected,
            [
                "lower limit of health of the station",
                "upper limit of health of the station",
            ],
        )?;
        let growth = self.growth_per_period;
        if !(growth >= 1.0 && growth.is_finite()) {
            let what = "growth in a fusion period";
            return Err(FilterError::Setting {
                what,
                found: growth,
                allowed: "at least 1 and finite",
            });
        }
        if let FusionRule::PriorCorrect(Sharing::Factor(factor)) = self.rule
            && !(factor >= 1.0 && factor.is_finite())
        {
            let what = "sharing factor";
            return Err(FilterError::Setting {
                what,
                found: factor,
                allowed: "at least 1 and finite",
            });
        }
        Ok(())
    }
}
