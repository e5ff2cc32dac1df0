//! Shapes that represent the motion of a large model in the analysis of its sensors.
//!
//! The analysis solves Riccati equations and frequency responses of `[x, ẋ]`, whose cost grows with
//! the cube of the degrees of freedom. A large model therefore moves in few shapes, `x = Φ q` with
//! `Φᵀ M Φ = I`. The shapes are the lowest modes and, for each excitation, the static displacement
//! that the modes omit (residual vectors: Dickens, Nakagawa & Wittbrodt 1997, *Computers &
//! Structures* 62, 985). Faster modes follow the excitation without inertia, as they do below their
//! resonance.

use crate::excitation::Action;
use crate::structure::Structure;
use nalgebra::{DMatrix, DVector};
use std::f64::consts::PI;

/// Number of degrees of freedom up to which the analysis uses the model as it is.
pub(crate) const LARGEST_WHOLE: usize = 200;

/// Maximum number of modes in the analysis, lowest first.
const MOST_MODES: usize = 60;

/// Minimum number of modes in the analysis, whatever their frequency.
const LEAST_MODES: usize = 20;

/// Maximum number of excitations with a residual vector. Components of a force field act on single
/// degrees of freedom and excite the fast modes little.
const MOST_RESIDUALS: usize = 10;

/// Smallest norm of a residual vector, as a share of the static displacement. A smaller one is
/// rounding.
const SMALLEST_RESIDUAL: f64 = 1e-6;

/// Shapes of the motion.
#[derive(Debug, Clone)]
pub(crate) struct RitzBasis {
    /// `Φ` (N_d × r), with `Φᵀ M Φ = I`.
    pub(crate) shapes: DMatrix<f64>,
    /// `Φᵀ M` (r × N_d), which returns `q` from `x = Φ q`.
    pub(crate) shares: DMatrix<f64>,
}

impl Structure {
    /// Returns the shapes for the analysis of a large model; `None` if it is analysed as it is.
    pub(crate) fn analysis_basis(&self) -> Option<RitzBasis> {
        if self.system.len() <= LARGEST_WHOLE {
            return None;
        }
        let omegas = &self.modes.angular_frequencies;
        let highest = PI / self.step_s(); // half the sampling rate
        let sampled = omegas.iter().filter(|omega| **omega <= highest).count();
        let modes = sampled.clamp(LEAST_MODES, MOST_MODES).min(omegas.len());
        let mass = self.system.mass.to_dense();
        let mut shapes: Vec<DVector<f64>> = (0..modes)
            .map(|mode| self.modes.shapes.column(mode).into_owned())
            .collect();
        for force in self.static_forces(&mass).into_iter().take(MOST_RESIDUALS) {
            shapes.extend(self.residual(modes, &shapes, &mass, &force));
        }
        let shapes = DMatrix::from_columns(&shapes);
        Some(RitzBasis {
            shares: shapes.tr_mul(&mass),
            shapes,
        })
    }

    /// Returns the spatial distribution of the force of each excitation component (N_d).
    fn static_forces(&self, mass: &DMatrix<f64>) -> Vec<DVector<f64>> {
        let unit = |dof: usize| {
            let mut force = DVector::zeros(self.system.len());
            force[dof] = 1.0;
            force
        };
        let of_excitation = |excitation: &crate::Excitation| match &excitation.action {
            Action::Ground { influence } => vec![mass * DVector::from_column_slice(influence)],
            Action::Force { degree_of_freedom } => vec![unit(*degree_of_freedom)],
            Action::ForceField(field) => {
                let dofs = field.degrees_of_freedom.iter();
                dofs.map(|dof| unit(*dof)).collect()
            }
        };
        self.excitations.iter().flat_map(of_excitation).collect()
    }

