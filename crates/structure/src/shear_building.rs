//! A shear building: floors of given mass, each joined to the floor below by a storey of given
//! stiffness.
//!
//! Degree of freedom `n` is the horizontal displacement of floor `n` relative to the ground. Storey
//! `n` joins floor `n − 1` (the ground for `n = 1`) to floor `n`. Huang & Yuen (2023), §2.3.3: `K`
//! is tridiagonal.

use crate::linear_system::{Mass, StoreyGroup, Substructure};
use nalgebra::DVector;
use nalgebra_sparse::{CooMatrix, CsrMatrix};

/// Masses (kg) and storey stiffnesses (N/m) from the bottom up, equal in number, all positive.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ShearBuilding {
    pub(crate) masses_kg: Vec<f64>,
    pub(crate) stiffnesses_n_per_m: Vec<f64>,
}

impl ShearBuilding {
    /// Creates `storeys` equal storeys with the first natural frequency `first_frequency_hz`.
    ///
    /// A uniform chain, fixed at the bottom and free at the top, has
    /// `ω₁ = 2 √(k/m) sin(π / (4N + 2))`.
    pub(crate) fn uniform(storeys: usize, mass_kg: f64, first_frequency_hz: f64) -> Self {
        let first = 2.0 * std::f64::consts::PI * first_frequency_hz;
        let of_unit_chain = 2.0 * (std::f64::consts::PI / (4 * storeys + 2) as f64).sin();
        let stiffness = mass_kg * (first / of_unit_chain).powi(2);
        Self {
            masses_kg: vec![mass_kg; storeys],
            stiffnesses_n_per_m: vec![stiffness; storeys],
        }
    }

    pub(crate) fn mass(&self) -> Mass {
        Mass::Lumped(DVector::from_column_slice(&self.masses_kg))
    }

    /// Returns one substructure per group of storeys.
    pub(crate) fn substructures(&self, groups: &[StoreyGroup]) -> Vec<Substructure> {
        chain(groups, &self.stiffnesses_n_per_m)
    }

    /// Returns `floor-1`, `floor-2`, ... from the bottom up.
    pub(crate) fn degrees_of_freedom(&self) -> Vec<String> {
        (1..=self.masses_kg.len())
            .map(|floor| format!("floor-{floor}"))
            .collect()
    }
}

/// Returns the matrix of each group of storeys for given stiffnesses (N/m) or dashpots (N s/m).
pub(crate) fn chain(groups: &[StoreyGroup], constants: &[f64]) -> Vec<Substructure> {
    let len = constants.len();
    let group = |group: &StoreyGroup| {
        let mut matrix = CooMatrix::new(len, len);
        for (above, k) in group.storeys.clone().zip(&constants[group.storeys.clone()]) {
            matrix.push(above, above, *k);
            if let Some(below) = above.checked_sub(1) {
                matrix.push(below, below, *k);
                matrix.push(below, above, -k);
                matrix.push(above, below, -k);
            }
        }
        Substructure {
            name: group.name.clone(),
            stiffness: CsrMatrix::from(&matrix),
        }
    };
    groups.iter().map(group).collect()
}

/// Puts each remaining storey into a separate group and sorts the groups upwards.
///
/// The names of these groups start with `storey-1` for the lowest storey.
pub(crate) fn with_single_storeys(
    mut groups: Vec<StoreyGroup>,
    storeys: usize,
) -> Vec<StoreyGroup> {
    let alone = |storey: &usize| !groups.iter().any(|group| group.storeys.contains(storey));
    let single = |storey| StoreyGroup {
        name: format!("storey-{}", storey + 1),
        storeys: storey..storey + 1,
    };
    let singles: Vec<StoreyGroup> = (0..storeys).filter(alone).map(single).collect();
    groups.extend(singles);
    groups.sort_by_key(|group| group.storeys.start);
    groups
}
