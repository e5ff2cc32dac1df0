//! The structure as an implementation of both model traits of `spandrel-filter`.
//!
//! Notation: Huang & Yuen (2023), §2.4. The state is `y = [x, ẋ, θ]`: displacements and velocities
//! relative to the ground (m, m/s), and the parameters as ratios to nominal. Accelerations have the
//! unit m/s². `R(x, ẋ; θ) = C ẋ + K x`, with `C = α M + β K(θ)`. The stiffness-proportional part of
//! the damping therefore scales with the stiffness: `∂R/∂θ = K_θ (x + β ẋ)`. The Jacobian is
//! applied to the parts `X`, `V`, `Θ` of given columns as
//! `A_y X = [V; −M⁻¹ K (X + β V) − α V + W Θ; 0]`, with `W = −M⁻¹ ∂R/∂θ` (2.50).
//!
//! With hysteretic springs, the hysteretic displacements `r` replace `x`, which then occurs in no
//! equation: `y = [r, ẋ, θ]`, `R = C ẋ + S r` with the spring forces `S r`. The Bouc-Wen law gives
//! `ṙ` from the velocities `w = D ẋ` that drive the springs, (2.87) to (2.94). The damping uses
//! `S w` instead of `K ẋ`. For a linear structure, `ṙ = w = ẋ` and `S = K`.

mod point;
mod proportional;
mod response;

use crate::assembly::Assembly;
use crate::excitation::Action;
use crate::hysteresis::{Drive, Hysteresis, Slopes};
use crate::linear_form::LinearForm;
use crate::linear_system::{Damping, Mass};
use crate::modes::Modes;
use crate::parameter::{Parameter, Scales};
use crate::sparse_cholesky::SparseCholesky;
use crate::structure::Structure;
use nalgebra::DMatrix;
use point::Point;
use proportional::StiffnessByMass;
pub(crate) use response::Motion;
use response::Response;
use spandrel_filter::discretise::Series;
use spandrel_filter::{ConstantTransition, ObservationModel, ProcessModel, ProportionalForm};
use std::ops::Range;

/// A structure with its sensors, linearised at one point for the process and at one for the
/// observation.
#[derive(Debug, Clone)]
pub struct StructureModel {
    fixed: Fixed,
    responses: Vec<Response>,
    process: Point,
    /// `M⁻¹ K` at the point of the process; `None` unless the damping is proportional.
    stiffness_by_mass: Option<StiffnessByMass>,
    observation: Point,
    feedthrough: DMatrix<f64>,
    has_feedthrough: bool,
}

/// Properties that do not depend on the state.
#[derive(Debug, Clone)]
pub(crate) struct Fixed {
    assembly: Assembly,
    /// Factor of a mass matrix that is not diagonal.
    mass_factor: Option<SparseCholesky>,
    /// `1/m` (1/kg) as designed; ones if `mass_factor` is used.
    reciprocal_masses: Vec<f64>,
    parameters: Vec<Parameter>,
    /// Range of degrees of freedom whose acceleration each parameter can change. The rest of a
    /// column of `W` is zero.
    reach: Vec<Range<usize>>,
    /// `α` (1/s) and `β` (s) as designed; zero if `C` is given by dashpots or a matrix.
    alpha_per_s: f64,
    beta_s: f64,
    /// `M⁻¹ T` (N_d × N_f) of the forces only, as designed (1/kg).
    forces: DMatrix<f64>,
    /// `−ι` (N_d × N_f) of the ground motions only.
    grounds: DMatrix<f64>,
    /// Law of hysteretic springs as designed; `None` for linear springs.
    hysteresis: Option<Hysteresis>,
    bounds: RateBounds,
}

/// Largest eigenvalues as designed, used to bound the eigenvalues of scaled matrices.
#[derive(Debug, Clone)]
struct RateBounds {
    /// Largest eigenvalue of `M⁻¹ K` of the springs (1/s²).
    stiffness: f64,
    /// Largest eigenvalue of `M⁻¹ C` for dashpots or a given `C` (1/s).
    damping: f64,
    /// `true` if no parameter scales some substructure.
    has_fixed_stiffness: bool,
    /// `true` if no parameter scales some dashpot or the given `C`.
    has_fixed_damping: bool,
}

impl Structure {
    /// Creates the model of the structure, linearised at the prior.
    #[must_use]
    pub fn model(&self) -> StructureModel {
        StructureModel::new(self)
    }
}

