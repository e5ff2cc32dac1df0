//! The matrices of a structure with known parameters, and their exact recursion from frame to
//! frame.
//!
//! `u̇ = A_u u + B_u f`, `z = H u + D f` with `u = [x, ẋ]`: Huang & Yuen (2023), (2.3) to (2.9).

use crate::hysteresis::Drive;
use crate::model::{Motion, StructureModel};
use crate::ritz_basis::RitzBasis;
use nalgebra::{Cholesky, DMatrix, DVector};
use spandrel_filter::{InputHold, ObservationModel, ProcessModel};

/// A structure with known parameters in continuous time.
#[derive(Debug, Clone)]
pub(crate) struct LinearForm {
    /// `A_u` (2 N_d × 2 N_d).
    pub(crate) system: DMatrix<f64>,
    /// `B_u` (2 N_d × N_f).
    pub(crate) input: DMatrix<f64>,
    /// `H` (N_0 × 2 N_d).
    pub(crate) observation: DMatrix<f64>,
    /// `D` (N_0 × N_f).
    pub(crate) direct: DMatrix<f64>,
}

/// The recursion `u_{i+1} = A u_i + B f_i + B₁ (f_{i+1} − f_i)`.
///
/// It is exact for an excitation that is constant or linear over a step.
#[derive(Debug, Clone)]
pub(crate) struct Recursion {
    /// `A` (2 N_d × 2 N_d), (2.8).
    pub(crate) transition: DMatrix<f64>,
    /// `B` (2 N_d × N_f), (2.9).
    pub(crate) input: DMatrix<f64>,
    /// `B₁` (2 N_d × N_f); zero for constant components.
    pub(crate) slope: DMatrix<f64>,
}

impl LinearForm {
    /// Extracts the matrices from `model` at given parameters (ratios to nominal).
    pub(crate) fn new(model: &mut StructureModel, theta: &[f64]) -> Self {
        Self::moving_in(model, theta, None)
    }

    /// Extracts the matrices of the motion in the shapes of `basis` (r), `x = Φ q`. `2 N_d` is then
    /// `2 r`. Springs driven by their drift rates move by `D Φ q`. Without a basis, every degree of
    /// freedom moves by itself.
    pub(crate) fn moving_in(
        model: &mut StructureModel,
        theta: &[f64],
        basis: Option<&RitzBasis>,
    ) -> Self {
        let (len, inputs) = (model.state_len(), model.excitation_len());
        let physical = len - model.parameter_len();
        let mut state = vec![0.0; len];
        state[physical..].copy_from_slice(theta);
        let at_rest = vec![0.0; inputs];
        model.linearise_process(&state, &at_rest);
        model.linearise_observation(&state, &at_rest);
        let columns = match basis {
            None => DMatrix::identity(len, physical),
            Some(basis) => twice(&basis.shapes, model.drive(), len),
        };
        let mut system = DMatrix::zeros(len, columns.ncols());
        model.jacobian_mul(&columns, &mut system);
        let mut input = DMatrix::zeros(len, inputs);
        model.excitation_matrix(&mut input);
        let mut observation = DMatrix::zeros(model.observation_len(), columns.ncols());
        if basis.is_none() {
            model.observation_jacobian_mul(&columns, &mut observation);
        }
        let direct = model.feedthrough().cloned();
        let mut form = Self {
            system: system.rows(0, physical).into_owned(),
            input: input.rows(0, physical).into_owned(),
            direct: direct.unwrap_or_else(|| DMatrix::zeros(observation.nrows(), inputs)),
            observation,
        };
        if let Some(basis) = basis {
            form.project(model, basis);
        }
        form
    }

    /// Replaces the rates of `[x, ẋ]` by those of `[q, q̇]`, by Galerkin's method:
    /// `q̈ = (Φᵀ M Φ)⁻¹ Φᵀ M ẍ`.
    fn project(&mut self, model: &StructureModel, basis: &RitzBasis) {
        let factors = model.mass_factors();
        let scaled = |by_mass: &DMatrix<f64>| {
            let mut scaled = by_mass.clone();
            for (mut column, factor) in scaled.column_iter_mut().zip(&factors) {
                column *= *factor;
            }
            scaled
        };
        let weighted = scaled(&basis.shares); // Φᵀ M
        let mass = (factors.iter().any(|factor| *factor != 1.0))
            .then(|| Cholesky::new(&weighted * &basis.shapes))
            .flatten(); // Φᵀ M Φ = I at the stated masses
        let (width, free) = weighted.shape();
        let amplitudes = |rates: &DMatrix<f64>| {
            let mut moved = DMatrix::zeros(2 * width, rates.ncols());
            for part in 0..2 {
                let mut of_dofs = rates.rows(part * free, free).into_owned();
                if part == 0 && model.drive() == Drive::Drift {
                    // D⁻¹ adds the drifts of all springs below.
                    for spring in 1..free {
                        let (mut sum, below) = of_dofs.rows_range_pair_mut(spring, spring - 1);
                        sum += below;
                    }
                }
                let mut of_part = &weighted * of_dofs;
                if let Some(mass) = &mass {
                    mass.solve_mut(&mut of_part);
                }
                moved.rows_mut(part * width, width).copy_from(&of_part);
            }
            moved
        };
        let (system, input) = (amplitudes(&self.system), amplitudes(&self.input));
        let outside = scaled(&basis.residual) * self.system.view((free, 0), (free, width)); // −R K Φ
        self.sense(model, [&basis.shapes, &outside], [&system, &input]);
        (self.system, self.input) = (system, input);
    }

