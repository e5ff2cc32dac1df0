//! What of the Jacobian depends on the point of linearisation.

use super::Fixed;
use crate::parameter::Scales;
use nalgebra::DMatrix;

/// The structure linearised at one state; everything is rewritten in place.
#[derive(Debug, Clone)]
pub(super) struct Point {
    pub(super) displacement: Vec<f64>,
    pub(super) velocity: Vec<f64>,
    /// `θ` (N_θ).
    pub(super) theta: Vec<f64>,
    pub(super) alpha_per_s: f64,
    pub(super) beta_s: f64,
    /// Values of `K(θ)` (N/m).
    pub(super) stiffness: Vec<f64>,
    /// `1/θ` of the mass of each degree of freedom, 1 where none scales it.
    pub(super) mass_factors_inverse: Vec<f64>,
    /// `−M⁻¹(C ẋ + K x)` (N_d).
    pub(super) restoring: Vec<f64>,
    /// `M⁻¹ T f` of the known forces (N_d).
    pub(super) forced: Vec<f64>,
    /// `−ι f` of the known ground motions (N_d).
    pub(super) ground: Vec<f64>,
    /// `ẍ` (N_d), the sum of the three.
    pub(super) acceleration: Vec<f64>,
    /// `∂(−M⁻¹R)/∂θ` (N_d × N_θ).
    pub(super) restoring_by_theta: DMatrix<f64>,
    /// `W = ∂ẍ/∂θ` (N_d × N_θ): with the forces, whose effect depends on the mass.
    pub(super) acceleration_by_theta: DMatrix<f64>,
    /// `x + β ẋ` (N_d).
    stretched: Vec<f64>,
}

impl Point {
    pub(super) fn new(fixed: &Fixed, inputs: usize) -> Self {
        debug_assert_eq!(fixed.forces.ncols(), inputs);
        let (free, parameters) = (fixed.assembly.len(), fixed.parameters.len());
        let zeros = || vec![0.0; free];
        Self {
            displacement: zeros(),
            velocity: zeros(),
            theta: vec![1.0; parameters],
            alpha_per_s: fixed.alpha_per_s,
            beta_s: fixed.beta_s,
            stiffness: vec![0.0; fixed.assembly.entry_count()],
            mass_factors_inverse: vec![1.0; free],
            restoring: zeros(),
            forced: zeros(),
            ground: zeros(),
            acceleration: zeros(),
            restoring_by_theta: DMatrix::zeros(free, parameters),
            acceleration_by_theta: DMatrix::zeros(free, parameters),
            stretched: zeros(),
        }
    }

    /// Moves the point to `state` (n) under the known `excitation` (N_f).
    pub(super) fn linearise(&mut self, fixed: &Fixed, state: &[f64], excitation: &[f64]) {
        let free = fixed.assembly.len();
        self.displacement.copy_from_slice(&state[..free]);
        self.velocity.copy_from_slice(&state[free..2 * free]);
        self.theta.copy_from_slice(&state[2 * free..]);
        self.scale(fixed);
        self.accelerate(fixed, excitation);
        self.differentiate(fixed);
    }

    /// Scales stiffness, mass and damping by `θ`.
    fn scale(&mut self, fixed: &Fixed) {
        fixed.assembly.assemble_to(&self.theta, &mut self.stiffness);
        (self.alpha_per_s, self.beta_s) = (fixed.alpha_per_s, fixed.beta_s);
        self.mass_factors_inverse.fill(1.0);
        for (parameter, theta) in fixed.parameters.iter().zip(&self.theta) {
            match &parameter.scales {
                Scales::Stiffness(_) => {}
                Scales::DampingAlpha => self.alpha_per_s *= theta,
                Scales::DampingBeta => self.beta_s *= theta,
                Scales::Mass(dofs) => {
                    for dof in dofs {
                        self.mass_factors_inverse[*dof] = 1.0 / theta;
                    }
                }
            }
        }
    }

    /// Writes the three parts of `ẍ = −M⁻¹(C ẋ + K x) + M⁻¹ T f`, equation (2.45).
    fn accelerate(&mut self, fixed: &Fixed, excitation: &[f64]) {
        for ((s, x), v) in self.stretched.iter_mut().zip(&self.displacement).zip(&self.velocity) {
            *s = x + self.beta_s * v;
        }
        fixed.assembly.mul_to(&self.stiffness, &self.stretched, &mut self.restoring); // K (x + β ẋ)
        if let Some(damping) = fixed.assembly.damping() {
            fixed.assembly.mul_add_to(damping, &self.velocity, &mut self.restoring); // + C ẋ
        }
        fixed.divide_by_mass(&mut self.restoring);
        self.forced.fill(0.0);
        self.ground.fill(0.0);
        for (input, f) in excitation.iter().enumerate() {
            for dof in 0..self.forced.len() {
                self.forced[dof] += fixed.forces[(dof, input)] * f;
                self.ground[dof] += fixed.grounds[(dof, input)] * f;
            }
        }
        for dof in 0..self.restoring.len() {
            let by_mass = self.mass_factors_inverse[dof];
            self.restoring[dof] = -by_mass * self.restoring[dof] - self.alpha_per_s * self.velocity[dof];
            self.forced[dof] *= by_mass;
            self.acceleration[dof] = self.restoring[dof] + self.forced[dof] + self.ground[dof];
        }
    }

