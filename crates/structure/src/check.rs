//! Analyses a structure and its sensors before the first measurement.
//!
//! The analysis covers frequencies, damping, and which quantities the sensors can identify.

mod assumptions;
mod design;
mod finding;
mod identification;
mod particles;

pub use particles::MOST_PARTICLE_STATES;

use crate::hysteresis::Constant;
use crate::information::Information;
use crate::parameter::Scales;
use crate::structure::Structure;
pub use assumptions::Assumption;
use finding::find;
pub use finding::{Finding, Severity, Shift};
use nalgebra::DMatrix;
use nalgebra_sparse::{CooMatrix, CsrMatrix};
use serde::Serialize;
use spandrel_filter::ProcessModel;
use spandrel_filter::discretise::Series;
use std::f64::consts::PI;

/// Share of the information of the sensors in the time of an analysis; the findings need the rest.
const SHARE_OF_INFORMATION: f64 = 0.7;

/// Result of the analysis of a structure.
#[derive(Debug, Clone, Serialize)]
pub struct CheckReport {
    /// Name of the structure.
    pub structure: String,
    /// Number of shapes in which a large model was analysed; `None` if it was analysed as it is.
    pub shapes: Option<usize>,
    /// Natural modes as designed, lowest frequency first.
    pub modes: Vec<ModeReport>,
    /// Planned subdivision of a time step by the filter.
    pub time_step: TimeStepReport,
    /// Information from the sensors; `None` if some mode is neither damped nor observed.
    pub identification: Option<IdentificationReport>,
    /// Findings to consider before the file is used, the most serious first.
    pub findings: Vec<Finding>,
    /// Facts that no check can verify. The rest of the report holds only if the file is right about
    /// them.
    pub assumptions: Vec<Assumption>,
}

/// One natural mode.
#[derive(Debug, Clone, Serialize)]
pub struct ModeReport {
    /// Natural frequency (Hz).
    pub frequency_hz: f64,
    /// Natural period (s).
    pub period_s: f64,
    /// Damping ratio.
    pub damping_ratio: f64,
    /// Relative change of the frequency per relative change of each parameter, `∂ln f/∂θ`, in state
    /// order. It is 0 for a parameter that scales neither mass nor stiffness.
    pub sensitivity: Vec<f64>,
}

/// Planned subdivision of a time step by the filter.
#[derive(Debug, Clone, Serialize)]
pub struct TimeStepReport {
    /// Highest natural frequency of the model (Hz).
    pub highest_frequency_hz: f64,
    /// Upper bound of the highest rate of the model times the time step, at the prior.
    pub rate_times_step: f64,
    /// Number of equal substeps in each time step.
    pub substeps: usize,
    /// Number of terms beyond the identity in the series of the matrix exponential, in each
    /// substep.
    pub series_order: usize,
}

/// Information of the sensors about parameters and noise levels.
#[derive(Debug, Clone, Serialize)]
pub struct IdentificationReport {
    /// Length of the data (s) for the values `std_after` and `relative_std_after`.
    pub duration_s: f64,
    /// Length of the data (s) that corresponds to the fading memory, `Δt/(λ − 1)`.
    pub memory_s: f64,
    /// Report on each parameter, in state order.
    pub parameters: Vec<ParameterReport>,
    /// Report on each noise level: excitations first, then groups of sensors.
    pub noise_levels: Vec<NoiseLevelReport>,
    /// Correlations between all parameters and noise levels, parameters first, row by row.
    ///
    /// They assume that every noise level is unknown and that the priors are wide.
    pub correlations: Vec<Vec<f64>>,
}

/// Expected precision of one parameter (ratios to nominal).
#[derive(Debug, Clone, Serialize)]
pub struct ParameterReport {
    /// Name of the parameter.
    pub name: String,
    /// Standard deviation before any data.
    pub prior_std: f64,
    /// Standard deviation after [`IdentificationReport::duration_s`] of data.
    pub std_after: f64,
    /// Standard deviation in the long run that the data support, with fading memory.
    pub std_steady: f64,
    /// Standard deviation that the filter will report in the long run. It is smaller than
    /// `std_steady` if the filter counts more information than the data contain.
    pub std_reported: f64,
    /// Time (s) in which the filter reduces an error of this parameter to 1/e (37 %).
    ///
    /// It is about [`IdentificationReport::memory_s`] if all the information that the filter counts
    /// also corrects the parameter. It is infinite above 100 times the memory, or if the linearised
    /// error does not decay.
    pub settling_s: f64,
    /// Change of the predicted data of one frame per 1 % change of the parameter.
    ///
    /// The unit is the standard deviation of the data. The value is the rms over frames, all
    /// channels together.
    pub dynamic_sensitivity: f64,
    /// Shift of the estimate for each noise level, if its standard deviation is stated 10 % too
    /// high.
    pub shifts: Vec<f64>,
}

