//! Moments of weighted particles, and random draws with given moments.
//!
//! `x` (n × N): one column per particle; `W` (N): normalised weights. Particles with weight zero
//! are ignored and may contain any value, including NaN.

use nalgebra::{DMatrix, DVector};

/// Largest remaining correlation at which the Jacobi method ends.
const OFF_DIAGONAL: f64 = 1e-15;

/// Maximum number of Jacobi sweeps.
///
/// The method converges quadratically within a few sweeps, except for matrices that are not finite.
const LARGEST_SWEEPS: usize = 60;

/// Computes the weighted mean and standard deviation of every component (n).
pub(super) fn mean_and_std_to(
    states: &[f64],
    weights: &[f64],
    mean: &mut DVector<f64>,
    std: &mut DVector<f64>,
) {
    let n = mean.len();
    mean.fill(0.0);
    std.fill(0.0);
    for (state, weight) in states
        .chunks_exact(n)
        .zip(weights)
        .filter(|(_, weight)| **weight > 0.0)
    {
        for (sum, value) in mean.iter_mut().zip(state) {
            *sum += weight * value;
        }
    }
    for (state, weight) in states
        .chunks_exact(n)
        .zip(weights)
        .filter(|(_, weight)| **weight > 0.0)
    {
        for j in 0..n {
            let deviation = state[j] - mean[j];
            std[j] += weight * deviation * deviation;
        }
    }
    std.apply(|variance| *variance = variance.sqrt());
}

/// Computes the weighted covariance (n × n) around a given mean.
pub(super) fn covariance_to(
    states: &[f64],
    weights: &[f64],
    mean: &DVector<f64>,
    out: &mut DMatrix<f64>,
) {
    let n = mean.len();
    out.fill(0.0);
    for (state, weight) in states
        .chunks_exact(n)
        .zip(weights)
        .filter(|(_, weight)| **weight > 0.0)
    {
        for j in 0..n {
            let right = weight * (state[j] - mean[j]);
            for i in 0..=j {
                out[(i, j)] += (state[i] - mean[i]) * right;
            }
        }
    }
    for j in 0..n {
        for i in 0..j {
            out[(j, i)] = out[(i, j)];
        }
    }
}

/// A square root of a covariance `V = D C D`, with the standard deviations `D` and the correlations
/// `C`.
///
/// The symmetric root of the correlations does not depend on the units, which can differ by many
/// orders of magnitude between components.
#[derive(Debug, Clone)]
pub(super) struct SquareRoot {
    /// `D` (n).
    deviation: DVector<f64>,
    /// `C^{1/2}` (n × n).
    root: DMatrix<f64>,
    /// `C`, then its eigenvalues on the diagonal (n × n).
    reduced: DMatrix<f64>,
    /// Eigenvectors (n × n).
    vectors: DMatrix<f64>,
}

impl SquareRoot {
    pub(super) fn new(n: usize) -> Self {
        let square = || DMatrix::zeros(n, n);
        Self {
            deviation: DVector::zeros(n),
            root: square(),
            reduced: square(),
            vectors: square(),
        }
    }

    /// Factorises a covariance (n × n); negative eigenvalues of its correlations become zero.
    pub(super) fn factorise(&mut self, covariance: &DMatrix<f64>) {
        let n = self.deviation.len();
        for j in 0..n {
            self.deviation[j] = covariance[(j, j)].max(0.0).sqrt();
        }
        for j in 0..n {
            for i in 0..n {
                let scale = self.deviation[i] * self.deviation[j];
                self.reduced[(i, j)] = if i == j {
                    1.0
                } else if scale > 0.0 {
                    0.5 * (covariance[(i, j)] + covariance[(j, i)]) / scale
                } else {
                    0.0 // a constant component has no correlation
                };
            }
        }
        diagonalise(&mut self.reduced, &mut self.vectors);
        for j in 0..n {
            for i in 0..=j {
                let product: f64 = (0..n)
                    .map(|k| {
                        self.reduced[(k, k)].max(0.0).sqrt()
                            * self.vectors[(i, k)]
                            * self.vectors[(j, k)]
                    })
                    .sum();
                self.root[(i, j)] = product;
                self.root[(j, i)] = product;
            }
        }
    }

