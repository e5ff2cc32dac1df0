//! The stiffness matrix of scaled substructures in one sparse pattern, made anew from values only.
//!
//! `K(θ) = K_fixed + Σ θ_p K_p` by rows: the pattern holds every entry of every substructure (and of a given damping
//! matrix), so that a change of `θ` touches values and never the pattern.

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
    /// Where in the values of the pattern.
    position: usize,
    value: f64,
}

/// All substructures that one parameter scales.
#[derive(Debug, Clone)]
struct Scaled {
    parameter: usize,
    entries: Vec<Entry>,
}

/// The common pattern of stiffness and damping, and what its values are made of.
#[derive(Debug, Clone)]
pub(crate) struct Assembly {
    row_starts: Vec<usize>,
    columns: Vec<usize>,
    /// `K_fixed` (N/m): the substructures that no parameter scales.
    fixed: Vec<f64>,
    scaled: Vec<Scaled>,
    /// A given `C` (N s/m) in the same pattern.
    damping: Option<Vec<f64>>,
}

impl Assembly {
    pub(crate) fn new(system: &LinearSystem, parameters: &[Parameter]) -> Self {
        let mut positions: BTreeMap<(usize, usize), usize> = BTreeMap::new();
        let given_damping = match &system.damping {
            Damping::Rayleigh { .. } => None,
            Damping::Matrix(matrix) => Some(matrix),
        };
        let matrices = system.substructures.iter().map(|part| &part.stiffness).chain(given_damping);
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
        let entries = |matrix: &CsrMatrix<f64>| -> Vec<Entry> {
            let entry = |(row, column, value): (usize, usize, &f64)| Entry {
                row,
                column,
                position: positions[&(row, column)],
                value: *value,
            };
            matrix.triplet_iter().map(entry).collect()
        };
        let in_pattern = |entries: Vec<Entry>| {
            let mut values = vec![0.0; columns.len()];
            for entry in entries {
                values[entry.position] += entry.value;
            }
            values
        };
        let scaled_by = |part: usize| {
            parameters.iter().position(|p| matches!(&p.scales, Scales::Stiffness(parts) if parts.contains(&part)))
        };
        let mut fixed = Vec::new();
        let mut scaled: Vec<Scaled> = Vec::new();
        for (index, part) in system.substructures.iter().enumerate() {
            let entries = entries(&part.stiffness);
            match scaled_by(index) {
                None => fixed.extend(entries),
                Some(parameter) => match scaled.iter_mut().find(|scaled| scaled.parameter == parameter) {
                    Some(scaled) => scaled.entries.extend(entries),
                    None => scaled.push(Scaled { parameter, entries }),
                },
            }
        }
        let damping = given_damping.map(|matrix| in_pattern(entries(matrix)));
        let fixed = in_pattern(fixed);
        Self { row_starts, columns, fixed, scaled, damping }
    }

    /// Returns `N_d`.
    pub(crate) fn len(&self) -> usize {
        self.row_starts.len() - 1
    }

    /// Returns the number of entries of the pattern.
    pub(crate) fn entry_count(&self) -> usize {
        self.columns.len()
    }

    /// Returns the values of a given damping matrix (N s/m).
    pub(crate) fn damping(&self) -> Option<&[f64]> {
        self.damping.as_deref()
    }

    /// Returns where the values of a row are, and their columns.
    pub(crate) fn row(&self, row: usize) -> (Range<usize>, &[usize]) {
        let range = self.row_starts[row]..self.row_starts[row + 1];
        (range.clone(), &self.columns[range])
    }

    /// Writes the values of `K(θ)` (N/m).
    pub(crate) fn assemble_to(&self, theta: &[f64], values: &mut [f64]) {
        values.copy_from_slice(&self.fixed);
        for scaled in &self.scaled {
            let factor = theta[scaled.parameter];
            for entry in &scaled.entries {
                values[entry.position] += factor * entry.value;
            }
        }
    }

    /// Writes `X u` for a matrix by its values and a vector `u` (N_d).
    pub(crate) fn mul_to(&self, values: &[f64], u: &[f64], out: &mut [f64]) {
        let mut start = 0;
        for (entry, end) in out.iter_mut().zip(&self.row_starts[1..]) {
            let row = values[start..*end].iter().zip(&self.columns[start..*end]);
            *entry = row.map(|(value, column)| value * u[*column]).sum();
            start = *end;
        }
    }

    /// Adds `X u` for a matrix by its values and a vector `u` (N_d).
    pub(crate) fn mul_add_to(&self, values: &[f64], u: &[f64], out: &mut [f64]) {
        let mut start = 0;
        for (entry, end) in out.iter_mut().zip(&self.row_starts[1..]) {
            let row = values[start..*end].iter().zip(&self.columns[start..*end]);
            *entry += row.map(|(value, column)| value * u[*column]).sum::<f64>();
            start = *end;
        }
    }

    /// Returns the range of rows in which the stiffness that one parameter scales has entries.
    pub(crate) fn scaled_rows(&self, parameter: usize) -> Range<usize> {
        let scaled = self.scaled.iter().filter(|scaled| scaled.parameter == parameter);
        let rows = || scaled.clone().flat_map(|scaled| scaled.entries.iter().map(|entry| entry.row));
        let first = rows().min().unwrap_or(0);
        first..rows().max().map_or(first, |last| last + 1)
    }

    /// Adds `K_p u` of the stiffness that one parameter scales to `out` (N_d); nothing for other parameters.
    pub(crate) fn mul_scaled_add_to(&self, parameter: usize, u: &[f64], out: &mut [f64]) {
        for scaled in self.scaled.iter().filter(|scaled| scaled.parameter == parameter) {
            for entry in &scaled.entries {
                out[entry.row] += entry.value * u[entry.column];
            }
        }
    }
}