impl StructureModel {
    fn new(structure: &Structure) -> Self {
        let fixed = Fixed::new(structure);
        let responses: Vec<Response> = structure
            .observations()
            .map(|channel| Response::new(channel, &fixed, &structure.system.mass))
            .collect();
        let inputs = structure.excitation_channels.len();
        let point = Point::new(&fixed, inputs);
        let feedthrough = DMatrix::zeros(responses.len(), inputs);
        let mut model = Self {
            process: point.clone(),
            stiffness_by_mass: StiffnessByMass::new(&fixed, &structure.system.damping),
            observation: point,
            fixed,
            responses,
            feedthrough,
            has_feedthrough: false,
        };
        let mut state = vec![0.0; model.state_len()];
        let free = 2 * model.fixed.assembly.len();
        for (entry, parameter) in state[free..].iter_mut().zip(&structure.parameters) {
            *entry = parameter.mean();
        }
        let at_rest = vec![0.0; inputs];
        model.linearise_process(&state, &at_rest);
        model.linearise_observation(&state, &at_rest);
        model.has_feedthrough = model.feedthrough.iter().any(|entry| *entry != 0.0);
        model
    }
}

impl Fixed {
    fn new(structure: &Structure) -> Self {
        let system = &structure.system;
        let len = system.len();
        let (alpha_per_s, beta_s) = match &system.damping {
            Damping::Rayleigh {
                alpha_per_s,
                beta_s,
            } => (*alpha_per_s, *beta_s),
            Damping::Dashpots(_) | Damping::Matrix(_) => (0.0, 0.0),
        };
        let (mass_factor, reciprocal_masses) = match &system.mass {
            Mass::Lumped(masses) => (None, masses.iter().map(|mass| 1.0 / mass).collect()),
            Mass::Consistent { factor, .. } => (Some(factor.clone()), vec![1.0; len]),
        };
        let inputs = structure.excitation_channels.len();
        let mut forces = DMatrix::zeros(len, inputs);
        let mut grounds = DMatrix::zeros(len, inputs);
        for (index, excitation) in structure.excitations.iter().enumerate() {
            let components = structure.components(index);
            let input = components.start;
            match &excitation.action {
                Action::Force { degree_of_freedom } => forces[(*degree_of_freedom, input)] = 1.0,
                Action::ForceField(field) => {
                    for (input, degree_of_freedom) in components.zip(&field.degrees_of_freedom) {
                        forces[(*degree_of_freedom, input)] = 1.0;
                    }
                }
                Action::Ground { influence } => {
                    for (entry, influence) in grounds.column_mut(input).iter_mut().zip(influence) {
                        *entry = -influence;
                    }
                }
            }
        }
        let assembly = Assembly::new(system, &structure.parameters);
        let reach = |(index, parameter): (usize, &Parameter)| match &parameter.scales {
            Scales::Stiffness(_) if mass_factor.is_none() => {
                assembly.stiffness().scaled_rows(index)
            }
            Scales::Dashpots(_) if mass_factor.is_none() => assembly
                .damping()
                .map_or(0..0, |damping| damping.scaled_rows(index)),
            Scales::Hysteresis(_) => 0..0, // changes only the rate of r
            Scales::Mass(dofs) => {
                let first = dofs.iter().min().map_or(0, |first| *first);
                first..dofs.iter().max().map_or(first, |last| last + 1)
            }
            // With a mass matrix that is not diagonal, every force accelerates every degree of
            // freedom.
            Scales::Stiffness(_)
            | Scales::Dashpots(_)
            | Scales::Damping
            | Scales::DampingAlpha
            | Scales::DampingBeta => 0..len,
        };
        Self {
            reach: structure.parameters.iter().enumerate().map(reach).collect(),
            assembly,
            mass_factor,
            reciprocal_masses,
            parameters: structure.parameters.clone(),
            alpha_per_s,
            beta_s,
            forces: system.mass.solve(forces),
            grounds,
            hysteresis: system.hysteresis,
            bounds: RateBounds::new(structure),
        }
    }
}

impl RateBounds {
    fn new(structure: &Structure) -> Self {
        let (system, parameters) = (&structure.system, &structure.parameters);
        // ω² of a pencil with a positive definite mass matrix, as checked when the file was read.
        let largest = |matrix| {
            Modes::new(system.mass.to_dense(), matrix).map_or(0.0, |modes| modes.highest().powi(2))
        };
        let scaled = |part| {
            parameters
                .iter()
                .any(|p| matches!(&p.scales, Scales::Stiffness(parts) if parts.contains(&part)))
        };
        let damped = |part| {
            parameters
                .iter()
                .any(|p| matches!(&p.scales, Scales::Dashpots(parts) if parts.contains(&part)))
        };
        let stiffness = match system.hysteresis {
            None => structure.modes.highest().powi(2),
            Some(_) => largest(system.nominal_stiffness() / system.initial_slope()),
        };
        Self {
            stiffness,
            damping: system.damping.matrix(system.len()).map_or(0.0, largest),
            has_fixed_stiffness: (0..system.substructures.len()).any(|part| !scaled(part)),
            has_fixed_damping: match &system.damping {
                Damping::Dashpots(dashpots) => (0..dashpots.len()).any(|part| !damped(part)),
                Damping::Matrix(_) => !damped(0),
                Damping::Rayleigh { .. } => true,
            },
        }
    }
}

