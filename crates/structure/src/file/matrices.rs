//! Reads the kind `matrices` of `[model]`: exports of a finite element program as Matrix Market
//! files.

use super::check_unique;
use crate::diagnostics::counted;
use crate::linear_system::{Damping, LinearSystem, Mass, Substructure, dense};
use crate::matrix_file::{self, Unusable};
use crate::section::{Section, is_name};
use crate::sparse_cholesky::SparseCholesky;
use nalgebra::DVector;
use nalgebra_sparse::CsrMatrix;
use std::ops::Range;
use std::path::{Path, PathBuf};
use toml::Spanned;

/// A matrix read from a file, with the position of its name in the structure file.
pub(super) struct Named {
    pub(super) key: String,
    pub(super) span: Range<usize>,
    pub(super) matrix: CsrMatrix<f64>,
}

/// Returns the path of a file named in the structure file, relative to the structure file.
pub(super) fn beside(section: &Section<'_>, file: &str) -> PathBuf {
    section
        .diagnostics()
        .path()
        .parent()
        .unwrap_or(Path::new(""))
        .join(file)
}

pub(super) fn read_matrices(section: &mut Section<'_>) -> Option<LinearSystem> {
    let mass_file = section.text("mass");
    let mass_file = section.require(
        "mass",
        "must name the Matrix Market file of the mass matrix",
        mass_file,
    );
    let mass = mass_file.and_then(|file| read_symmetric(section, section.key("mass"), &file));
    let mass = mass.and_then(|named| check_mass(section, named));
    let parts = read_substructures(section);
    let names = section.names("degrees-of-freedom");
    let (mass, parts) = (mass?, parts?);
    let len = mass.to_dense().nrows();
    let mut all_fit = true;
    for (_, part) in &parts {
        all_fit &= fits(section, part, len);
    }
    let degrees_of_freedom = match names {
        None => Some((1..=len).map(|number| number.to_string()).collect()),
        Some(names) => check_names(section, names, len),
    };
    let degrees_of_freedom = degrees_of_freedom.filter(|_| all_fit)?;
    let substructures = parts
        .into_iter()
        .map(|(name, part)| Substructure {
            name,
            stiffness: part.matrix,
        })
        .collect();
    let system = LinearSystem {
        mass,
        substructures,
        damping: Damping::NONE,
        degrees_of_freedom,
        ground_directions: Vec::new(),
        storeys: Vec::new(),
        hysteresis: None,
        skeleton: None,
    };
    if let Some(free) = matrix_file::free_degree_of_freedom(&system.nominal_stiffness()) {
        let found = format!(
            "leave degree of freedom {} free to move",
            system.degrees_of_freedom[free]
        );
        let allowed = "must hold the structure together: their sum must be positive definite";
        section
            .diagnostics()
            .report(section.span(), section.key("substructures"), found, allowed);
        return None;
    }
    Some(system)
}

/// Returns `true` if a substructure has as many degrees of freedom as the mass matrix, or reports
/// it.
fn fits(section: &Section<'_>, part: &Named, len: usize) -> bool {
    let own = part.matrix.nrows();
    if own != len {
        let found = format!(
            "has {}",
            counted(own, "degree of freedom", "degrees of freedom")
        );
        let allowed = format!("must have {len} like the mass matrix");
        section
            .diagnostics()
            .report(part.span.clone(), &part.key, found, allowed);
    }
    own == len
}

/// Returns the names of the degrees of freedom, or reports that their number is wrong.
fn check_names(
    section: &Section<'_>,
    names: Spanned<Vec<Spanned<String>>>,
    len: usize,
) -> Option<Vec<String>> {
    let found = names.get_ref().len();
    if found != len {
        let found = format!("has {}", counted(found, "entry", "entries"));
        let allowed = format!("must have {len}, one per degree of freedom");
        section.diagnostics().report(
            names.span(),
            section.key("degrees-of-freedom"),
            found,
            allowed,
        );
    }
    check_unique(section, "degrees-of-freedom", names.get_ref());
    let names = names.into_inner().into_iter().map(Spanned::into_inner);
    (found == len).then(|| names.collect())
}

pub(super) fn read_symmetric(
    section: &Section<'_>,
    key: String,
    file: &Spanned<String>,
) -> Option<Named> {
    let path = beside(section, file.get_ref());
    match matrix_file::read_symmetric(&path) {
        Ok(matrix) => Some(Named {
            key,
            span: file.span(),
            matrix,
        }),
        Err(Unusable { found, allowed }) => {
            section
                .diagnostics()
                .report(file.span(), key, found, allowed);
            None
        }
    }
}

/// Converts a diagonal mass matrix to lumped masses; factorises any other matrix.
fn check_mass(section: &Section<'_>, named: Named) -> Option<Mass> {
    let Named { key, span, matrix } = named;
    let refuse = |found: String| {
        section
            .diagnostics()
            .report(span, key, found, "must be positive definite");
        None
    };
    let matrix = dense(&matrix);
    let diagonal: DVector<f64> = matrix.diagonal();
    if let Some(massless) = diagonal.iter().position(|mass| *mass <= 0.0) {
        let (mass, number) = (diagonal[massless], massless + 1);
        return refuse(format!(
            "has the mass {mass} kg at degree of freedom {number}"
        ));
    }
    if matrix.iter().filter(|entry| **entry != 0.0).count() == diagonal.len() {
        return Some(Mass::Lumped(diagonal));
    }
    match SparseCholesky::new(&matrix) {
        Some(factor) => Some(Mass::Consistent { matrix, factor }),
        None => refuse("has no Cholesky factor".to_owned()),
    }
}

fn read_substructures(section: &mut Section<'_>) -> Option<Vec<(String, Named)>> {
    let allowed =
        "must name the stiffness matrix of each substructure: { deck = \"k-deck.mtx\", ... }";
    let entries = section.entries("substructures");
    section.require("substructures", allowed, Some(()));
    let mut parts = Vec::new();
    let declared = entries.len();
    for (name, value) in entries {
        let key = section.key(&format!("substructures.{}", name.get_ref()));
        let Some(file) = value.get_ref().as_str() else {
            section.refuse(
                &format!("substructures.{}", name.get_ref()),
                value,
                "must name a Matrix Market file",
            );
            continue;
        };
        if !is_name(name.get_ref()) {
            let allowed = "must have a name of 1 to 64 lower-case letters, digits and hyphens";
            section
                .diagnostics()
                .report(name.span(), &key, "is not a name", allowed);
            continue;
        }
        let file = Spanned::new(value.span(), file.to_owned());
        let Some(part) = read_symmetric(section, key, &file) else {
            continue;
        };
        match matrix_file::check_semidefinite(&dense(&part.matrix)) {
            Ok(()) => parts.push((name.into_inner(), part)),
            Err(Unusable { found, allowed }) => section
                .diagnostics()
                .report(part.span, part.key, found, allowed),
        }
    }
    (declared > 0 && parts.len() == declared).then_some(parts)
}
