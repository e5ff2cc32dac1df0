//! Linear time-invariant models without parameters. With such a model, the extended filter is a
//! Kalman filter.
//!
//! The model is `ẏ = A y + B f`, `z = H y + D f + n`, in one of two forms:
//!
//! - [`StateSpace`] uses any coordinates.
//! - [`ModalModel`] uses the modal coordinates of a classically damped structure. `A` then consists
//!   of four diagonals, and the prediction of the covariance takes `O(n²)` operations instead of
//!   `O(n³)`.
//!
//! Source of the modal form: Yuen, Liang & Kuok (2013). It does not change their method.

use crate::constant::ConstantTransition;
use crate::error::FilterError;
use crate::model::{ObservationModel, ProcessModel};
use nalgebra::{Cholesky, DMatrix, DVector, SymmetricEigen};

/// Largest off-diagonal modal damping, relative to the largest diagonal entry, that counts as
/// rounding.
///
/// It also limits negative eigenvalues of the stiffness, relative to the largest eigenvalue.
const UNCOUPLED: f64 = 1e-8;

/// Number of squarings of the system matrix. The bound `‖A⁶⁴‖^(1/64)` is close to the spectral
/// radius.
const SQUARINGS: i32 = 6;

/// Direct effect of the excitation on the sensors (N_0 × N_f).
#[derive(Debug, Clone, PartialEq)]
pub enum DirectTerm {
    /// No direct effect: displacements, velocities, absolute accelerations under ground motion.
    None,
    /// Only the known part of the excitation acts on the sensors, as in the data of Yuen, Liang &
    /// Kuok (2013), case 3.
    Known(DMatrix<f64>),
    /// Both parts act on the sensors: forces on sensed masses, relative accelerations.
    Whole(DMatrix<f64>),
}

impl DirectTerm {
    fn matrix(&self) -> Option<&DMatrix<f64>> {
        match self {
            Self::None => None,
            Self::Known(matrix) | Self::Whole(matrix) => Some(matrix),
        }
    }
}

/// `z = H y + D f + n` with the point of the last linearisation.
#[derive(Debug, Clone)]
struct LinearObservation {
    /// `Hᵀ` (n × N_0), because its columns are long and contiguous.
    transposed: DMatrix<f64>,
    direct: DirectTerm,
    state: DVector<f64>,
    excitation: DVector<f64>,
}

impl LinearObservation {
    fn new(
        matrix: DMatrix<f64>,
        direct: DirectTerm,
        n: usize,
        inputs: usize,
    ) -> Result<Self, FilterError> {
        check_len("columns of the observation matrix", matrix.ncols(), n)?;
        if let Some(direct) = direct.matrix() {
            check_len("rows of the direct term", direct.nrows(), matrix.nrows())?;
            check_len("columns of the direct term", direct.ncols(), inputs)?;
        }
        Ok(Self {
            transposed: matrix.transpose(),
            direct,
            state: DVector::zeros(n),
            excitation: DVector::zeros(inputs),
        })
    }

    fn linearise(&mut self, state: &[f64], excitation: &[f64]) {
        self.state.copy_from_slice(state);
        self.excitation.copy_from_slice(excitation);
    }

    fn observe(&self, out: &mut [f64]) {
        for (entry, row) in out.iter_mut().zip(self.transposed.column_iter()) {
            *entry = row.dot(&self.state);
        }
        if let Some(direct) = self.direct.matrix() {
            for (column, known) in direct.column_iter().zip(self.excitation.iter()) {
                out.iter_mut()
                    .zip(column.iter())
                    .for_each(|(entry, weight)| *entry += weight * known);
            }
        }
    }

    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        for (column, mut target) in columns.column_iter().zip(out.column_iter_mut()) {
            for (entry, row) in target.iter_mut().zip(self.transposed.column_iter()) {
                *entry = row.dot(&column);
            }
        }
    }

    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        match &self.direct {
            DirectTerm::Whole(matrix) => Some(matrix),
            DirectTerm::None | DirectTerm::Known(_) => None,
        }
    }
}

