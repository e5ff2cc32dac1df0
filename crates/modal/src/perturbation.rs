//! First-order change of poles and shapes with the covariances of each block.
//!
//! Source: Reynders, Pintelon & De Roeck (2008), Mech. Syst. Signal Process. 22, 948–969, for the
//! perturbation; Döhler & Mevel (2013), Mech. Syst. Signal Process. 38, 346–366, for its efficient
//! form, in which no covariance matrix of the covariances is built: each block is one column of its
//! square root. Equation numbers refer to docs/theory/modal.md.
//!
//! Only the component of ΔU orthogonal to U_n matters, because the component within U_n changes the
//! state basis, which leaves poles and shapes unchanged.

use crate::covariance::EpochCovariances;
use crate::realisation::{Model, Pole, Realisation};
use nalgebra::{Complex, DMatrix, DMatrixView, DVector};
use std::f64::consts::PI;

type Vector = DVector<Complex<f64>>;

/// Products of the differences of all blocks with the singular vectors.
#[derive(Debug)]
pub(crate) struct Perturbations<'r> {
    realisation: &'r Realisation,
    blocks: Vec<BlockPerturbation>,
}

/// Products of one block, up to the highest order.
#[derive(Debug)]
struct BlockPerturbation {
    /// ΔH V S⁻¹.
    z: DMatrix<f64>,
    /// σ_j Q_ij + σ_i P_ij, part of equation (8).
    numerator: DMatrix<f64>,
}

/// Change of a pole and of its shape with one block.
#[derive(Debug, Clone)]
pub(crate) struct Change {
    /// Change of the frequency (Hz).
    pub(crate) frequency_hz: f64,
    /// Change of the damping ratio.
    pub(crate) damping: f64,
    /// Change of the shape.
    pub(crate) shape: Vector,
}

impl<'r> Perturbations<'r> {
    /// Prepares the blocks of an epoch whose mean covariances are `mean`.
    pub(crate) fn new(
        realisation: &'r Realisation,
        covariances: &EpochCovariances,
        mean: &DMatrix<f64>,
    ) -> Self {
        let highest = realisation.highest_order();
        let svd = &realisation.svd;
        let (u, v) = (svd.u.columns(0, highest), svd.v.columns(0, highest));
        let blocks = (0..covariances.blocks())
            .map(|block| {
                let difference = covariances.hankel(&covariances.difference(block, mean)); // ΔH
                let product = &difference * v; // ΔH v_j
                let p = svd.u.tr_mul(&product); // P_ij = u_iᵀ ΔH v_j
                let q = svd.v.tr_mul(&difference.tr_mul(&u)); // Q_ij = v_iᵀ ΔHᵀ u_j
                BlockPerturbation {
                    z: DMatrix::from_fn(product.nrows(), highest, |i, j| {
                        product[(i, j)] / svd.s[j]
                    }),
                    numerator: DMatrix::from_fn(p.nrows(), highest, |i, j| {
                        svd.s[j] * q[(i, j)] + svd.s[i] * p[(i, j)]
                    }),
                }
            })
            .collect();
        Self {
            realisation,
            blocks,
        }
    }

    /// Returns the change of a pole with each block. Returns `None` if the equations of its model
    /// are singular.
    pub(crate) fn changes(&self, model: &Model, pole: &Pole) -> Option<Vec<Change>> {
        let sensitivity = Sensitivity::new(self.realisation, model, pole)?;
        Some(
            self.blocks
                .iter()
                .map(|block| sensitivity.change(block))
                .collect(),
        )
    }
}

/// Everything about a pole that does not depend on the block.
#[derive(Debug)]
struct Sensitivity<'r> {
    realisation: &'r Realisation,
    model: &'r Model,
    position: usize,
    /// ψ.
    vector: Vector,
    /// U_restᵀ e.
    residual_in_rest: Vector,
    /// (I − U_n U_nᵀ) e.
    residual_outside: Vector,
    /// Ψ⁻¹ (O_upᵀ O_up)⁻¹.
    left: DMatrix<Complex<f64>>,
    /// σ_i / (σ_j (σ_j² − σ_i²)) for i > n, j ≤ n.
    weights: DMatrix<f64>,
}