    /// Adds `scale · D C^{1/2} z` to a state (n), with `z` (n) standard normal.
    pub(super) fn add_draw(&self, scale: f64, z: &[f64], state: &mut [f64]) {
        for (j, value) in state.iter_mut().enumerate() {
            let product: f64 = self
                .root
                .column(j)
                .iter()
                .zip(z)
                .map(|(root, z)| root * z)
                .sum();
            *value += scale * self.deviation[j] * product;
        }
    }
}

/// Replaces a symmetric matrix by its eigenvalues on the diagonal, with the eigenvectors as
/// columns: cyclic Jacobi method.
fn diagonalise(matrix: &mut DMatrix<f64>, vectors: &mut DMatrix<f64>) {
    let n = matrix.nrows();
    vectors.fill_with_identity();
    for _ in 0..LARGEST_SWEEPS {
        let mut largest = 0.0_f64;
        for q in 1..n {
            for p in 0..q {
                let off = matrix[(p, q)];
                largest = largest.max(off.abs());
                if off.abs() <= OFF_DIAGONAL {
                    continue;
                }
                let half = 0.5 * (matrix[(q, q)] - matrix[(p, p)]) / off; // cot 2φ
                let t = half.signum() / (half.abs() + half.hypot(1.0)); // tan φ, the smaller angle
                let c = 1.0 / t.hypot(1.0);
                let s = t * c;
                for k in 0..n {
                    let (a, b) = (matrix[(k, p)], matrix[(k, q)]);
                    matrix[(k, p)] = c * a - s * b;
                    matrix[(k, q)] = s * a + c * b;
                    let (a, b) = (vectors[(k, p)], vectors[(k, q)]);
                    vectors[(k, p)] = c * a - s * b;
                    vectors[(k, q)] = s * a + c * b;
                }
                for k in 0..n {
                    let (a, b) = (matrix[(p, k)], matrix[(q, k)]);
                    matrix[(p, k)] = c * a - s * b;
                    matrix[(q, k)] = s * a + c * b;
                }
            }
        }
        if largest <= OFF_DIAGONAL {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn root_reproduces_a_covariance_of_different_units() {
        let factor = DMatrix::from_fn(5, 4, |i, j| {
            ((3 * i + 2 * j) as f64).sin() * 10f64.powi(3 * i as i32 - 6)
        });
        let mut covariance = &factor * factor.transpose(); // rank 4 of 5
        covariance.row_mut(2).fill(0.0);
        covariance.column_mut(2).fill(0.0);
        let mut root = SquareRoot::new(5);
        root.factorise(&covariance);
        let mut columns = DMatrix::zeros(5, 5);
        for j in 0..5 {
            let z: Vec<f64> = (0..5).map(|i| f64::from(u8::from(i == j))).collect();
            root.add_draw(1.0, &z, &mut columns.as_mut_slice()[5 * j..5 * j + 5]);
        }
        let found = &columns * columns.transpose();
        for j in 0..5 {
            for i in 0..5 {
                let scale = (covariance[(i, i)] * covariance[(j, j)]).sqrt();
                assert!(
                    (found[(i, j)] - covariance[(i, j)]).abs() <= 1e-12 * scale,
                    "({i}, {j})"
                );
            }
        }
    }

    #[test]
    fn moments_ignore_particles_without_weight() {
        let states = [1.0, 10.0, f64::NAN, f64::NAN, 3.0, 30.0];
        let weights = [0.25, 0.0, 0.75];
        let (mut mean, mut std) = (DVector::zeros(2), DVector::zeros(2));
        mean_and_std_to(&states, &weights, &mut mean, &mut std);
        assert_eq!(mean.as_slice(), [2.5, 25.0]);
        assert!((std[0] - 0.75_f64.sqrt()).abs() < 1e-15);
        let mut covariance = DMatrix::zeros(2, 2);
        covariance_to(&states, &weights, &mean, &mut covariance);
        assert!((covariance[(1, 0)] - 7.5).abs() < 1e-13);
    }
}
