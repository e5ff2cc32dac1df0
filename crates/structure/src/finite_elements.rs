//! Assembles element matrices into the matrices of a structure.
//!
//! Degrees of freedom are numbered by node and direction; some are fixed. Element matrices are in
//! global directions, with the degrees of freedom of the first node before those of the second.

use crate::linear_system::{Damping, GroundDirection, LinearSystem, Mass, Substructure};
use crate::sparse_cholesky::SparseCholesky;
use nalgebra::{DMatrix, DVector};
use nalgebra_sparse::{CooMatrix, CsrMatrix};

/// Directions in which the ground can move; other directions are rotations.
const TRANSLATIONS: [&str; 3] = ["x", "y", "z"];

/// Degrees of freedom of nodes, without the fixed ones.
#[derive(Debug, Clone)]
pub(crate) struct Freedoms {
    directions: &'static [&'static str],
    /// Degree of freedom of each node and direction, by node; `None` if fixed.
    free: Vec<Option<usize>>,
    names: Vec<String>,
}

impl Freedoms {
    /// Numbers the directions of each node, by node.
    ///
    /// `is_fixed` returns `true` if a (node, direction) cannot move.
    pub(crate) fn new<'n>(
        nodes: impl Iterator<Item = &'n str>,
        directions: &'static [&'static str],
        is_fixed: impl Fn(usize, usize) -> bool,
    ) -> Self {
        let (mut free, mut names) = (Vec::new(), Vec::new());
        for (node, name) in nodes.enumerate() {
            for (index, direction) in directions.iter().enumerate() {
                if is_fixed(node, index) {
                    free.push(None);
                } else {
                    free.push(Some(names.len()));
                    names.push(format!("node-{name}-{direction}"));
                }
            }
        }
        Self {
            directions,
            free,
            names,
        }
    }

    /// Returns the number of free degrees of freedom.
    pub(crate) fn len(&self) -> usize {
        self.names.len()
    }

    /// Returns the degrees of freedom of two nodes in the order of an element matrix.
    fn of_element(&self, ends: [usize; 2]) -> Vec<Option<usize>> {
        let per_node = self.directions.len();
        ends.iter()
            .flat_map(|node| &self.free[node * per_node..(node + 1) * per_node])
            .copied()
            .collect()
    }

    /// Returns the influence of the ground on all degrees of freedom, for each direction with any.
    fn ground_directions(&self) -> Vec<GroundDirection> {
        let per_node = self.directions.len();
        let mut found = Vec::new();
        for (index, direction) in self
            .directions
            .iter()
            .enumerate()
            .filter(|(_, name)| TRANSLATIONS.contains(name))
        {
            let mut influence = vec![0.0; self.len()];
            for dof in self.free.iter().skip(index).step_by(per_node).flatten() {
                influence[*dof] = 1.0;
            }
            if influence.contains(&1.0) {
                found.push(GroundDirection {
                    name: direction,
                    influence,
                });
            }
        }
        found
    }
}

/// Matrices of a structure during the assembly of its elements.
pub(crate) struct FiniteElements {
    freedoms: Freedoms,
    mass: DMatrix<f64>,
    parts: Vec<(String, CooMatrix<f64>)>,
}

impl FiniteElements {
    /// Creates empty matrices for the named substructures.
    pub(crate) fn new(freedoms: Freedoms, parts: impl Iterator<Item = String>) -> Self {
        let len = freedoms.len();
        let parts = parts.map(|name| (name, CooMatrix::new(len, len))).collect();
        Self {
            freedoms,
            mass: DMatrix::zeros(len, len),
            parts,
        }
    }

    /// Adds the mass of an element between two nodes (kg, kg m², ...).
    pub(crate) fn add_mass(&mut self, ends: [usize; 2], element: &DMatrix<f64>) {
        let dofs = self.freedoms.of_element(ends);
        for_each_free(&dofs, element, |row, column, value| {
            self.mass[(row, column)] += value
        });
    }

    /// Adds the stiffness of an element between two nodes (N/m, N m, ...) to a substructure.
    pub(crate) fn add_stiffness(&mut self, part: usize, ends: [usize; 2], element: &DMatrix<f64>) {
        let dofs = self.freedoms.of_element(ends);
        let stiffness = &mut self.parts[part].1;
        for_each_free(&dofs, element, |row, column, value| {
            stiffness.push(row, column, value)
        });
    }

    /// Returns the structure without damping; `None` if its mass is not positive definite.
    pub(crate) fn finish(self) -> Option<LinearSystem> {
        let is_diagonal =
            self.mass.iter().filter(|entry| **entry != 0.0).count() <= self.mass.nrows();
        let diagonal: DVector<f64> = self.mass.diagonal();
        let mass = if is_diagonal && diagonal.iter().all(|mass| *mass > 0.0) {
            Mass::Lumped(diagonal)
        } else {
            Mass::Consistent {
                factor: SparseCholesky::new(&self.mass)?,
                matrix: self.mass,
            }
        };
        let substructure = |(name, stiffness): (String, CooMatrix<f64>)| Substructure {
            name,
            stiffness: CsrMatrix::from(&stiffness),
        };
        Some(LinearSystem {
            mass,
            substructures: self.parts.into_iter().map(substructure).collect(),
            damping: Damping::NONE,
            ground_directions: self.freedoms.ground_directions(),
            degrees_of_freedom: self.freedoms.names,
            storeys: Vec::new(),
            hysteresis: None,
            skeleton: None,
        })
    }
}

/// Calls `add` for every nonzero entry whose degrees of freedom are both free.
fn for_each_free(
    dofs: &[Option<usize>],
    element: &DMatrix<f64>,
    mut add: impl FnMut(usize, usize, f64),
) {
    for (i, row) in dofs.iter().enumerate() {
        for (j, column) in dofs.iter().enumerate() {
            if let (Some(row), Some(column)) = (row, column)
                && element[(i, j)] != 0.0
            {
                add(*row, *column, element[(i, j)]);
            }
        }
    }
}
