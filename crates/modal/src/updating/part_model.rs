//! A linear structure whose parts have scalable stiffnesses, and the sensitivities of its modes.
//!
//! K(x) = K_fixed + Σ_s e^(x_s) K_s, with x_s = ln of the stiffness of part *s*, relative to
//! nominal. With K φ_j = ω_j² M φ_j and φ_jᵀ M φ_j = 1 (Fox & Kapoor 1968):
//!
//! - ∂ ln f_j/∂x_s = e^(x_s) φ_jᵀ K_s φ_j / (2 ω_j²)
//! - ∂φ_j/∂x_s = Σ_i≠j φ_i e^(x_s) (φ_iᵀ K_s φ_j) / (ω_j² − ω_i²)

use crate::ModalError;
use nalgebra::{DMatrix, DVector, SymmetricEigen};
use std::f64::consts::TAU;

/// A linear structure whose parts have scalable stiffnesses.
#[derive(Debug, Clone, PartialEq)]
pub struct PartModel {
    /// L, with M = L Lᵀ.
    lower: DMatrix<f64>,
    mass: DMatrix<f64>,
    fixed: DMatrix<f64>,
    parts: Vec<Vec<Entry>>,
    sensors: DMatrix<f64>,
}

/// An entry of a sparse matrix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    /// Row, from 0.
    pub row: usize,
    /// Column, from 0.
    pub column: usize,
    /// Value.
    pub value: f64,
}

/// The undamped modes at some stiffnesses, lowest first.
#[derive(Debug, Clone)]
struct Modes {
    /// ω² (rad²/s²).
    squares: Vec<f64>,
    /// Φ, one column per mode, with Φᵀ M Φ = I.
    shapes: DMatrix<f64>,
}

/// A mode of the model and its derivatives by x.
#[derive(Debug, Clone)]
pub(crate) struct ModeLine {
    pub(crate) ln_frequency: f64,
    /// ∂ ln f/∂x.
    pub(crate) ln_frequency_by: DVector<f64>,
    /// Shape at the sensors.
    pub(crate) shape: DVector<f64>,
    /// ∂(shape)/∂x, one column per part.
    pub(crate) shape_by: DMatrix<f64>,
    /// Shape at all degrees of freedom, by which the mode is recognised at other stiffnesses.
    pub(crate) whole: DVector<f64>,
    /// Smallest |f_i/f_j − 1| to another mode.
    pub(crate) gap: f64,
}

impl PartModel {
    /// Creates a model.
    ///
    /// - `mass`: M, symmetric and positive definite
    /// - `fixed`: stiffness of what no part scales, of the same size
    /// - `parts`: K_s of each part, with all entries of both triangles
    /// - `sensors`: one row per channel, from displacements to what the channel measures, up to a
    ///   factor that all channels have in common
    ///
    /// # Errors
    /// Returns an error if the sizes differ, or if the mass matrix is not positive definite.
    pub fn new(
        mass: DMatrix<f64>,
        fixed: DMatrix<f64>,
        parts: Vec<Vec<Entry>>,
        sensors: DMatrix<f64>,
    ) -> Result<Self, ModalError> {
        let len = mass.nrows();
        let fits = mass.is_square() && fixed.shape() == (len, len) && sensors.ncols() == len;
        let inside = |entry: &Entry| entry.row < len && entry.column < len;
        let lower = mass.clone().cholesky().map(nalgebra::Cholesky::unpack);
        match lower {
            Some(lower) if fits && parts.iter().flatten().all(inside) => Ok(Self {
                lower,
                mass,
                fixed,
                parts,
                sensors,
            }),
            _ => Err(ModalError::Model),
        }
    }

    /// Returns the number of parts.
    #[must_use]
    pub fn parts(&self) -> usize {
        self.parts.len()
    }

    /// Returns the number of channels.
    #[must_use]
    pub fn channels(&self) -> usize {
        self.sensors.nrows()
    }

    /// Returns the natural frequencies (Hz) at stiffnesses of `ln_stiffness`, lowest first, with
    /// their shapes at the sensors in columns.
    ///
    /// # Errors
    /// Returns an error if the eigenvalue problem has no finite solution.
    pub fn modes(
        &self,
        ln_stiffness: &DVector<f64>,
    ) -> Result<(Vec<f64>, DMatrix<f64>), ModalError> {
        let (frequencies_hz, shapes) = self.whole_modes(ln_stiffness)?;
        Ok((frequencies_hz, self.seen(&shapes)))
    }