impl<'r> Sensitivity<'r> {
    fn new(realisation: &'r Realisation, model: &'r Model, pole: &Pole) -> Option<Self> {
        let n = model.order;
        let svd = &realisation.svd;
        let (l, rows) = (realisation.outputs, svd.u.nrows());
        let vector: Vector = model.vectors.column(pole.position).into_owned();
        let u_psi = real_times(svd.u.columns(0, n), &vector);
        let up = u_psi.rows(0, rows - l);
        let down = u_psi.rows(l, rows - l);
        let mu = model.values[pole.position];
        // e = (O_down − μ O_up) ψ, the residual of the least squares, in the rows of O_up.
        let mut residual = Vector::zeros(rows);
        residual.rows_mut(0, rows - l).copy_from(&(down - up * mu));
        let gram = realisation.gram_factor(n)?;
        let inverse_gram = gram.solve(&DMatrix::identity(n, n));
        let inverse_gram = inverse_gram.map(|value| Complex::new(value, 0.0));
        let left = model.vectors.clone().lu().solve(&inverse_gram)?;
        let rest = svd.u.ncols() - n;
        let weights = DMatrix::from_fn(rest, n, |i, j| {
            let (si, sj) = (svd.s[n + i], svd.s[j]);
            si / (sj * (sj * sj - si * si)) // (8)
        });
        let u_rest = svd.u.columns(n, rest);
        let u_n = svd.u.columns(0, n);
        let within = real_times(u_n, &real_transposed_times(u_n, &residual));
        Some(Self {
            residual_outside: &residual - within,
            residual_in_rest: real_transposed_times(u_rest, &residual),
            realisation,
            model,
            position: pole.position,
            vector,
            left,
            weights,
        })
    }

    /// Returns the change with the covariances of one block.
    fn change(&self, block: &BlockPerturbation) -> Change {
        let n = self.model.order;
        let (l, rows) = (self.realisation.outputs, self.realisation.svd.u.nrows());
        let mu = self.model.values[self.position];
        let k = self.correction(block);
        let d = self.observability_change_times_vector(block, &k); // ΔO ψ
        let t = self.observability_change_transposed_times_residual(block, &k); // ΔO_upᵀ e
        let u_up = self.realisation.svd.u.view((0, 0), (rows - l, n));
        let moved = d.rows(l, rows - l) - d.rows(0, rows - l) * mu;
        // χ* ΔA ψ = χ* (O_upᵀ O_up)⁻¹ (O_upᵀ (ΔO_down − μ ΔO_up) ψ + ΔO_upᵀ e) (9)
        let turned = &self.left * (real_transposed_times(u_up, &moved) + t);
        let delta_mu = turned[self.position]; // χ_j* ψ_j = 1 (10)
        let mut delta_psi = Vector::zeros(n);
        for k in 0..n {
            let gap = mu - self.model.values[k];
            if k != self.position && gap.norm() > 0.0 {
                delta_psi += self.model.vectors.column(k) * (turned[k] / gap); // (11)
            }
        }
        let c = self.realisation.svd.u.view((0, 0), (l, n));
        let shape = d.rows(0, l) + real_times(c, &delta_psi); // Δφ = ΔC ψ + C Δψ (11)
        let lambda = mu.ln() * self.realisation.rate_hz;
        let delta_lambda = delta_mu / mu * self.realisation.rate_hz;
        let omega = lambda.norm();
        let delta_omega = (lambda.conj() * delta_lambda).re / omega; // Δ|λ|
        Change {
            frequency_hz: delta_omega / (2.0 * PI),
            // ζ = −Re λ/|λ|
            damping: -delta_lambda.re / omega + lambda.re * delta_omega / (omega * omega),
            shape,
        }
    }

    /// Returns ΔO ψ = (I − U_n U_nᵀ) Z ψ + U_rest K ψ (8).
    fn observability_change_times_vector(
        &self,
        block: &BlockPerturbation,
        k: &DMatrix<f64>,
    ) -> Vector {
        let n = self.model.order;
        let u = &self.realisation.svd.u;
        let (u_n, u_rest) = u.columns_range_pair(..n, n..);
        let z_psi = real_times(block.z.columns(0, n), &self.vector);
        let within = real_times(u_n, &real_transposed_times(u_n, &z_psi));
        let k_psi = real_times(k.columns(0, n), &self.vector);
        z_psi - within + real_times(u_rest, &k_psi)
    }

    /// Returns ΔOᵀ e, whose rows below O_up do not count because e is zero there.
    fn observability_change_transposed_times_residual(
        &self,
        block: &BlockPerturbation,
        k: &DMatrix<f64>,
    ) -> Vector {
        let n = self.model.order;
        real_transposed_times(block.z.columns(0, n), &self.residual_outside)
            + real_transposed_times(k.columns(0, n), &self.residual_in_rest)
    }

    /// Returns K_ij = σ_i (σ_j Q_ij + σ_i P_ij) / (σ_j (σ_j² − σ_i²)) (8).
    fn correction(&self, block: &BlockPerturbation) -> DMatrix<f64> {
        let n = self.model.order;
        let numerator = block.numerator.view((n, 0), self.weights.shape());
        numerator.component_mul(&self.weights)
    }
}

