//! The response of one channel to the state, and its row of the observation Jacobian.
//!
//! Accelerations follow Huang & Yuen (2023), §2.2. An absolute acceleration is `−M⁻¹R + M⁻¹T f` of
//! the forces only, because the ground motion cancels. A relative acceleration also has the term
//! `−ι f`. A restoring acceleration is `−M⁻¹R`.

use super::Fixed;
use super::point::Point;
use crate::linear_system::Mass;
use crate::node::{Channel, Quantity};
use nalgebra::DMatrix;

/// The motion that a sensor responds to.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Motion {
    Displacement,
    Velocity,
    /// The acceleration of a degree of freedom.
    Acceleration(usize),
}

/// One observation row.
#[derive(Debug, Clone)]
pub(super) enum Response {
    /// A weighted sum of displacements (m, or 1 for a strain).
    Displacement(Vec<(usize, f64)>),
    /// The velocity of one degree of freedom (m/s).
    Velocity(usize),
    /// An acceleration of one degree of freedom (m/s²).
    Acceleration(Acceleration),
}

/// The row of `−M⁻¹[K, C]` of one degree of freedom.
#[derive(Debug, Clone)]
pub(super) struct Acceleration {
    dof: usize,
    /// `true` if the direct effect of forces is included.
    forces: bool,
    /// `true` if the ground motion is included.
    ground: bool,
    /// `M⁻¹ e` of the degree of freedom (1/kg), if the mass matrix is not diagonal.
    by_mass: Option<Vec<f64>>,
    /// Columns of the entries of `stiffness` and `damping`.
    columns: Vec<usize>,
    /// `−M⁻¹ K` (1/s²).
    stiffness: Vec<f64>,
    /// `−M⁻¹ C` of dashpots or a given `C` (1/s); empty otherwise.
    damping: Vec<f64>,
    /// Parameters that can change the acceleration.
    parameters: Vec<usize>,
    /// Nonzero entries of the Jacobian row: state index and value. Some indices occur several
    /// times.
    row: Vec<(usize, f64)>,
}

impl Response {
    pub(super) fn new(channel: &Channel, fixed: &Fixed, mass: &Mass) -> Self {
        // A channel of one degree of freedom has exactly one term. A measured excitation is not a
        // response.
        let dof = channel.sensed.first().map_or(0, |(dof, _)| *dof);
        let acceleration = |forces, ground| {
            Self::Acceleration(Acceleration::new(dof, forces, ground, fixed, mass))
        };
        match channel.quantity() {
            Quantity::Displacement | Quantity::Strain => Self::Displacement(channel.sensed.clone()),
            Quantity::Velocity => Self::Velocity(dof),
            Quantity::AbsoluteAcceleration => acceleration(true, false),
            Quantity::RelativeAcceleration => acceleration(true, true),
            Quantity::RestoringAcceleration | Quantity::GroundAcceleration | Quantity::Force => {
                acceleration(false, false)
            }
        }
    }

    /// Returns the sensed motion, and its degrees of freedom with their factors.
    pub(super) fn sensed(&self) -> (Motion, Vec<(usize, f64)>) {
        match self {
            Self::Displacement(terms) => (Motion::Displacement, terms.clone()),
            Self::Velocity(dof) => (Motion::Velocity, vec![(*dof, 1.0)]),
            Self::Acceleration(Acceleration { dof, .. }) => {
                (Motion::Acceleration(*dof), vec![(*dof, 1.0)])
            }
        }
    }

    /// Scales the row by the parameters at `point`.
    pub(super) fn linearise(&mut self, fixed: &Fixed, point: &Point) {
        if let Self::Acceleration(acceleration) = self {
            acceleration.linearise(fixed, point);
        }
    }

    /// Returns the predicted observation at the point.
    pub(super) fn value(&self, point: &Point) -> f64 {
        match self {
            Self::Displacement(terms) => terms
                .iter()
                .map(|(dof, factor)| factor * point.displacement[*dof])
                .sum(),
            Self::Velocity(dof) => point.velocity[*dof],
            Self::Acceleration(Acceleration {
                dof,
                forces,
                ground,
                ..
            }) => {
                let forced = if *forces { point.forced[*dof] } else { 0.0 };
                let ground = if *ground { point.ground[*dof] } else { 0.0 };
                point.restoring[*dof] + forced + ground
            }
        }
    }

    /// Returns the product of the Jacobian row and a column (n) with the parts `x`, `v` (N_d) and
    /// `θ`.
    pub(super) fn jacobian_dot(&self, free: usize, column: &[f64]) -> f64 {
        match self {
            Self::Displacement(terms) => terms
                .iter()
                .map(|(dof, factor)| factor * column[*dof])
                .sum(),
            Self::Velocity(dof) => column[free + dof],
            Self::Acceleration(Acceleration { row, .. }) => row
                .iter()
                .map(|(entry, value)| value * column[*entry])
                .sum(),
        }
    }