    /// Returns the natural frequencies (Hz) and the shapes at all degrees of freedom, in columns.
    pub(crate) fn whole_modes(
        &self,
        ln_stiffness: &DVector<f64>,
    ) -> Result<(Vec<f64>, DMatrix<f64>), ModalError> {
        let modes = self.solve(ln_stiffness)?;
        let frequencies = modes.squares.iter().map(|square| square.sqrt() / TAU);
        Ok((frequencies.collect(), modes.shapes))
    }

    /// Returns shapes at all degrees of freedom, in columns, as the sensors show them.
    pub(crate) fn seen(&self, shapes: &DMatrix<f64>) -> DMatrix<f64> {
        &self.sensors * shapes
    }

    fn solve(&self, ln_stiffness: &DVector<f64>) -> Result<Modes, ModalError> {
        let failed = ModalError::NotConverged {
            what: "eigenvalue decomposition of the model",
        };
        let mut stiffness = self.fixed.clone();
        for (part, x) in self.parts.iter().zip(ln_stiffness.iter()) {
            for entry in part {
                stiffness[(entry.row, entry.column)] += x.exp() * entry.value;
            }
        }
        self.lower.solve_lower_triangular_mut(&mut stiffness);
        stiffness.transpose_mut();
        self.lower.solve_lower_triangular_mut(&mut stiffness);
        if stiffness.iter().any(|entry| !entry.is_finite()) {
            return Err(failed); // the iteration would not terminate
        }
        let transposed = stiffness.transpose();
        let eigen = SymmetricEigen::new((stiffness + transposed) * 0.5);
        let mut order: Vec<usize> = (0..eigen.eigenvalues.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
        let mut shapes = eigen.eigenvectors.select_columns(&order);
        self.lower.tr_solve_lower_triangular_mut(&mut shapes);
        let squares = order.iter().map(|mode| eigen.eigenvalues[*mode]);
        Ok(Modes {
            // A mechanism has the frequency 0, and no logarithm of it.
            squares: squares
                .map(|square| square.max(f64::MIN_POSITIVE))
                .collect(),
            shapes,
        })
    }

    /// Returns the modes whose shapes `followed` are nearest, with their derivatives.
    ///
    /// Modes are recognised by |φ_iᵀ M φ|, so that modes which change places are not confused.
    pub(crate) fn lines(
        &self,
        ln_stiffness: &DVector<f64>,
        followed: &[DVector<f64>],
    ) -> Result<Vec<ModeLine>, ModalError> {
        let modes = self.solve(ln_stiffness)?;
        let mut taken = vec![false; modes.squares.len()];
        let mut lines = Vec::with_capacity(followed.len());
        for shape in followed {
            let likeness = modes.shapes.tr_mul(&(&self.mass * shape));
            let free = (0..taken.len()).filter(|mode| !taken[*mode]);
            let nearest = free.max_by(|a, b| likeness[*a].abs().total_cmp(&likeness[*b].abs()));
            let Some(mode) = nearest else {
                return Err(ModalError::Model);
            };
            taken[mode] = true;
            lines.push(self.line(&modes, mode, ln_stiffness));
        }
        Ok(lines)
    }

    /// Returns all modes with their derivatives.
    #[cfg(test)]
    pub(crate) fn all_lines(
        &self,
        ln_stiffness: &DVector<f64>,
    ) -> Result<Vec<ModeLine>, ModalError> {
        let modes = self.solve(ln_stiffness)?;
        let all = 0..modes.squares.len();
        Ok(all
            .map(|mode| self.line(&modes, mode, ln_stiffness))
            .collect())
    }

    fn line(&self, modes: &Modes, mode: usize, ln_stiffness: &DVector<f64>) -> ModeLine {
        let square = modes.squares[mode];
        let whole = modes.shapes.column(mode).into_owned();
        let parts = self.parts.len();
        let mut ln_frequency_by = DVector::zeros(parts);
        let mut shares = DMatrix::zeros(modes.squares.len(), parts);
        for (part, (entries, x)) in self.parts.iter().zip(ln_stiffness.iter()).enumerate() {
            let mut force = DVector::zeros(whole.len()); // e^x K_s φ_j
            for entry in entries {
                force[entry.row] += x.exp() * entry.value * whole[entry.column];
            }
            let mut products = modes.shapes.tr_mul(&force);
            ln_frequency_by[part] = products[mode] / (2.0 * square);
            for (other, product) in products.iter_mut().enumerate() {
                *product = match other == mode {
                    true => 0.0,
                    false => *product / nonzero(square - modes.squares[other]),
                };
            }
            shares.set_column(part, &products);
        }
        let gaps = modes.squares.iter().enumerate();
        let gaps = gaps.filter(|(other, _)| *other != mode);
        let gap = gaps.map(|(_, other)| ((other / square).sqrt() - 1.0).abs());
        ModeLine {
            ln_frequency: (square.sqrt() / TAU).ln(),
            ln_frequency_by,
            shape: &self.sensors * &whole,
            shape_by: &self.sensors * (&modes.shapes * shares),
            gap: gap.fold(f64::INFINITY, f64::min),
            whole,
        }
    }
}

/// Returns a divisor of the same sign that is not zero, for modes of one frequency.
fn nonzero(divisor: f64) -> f64 {
    match divisor.abs() < f64::MIN_POSITIVE {
        true => f64::MIN_POSITIVE,
        false => divisor,
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns a chain of storeys with equal masses (kg) and these stiffnesses (N/m), measured on
    /// every floor.
    pub(crate) fn chain(masses: &[f64], stiffnesses: &[f64]) -> PartModel {
        let len = masses.len();
        let storey = |(storey, stiffness): (usize, &f64)| {
            let entry = |row, column, value| Entry { row, column, value };
            let mut entries = vec![entry(storey, storey, *stiffness)];
            if let Some(below) = storey.checked_sub(1) {
                entries.push(entry(below, below, *stiffness));
                entries.push(entry(below, storey, -stiffness));
                entries.push(entry(storey, below, -stiffness));
            }
            entries
        };
        PartModel::new(
            DMatrix::from_diagonal(&DVector::from_column_slice(masses)),
            DMatrix::zeros(len, len),
            stiffnesses.iter().enumerate().map(storey).collect(),
            DMatrix::identity(len, len),
        )
        .unwrap()
    }

    /// f_j = √(k/m) sin((2j − 1)π/(4n + 2))/π for a uniform chain.
    #[test]
    fn frequencies_of_a_uniform_chain_are_known() {
        let model = chain(&[2.0; 5], &[300.0; 5]);
        let (found, _) = model.modes(&DVector::zeros(5)).unwrap();
        for (mode, found) in found.iter().enumerate() {
            let angle = (2 * mode + 1) as f64 * std::f64::consts::PI / 22.0;
            let expected = (300.0_f64 / 2.0).sqrt() * angle.sin() / std::f64::consts::PI;
            assert!(
                (found - expected).abs() < 1e-12 * expected,
                "{found} {expected}"
            );
        }
    }

    #[test]
    fn derivatives_are_the_limit_of_differences() {
        let model = chain(
            &[2.0, 1.7, 2.2, 1.9, 1.5],
            &[300.0, 250.0, 400.0, 210.0, 150.0],
        );
        let x = DVector::from_column_slice(&[0.1, -0.2, 0.05, 0.0, 0.3]);
        let lines = model.all_lines(&x).unwrap();
        let followed: Vec<DVector<f64>> = lines.iter().map(|line| line.whole.clone()).collect();
        for part in 0..5 {
            let [up, down] = [1e-5, -1e-5].map(|by| {
                let mut moved = x.clone();
                moved[part] += by;
                model.lines(&moved, &followed).unwrap()
            });
            for ((line, up), down) in lines.iter().zip(&up).zip(&down) {
                let by = (up.ln_frequency - down.ln_frequency) / 2e-5;
                assert!((by - line.ln_frequency_by[part]).abs() < 1e-8);
                // The sign of an eigenvector is arbitrary.
                let signed = |of: &ModeLine| &of.shape * of.shape.dot(&line.shape).signum();
                let by = (signed(up) - signed(down)) / 2e-5;
                assert!((by - line.shape_by.column(part)).norm() < 1e-7);
            }
        }
    }

    /// All parts together scale K, and f with √K: Σ_s ∂ ln f/∂x_s = ½.
    #[test]
    fn sensitivities_of_all_parts_sum_to_one_half() {
        let model = chain(&[2.0, 1.7, 2.2], &[300.0, 250.0, 400.0]);
        for line in model.all_lines(&DVector::zeros(3)).unwrap() {
            assert!((line.ln_frequency_by.sum() - 0.5).abs() < 1e-12);
        }
    }

    #[test]
    fn a_mass_that_is_not_positive_is_refused() {
        let empty = || DMatrix::zeros(2, 2);
        let refused = PartModel::new(empty(), empty(), Vec::new(), empty());
        assert_eq!(refused.unwrap_err(), ModalError::Model);
    }
}