impl ProcessModel for StructureModel {
    fn state_len(&self) -> usize {
        2 * self.fixed.assembly.len() + self.fixed.parameters.len()
    }

    fn parameter_len(&self) -> usize {
        self.fixed.parameters.len()
    }

    fn excitation_len(&self) -> usize {
        self.fixed.forces.ncols()
    }

    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.process.linearise(&self.fixed, state, excitation);
        if let Some(stiffness_by_mass) = &mut self.stiffness_by_mass {
            stiffness_by_mass.set(&self.fixed, &self.process);
        }
    }

    fn derivative(&self, out: &mut [f64]) {
        let free = self.fixed.assembly.len();
        let (out_x, rest) = out.split_at_mut(free);
        let (out_v, out_theta) = rest.split_at_mut(free);
        out_x.copy_from_slice(&self.process.rate);
        out_v.copy_from_slice(&self.process.acceleration); // ẍ = −M⁻¹ R + M⁻¹ T f (2.45)
        out_theta.fill(0.0);
    }

    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        self.process.jacobian_mul(&self.fixed, columns, out);
    }

    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        let free = self.fixed.assembly.len();
        out.fill(0.0);
        for input in 0..self.excitation_len() {
            for dof in 0..free {
                out[(free + dof, input)] = self.process.mass_factors_inverse[dof]
                    * self.fixed.forces[(dof, input)]
                    + self.fixed.grounds[(dof, input)];
            }
        }
    }

    /// Bounds the eigenvalues `s` of the process.
    ///
    /// In a linear structure, `s² + c s + k = 0`, where `c` and `k` are Rayleigh quotients of
    /// `M⁻¹ C` and `M⁻¹ K`. With Rayleigh damping, `c = α + β k`. Then `|s|` is `√k` unless the
    /// mode is overdamped, and at most `α` or the `|s|` of the highest mode. With a given damping
    /// matrix, `|s| ≤ max(√k, c)`, both at their maximum.
    ///
    /// For hysteretic springs, `|s| ≤ max(|∂ṙ/∂r|, c) + √(|∂ṙ/∂w| k)`. This is the norm of a block
    /// matrix in which the root of the mass weights velocities and the root of the stiffness
    /// weights drifts.
    fn rate_bound(&self) -> f64 {
        let (k, given) = self.largest_quotients();
        let (alpha, beta) = (self.process.alpha_per_s.abs(), self.process.beta_s.abs());
        let c = alpha + beta * k + given;
        if self.fixed.hysteresis.is_some() {
            let largest = |slope: fn(&Slopes) -> f64| {
                self.process.slopes.iter().map(slope).fold(0.0, f64::max)
            };
            let by_displacement = largest(|slopes| slopes.by_displacement.abs());
            let by_velocity = largest(|slopes| slopes.by_velocity.abs());
            return by_displacement.max(c) + (by_velocity * k).sqrt();
        }
        if given > 0.0 {
            return k.sqrt().max(c);
        }
        let discriminant = c * c - 4.0 * k;
        if discriminant > 0.0 {
            alpha.max((c + discriminant.sqrt()) / 2.0)
        } else {
            alpha.max(k.sqrt())
        }
    }

    fn proportional_form(&self) -> Option<ProportionalForm<'_>> {
        self.stiffness_by_mass.as_ref().map(
            |StiffnessByMass {
                 matrix,
                 half_bandwidth,
             }| ProportionalForm {
                stiffness: matrix,
                stiffness_bound: self.largest_quotients().0,
                half_bandwidth: *half_bandwidth,
                alpha_per_s: self.process.alpha_per_s,
                beta_s: self.process.beta_s,
                acceleration_by_theta: &self.process.acceleration_by_theta,
                reach: &self.fixed.reach,
            },
        )
    }

    /// Returns the exact transition of a linear structure without parameters, if it is faster.
    ///
    /// The filter of such a structure is the Kalman filter.
    fn constant_transition(&self, step_s: f64) -> Option<ConstantTransition> {
        if self.parameter_len() > 0 || self.is_hysteretic() || !self.is_densely_faster(step_s) {
            return None;
        }
        let form = LinearForm::new(&mut self.clone(), &[]);
        ConstantTransition::dense(&form.system, &form.input, step_s).ok()
    }
}

/// Time ratio of a sparse to a dense multiplication.
///
/// A product with a dense matrix reads memory in sequence; a sparse matrix looks up each entry.
const LOOKING_UP: usize = 4;

