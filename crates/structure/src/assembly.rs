//! Stiffness and damping matrices with scaled parts, in one sparse pattern.
//!
//! `K(θ) = K_fixed + Σ θ_p K_p` is stored by rows. The pattern holds every entry of every
//! substructure and of the damping. A change of `θ` therefore changes values, but never the
//! pattern.

use crate::linear_system::{Damping, LinearSystem};
use crate::parameter::{Parameter, Scales};
use nalgebra_sparse::CsrMatrix;
use std::collections::BTreeMap;
use std::ops::Range;

/// One entry of a substructure.
#[derive(Debug, Clone, Copy)]
struct Entry {
    row: usize,
    column: usize,
    /// Index into the values of the pattern.
    position: usize,
    value: f64,
}

/// A matrix that is a sum of parts: `X(θ) = X_fixed + Σ θ_p X_p`.
#[derive(Debug, Clone)]
pub(crate) struct Sum {
    /// Sum of the parts that no parameter scales.
    fixed: Vec<f64>,
    /// Entries of all parts that each parameter scales, up to the last parameter that scales any.
    scaled: Vec<Vec<Entry>>,
}

impl Sum {
    /// Writes the values at `θ`.
    pub(crate) fn assemble_to(&self, theta: &[f64], values: &mut [f64]) {
        values.copy_from_slice(&self.fixed);
        for (scaled, factor) in self.scaled.iter().zip(theta) {
            for entry in scaled {
                values[entry.position] += factor * entry.value;
            }
        }
    }

    /// Returns the range of rows that contain entries scaled by one parameter.
    pub(crate) fn scaled_rows(&self, parameter: usize) -> Range<usize> {
        let rows = || self.of(parameter).map(|entry| entry.row);
        let first = rows().min().unwrap_or(0);
        first..rows().max().map_or(first, |last| last + 1)
    }

    /// Adds `X_p u` to `out` (N_d), where one parameter scales `X_p`; adds nothing for other
    /// parameters.
    pub(crate) fn mul_scaled_add_to(&self, parameter: usize, u: &[f64], out: &mut [f64]) {
        for entry in self.of(parameter) {
            out[entry.row] += entry.value * u[entry.column];
        }
    }

    fn of(&self, parameter: usize) -> impl Iterator<Item = &Entry> {
        self.scaled.get(parameter).into_iter().flatten()
    }
}

/// The common sparse pattern of stiffness and damping, and the parts of their values.
#[derive(Debug, Clone)]
pub(crate) struct Assembly {
    row_starts: Vec<usize>,
    columns: Vec<usize>,
    /// `K` (N/m) maps displacements to forces, or the hysteretic displacements of springs to
    /// forces.
    stiffness: Sum,
    /// `C` (N s/m) of dashpots, or a matrix from the structure file.
    damping: Option<Sum>,
}

impl Assembly {
    pub(crate) fn new(system: &LinearSystem, parameters: &[Parameter]) -> Self {
        let stiffness: Vec<_> = (0..system.substructures.len())
            .map(|part| system.forces(part))
            .collect();
        let damping: Option<Vec<_>> = match &system.damping {
            Damping::Rayleigh { .. } => None,
            Damping::Matrix(matrix) => Some(vec![matrix.clone()]),
            Damping::Dashpots(dashpots) => {
                Some(dashpots.iter().map(|part| part.stiffness.clone()).collect())
            }
        };
        let mut positions: BTreeMap<(usize, usize), usize> = BTreeMap::new();
        let matrices = stiffness.iter().chain(damping.iter().flatten());
        for (row, column, _) in matrices.flat_map(CsrMatrix::triplet_iter) {
            positions.insert((row, column), 0);
        }
        let mut row_starts = vec![0; system.len() + 1];
        let mut columns = Vec::with_capacity(positions.len());
        for (position, ((row, column), slot)) in positions.iter_mut().enumerate() {
            *slot = position;
            row_starts[row + 1] = position + 1;
            columns.push(*column);
        }
        for row in 0..system.len() {
            row_starts[row + 1] = row_starts[row + 1].max(row_starts[row]); // a row without entries
        }
        let stiffness_of = |part| {
            parameters.iter().position(
                |p| matches!(&p.scales, Scales::Stiffness(parts) if parts.contains(&part)),
            )
        };
        let damping_of = |part| {
            parameters
                .iter()
                .position(|p| matches!(&p.scales, Scales::Dashpots(parts) if parts.contains(&part)))
        };
        Self {
            stiffness: sum(&positions, &stiffness, stiffness_of),
            damping: damping.map(|parts| sum(&positions, &parts, damping_of)),
            row_starts,
            columns,
        }
    }