/// Expected precision of one noise level.
#[derive(Debug, Clone, Serialize)]
pub struct NoiseLevelReport {
    /// Name of the noise level.
    pub name: String,
    /// `true` if the structure file requests adaptation of the level.
    pub adapted: bool,
    /// Relative standard deviation of the level (itself a standard deviation) after the duration,
    /// if the filter adapts it.
    pub relative_std_after: f64,
    /// Ratio of the actual to the intended rate of adaptation, if the filter adapts the level.
    ///
    /// The half-life sets the intended rate; 1 means that the level follows its half-life.
    pub haste: f64,
}

impl Structure {
    /// Analyses the structure with `duration_s` (s) of simulated data.
    ///
    /// The same `seed` gives the same report.
    #[must_use]
    pub fn check(&self, duration_s: f64, seed: u64) -> CheckReport {
        self.check_with_progress(duration_s, seed, &|_| {})
    }

    /// Analyses the structure like [`Structure::check`], and reports the completed share (0 to 1).
    #[must_use]
    pub fn check_with_progress(
        &self,
        duration_s: f64,
        seed: u64,
        on_share: &dyn Fn(f64),
    ) -> CheckReport {
        let frames = (duration_s * self.sampling_rate_hz).round().max(1.0) as u64;
        let of_information = |share: f64| on_share(SHARE_OF_INFORMATION * share);
        let information = Information::expected(self, frames, seed, &of_information);
        let identification =
            information.and_then(|information| self.identification(&information, frames));
        on_share(SHARE_OF_INFORMATION);
        let time_step = self.time_step();
        let modes = self.mode_reports();
        let mut findings = find(self, identification.as_ref(), &time_step, &modes);
        findings.extend(self.particle_findings(&time_step));
        findings.sort_by_key(Finding::severity);
        on_share(1.0);
        let assumptions = self.assumptions();
        CheckReport {
            structure: self.name.clone(),
            shapes: self.analysis_basis().map(|basis| basis.shapes.ncols()),
            modes,
            time_step,
            identification,
            findings,
            assumptions,
        }
    }

    /// Returns an estimate of the memory that a check takes (bytes).
    pub fn check_bytes(&self) -> usize {
        Information::bytes(self)
    }

    fn time_step(&self) -> TimeStepReport {
        let rate_bound = self.model().rate_bound();
        let series = Series::choose(rate_bound, self.step_s());
        TimeStepReport {
            highest_frequency_hz: self.modes.highest() / (2.0 * PI),
            rate_times_step: rate_bound * self.step_s(),
            substeps: series.substeps,
            series_order: series.order,
        }
    }

    fn mode_reports(&self) -> Vec<ModeReport> {
        let modes = &self.modes;
        let ratios = modes.damping_ratios(&self.system);
        let derivatives: Vec<CsrMatrix<f64>> = self
            .parameters
            .iter()
            .map(|p| self.stiffness_derivative(&p.scales))
            .collect();
        let report = |(mode, omega): (usize, &f64)| {
            let sensitivity =
                self.parameters
                    .iter()
                    .zip(&derivatives)
                    .map(|(parameter, derivative)| {
                        let quadratic = modes.sparse_quadratic(mode, derivative);
                        match parameter.scales {
                            Scales::Mass(_) => -0.5 * quadratic,    // ∂ω²/∂θ = −ω² φᵀ M_θ φ
                            _ => 0.5 * quadratic / (omega * omega), // ∂ω²/∂θ = φᵀ K_θ φ
                        }
                    });
            ModeReport {
                frequency_hz: omega / (2.0 * PI),
                period_s: 2.0 * PI / omega,
                damping_ratio: ratios[mode],
                sensitivity: sensitivity.collect(),
            }
        };
        modes
            .angular_frequencies
            .iter()
            .enumerate()
            .map(report)
            .collect()
    }

    /// Returns the part of the stiffness or mass matrix that a parameter scales.
    ///
    /// The result is zero for damping and for the other constants of hysteresis.
    fn stiffness_derivative(&self, scales: &Scales) -> CsrMatrix<f64> {
        let len = self.system.len();
        match scales {
            Scales::Stiffness(parts) => {
                let parts = parts.iter().map(|part| &self.system.substructures[*part]);
                let sum = parts.fold(CsrMatrix::zeros(len, len), |sum, part| {
                    sum + &part.stiffness
                });
                sum * self.system.initial_slope()
            }
            Scales::Mass(dofs) => {
                let mut mass = self.system.mass.to_dense();
                for dof in (0..len).filter(|dof| !dofs.contains(dof)) {
                    mass[(dof, dof)] = 0.0;
                }
                sparse(&mass)
            }
            Scales::Hysteresis(Constant::A) => sparse(&self.system.nominal_stiffness()),
            Scales::Damping
            | Scales::DampingAlpha
            | Scales::DampingBeta
            | Scales::Dashpots(_)
            | Scales::Hysteresis(_) => CsrMatrix::zeros(len, len),
        }
    }
}

fn sparse(matrix: &DMatrix<f64>) -> CsrMatrix<f64> {
    CsrMatrix::from(&CooMatrix::from(matrix))
}

#[cfg(test)]
mod tests;