/// Writes `X v`.
fn mul_to(x: &DMatrix<f64>, v: &[f64], out: &mut [f64]) {
    out.fill(0.0);
    for (column, weight) in x.column_iter().zip(v) {
        if *weight != 0.0 {
            out.iter_mut()
                .zip(column.iter())
                .for_each(|(entry, value)| *entry += value * weight);
        }
    }
}

fn check_len(what: &'static str, found: usize, expected: usize) -> Result<(), FilterError> {
    if found == expected {
        Ok(())
    } else {
        Err(FilterError::Dimension {
            what,
            found,
            expected,
        })
    }
}

/// A linear time-invariant model in any coordinates.
///
/// For a structure with many classically damped degrees of freedom, use [`ModalModel`]. It is
/// equivalent and much faster.
#[derive(Debug, Clone)]
pub struct StateSpace {
    /// `A` (n × n, 1/s)
    system: DMatrix<f64>,
    /// `B` (n × N_f)
    input: DMatrix<f64>,
    rate_bound: f64,
    process: [DVector<f64>; 2],
    observation: LinearObservation,
}

impl StateSpace {
    /// Creates a model from `A` (n × n, 1/s), `B` (n × N_f), `H` (N_0 × n) and the direct term.
    ///
    /// # Errors
    /// Returns [`FilterError::Dimension`] if a size does not fit.
    pub fn new(
        system: DMatrix<f64>,
        input: DMatrix<f64>,
        observation: DMatrix<f64>,
        direct: DirectTerm,
    ) -> Result<Self, FilterError> {
        let (n, inputs) = (system.nrows(), input.ncols());
        check_len("columns of the system matrix", system.ncols(), n)?;
        check_len("rows of the input matrix", input.nrows(), n)?;
        let observation = LinearObservation::new(observation, direct, n, inputs)?;
        let rate_bound = spectral_radius_bound(&system);
        Ok(Self {
            system,
            input,
            rate_bound,
            process: [DVector::zeros(n), DVector::zeros(inputs)],
            observation,
        })
    }

    /// Creates the model of `M ẍ + L ẋ + K x = T f` with the state `[x, ẋ]`.
    ///
    /// - `M`, `L`, `K` (N_d × N_d): mass, damping and stiffness
    /// - `distribution`: `T` (N_d × N_f)
    /// - `observation`: `H` (N_0 × 2 N_d)
    ///
    /// # Errors
    /// Returns an error if a size does not fit or `M` is not positive definite.
    pub fn second_order(
        [mass, damping, stiffness]: [&DMatrix<f64>; 3],
        distribution: &DMatrix<f64>,
        observation: DMatrix<f64>,
        direct: DirectTerm,
    ) -> Result<Self, FilterError> {
        let free = check_second_order([mass, damping, stiffness], distribution)?;
        let factor = Cholesky::new(mass.clone()).ok_or(NO_MASS)?;
        let mut system = DMatrix::zeros(2 * free, 2 * free);
        system
            .view_mut((0, free), (free, free))
            .fill_with_identity();
        system
            .view_mut((free, 0), (free, free))
            .copy_from(&-factor.solve(stiffness));
        system
            .view_mut((free, free), (free, free))
            .copy_from(&-factor.solve(damping));
        let mut input = DMatrix::zeros(2 * free, distribution.ncols());
        input
            .rows_mut(free, free)
            .copy_from(&factor.solve(distribution));
        Self::new(system, input, observation, direct)
    }

    /// Returns `A` (n × n, 1/s).
    #[must_use]
    pub fn system(&self) -> &DMatrix<f64> {
        &self.system
    }

    /// Returns `B` (n × N_f).
    #[must_use]
    pub fn input(&self) -> &DMatrix<f64> {
        &self.input
    }
}

