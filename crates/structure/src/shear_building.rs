//! The shear building: floors of given mass, each joined to the one below by a storey of given stiffness.
//!
//! Degree of freedom `n` is the horizontal displacement of floor `n` relative to the ground; storey `n` joins floor
//! `n − 1` (the ground for `n = 1`) to floor `n`. Huang & Yuen (2023), §2.3.3: `K` is tridiagonal.

use crate::linear_system::{Mass, Substructure};
use nalgebra::DVector;
use nalgebra_sparse::{CooMatrix, CsrMatrix};

/// Masses (kg) and storey stiffnesses (N/m) from the bottom up, as many of each, all positive.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ShearBuilding {
    pub(crate) masses_kg: Vec<f64>,
    pub(crate) stiffnesses_n_per_m: Vec<f64>,
}

impl ShearBuilding {
    /// Makes `storeys` equal storeys whose first natural frequency is `first_frequency_hz`.
    ///
    /// A uniform chain fixed below and free above has `ω₁ = 2 √(k/m) sin(π / (4N + 2))`.
    pub(crate) fn uniform(storeys: usize, mass_kg: f64, first_frequency_hz: f64) -> Self {
        let first = 2.0 * std::f64::consts::PI * first_frequency_hz;
        let of_unit_chain = 2.0 * (std::f64::consts::PI / (4 * storeys + 2) as f64).sin();
        let stiffness = mass_kg * (first / of_unit_chain).powi(2);
        Self { masses_kg: vec![mass_kg; storeys], stiffnesses_n_per_m: vec![stiffness; storeys] }
    }

    pub(crate) fn mass(&self) -> Mass {
        Mass::Lumped(DVector::from_column_slice(&self.masses_kg))
    }

    /// Returns one substructure per storey, `storey-1` at the bottom.
    pub(crate) fn substructures(&self) -> Vec<Substructure> {
        let len = self.masses_kg.len();
        let storey = |(above, k): (usize, &f64)| {
            let mut stiffness = CooMatrix::new(len, len);
            stiffness.push(above, above, *k);
            if let Some(below) = above.checked_sub(1) {
                stiffness.push(below, below, *k);
                stiffness.push(below, above, -k);
                stiffness.push(above, below, -k);
            }
            Substructure { name: format!("storey-{}", above + 1), stiffness: CsrMatrix::from(&stiffness) }
        };
        self.stiffnesses_n_per_m.iter().enumerate().map(storey).collect()
    }

    /// Returns `floor-1`, `floor-2`, ... from the bottom up.
    pub(crate) fn degrees_of_freedom(&self) -> Vec<String> {
        (1..=self.masses_kg.len()).map(|floor| format!("floor-{floor}")).collect()
    }
}