    /// Writes `∂ẍ/∂θ`, with `∂R/∂θ = K_θ (x + β ẋ)`, `M ẋ` and `K ẋ` for stiffness, `α` and `β`.
    fn differentiate(&mut self, fixed: &Fixed) {
        let free = self.velocity.len();
        self.restoring_by_theta.fill(0.0);
        let columns = self.restoring_by_theta.as_mut_slice().chunks_exact_mut(free);
        for ((index, parameter), column) in fixed.parameters.iter().enumerate().zip(columns) {
            match &parameter.scales {
                Scales::Stiffness(_) => fixed.assembly.mul_scaled_add_to(index, &self.stretched, column),
                Scales::DampingBeta => {
                    fixed.assembly.mul_to(&self.stiffness, &self.velocity, column);
                    column.iter_mut().for_each(|entry| *entry *= fixed.beta_s);
                }
                Scales::DampingAlpha => {
                    for (entry, v) in column.iter_mut().zip(&self.velocity) {
                        *entry = -fixed.alpha_per_s * v;
                    }
                    continue; // M⁻¹ M: nothing to divide by
                }
                Scales::Mass(dofs) => {
                    // −M⁻¹R + α ẋ is what depends on the mass, as 1/θ
                    for dof in dofs {
                        let by_mass = self.restoring[*dof] + self.alpha_per_s * self.velocity[*dof];
                        column[*dof] = -by_mass * self.mass_factors_inverse[*dof];
                    }
                    continue;
                }
            }
            fixed.divide_by_mass(column);
            for (entry, by_mass) in column.iter_mut().zip(&self.mass_factors_inverse) {
                *entry *= -by_mass;
            }
        }
        self.acceleration_by_theta.copy_from(&self.restoring_by_theta);
        for (index, parameter) in fixed.parameters.iter().enumerate() {
            if let Scales::Mass(dofs) = &parameter.scales {
                for dof in dofs {
                    self.acceleration_by_theta[(*dof, index)] -= self.forced[*dof] * self.mass_factors_inverse[*dof];
                }
            }
        }
    }

    /// Writes `A_y X` (n × c), equation (2.50).
    pub(super) fn jacobian_mul(&self, fixed: &Fixed, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let free = self.velocity.len();
        let len = columns.nrows();
        for (column, out) in columns.as_slice().chunks_exact(len).zip(out.as_mut_slice().chunks_exact_mut(len)) {
            let (x, rest) = column.split_at(free);
            let (v, theta) = rest.split_at(free);
            let (out_x, rest) = out.split_at_mut(free);
            let (out_v, out_theta) = rest.split_at_mut(free);
            // the rows of x lend their place to x + β ẋ
            for ((s, x), v) in out_x.iter_mut().zip(x).zip(v) {
                *s = x + self.beta_s * v;
            }
            fixed.assembly.mul_to(&self.stiffness, out_x, out_v); // K (X + β V)
            if let Some(damping) = fixed.assembly.damping() {
                fixed.assembly.mul_add_to(damping, v, out_v); // + C V
            }
            out_x.copy_from_slice(v);
            if let Some(factor) = &fixed.mass_factor {
                factor.solve_mut(out_v);
            }
            let by_mass = fixed.reciprocal_masses.iter().zip(&self.mass_factors_inverse);
            for ((entry, v), (reciprocal, factor)) in out_v.iter_mut().zip(v).zip(by_mass) {
                *entry = -reciprocal * factor * *entry - self.alpha_per_s * v; // −M⁻¹ (…) − α V
            }
            let by_theta = self.acceleration_by_theta.as_slice().chunks_exact(free).zip(&fixed.reach);
            for (theta, (w, reach)) in theta.iter().zip(by_theta).filter(|(theta, _)| **theta != 0.0) {
                for (entry, w) in out_v[reach.clone()].iter_mut().zip(&w[reach.clone()]) {
                    *entry += w * theta; // + W Θ
                }
            }
            out_theta.fill(0.0);
        }
    }
}

impl Fixed {
    /// Replaces a vector `r` (N_d) by `M⁻¹ r` with the mass as designed.
    fn divide_by_mass(&self, r: &mut [f64]) {
        if let Some(factor) = &self.mass_factor {
            factor.solve_mut(r);
        }
        for (entry, reciprocal) in r.iter_mut().zip(&self.reciprocal_masses) {
            *entry *= reciprocal;
        }
    }
}
