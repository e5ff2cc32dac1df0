//! The matrix for the step of a linear structure with Rayleigh damping.

use super::Fixed;
use super::point::Point;
use crate::assembly::Assembly;
use crate::linear_system::Damping;
use nalgebra::DMatrix;

/// `G = M⁻¹ K(θ)` (N_d × N_d, 1/s²), overwritten in place.
#[derive(Debug, Clone)]
pub(super) struct StiffnessByMass {
    pub(super) matrix: DMatrix<f64>,
    /// Distance from the diagonal beyond which all entries are zero.
    pub(super) half_bandwidth: usize,
}

impl StiffnessByMass {
    /// Allocates `G`; `None` if the damping is not proportional or the springs are hysteretic.
    pub(super) fn new(fixed: &Fixed, damping: &Damping) -> Option<Self> {
        if fixed.hysteresis.is_some() || !matches!(damping, Damping::Rayleigh { .. }) {
            return None;
        }
        let free = fixed.assembly.len();
        // With a mass matrix that is not diagonal, every force accelerates every degree of freedom.
        let half_bandwidth = if fixed.mass_factor.is_some() {
            free - 1
        } else {
            half_bandwidth(&fixed.assembly)
        };
        Some(Self {
            matrix: DMatrix::zeros(free, free),
            half_bandwidth,
        })
    }

    /// Writes `G` at a point.
    pub(super) fn set(&mut self, fixed: &Fixed, point: &Point) {
        let free = fixed.assembly.len();
        for (index, column) in self
            .matrix
            .as_mut_slice()
            .chunks_exact_mut(free)
            .enumerate()
        {
            // The row equals the column, because K is symmetric.
            let (places, rows) = fixed.assembly.row(index);
            let entries = rows.iter().zip(&point.stiffness[places]);
            if fixed.mass_factor.is_none() {
                // Entries outside the pattern have been zero since the allocation.
                for (row, value) in entries {
                    column[*row] =
                        value * fixed.reciprocal_masses[*row] * point.mass_factors_inverse[*row];
                }
                continue;
            }
            column.fill(0.0);
            for (row, value) in entries {
                column[*row] = *value;
            }
            fixed.divide_by_mass(column);
            for (entry, by_mass) in column.iter_mut().zip(&point.mass_factors_inverse) {
                *entry *= by_mass;
            }
        }
    }
}

/// Returns the maximum distance of the pattern from the diagonal.
fn half_bandwidth(assembly: &Assembly) -> usize {
    (0..assembly.len())
        .flat_map(|row| {
            assembly
                .row(row)
                .1
                .iter()
                .map(move |column| column.abs_diff(row))
        })
        .max()
        .unwrap_or(0)
}
