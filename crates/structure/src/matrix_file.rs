//! Reads matrices of a finite element program (Matrix Market) and checks that a structure can use
//! them.

use crate::linear_system::LARGEST_MODEL;
use crate::text_encoding::decode;
use nalgebra::{DMatrix, SymmetricEigen};
use nalgebra_sparse::io::load_coo_from_matrix_market_str;
use nalgebra_sparse::{CooMatrix, CsrMatrix};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Maximum difference of mirrored entries, relative to the largest entry. Files contain rounded
/// decimals.
const SYMMETRY_TOLERANCE: f64 = 1e-8;

/// Share of the largest eigenvalue below which an eigenvalue counts as zero.
///
/// The limit allows for rounding of the file and of the solver.
const ZERO_EIGENVALUE: f64 = 1e-9;

/// A matrix that cannot be used: the value found and the values allowed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Unusable {
    pub(crate) found: String,
    pub(crate) allowed: String,
}

impl Unusable {
    pub(crate) fn new(found: impl Into<String>, allowed: impl Into<String>) -> Self {
        Self {
            found: found.into(),
            allowed: allowed.into(),
        }
    }
}

/// Reads a matrix of any shape; adds duplicate entries.
pub(crate) fn read(path: &Path) -> Result<CsrMatrix<f64>, Unusable> {
    let allowed = "must be a Matrix Market file beside the structure file";
    let shown = path.display();
    let text =
        read_text(path).map_err(|found| Unusable::new(format!("{shown} {found}"), allowed))?;
    // The reader rejects a last line without a line break, and lines that end in CR LF.
    let text = text.replace("\r\n", "\n");
    check_sizes(&text).map_err(|found| Unusable::new(format!("{shown} {found}"), SIZE_RULE))?;
    let entries: CooMatrix<f64> =
        load_coo_from_matrix_market_str(text.trim_end()).map_err(|error| {
            let message = error.message().lines().collect::<Vec<_>>().join(" ");
            Unusable::new(format!("{shown} is not readable ({message})"), allowed)
        })?;
    let matrix = CsrMatrix::from(&entries);
    match matrix
        .triplet_iter()
        .find(|(_, _, value)| !value.is_finite())
    {
        Some((row, column, value)) => Err(Unusable::new(
            format!(
                "{shown} has {value} at row {}, column {}",
                row + 1,
                column + 1
            ),
            "must hold finite numbers",
        )),
        None => Ok(matrix),
    }
}

/// Maximum size of a matrix file (bytes): all entries of the largest matrix, each on its own line.
const MAX_BYTES: u64 = 64 << 20;

/// Reads the text of a matrix file. The error describes what was found.
fn read_text(path: &Path) -> Result<String, String> {
    let unreadable = |error: std::io::Error| format!("cannot be read ({error})");
    let metadata = std::fs::metadata(path).map_err(unreadable)?;
    // Opening a pipe waits for its writer, and a device has no end.
    if !metadata.is_file() {
        return Err("is a folder, a pipe, a device or a socket".to_owned());
    }
    // Before the file is read, because reading takes up to three times its size.
    if metadata.len() > MAX_BYTES {
        return Err(format!(
            "has {} bytes, at most {MAX_BYTES} are allowed",
            metadata.len()
        ));
    }
    let mut bytes = Vec::new();
    File::open(path)
        .map_err(unreadable)?
        .take(MAX_BYTES) // the file may grow meanwhile
        .read_to_end(&mut bytes)
        .map_err(unreadable)?;
    decode(bytes).map_err(|wrong| format!("line {}: {}", wrong.line, wrong.found))
}

/// Allowed numbers of rows, columns and entries.
const SIZE_RULE: &str = "must have at most 1000 degrees of freedom (reduce the model first)";

/// Checks the declared sizes and the indices, because the reader accepts any.
fn check_sizes(text: &str) -> Result<(), String> {
    let is_coordinate = text
        .lines()
        .next()
        .is_some_and(|header| header.to_ascii_lowercase().contains("coordinate"));
    let lines = text
        .lines()
        .filter(|line| !line.starts_with('%') && !line.trim().is_empty());
    for (number, line) in lines.enumerate() {
        let (shape, indices) = (number == 0, is_coordinate);
        let counting = if shape {
            3
        } else if indices {
            2
        } else {
            0
        };
        for (place, word) in line.split_whitespace().take(counting).enumerate() {
            let largest = if place == 2 {
                LARGEST_MODEL * LARGEST_MODEL
            } else {
                LARGEST_MODEL
            };
            let counts = !word.is_empty() && word.bytes().all(|digit| digit.is_ascii_digit());
            if counts && !word.parse::<usize>().is_ok_and(|count| count <= largest) {
                return Err(format!("has {word} in {line:?}"));
            }
        }
    }
    Ok(())
}

/// Reads a symmetric matrix and averages small deviations from symmetry.
pub(crate) fn read_symmetric(path: &Path) -> Result<CsrMatrix<f64>, Unusable> {
    let matrix = read(path)?;
    let shown = path.display();
    if matrix.nrows() != matrix.ncols() {
        let found = format!("{shown} is {} × {}", matrix.nrows(), matrix.ncols());
        return Err(Unusable::new(found, "must be square"));
    }
    let largest = matrix
        .values()
        .iter()
        .fold(0.0_f64, |largest, value| largest.max(value.abs()));
    let transposed = matrix.transpose();
    let difference = &matrix - &transposed;
    for (row, column, value) in difference.triplet_iter() {
        if value.abs() > SYMMETRY_TOLERANCE * largest {
            let entry = |row, column| {
                matrix
                    .get_entry(row, column)
                    .map_or(0.0, |entry| entry.into_value())
            };
            let found = format!(
                "{shown} has {} at row {}, column {} but {} at row {}, column {}",
                entry(row, column),
                row + 1,
                column + 1,
                entry(column, row),
                column + 1,
                row + 1
            );
            return Err(Unusable::new(found, "must be symmetric"));
        }
    }
    Ok((matrix + transposed) * 0.5)
}

/// Checks that a symmetric matrix has no negative eigenvalue.
pub(crate) fn check_semidefinite(matrix: &DMatrix<f64>) -> Result<(), Unusable> {
    let eigenvalues = matrix.symmetric_eigenvalues();
    let largest = eigenvalues
        .iter()
        .fold(0.0_f64, |largest, value| largest.max(value.abs()));
    let smallest = eigenvalues.min();
    if smallest < -ZERO_EIGENVALUE * largest {
        return Err(Unusable::new(
            format!("has the negative eigenvalue {smallest:.6e}"),
            "must be positive semidefinite",
        ));
    }
    Ok(())
}

/// Returns the degree of freedom that moves most without resistance; `None` if the matrix is
/// positive definite.
pub(crate) fn free_degree_of_freedom(matrix: &DMatrix<f64>) -> Option<usize> {
    let eigen = SymmetricEigen::new(matrix.clone());
    let (smallest, value) = eigen.eigenvalues.argmin();
    let largest = eigen.eigenvalues.amax();
    (value <= ZERO_EIGENVALUE * largest).then(|| eigen.eigenvectors.column(smallest).iamax())
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn pipe_and_device_are_no_matrix() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe.mtx");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        for path in [pipe.as_path(), Path::new("/dev/zero")] {
            let found = read(path).unwrap_err().found;
            let expected = format!(
                "{} is a folder, a pipe, a device or a socket",
                path.display()
            );
            assert_eq!(found, expected);
        }
    }
}
