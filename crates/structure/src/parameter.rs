//! Uncertain parameters of a structure: the property that each scales, and its prior.

use crate::hysteresis::Constant;

/// Property that a parameter multiplies.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Scales {
    /// Stiffness of these substructures (indices from 0).
    Stiffness(Vec<usize>),
    /// Mass of these degrees of freedom (indices from 0); only for a lumped mass.
    Mass(Vec<usize>),
    /// These dashpots (indices from 0); a given damping matrix counts as one dashpot.
    Dashpots(Vec<usize>),
    /// A constant of the law of all hysteretic springs.
    Hysteresis(Constant),
    /// `α` and `β` of Rayleigh damping together.
    Damping,
    /// `α` of Rayleigh damping.
    DampingAlpha,
    /// `β` of Rayleigh damping.
    DampingBeta,
}

/// An identified parameter: a dimensionless ratio to the nominal value, 1 as designed.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    pub(crate) name: String,
    pub(crate) scales: Scales,
    pub(crate) mean: f64,
    pub(crate) std: f64,
    pub(crate) bounds: (f64, f64),
}

impl Parameter {
    /// Returns the name, unique in the structure.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the prior mean (ratio to nominal).
    #[must_use]
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// Returns the prior standard deviation (ratio to nominal).
    #[must_use]
    pub fn std(&self) -> f64 {
        self.std
    }

    /// Returns the minimum and maximum value that the filter may report (ratios to nominal).
    #[must_use]
    pub fn bounds(&self) -> (f64, f64) {
        self.bounds
    }

    /// Returns `true` if the parameter scales a stiffness, so that `1 − θ` is a loss of stiffness.
    #[must_use]
    pub fn is_stiffness(&self) -> bool {
        matches!(self.scales, Scales::Stiffness(_))
    }
}