fn real_times(matrix: DMatrixView<'_, f64>, vector: &Vector) -> Vector {
    complex(&(matrix * parts(vector)))
}

fn real_transposed_times(matrix: DMatrixView<'_, f64>, vector: &Vector) -> Vector {
    complex(&matrix.tr_mul(&parts(vector)))
}

/// Returns the real and the imaginary part as two columns, so that one product serves both.
fn parts(vector: &Vector) -> DMatrix<f64> {
    DMatrix::from_fn(vector.len(), 2, |row, column| match column {
        0 => vector[row].re,
        _ => vector[row].im,
    })
}

fn complex(parts: &DMatrix<f64>) -> Vector {
    Vector::from_fn(parts.nrows(), |row, _| {
        Complex::new(parts[(row, 0)], parts[(row, 1)])
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ModalSettings;
    use crate::stream::{Epoch, ModalStream};

    /// An epoch of three channels, each a sum of two resonances under pseudorandom forces.
    fn epoch() -> Epoch {
        let settings = ModalSettings {
            block_rows: 12,
            highest_order: 10,
            blocks: 6,
            epoch_s: 100.0,
            references: vec![0, 2],
            ..ModalSettings::new(3, 20.0)
        };
        let mut stream = ModalStream::new(&settings).unwrap();
        let mut number = 7_u64;
        let mut random = move || {
            number = number
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (number >> 33) as f64 / f64::from(1_u32 << 31) - 0.5
        };
        let mut past = [[0.0; 2]; 2];
        loop {
            for (state, rotation) in past.iter_mut().zip([0.4_f64, 1.1]) {
                let next =
                    2.0 * 0.97 * rotation.cos() * state[0] - 0.97 * 0.97 * state[1] + random();
                *state = [next, state[0]];
            }
            let [[a, _], [b, _]] = past;
            let frame = [
                a + b + 0.2 * random(),
                a - 0.5 * b + 0.2 * random(),
                0.3 * a - b,
            ];
            if let Some(epoch) = stream.push(&frame).unwrap() {
                return epoch;
            }
        }
    }

    fn pole_of(covariances: DMatrix<f64>, epoch: &Epoch, order: usize, near_hz: f64) -> Pole {
        let hankel = epoch.covariances.hankel(&covariances);
        let realisation = Realisation::new(hankel, 3, epoch.rate_hz, 10).unwrap();
        let model = realisation.model(order).unwrap().unwrap();
        let poles = realisation.poles(&model).into_iter();
        poles
            .min_by(|a, b| {
                let distance = |pole: &Pole| (pole.frequency_hz - near_hz).abs();
                distance(a).total_cmp(&distance(b))
            })
            .unwrap()
    }

    /// The derivative by central differences of the whole identification, block by block. Shapes
    /// are compared relative to their first channel, because their scale is arbitrary.
    #[test]
    fn changes_are_the_derivatives_of_the_identification() {
        const STEP: f64 = 1e-5;
        let epoch = epoch();
        let mean = epoch.covariances.mean();
        let hankel = epoch.covariances.hankel(&mean);
        let realisation = Realisation::new(hankel, 3, epoch.rate_hz, 10).unwrap();
        let perturbations = Perturbations::new(&realisation, &epoch.covariances, &mean);
        for order in [4, 8] {
            let model = realisation.model(order).unwrap().unwrap();
            for near_hz in [0.4 * 20.0 / (2.0 * PI), 1.1 * 20.0 / (2.0 * PI)] {
                let pole = pole_of(mean.clone(), &epoch, order, near_hz);
                let changes = perturbations.changes(&model, &pole).unwrap();
                for (block, change) in changes.iter().enumerate() {
                    let difference = epoch.covariances.difference(block, &mean) * STEP;
                    let plus = pole_of(&mean + &difference, &epoch, order, near_hz);
                    let minus = pole_of(&mean - &difference, &epoch, order, near_hz);
                    let check = |what: &str, found: f64, plus: f64, minus: f64| {
                        let expected = (plus - minus) / (2.0 * STEP);
                        assert!(
                            (found - expected).abs() < 1e-4 * (expected.abs() + 0.01),
                            "order {order}, {near_hz} Hz, block {block}: {what} {found}, {expected}"
                        );
                    };
                    check(
                        "frequency",
                        change.frequency_hz,
                        plus.frequency_hz,
                        minus.frequency_hz,
                    );
                    check("damping", change.damping, plus.damping, minus.damping);
                    let ratio = |pole: &Pole| pole.shape[1] / pole.shape[0];
                    let turned = (change.shape[1] - ratio(&pole) * change.shape[0]) / pole.shape[0];
                    check("shape", turned.re, ratio(&plus).re, ratio(&minus).re);
                }
            }
        }
    }
}