    /// Returns the static displacement under `force` that the first `modes` and the other `shapes`
    /// omit, with unit modal mass. Returns `None` if they omit nothing.
    fn residual(
        &self,
        modes: usize,
        shapes: &[DVector<f64>],
        mass: &DMatrix<f64>,
        force: &DVector<f64>,
    ) -> Option<DVector<f64>> {
        let omegas = DVector::from_column_slice(&self.modes.angular_frequencies);
        let loads = self.modes.shapes.tr_mul(force); // Φᵀ p
        let mut amplitudes = loads.component_div(&omegas.component_mul(&omegas)); // Λ⁻¹ Φᵀ p
        let whole = amplitudes.norm();
        amplitudes.rows_mut(0, modes).fill(0.0);
        let mut shape = &self.modes.shapes * amplitudes;
        for other in &shapes[modes..] {
            let share = (mass * other).dot(&shape);
            shape.axpy(-share, other, 1.0);
        }
        let norm = (mass * &shape).dot(&shape).sqrt();
        (norm > SMALLEST_RESIDUAL * whole).then(|| shape / norm)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    /// A tall building under ground motion, just too large to be analysed as it is.
    const TALL: &str = "
        [structure]
        name = \"tall\"
        sampling-rate-hz = 50
        [model]
        kind = \"shear-building\"
        storeys = 201
        mass-kg = 20_000
        first-frequency-hz = 0.15
        [damping]
        kind = \"rayleigh\"
        ratio = 0.02
        modes = [1, 2]
        [[parameter]]
        name = \"damping\"
        scales = \"damping\"
        of = \"all\"
        std = 0.2
        [[excitation]]
        name = \"ground\"
        kind = \"ground\"
        std = 0.1
        measured-on = \"ground\"
        [[node]]
        name = \"site\"
        [[node.channel]]
        name = \"ground\"
        quantity = \"ground-acceleration\"
        unit = \"m/s2\"
        noise-std = 0.005
        [[node.channel]]
        name = \"roof\"
        quantity = \"absolute-acceleration\"
        dof = \"floor-201\"
        unit = \"m/s2\"
        noise-std = 0.005
    ";

    /// Amplitudes of undamped motion under the forces p sin ωt, as a sum over all modes:
    /// x = Σ φ_j φ_jᵀ p / (ω_j² − ω²).
    fn whole(structure: &Structure, force: &DVector<f64>, omega: f64) -> DVector<f64> {
        let loads = structure.modes.shapes.tr_mul(force);
        let natural = DVector::from_column_slice(&structure.modes.angular_frequencies);
        let amplitudes = loads.zip_map(&natural, |p, own| p / (own * own - omega * omega));
        &structure.modes.shapes * amplitudes
    }

    /// The same in the shapes of the analysis: (Φᵀ K Φ − ω² I) q = Φᵀ p.
    fn reduced(
        structure: &Structure,
        basis: &RitzBasis,
        force: &DVector<f64>,
        omega: f64,
    ) -> DVector<f64> {
        let natural = DVector::from_column_slice(&structure.modes.angular_frequencies);
        // K = M Φ_all Λ Φ_allᵀ M, so Φᵀ K Φ = A Λ Aᵀ with A = Φᵀ M Φ_all.
        let a = &basis.shares * &structure.modes.shapes;
        let scaled = DMatrix::from_fn(a.nrows(), a.ncols(), |i, j| a[(i, j)] * natural[j].powi(2));
        let mut dynamic = scaled * a.transpose();
        for own in 0..dynamic.nrows() {
            dynamic[(own, own)] -= omega * omega;
        }
        let q = dynamic.lu().solve(&basis.shapes.tr_mul(force)).unwrap();
        &basis.shapes * q
    }

    #[test]
    fn reduced_model_moves_as_the_whole_one_up_to_two_thirds_of_its_modes() {
        let structure = Structure::parse(TALL, Path::new("tall.toml")).unwrap();
        let basis = structure.analysis_basis().unwrap();
        let modes = &structure.modes.angular_frequencies;
        assert!(modes.len() > MOST_MODES && basis.shapes.ncols() > MOST_MODES);
        let mass = structure.system.mass.to_dense();
        for force in structure.static_forces(&mass) {
            let mut errors = Vec::new();
            // Between the modes, where the undamped motion is finite.
            for mode in [0, 4, 9, 19, 39] {
                let omega = 0.5 * (modes[mode] + modes[mode + 1]);
                let (whole, reduced) = (
                    whole(&structure, &force, omega),
                    reduced(&structure, &basis, &force, omega),
                );
                errors.push((&whole - reduced).norm() / whole.norm());
            }
            assert!(errors.iter().all(|error| *error < 0.01), "{errors:?}");
            let still = whole(&structure, &force, 0.0);
            let error = (&still - reduced(&structure, &basis, &force, 0.0)).norm() / still.norm();
            assert!(error < 1e-9, "{error}");
        }
    }
}
