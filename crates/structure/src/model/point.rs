//! The parts of the Jacobian that depend on the point of linearisation.

use super::Fixed;
use crate::hysteresis::{Drive, Slopes};
use crate::parameter::Scales;
use nalgebra::DMatrix;

/// Number of columns multiplied together. Their sums are independent, so no sum waits for another.
const BLOCK: usize = 4;

/// The structure linearised at one state; all values are overwritten in place.
#[derive(Debug, Clone)]
pub(super) struct Point {
    /// `x`, or `r` of hysteretic springs (N_d, m).
    pub(super) displacement: Vec<f64>,
    pub(super) velocity: Vec<f64>,
    /// `w` (N_d), the velocities of floors or springs.
    driving: Vec<f64>,
    /// `ẋ`, or `ṙ` of hysteretic springs (N_d, m/s).
    pub(super) rate: Vec<f64>,
    /// Derivatives of `ṙ` of each hysteretic spring with respect to its own `w` and `r`.
    pub(super) slopes: Vec<Slopes>,
    /// Derivatives of `ṙ` with respect to parameters that scale a constant of the law.
    ///
    /// Each entry contains the index of the parameter and a column (N_d).
    rate_by_theta: Vec<(usize, Vec<f64>)>,
    /// `θ` (N_θ).
    pub(super) theta: Vec<f64>,
    /// `true` if the values that depend only on `θ` are set; without parameters they are set once.
    is_scaled: bool,
    pub(super) alpha_per_s: f64,
    pub(super) beta_s: f64,
    /// Values of `K(θ)` (N/m).
    pub(super) stiffness: Vec<f64>,
    /// Values of `C(θ)` (N s/m) of dashpots or a given matrix; empty with Rayleigh damping.
    pub(super) damping: Vec<f64>,
    /// `1/θ` of the mass of each degree of freedom, 1 if no parameter scales it.
    pub(super) mass_factors_inverse: Vec<f64>,
    /// `−M⁻¹(C ẋ + K x)` (N_d).
    pub(super) restoring: Vec<f64>,
    /// `M⁻¹ T f` of the known forces (N_d).
    pub(super) forced: Vec<f64>,
    /// `−ι f` of the known ground motions (N_d).
    pub(super) ground: Vec<f64>,
    /// `ẍ` (N_d), the sum of the preceding three vectors.
    pub(super) acceleration: Vec<f64>,
    /// `∂(−M⁻¹R)/∂θ` (N_d × N_θ).
    pub(super) restoring_by_theta: DMatrix<f64>,
    /// `W = ∂ẍ/∂θ` (N_d × N_θ), including the forces, whose effect depends on the mass.
    pub(super) acceleration_by_theta: DMatrix<f64>,
    /// `x + β w` (N_d).
    stretched: Vec<f64>,
}

