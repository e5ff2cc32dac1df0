//! A chain of unit masses under random forces, in modal coordinates.
//!
//! Its modes come from Jacobi rotations written here, so that the simulation shares no linear
//! algebra with the method under test. The forces are white. Each modal oscillator is integrated by
//! the exact solution for a force that is constant over a step.

#[path = "../oscillator/mod.rs"]
mod oscillator;

use oscillator::exact_step;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use std::f64::consts::PI;

/// Steps of the integration per sample, so that the force is white up to the sampling rate.
const SUBSTEPS: usize = 4;

pub struct Chain {
    frequencies_hz: Vec<f64>,
    /// One shape per mode.
    shapes: Vec<Vec<f64>>,
    damping: f64,
}

impl Chain {
    /// Creates a chain fixed at its foot, with springs (N/m) from the foot upwards, masses of 1 kg
    /// and one damping ratio for all modes.
    pub fn new(springs: &[f64], damping: f64) -> Self {
        let n = springs.len();
        let mut stiffness = vec![vec![0.0; n]; n];
        for (at, spring) in springs.iter().enumerate() {
            stiffness[at][at] += spring;
            if at > 0 {
                stiffness[at - 1][at - 1] += spring;
                stiffness[at][at - 1] -= spring;
                stiffness[at - 1][at] -= spring;
            }
        }
        let (values, shapes) = jacobi(stiffness);
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by(|a, b| values[*a].total_cmp(&values[*b]));
        Self {
            frequencies_hz: order
                .iter()
                .map(|k| values[*k].sqrt() / (2.0 * PI))
                .collect(),
            shapes: order.iter().map(|k| shapes[*k].clone()).collect(),
            damping,
        }
    }

    pub fn frequencies_hz(&self) -> Vec<f64> {
        self.frequencies_hz.clone()
    }

    pub fn shapes(&self) -> &[Vec<f64>] {
        &self.shapes
    }

    /// Standard deviation of the force on each mass (N).
    pub fn excitation_std(&self) -> f64 {
        1.0
    }

    /// Simulates accelerations (m/s²) with sensor noise of 2 % of their level.
    pub fn record(&self, rate_hz: f64, length_s: f64, seed: u64) -> Vec<Vec<f64>> {
        let n = self.frequencies_hz.len();
        let step = 1.0 / (rate_hz * SUBSTEPS as f64);
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let mut force = vec![0.0; n];
        let mut state = vec![[0.0; 2]; n];
        let settle = (20.0 * rate_hz) as usize;
        let mut frames: Vec<Vec<f64>> = Vec::new();
        for sample in 0..settle + (length_s * rate_hz) as usize {
            let mut modal_acceleration = vec![0.0; n];
            for _ in 0..SUBSTEPS {
                for value in &mut force {
                    *value = normal();
                }
                for k in 0..n {
                    let p: f64 = self.shapes[k].iter().zip(&force).map(|(s, f)| s * f).sum();
                    let omega = 2.0 * PI * self.frequencies_hz[k];
                    state[k] = exact_step(state[k], p, omega, self.damping, step);
                    let [q, v] = state[k];
                    modal_acceleration[k] = p - 2.0 * self.damping * omega * v - omega * omega * q;
                }
            }
            if sample >= settle {
                frames.push(
                    (0..n)
                        .map(|mass| {
                            let motion: f64 = (0..n)
                                .map(|k| self.shapes[k][mass] * modal_acceleration[k])
                                .sum();
                            motion + 0.05 * normal()
                        })
                        .collect(),
                );
            }
        }
        frames
    }
}

/// Returns eigenvalues and eigenvectors of a symmetric matrix by cyclic Jacobi rotations.
fn jacobi(mut a: Vec<Vec<f64>>) -> (Vec<f64>, Vec<Vec<f64>>) {
    let n = a.len();
    let mut vectors: Vec<Vec<f64>> = (0..n)
        .map(|i| (0..n).map(|j| f64::from(u8::from(i == j))).collect())
        .collect();
    for _ in 0..60 {
        for p in 0..n {
            for q in p + 1..n {
                if a[p][q] == 0.0 {
                    continue;
                }
                let angle = 0.5 * (2.0 * a[p][q]).atan2(a[q][q] - a[p][p]);
                let (s, c) = angle.sin_cos();
                for k in 0..n {
                    let (x, y) = (a[k][p], a[k][q]);
                    (a[k][p], a[k][q]) = (c * x - s * y, s * x + c * y);
                }
                for k in 0..n {
                    let (x, y) = (a[p][k], a[q][k]);
                    (a[p][k], a[q][k]) = (c * x - s * y, s * x + c * y);
                    let (x, y) = (vectors[p][k], vectors[q][k]);
                    (vectors[p][k], vectors[q][k]) = (c * x - s * y, s * x + c * y);
                }
            }
        }
    }
    ((0..n).map(|k| a[k][k]).collect(), vectors)
}