    /// Makes the sensors see the motion `Φ q − R K(θ) Φ q` of the `shapes`, `Φ` and `−R K(θ) Φ`
    /// ([`crate::ritz_basis`]), with the rates of `[q, q̇]`.
    ///
    /// Sensors of acceleration see its second derivative. Their own row of `−M⁻¹ K Φ` would
    /// multiply the error of the shapes by the square of the highest frequency.
    fn sense(
        &mut self,
        model: &StructureModel,
        [shapes, outside]: [&DMatrix<f64>; 2],
        [system, input]: [&DMatrix<f64>; 2],
    ) {
        let (free, width) = shapes.shape();
        for (row, (motion, sensed)) in model.sensed().enumerate() {
            let mut shape = outside.row(row).into_owned();
            for (dof, factor) in sensed {
                shape += shapes.row(dof) * factor;
            }
            let mut observed = self.observation.row_mut(row);
            match motion {
                Motion::Displacement => observed.columns_mut(0, width).copy_from(&shape),
                Motion::Velocity => observed.columns_mut(width, width).copy_from(&shape),
                Motion::Acceleration(dof) => {
                    observed.copy_from(&(&shape * system.rows(width, width)));
                    // What the sensor does not feel, such as the ground motion, is left out as it
                    // is.
                    let felt = self.direct.row(row) - self.input.row(free + dof);
                    let moved = shape * input.rows(width, width) + felt;
                    self.direct.set_row(row, &moved);
                }
            }
        }
    }

    /// Returns the equilibrium state (2 N_d) under a constant `excitation` (N_f):
    /// `A_u u + B_u f = 0`.
    pub(crate) fn rest(&self, excitation: &DVector<f64>) -> DVector<f64> {
        let pushed = -(&self.input * excitation);
        // The stiffness is positive definite, as checked when the file was read.
        self.system
            .clone()
            .lu()
            .solve(&pushed)
            .unwrap_or_else(|| DVector::zeros(self.system.nrows()))
    }

    /// Creates the recursion for a step of `step_s` (s) from one exponential of an augmented
    /// matrix.
    ///
    /// `holds` specifies how each excitation component varies within a step.
    pub(crate) fn recursion(&self, step_s: f64, holds: &[InputHold]) -> Recursion {
        let (n, inputs) = (self.input.nrows(), self.input.ncols());
        let with_slope = if holds.contains(&InputHold::First) {
            inputs
        } else {
            0
        };
        let mut augmented = DMatrix::zeros(n + inputs + with_slope, n + inputs + with_slope);
        augmented
            .view_mut((0, 0), (n, n))
            .copy_from(&(&self.system * step_s));
        augmented
            .view_mut((0, n), (n, inputs))
            .copy_from(&(&self.input * step_s));
        for input in 0..with_slope {
            augmented[(n + input, n + inputs + input)] = 1.0; // f = f_i + (t/Δt)(f_{i+1} − f_i)
        }
        let exponential = augmented.exp();
        let block = |column, width| exponential.view((0, column), (n, width)).into_owned();
        let mut slope = DMatrix::zeros(n, inputs);
        for (input, _) in holds
            .iter()
            .enumerate()
            .filter(|(_, hold)| **hold == InputHold::First)
        {
            slope
                .column_mut(input)
                .copy_from(&block(n + inputs + input, 1));
        }
        Recursion {
            transition: block(0, n),
            input: block(n, inputs),
            slope,
        }
    }
}

/// Returns `[D Φ, 0; 0, Φ; 0, 0]` with `len` rows. `D` is the identity for linear springs.
fn twice(shapes: &DMatrix<f64>, drive: Drive, len: usize) -> DMatrix<f64> {
    let (free, width) = shapes.shape();
    let mut columns = DMatrix::zeros(len, 2 * width);
    columns
        .view_mut((free, width), (free, width))
        .copy_from(shapes);
    for (shape, column) in shapes
        .as_slice()
        .chunks_exact(free)
        .zip(columns.as_mut_slice().chunks_exact_mut(len))
    {
        drive.drive_to(shape, &mut column[..free]);
    }
    columns
}