/// Returns `‖A^k‖^(1/k)` for a large `k`, an upper bound of the magnitude of every eigenvalue.
fn spectral_radius_bound(system: &DMatrix<f64>) -> f64 {
    let mut power = system.clone();
    let mut logarithm = 0.0; // logarithm of the factors removed from the power, divided by k
    for squaring in 0..=SQUARINGS {
        let size = power.norm();
        if size == 0.0 || !size.is_finite() {
            return size;
        }
        logarithm += size.ln() / 2f64.powi(squaring);
        power /= size;
        if squaring < SQUARINGS {
            power = &power * &power;
        }
    }
    logarithm.exp()
}

const NO_MASS: FilterError = FilterError::Setting {
    what: "smallest pivot of the mass matrix",
    found: 0.0,
    allowed: "positive",
};

fn check_second_order(
    matrices: [&DMatrix<f64>; 3],
    distribution: &DMatrix<f64>,
) -> Result<usize, FilterError> {
    let free = distribution.nrows();
    for (what, matrix) in ["mass matrix", "damping matrix", "stiffness matrix"]
        .into_iter()
        .zip(matrices)
    {
        check_len(what, matrix.nrows(), free)?;
        check_len(what, matrix.ncols(), free)?;
    }
    Ok(free)
}

impl ProcessModel for StateSpace {
    fn state_len(&self) -> usize {
        self.system.nrows()
    }

    fn parameter_len(&self) -> usize {
        0
    }

    fn excitation_len(&self) -> usize {
        self.input.ncols()
    }

    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        let [y, f] = &mut self.process;
        y.copy_from_slice(state);
        f.copy_from_slice(excitation);
    }

    fn derivative(&self, out: &mut [f64]) {
        let [y, f] = &self.process;
        mul_to(&self.system, y.as_slice(), out);
        for (column, known) in self.input.column_iter().zip(f.iter()) {
            out.iter_mut()
                .zip(column.iter())
                .for_each(|(entry, weight)| *entry += weight * known);
        }
    }

    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let n = self.system.nrows();
        for (column, target) in columns
            .as_slice()
            .chunks_exact(n)
            .zip(out.as_mut_slice().chunks_exact_mut(n))
        {
            mul_to(&self.system, column, target);
        }
    }

    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.copy_from(&self.input);
    }

    fn rate_bound(&self) -> f64 {
        self.rate_bound
    }

    fn constant_transition(&self, step_s: f64) -> Option<ConstantTransition> {
        ConstantTransition::dense(&self.system, &self.input, step_s).ok()
    }
}

/// A classically damped structure in mass-normalised modal coordinates, with the state `[q, q̇]` (2
/// N_d).
///
/// `x = Φ q` with `Φᵀ M Φ = I`, `Φᵀ K Φ = diag(ω²)` and `Φᵀ L Φ = diag(2ζω)`.
#[derive(Debug, Clone)]
pub struct ModalModel {
    /// `Φ` (N_d × N_d)
    shapes: DMatrix<f64>,
    /// `Φᵀ M` (N_d × N_d), the inverse of `Φ`
    inverse_shapes: DMatrix<f64>,
    /// `ω²` (N_d, 1/s²)
    stiffness: DVector<f64>,
    /// `2ζω` (N_d, 1/s)
    damping: DVector<f64>,
    /// `Φᵀ T` (N_d × N_f)
    participation: DMatrix<f64>,
    process: [DVector<f64>; 2],
    observation: LinearObservation,
}