impl StructureModel {
    /// Returns `true` if a step with the exact transition (n × n) is faster than the series.
    ///
    /// The contribution of the noise to the exact transition is known beforehand. The series uses
    /// the sparse Jacobian.
    fn is_densely_faster(&self, step_s: f64) -> bool {
        let (n, inputs) = (self.state_len(), self.excitation_len());
        let Series { substeps, order } = Series::choose(self.rate_bound(), step_s);
        let series =
            LOOKING_UP * substeps * order * (2 * self.fixed.assembly.entry_count() + 4 * n);
        n * n <= series + n * inputs * inputs // per column; the last term for B Σ_f Bᵀ
    }

    /// Returns `true` if the springs are hysteretic; the state then contains hysteretic
    /// displacements.
    pub(crate) fn is_hysteretic(&self) -> bool {
        self.fixed.hysteresis.is_some()
    }

    /// Returns the factor of the mass of each degree of freedom (N_d) at the last linearised state.
    pub(crate) fn mass_factors(&self) -> Vec<f64> {
        let inverses = self.process.mass_factors_inverse.iter();
        inverses.map(|inverse| 1.0 / inverse).collect()
    }

    /// Returns the velocity that drives the springs; `Floor` for linear springs.
    pub(crate) fn drive(&self) -> Drive {
        self.fixed.drive()
    }

    /// Returns what each response senses: the motion, and the degrees of freedom with their
    /// factors.
    pub(crate) fn sensed(&self) -> impl Iterator<Item = (Motion, Vec<(usize, f64)>)> {
        self.responses.iter().map(Response::sensed)
    }

    /// Returns bounds of the Rayleigh quotients of `M⁻¹ K` of the springs (1/s²) and of `M⁻¹ C`
    /// (1/s).
    ///
    /// The second bound excludes `α` and `β`.
    fn largest_quotients(&self) -> (f64, f64) {
        let RateBounds {
            stiffness,
            damping,
            has_fixed_stiffness,
            has_fixed_damping,
        } = &self.fixed.bounds;
        let floor = |is_there: bool| if is_there { 1.0 } else { 0.0 };
        let mut largest_stiffness: f64 = floor(*has_fixed_stiffness);
        let mut largest_damping: f64 = floor(*has_fixed_damping);
        let mut smallest_mass = 1.0_f64;
        for (parameter, theta) in self.fixed.parameters.iter().zip(&self.process.theta) {
            match parameter.scales {
                Scales::Stiffness(_) => largest_stiffness = theta.abs().max(largest_stiffness),
                Scales::Dashpots(_) => largest_damping = theta.abs().max(largest_damping),
                Scales::Mass(_) => smallest_mass = smallest_mass.min(theta.abs()),
                Scales::Damping
                | Scales::DampingAlpha
                | Scales::DampingBeta
                | Scales::Hysteresis(_) => {}
            }
        }
        (
            stiffness * largest_stiffness / smallest_mass,
            damping * largest_damping / smallest_mass,
        )
    }
}

impl ObservationModel for StructureModel {
    fn observation_len(&self) -> usize {
        self.responses.len()
    }

    fn linearise_observation(&mut self, state: &[f64], excitation: &[f64]) {
        let is_known = self.parameter_len() == 0 && self.observation.is_scaled();
        self.observation.linearise(&self.fixed, state, excitation);
        if is_known {
            return; // without parameters the rows are the same at every point
        }
        for (row, response) in self.responses.iter_mut().enumerate() {
            response.linearise(&self.fixed, &self.observation);
            for input in 0..self.feedthrough.ncols() {
                self.feedthrough[(row, input)] =
                    response.direct_effect(&self.fixed, &self.observation, input);
            }
        }
    }

    fn observe(&self, out: &mut [f64]) {
        for (entry, response) in out.iter_mut().zip(&self.responses) {
            *entry = response.value(&self.observation);
        }
    }

    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let (len, free) = (self.state_len(), self.fixed.assembly.len());
        let rows = self.responses.len();
        if rows == 0 {
            return; // a node that measures only the excitation
        }
        for (column, out) in columns
            .as_slice()
            .chunks_exact(len)
            .zip(out.as_mut_slice().chunks_exact_mut(rows))
        {
            for (entry, response) in out.iter_mut().zip(&self.responses) {
                *entry = response.jacobian_dot(free, column);
            }
        }
    }

    fn observation_matrix(&self, transposed: &mut DMatrix<f64>) -> bool {
        let (len, free) = (self.state_len(), self.fixed.assembly.len());
        transposed.as_mut_slice().fill(0.0);
        for (column, response) in transposed
            .as_mut_slice()
            .chunks_exact_mut(len)
            .zip(&self.responses)
        {
            response.add_row_to(free, column);
        }
        true
    }

    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        self.has_feedthrough.then_some(&self.feedthrough)
    }
}

#[cfg(test)]
mod tests;