    /// Adds the Jacobian row to a vector (n).
    pub(super) fn add_row_to(&self, free: usize, out: &mut [f64]) {
        match self {
            Self::Displacement(terms) => terms.iter().for_each(|(dof, factor)| out[*dof] += factor),
            Self::Velocity(dof) => out[free + dof] += 1.0,
            Self::Acceleration(Acceleration { row, .. }) => {
                row.iter().for_each(|(entry, value)| out[*entry] += value)
            }
        }
    }

    /// Returns the entry of `D` for one component of the excitation.
    pub(super) fn direct_effect(&self, fixed: &Fixed, point: &Point, input: usize) -> f64 {
        match self {
            Self::Displacement(_) | Self::Velocity(_) => 0.0,
            Self::Acceleration(Acceleration {
                dof,
                forces,
                ground,
                ..
            }) => {
                let force = fixed.forces[(*dof, input)] * point.mass_factors_inverse[*dof];
                let forced = if *forces { force } else { 0.0 };
                let ground = if *ground {
                    fixed.grounds[(*dof, input)]
                } else {
                    0.0
                };
                forced + ground
            }
        }
    }
}

impl Acceleration {
    fn new(dof: usize, forces: bool, ground: bool, fixed: &Fixed, mass: &Mass) -> Self {
        let free = fixed.assembly.len();
        let (by_mass, columns): (_, Vec<usize>) = match mass {
            Mass::Lumped(_) => (None, fixed.assembly.row(dof).1.to_vec()),
            Mass::Consistent { .. } => {
                let unit = DMatrix::from_fn(free, 1, |row, _| if row == dof { 1.0 } else { 0.0 });
                (
                    Some(mass.solve(unit).as_slice().to_vec()),
                    (0..free).collect(),
                )
            }
        };
        let entries = columns.len();
        let damping = vec![
            0.0;
            if fixed.assembly.damping().is_some() {
                entries
            } else {
                0
            }
        ];
        let parameters: Vec<usize> = (0..fixed.reach.len())
            .filter(|parameter| fixed.reach[*parameter].contains(&dof))
            .collect();
        let row = Vec::with_capacity(4 * entries + 1 + parameters.len());
        Self {
            dof,
            forces,
            ground,
            by_mass,
            columns,
            stiffness: vec![0.0; entries],
            damping,
            parameters,
            row,
        }
    }

    fn linearise(&mut self, fixed: &Fixed, point: &Point) {
        let given = &point.damping;
        match &self.by_mass {
            None => {
                let by_mass =
                    -fixed.reciprocal_masses[self.dof] * point.mass_factors_inverse[self.dof];
                let (range, _) = fixed.assembly.row(self.dof);
                for (entry, k) in self
                    .stiffness
                    .iter_mut()
                    .zip(&point.stiffness[range.clone()])
                {
                    *entry = by_mass * k;
                }
                for (entry, c) in self
                    .damping
                    .iter_mut()
                    .zip(given.get(range).unwrap_or_default())
                {
                    *entry = by_mass * c;
                }
            }
            Some(by_mass) => {
                // A row of M⁻¹K is K times a column of M⁻¹, because both are symmetric.
                fixed
                    .assembly
                    .mul_to(&point.stiffness, by_mass, &mut self.stiffness);
                self.stiffness.iter_mut().for_each(|entry| *entry = -*entry);
                if !given.is_empty() {
                    fixed.assembly.mul_to(given, by_mass, &mut self.damping);
                    self.damping.iter_mut().for_each(|entry| *entry = -*entry);
                }
            }
        }
        self.write_row(fixed, point);
    }

    /// Writes the Jacobian row, `−M⁻¹[K, α M + β K D + C]` and `∂/∂θ`.
    fn write_row(&mut self, fixed: &Fixed, point: &Point) {
        let free = fixed.assembly.len();
        let row = &mut self.row;
        row.clear();
        row.extend(
            self.columns
                .iter()
                .copied()
                .zip(self.stiffness.iter().copied()),
        );
        if point.beta_s != 0.0 {
            for (column, k) in self.columns.iter().zip(&self.stiffness) {
                let of_drive = fixed.drive().of_velocities(*column).into_iter().flatten();
                row.extend(
                    of_drive.map(|(velocity, sign)| (free + velocity, point.beta_s * k * sign)),
                );
            }
        }
        row.extend(
            self.columns
                .iter()
                .zip(&self.damping)
                .map(|(column, c)| (free + column, *c)),
        );
        row.push((free + self.dof, -point.alpha_per_s));
        let by_theta = if self.forces {
            &point.acceleration_by_theta
        } else {
            &point.restoring_by_theta
        };
        row.extend(
            self.parameters
                .iter()
                .map(|parameter| (2 * free + parameter, by_theta[(self.dof, *parameter)])),
        );
    }
}