impl ModalModel {
    /// Creates the model of `M ẍ + L ẋ + K x = T f` from its physical matrices.
    ///
    /// - `M`, `L`, `K` (N_d × N_d): mass, damping and stiffness
    /// - `distribution`: `T` (N_d × N_f)
    /// - `observation`: `H` (N_0 × 2 N_d) for the physical state `[x, ẋ]`
    ///
    /// # Errors
    /// Returns an error if a size does not fit, `M` is not positive definite, `K` has a negative
    /// eigenvalue, or the damping couples the modes.
    pub fn new(
        [mass, damping, stiffness]: [&DMatrix<f64>; 3],
        distribution: &DMatrix<f64>,
        observation: &DMatrix<f64>,
        direct: DirectTerm,
    ) -> Result<Self, FilterError> {
        let free = check_second_order([mass, damping, stiffness], distribution)?;
        check_len(
            "columns of the observation matrix",
            observation.ncols(),
            2 * free,
        )?;
        let factor = Cholesky::new(mass.clone()).ok_or(NO_MASS)?.unpack();
        let from_left = |x: &DMatrix<f64>| factor.solve_lower_triangular(x).ok_or(NO_MASS);
        let mut normalised = from_left(&from_left(stiffness)?.transpose())?; // L⁻¹ K L⁻ᵀ
        crate::dense::symmetrise_mut(&mut normalised);
        let eigen = SymmetricEigen::new(normalised);
        let mut order: Vec<usize> = (0..free).collect();
        order.sort_by(|&i, &j| eigen.eigenvalues[i].total_cmp(&eigen.eigenvalues[j]));
        let vectors = DMatrix::from_fn(free, free, |i, j| eigen.eigenvectors[(i, order[j])]);
        let squares = DVector::from_fn(free, |j, _| eigen.eigenvalues[order[j]]);
        let largest = squares.amax();
        for &square in &squares {
            if !(square >= -UNCOUPLED * largest && square.is_finite()) {
                let what = "eigenvalue of the stiffness matrix";
                return Err(FilterError::Setting {
                    what,
                    found: square,
                    allowed: "not negative",
                });
            }
        }
        let shapes = factor.tr_solve_lower_triangular(&vectors).ok_or(NO_MASS)?; // Φ = L⁻ᵀ V
        let modal_damping = shapes.transpose() * damping * &shapes;
        let coupling =
            DMatrix::from_fn(
                free,
                free,
                |i, j| if i == j { 0.0 } else { modal_damping[(i, j)] },
            )
            .amax();
        if coupling > UNCOUPLED * modal_damping.amax() {
            let what = "coupling of the modes by the damping matrix (1/s)";
            return Err(FilterError::Setting {
                what,
                found: coupling,
                allowed: "zero: damping must be classical",
            });
        }
        let mut modal_observation = DMatrix::zeros(observation.nrows(), 2 * free);
        for half in [0, free] {
            let block = observation.columns(half, free) * &shapes;
            modal_observation.columns_mut(half, free).copy_from(&block);
        }
        let inputs = distribution.ncols();
        Ok(Self {
            inverse_shapes: shapes.transpose() * mass,
            participation: shapes.transpose() * distribution,
            stiffness: squares.map(|square| square.max(0.0)),
            damping: modal_damping.diagonal(),
            process: [DVector::zeros(2 * free), DVector::zeros(inputs)],
            observation: LinearObservation::new(modal_observation, direct, 2 * free, inputs)?,
            shapes,
        })
    }

    /// Returns the mode shapes `Φ` as columns, in ascending order of frequency (N_d × N_d, N_d =
    /// number of free degrees of freedom).
    #[must_use]
    pub fn shapes(&self) -> &DMatrix<f64> {
        &self.shapes
    }

    /// Returns the natural angular frequencies `ω` of the undamped modes, in ascending order
    /// (rad/s; length N_d, the number of free degrees of freedom). A mode without stiffness has 0.
    #[must_use]
    pub fn angular_frequencies(&self) -> DVector<f64> {
        self.stiffness.map(f64::sqrt)
    }

    /// Returns the damping ratios `ζ` of the modes, in ascending order of frequency (length N_d,
    /// the number of free degrees of freedom). The ratio is infinite or NaN for a mode without
    /// stiffness.
    #[must_use]
    pub fn damping_ratios(&self) -> DVector<f64> {
        self.damping.zip_map(&self.stiffness, |damping, square| {
            damping / (2.0 * square.sqrt())
        })
    }