    /// Returns `N_d`.
    pub(crate) fn len(&self) -> usize {
        self.row_starts.len() - 1
    }

    /// Returns the number of entries of the pattern.
    pub(crate) fn entry_count(&self) -> usize {
        self.columns.len()
    }

    /// Returns `K`.
    pub(crate) fn stiffness(&self) -> &Sum {
        &self.stiffness
    }

    /// Returns `C` of dashpots or of a damping matrix; `None` for Rayleigh damping.
    pub(crate) fn damping(&self) -> Option<&Sum> {
        self.damping.as_ref()
    }

    /// Returns the value range and the column indices of a row.
    pub(crate) fn row(&self, row: usize) -> (Range<usize>, &[usize]) {
        let range = self.row_starts[row]..self.row_starts[row + 1];
        (range.clone(), &self.columns[range])
    }

    /// Writes `X u` to `out` for a vector `u` (N_d) and a matrix given by its `values`.
    pub(crate) fn mul_to(&self, values: &[f64], u: &[f64], out: &mut [f64]) {
        let mut start = 0;
        for (entry, end) in out.iter_mut().zip(&self.row_starts[1..]) {
            let row = values[start..*end].iter().zip(&self.columns[start..*end]);
            *entry = row.map(|(value, column)| value * u[*column]).sum();
            start = *end;
        }
    }

    /// Writes `X u` for several columns `u` (N_d) at once, bit-identical to one column at a time.
    pub(crate) fn mul_columns_to<const C: usize>(
        &self,
        values: &[f64],
        u: &[&mut [f64]; C],
        out: &mut [&mut [f64]; C],
    ) {
        let mut start = 0;
        for (row, end) in self.row_starts[1..].iter().enumerate() {
            let mut sums = [0.0; C];
            for (value, column) in values[start..*end].iter().zip(&self.columns[start..*end]) {
                for (sum, u) in sums.iter_mut().zip(u) {
                    *sum += value * u[*column];
                }
            }
            for (out, sum) in out.iter_mut().zip(sums) {
                out[row] = sum;
            }
            start = *end;
        }
    }

    /// Adds `X u` to `out` for a vector `u` (N_d) and a matrix given by its `values`.
    pub(crate) fn mul_add_to(&self, values: &[f64], u: &[f64], out: &mut [f64]) {
        let mut start = 0;
        for (entry, end) in out.iter_mut().zip(&self.row_starts[1..]) {
            let row = values[start..*end].iter().zip(&self.columns[start..*end]);
            *entry += row.map(|(value, column)| value * u[*column]).sum::<f64>();
            start = *end;
        }
    }
}

/// Separates the unscaled parts from the parts that each parameter scales.
///
/// `scaled_by` returns the parameter that scales a part, or `None`.
fn sum(
    positions: &BTreeMap<(usize, usize), usize>,
    parts: &[CsrMatrix<f64>],
    scaled_by: impl Fn(usize) -> Option<usize>,
) -> Sum {
    let mut total = Sum {
        fixed: vec![0.0; positions.len()],
        scaled: Vec::new(),
    };
    for (index, part) in parts.iter().enumerate() {
        let entries = part.triplet_iter().map(|(row, column, value)| Entry {
            row,
            column,
            position: positions[&(row, column)],
            value: *value,
        });
        match scaled_by(index) {
            None => entries.for_each(|entry| total.fixed[entry.position] += entry.value),
            Some(parameter) => {
                let len = total.scaled.len().max(parameter + 1);
                total.scaled.resize_with(len, Vec::new);
                total.scaled[parameter].extend(entries);
            }
        }
    }
    total
}
