//! Assumptions behind the results of a check.
//!
//! These are unmeasured levels, excitation colours and damping, and facts that no check can verify.

use super::finding::{Finding, Shift};
use crate::alert_rule::{AlertRule, Reference};
use crate::parameter::Scales;
use crate::structure::Structure;
use serde::Serialize;
use std::fmt;

/// Factor by which a stated level or damping may be wrong, in either direction.
const WRONG_BY: f64 = 2.0;

/// Least standard deviation to which a design can be known (ratio to nominal). Masses alone are not
/// known better.
const KNOWN_DESIGN: f64 = 0.01;

/// A fact that a check cannot verify. The results of the check hold only if the file is right about
/// it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Assumption {
    /// No parameter scales some of the masses.
    Masses,
    /// Some damping is neither identified nor stated to be known.
    Damping,
    /// The parts are joined as in the model and respond linearly.
    Connections,
    /// The foundation does not move relative to the ground.
    Soil,
    /// The sensors have the positions and directions given in the file.
    SensorPositions,
    /// Stiffness does not change with temperature.
    Temperature,
}

impl fmt::Display for Assumption {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Masses => {
                "masses: a mass error of 10 % appears as a stiffness error of 10 %, unless the \
                 reference is learnt"
            }
            Self::Damping => "damping: fixed, although rarely known to a factor of two",
            Self::Connections => {
                "connections: joints, walls and fittings behave as modelled; \
                nothing yields or rattles"
            }
            Self::Soil => "soil: the foundation neither rocks nor slides",
            Self::SensorPositions => {
                "sensors: the file states the correct position, sign, unit and axis of each sensor"
            }
            Self::Temperature => {
                "temperature: the daily cycle of stiffness, often several per \
                cent, looks like damage and repair"
            }
        })
    }
}

impl Structure {
    /// Returns the facts about this structure that no check can verify.
    pub(super) fn assumptions(&self) -> Vec<Assumption> {
        let scaled = |parameter: &crate::Parameter| match &parameter.scales {
            Scales::Mass(dofs) => dofs.len(),
            _ => 0,
        };
        let masses = self.parameters.iter().map(scaled).sum::<usize>() < self.system.len();
        let damping = self.damping_is_assumed();
        let rest = [
            Assumption::Connections,
            Assumption::Soil,
            Assumption::SensorPositions,
            Assumption::Temperature,
        ];
        let first = [
            masses.then_some(Assumption::Masses),
            damping.then_some(Assumption::Damping),
        ];
        first.into_iter().flatten().chain(rest).collect()
    }

    /// Returns findings on the assumptions behind the estimates, with figures.
    pub(super) fn assumption_findings(&self) -> Vec<Finding> {
        let mut findings = Vec::new();
        if self.parameters.is_empty() {
            return findings;
        }
        let unmeasured: Vec<&str> = (0..self.noise_levels.len())
            .filter(|level| self.is_unknown(*level))
            .map(|level| self.noise_levels[level].name())
            .collect();
        let errors = self.errors_by_unmeasured_excitation();
        for (parameter, error) in self.parameters.iter().zip(&errors) {
            if self.spoils(parameter, *error) {
                findings.push(Finding::RestsOnExcitation {
                    parameter: parameter.name.clone(),
                    excitations: unmeasured.join(", "),
                    error: *error,
                });
            }
        }
        for level in self.assumed_levels() {
            let shifts = self.both(|factor| self.shifts_by_level(level, factor));
            findings.extend(shifts.map(|shifts| Finding::LevelAssumed {
                level: self.noise_levels[level].name.clone(),
                factor: WRONG_BY,
                shifts,
            }));
        }
        if self.damping_is_assumed() {
            let shifts = self.both(|factor| self.shifts_by_damping(factor));
            findings.extend(shifts.map(|shifts| Finding::DampingAssumed {
                factor: WRONG_BY,
                shifts,
            }));
        }
        findings.extend(self.trusted_design());
        let parameters = self.parameters.iter();
        let stiffnesses = parameters.filter(|one| one.is_stiffness());
        let (channels, parameters) = (self.observation_channels().len(), stiffnesses.count());
        if 2 * channels < parameters {
            findings.push(Finding::FewSensors {
                channels,
                parameters,
            });
        }
        findings
    }

    /// Returns the alert rule that trusts the design most, if it trusts it too much.
    fn trusted_design(&self) -> Option<Finding> {
        let of_rule = |rule: &AlertRule| match &rule.reference {
            Reference::Given { mean, std } if mean.iter().all(|mean| *mean == 1.0) => {
                std.iter().copied().reduce(f64::min)
            }
            Reference::Given { .. } | Reference::Baseline { .. } => None,
        };
        let least = self
            .alert_rules()
            .iter()
            .filter_map(of_rule)
            .reduce(f64::min);
        least
            .filter(|std| *std < KNOWN_DESIGN)
            .map(|std| Finding::DesignTrusted { std })
    }

    /// Returns the shift of each parameter if the true value is the stated value divided by, or
    /// multiplied by, the factor.
    fn both(&self, shifts: impl Fn(f64) -> Option<Vec<f64>>) -> Option<Vec<Shift>> {
        let [under, over] = [shifts(1.0 / WRONG_BY)?, shifts(WRONG_BY)?];
        let shift = |((parameter, under), over): ((&crate::Parameter, &f64), &f64)| Shift {
            parameter: parameter.name.clone(),
            if_less: *under,
            if_more: *over,
        };
        Some(
            self.parameters
                .iter()
                .zip(&under)
                .zip(&over)
                .map(shift)
                .collect(),
        )
    }
}