    /// Returns the matrix that maps modal coordinates and velocities `[q, q̇]` to displacements and
    /// velocities `[x, ẋ]`. It has 2 N_d × 2 N_d elements for N_d free degrees of freedom.
    #[must_use]
    pub fn physical_from_modal(&self) -> DMatrix<f64> {
        twice(&self.shapes)
    }

    /// Returns the matrix that maps displacements and velocities `[x, ẋ]` to modal coordinates and
    /// velocities `[q, q̇]`. It has 2 N_d × 2 N_d elements for N_d free degrees of freedom.
    #[must_use]
    pub fn modal_from_physical(&self) -> DMatrix<f64> {
        twice(&self.inverse_shapes)
    }
}

/// Returns the block-diagonal matrix with `block` twice on its diagonal.
fn twice(block: &DMatrix<f64>) -> DMatrix<f64> {
    let n = block.nrows();
    let mut whole = DMatrix::zeros(2 * n, 2 * n);
    for start in [0, n] {
        whole.view_mut((start, start), (n, n)).copy_from(block);
    }
    whole
}

impl ProcessModel for ModalModel {
    fn state_len(&self) -> usize {
        2 * self.stiffness.len()
    }

    fn parameter_len(&self) -> usize {
        0
    }

    fn excitation_len(&self) -> usize {
        self.participation.ncols()
    }

    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        let [y, f] = &mut self.process;
        y.copy_from_slice(state);
        f.copy_from_slice(excitation);
    }

    fn derivative(&self, out: &mut [f64]) {
        let [y, f] = &self.process;
        let modes = self.stiffness.len();
        for j in 0..modes {
            let force: f64 = self
                .participation
                .row(j)
                .iter()
                .zip(f.iter())
                .map(|(share, known)| share * known)
                .sum();
            out[j] = y[modes + j];
            out[modes + j] = force - self.stiffness[j] * y[j] - self.damping[j] * y[modes + j];
        }
    }

    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let modes = self.stiffness.len();
        for k in 0..columns.ncols() {
            for j in 0..modes {
                let (q, rate) = (columns[(j, k)], columns[(modes + j, k)]);
                out[(j, k)] = rate;
                out[(modes + j, k)] = -self.stiffness[j] * q - self.damping[j] * rate;
            }
        }
    }

    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        let modes = self.stiffness.len();
        out.fill(0.0);
        out.rows_mut(modes, modes).copy_from(&self.participation);
    }

    fn rate_bound(&self) -> f64 {
        // |λ| = ω below critical damping, and less than c above it.
        self.stiffness
            .iter()
            .zip(self.damping.iter())
            .map(|(square, c)| square.sqrt().max(c.abs()))
            .fold(0.0, f64::max)
    }

    fn constant_transition(&self, step_s: f64) -> Option<ConstantTransition> {
        let (stiffness, damping) = (self.stiffness.as_slice(), self.damping.as_slice());
        ConstantTransition::modal(stiffness, damping, &self.participation, step_s).ok()
    }
}

macro_rules! observe_linearly {
    ($($model:ty),*) => {$(
        impl ObservationModel for $model {
            fn observation_len(&self) -> usize {
                self.observation.transposed.ncols()
            }

            fn linearise_observation(&mut self, state: &[f64], excitation: &[f64]) {
                self.observation.linearise(state, excitation);
            }

            fn observe(&self, out: &mut [f64]) {
                self.observation.observe(out);
            }

            fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
                self.observation.jacobian_mul(columns, out);
            }

            fn feedthrough(&self) -> Option<&DMatrix<f64>> {
                self.observation.feedthrough()
            }
        }
    )*};
}

observe_linearly!(StateSpace, ModalModel);

#[cfg(test)]
mod tests;