impl Point {
    pub(super) fn new(fixed: &Fixed, inputs: usize) -> Self {
        debug_assert_eq!(fixed.forces.ncols(), inputs);
        let (free, parameters) = (fixed.assembly.len(), fixed.parameters.len());
        let zeros = || vec![0.0; free];
        let hysteretic = fixed
            .parameters
            .iter()
            .enumerate()
            .filter(|(_, p)| matches!(p.scales, Scales::Hysteresis(_)));
        Self {
            displacement: zeros(),
            velocity: zeros(),
            driving: zeros(),
            rate: zeros(),
            slopes: fixed
                .hysteresis
                .map_or(Vec::new(), |law| vec![law.slopes(0.0, 0.0); free]),
            rate_by_theta: hysteretic.map(|(index, _)| (index, zeros())).collect(),
            theta: vec![1.0; parameters],
            is_scaled: false,
            alpha_per_s: fixed.alpha_per_s,
            beta_s: fixed.beta_s,
            stiffness: vec![0.0; fixed.assembly.entry_count()],
            damping: vec![
                0.0;
                fixed
                    .assembly
                    .damping()
                    .map_or(0, |_| fixed.assembly.entry_count())
            ],
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

    /// Returns `true` if the point has been linearised at least once.
    pub(super) fn is_scaled(&self) -> bool {
        self.is_scaled
    }

    /// Linearises at `state` (n) under the known `excitation` (N_f).
    pub(super) fn linearise(&mut self, fixed: &Fixed, state: &[f64], excitation: &[f64]) {
        let free = fixed.assembly.len();
        self.displacement.copy_from_slice(&state[..free]);
        self.velocity.copy_from_slice(&state[free..2 * free]);
        fixed.drive_to(&self.velocity, &mut self.driving);
        if !self.is_scaled || self.theta != state[2 * free..] {
            self.theta.copy_from_slice(&state[2 * free..]);
            self.scale(fixed);
            self.is_scaled = true;
        }
        self.move_springs(fixed);
        self.accelerate(fixed, excitation);
        self.differentiate(fixed);
    }

    /// Scales stiffness, mass and damping by `θ`.
    fn scale(&mut self, fixed: &Fixed) {
        fixed
            .assembly
            .stiffness()
            .assemble_to(&self.theta, &mut self.stiffness);
        if let Some(damping) = fixed.assembly.damping() {
            damping.assemble_to(&self.theta, &mut self.damping);
        }
        (self.alpha_per_s, self.beta_s) = (fixed.alpha_per_s, fixed.beta_s);
        self.mass_factors_inverse.fill(1.0);
        for (parameter, theta) in fixed.parameters.iter().zip(&self.theta) {
            match &parameter.scales {
                Scales::Stiffness(_) | Scales::Dashpots(_) | Scales::Hysteresis(_) => {}
                Scales::Damping => {
                    self.alpha_per_s *= theta;
                    self.beta_s *= theta;
                }
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

    /// Writes `ṙ` and its derivatives, (2.88); writes `ẋ` for linear springs.
    fn move_springs(&mut self, fixed: &Fixed) {
        let Some(mut law) = fixed.hysteresis else {
            self.rate.copy_from_slice(&self.velocity);
            return;
        };
        for (parameter, theta) in fixed.parameters.iter().zip(&self.theta) {
            if let Scales::Hysteresis(constant) = parameter.scales {
                law.scale(constant, *theta);
            }
        }
        let springs = || self.driving.iter().zip(&self.displacement);
        for ((rate, slopes), (w, r)) in self.rate.iter_mut().zip(&mut self.slopes).zip(springs()) {
            *rate = law.rate(*w, *r);
            *slopes = law.slopes(*w, *r);
        }
        for (parameter, column) in &mut self.rate_by_theta {
            if let Scales::Hysteresis(constant) = fixed.parameters[*parameter].scales {
                let Some(nominal) = fixed.hysteresis.map(|law| law.constant(constant)) else {
                    continue;
                };
                for (entry, (w, r)) in column.iter_mut().zip(springs()) {
                    *entry = nominal * law.slope_by(constant, *w, *r);
                }
            }
        }
    }

    /// Replaces `w` in `out` (N_d) by the derivative of `ṙ` along a column with the parts `r` and
    /// `theta`.
    ///
    /// For linear springs, `out` keeps `ẋ`.
    fn differentiate_rate(&self, r: &[f64], theta: &[f64], out: &mut [f64]) {
        for ((entry, slopes), r) in out.iter_mut().zip(&self.slopes).zip(r) {
            *entry = slopes.by_velocity * *entry + slopes.by_displacement * r;
        }
        for (parameter, column) in &self.rate_by_theta {
            for (entry, slope) in out.iter_mut().zip(column) {
                *entry += slope * theta[*parameter];
            }
        }
    }

    /// Writes the three parts of `ẍ = −M⁻¹(C ẋ + K x) + M⁻¹ T f`, equation (2.45).
    fn accelerate(&mut self, fixed: &Fixed, excitation: &[f64]) {
        for ((s, x), w) in self
            .stretched
            .iter_mut()
            .zip(&self.displacement)
            .zip(&self.driving)
        {
            *s = x + self.beta_s * w;
        }
        fixed
            .assembly
            .mul_to(&self.stiffness, &self.stretched, &mut self.restoring); // K (x + β w)
        if !self.damping.is_empty() {
            fixed
                .assembly
                .mul_add_to(&self.damping, &self.velocity, &mut self.restoring); // + C ẋ
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
            self.restoring[dof] =
                -by_mass * self.restoring[dof] - self.alpha_per_s * self.velocity[dof];
            self.forced[dof] *= by_mass;
            self.acceleration[dof] = self.restoring[dof] + self.forced[dof] + self.ground[dof];
        }
    }

    /// Writes `∂ẍ/∂θ`.
    ///
    /// `∂R/∂θ` is `K_θ (x + β w)` for stiffness, `C_θ ẋ` for dashpots, `M ẋ` for `α`, `K w` for
    /// `β`, and the sum of the last two for all Rayleigh damping.
    fn differentiate(&mut self, fixed: &Fixed) {
        let free = self.velocity.len();
        let columns = self
            .restoring_by_theta
            .as_mut_slice()
            .chunks_exact_mut(free);
        let columns = columns.zip(
            self.acceleration_by_theta
                .as_mut_slice()
                .chunks_exact_mut(free),
        );
        for ((index, parameter), (column, of_acceleration)) in
            fixed.parameters.iter().enumerate().zip(columns)
        {
            let reach = fixed.reach[index].clone();
            for row in reach.clone() {
                column[row] = 0.0; // mostly two rows: a call of memset would take longer
            }
            // M⁻¹ M cancels, and a mass parameter already includes the division by the mass.
            let is_divided = !matches!(parameter.scales, Scales::DampingAlpha | Scales::Mass(_));
            match &parameter.scales {
                Scales::Stiffness(_) => {
                    fixed
                        .assembly
                        .stiffness()
                        .mul_scaled_add_to(index, &self.stretched, column);
                }
                Scales::Dashpots(_) => {
                    if let Some(damping) = fixed.assembly.damping() {
                        damping.mul_scaled_add_to(index, &self.velocity, column);
                    }
                }
                Scales::Hysteresis(_) => continue, // changes only the rate of r
                Scales::Damping | Scales::DampingBeta => {
                    fixed
                        .assembly
                        .mul_to(&self.stiffness, &self.driving, column);
                    column.iter_mut().for_each(|entry| *entry *= fixed.beta_s);
                }
                Scales::DampingAlpha => {
                    for (entry, v) in column.iter_mut().zip(&self.velocity) {
                        *entry = -fixed.alpha_per_s * v;
                    }
                }
                Scales::Mass(dofs) => {
                    // The terms proportional to M⁻¹, −M⁻¹R + α ẋ, depend on the mass as 1/θ.
                    for dof in dofs {
                        let by_mass = self.restoring[*dof] + self.alpha_per_s * self.velocity[*dof];
                        column[*dof] = -by_mass * self.mass_factors_inverse[*dof];
                    }
                }
            }
            if let (true, Some(factor)) = (is_divided, &fixed.mass_factor) {
                factor.solve_mut(column);
            }
            let by_mass = fixed.reciprocal_masses[reach.clone()]
                .iter()
                .zip(&self.mass_factors_inverse[reach.clone()]);
            let entries = column[reach.clone()]
                .iter_mut()
                .zip(&mut of_acceleration[reach]);
            for ((entry, of_acceleration), (reciprocal, factor)) in entries.zip(by_mass) {
                *entry *= if is_divided {
                    -reciprocal * factor
                } else {
                    1.0
                };
                *of_acceleration = *entry;
            }
            if matches!(parameter.scales, Scales::Damping) {
                for ((entry, of_acceleration), v) in
                    column.iter_mut().zip(of_acceleration).zip(&self.velocity)
                {
                    *entry -= fixed.alpha_per_s * v; // −M⁻¹ α M ẋ
                    *of_acceleration = *entry;
                }
            }
        }
        for (index, parameter) in fixed.parameters.iter().enumerate() {
            if let Scales::Mass(dofs) = &parameter.scales {
                for dof in dofs {
                    self.acceleration_by_theta[(*dof, index)] -=
                        self.forced[*dof] * self.mass_factors_inverse[*dof];
                }
            }
        }
    }

    /// Writes `A_y X` (n × c), equation (2.50).
    pub(super) fn jacobian_mul(
        &self,
        fixed: &Fixed,
        columns: &DMatrix<f64>,
        out: &mut DMatrix<f64>,
    ) {
        let len = columns.nrows();
        let whole = columns.ncols() / BLOCK * BLOCK * len;
        let (blocks, rest) = columns.as_slice().split_at(whole);
        let (out_blocks, out_rest) = out.as_mut_slice().split_at_mut(whole);
        for (block, out) in blocks
            .chunks_exact(BLOCK * len)
            .zip(out_blocks.chunks_exact_mut(BLOCK * len))
        {
            self.jacobian_mul_block::<BLOCK>(fixed, block, out);
        }
        for (column, out) in rest.chunks_exact(len).zip(out_rest.chunks_exact_mut(len)) {
            self.jacobian_mul_block::<1>(fixed, column, out);
        }
    }

    /// Writes `A_y X` for `C` columns, stored one after the other in both slices.
    fn jacobian_mul_block<const C: usize>(&self, fixed: &Fixed, columns: &[f64], out: &mut [f64]) {
        let (free, len) = (self.velocity.len(), columns.len() / C);
        let mut in_columns = columns.chunks_exact(len);
        let columns: [&[f64]; C] = std::array::from_fn(|_| in_columns.next().unwrap_or_default());
        let mut out_columns = out.chunks_exact_mut(len).map(|out| out.split_at_mut(free));
        let (mut out_x, mut out_v): ([&mut [f64]; C], [&mut [f64]; C]) = (empty(), empty());
        for (out_x, out_v) in out_x.iter_mut().zip(&mut out_v) {
            let Some((x, rest)) = out_columns.next() else {
                continue;
            };
            let (v, out_theta) = rest.split_at_mut(free);
            out_theta.fill(0.0);
            (*out_x, *out_v) = (x, v);
        }
        // The rows of x temporarily hold x + β w.
        for (column, out_x) in columns.iter().zip(&mut out_x) {
            let (x, v) = column.split_at(free);
            fixed.drive_to(&v[..free], out_x);
            for (s, x) in out_x.iter_mut().zip(x) {
                *s = x + self.beta_s * *s;
            }
        }
        fixed
            .assembly
            .mul_columns_to(&self.stiffness, &out_x, &mut out_v); // K (X + β W)
        for ((column, out_x), out_v) in columns.iter().zip(&mut out_x).zip(&mut out_v) {
            let (x, rest) = column.split_at(free);
            let (v, theta) = rest.split_at(free);
            if !self.damping.is_empty() {
                fixed.assembly.mul_add_to(&self.damping, v, out_v); // + C V
            }
            fixed.drive_to(v, out_x);
            self.differentiate_rate(x, theta, out_x);
        }
        if let Some(factor) = &fixed.mass_factor {
            factor.solve_columns_mut(&mut out_v);
        }
        for (column, out_v) in columns.iter().zip(&mut out_v) {
            let (v, theta) = column[free..].split_at(free);
            let by_mass = fixed
                .reciprocal_masses
                .iter()
                .zip(&self.mass_factors_inverse);
            for ((entry, v), (reciprocal, factor)) in out_v.iter_mut().zip(v).zip(by_mass) {
                *entry = -reciprocal * factor * *entry - self.alpha_per_s * v; // −M⁻¹ (…) − α V
            }
            let by_theta = self
                .acceleration_by_theta
                .as_slice()
                .chunks_exact(free)
                .zip(&fixed.reach);
            for (theta, (w, reach)) in theta
                .iter()
                .zip(by_theta)
                .filter(|(theta, _)| **theta != 0.0)
            {
                for (entry, w) in out_v[reach.clone()].iter_mut().zip(&w[reach.clone()]) {
                    *entry += w * theta; // + W Θ
                }
            }
        }
    }
}

/// Returns `C` empty slices as placeholders.
fn empty<'s, const C: usize>() -> [&'s mut [f64]; C] {
    std::array::from_fn(|_| Default::default())
}

impl Fixed {
    /// Writes `w = D ẋ` (N_d): the velocities of floors, or the drift rates of springs.
    fn drive_to(&self, velocity: &[f64], out: &mut [f64]) {
        self.drive().drive_to(velocity, out);
    }

    /// Returns the velocity that drives the springs; `Floor` for linear springs.
    pub(super) fn drive(&self) -> Drive {
        self.hysteresis.map_or(Drive::Floor, |law| law.drive)
    }

    /// Replaces a vector `r` (N_d) by `M⁻¹ r` with the mass as designed.
    pub(super) fn divide_by_mass(&self, r: &mut [f64]) {
        if let Some(factor) = &self.mass_factor {
            factor.solve_mut(r);
        }
        for (entry, reciprocal) in r.iter_mut().zip(&self.reciprocal_masses) {
            *entry *= reciprocal;
        }
    }
}
