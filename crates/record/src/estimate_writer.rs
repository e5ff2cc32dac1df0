//! Writes estimates: mean and standard deviation of each quantity, one row per frame.

use std::path::Path;

use crate::new_file::{self, NewFile};
use crate::{ColumnMapping, CsvWriter, RecordError};

/// A writer of estimates as CSV: the time in s, then `NAME.mean` and `NAME.std` of each quantity.
/// It replaces an existing file when it has finished.
pub struct EstimateWriter {
    csv: CsvWriter<NewFile>,
    row: Vec<f64>,
}

impl EstimateWriter {
    /// Creates the file and writes the header.
    ///
    /// # Errors
    /// Returns an error if the file cannot be created or written.
    pub fn create<S: AsRef<str>>(path: &Path, names: &[S]) -> Result<Self, RecordError> {
        let columns: Vec<String> = names
            .iter()
            .flat_map(|name| {
                [
                    format!("{}.mean", name.as_ref()),
                    format!("{}.std", name.as_ref()),
                ]
            })
            .collect();
        Ok(Self {
            csv: CsvWriter::new(
                new_file::create(path)?,
                path,
                &ColumnMapping::by_name(columns.iter().map(String::as_str)),
            )?,
            row: Vec::with_capacity(columns.len()),
        })
    }

    /// Writes one frame: its time in ns, and mean and standard deviation of each quantity (ratios,
    /// or SI units).
    ///
    /// # Errors
    /// Returns an error if the number of pairs differs from the number of quantities, a value is
    /// infinite, or the file cannot be written.
    pub fn write(
        &mut self,
        time_ns: i64,
        mean_and_std: impl IntoIterator<Item = (f64, f64)>,
    ) -> Result<(), RecordError> {
        self.row.clear();
        self.row
            .extend(mean_and_std.into_iter().flat_map(|(mean, std)| [mean, std]));
        self.csv.write_row(time_ns, &self.row)
    }

    /// Completes the file. Dropping the writer without this call removes the rows.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn finish(self) -> Result<(), RecordError> {
        new_file::finish(self.csv.finish()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_parameter_has_mean_and_std_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("estimates.csv");
        let mut writer = EstimateWriter::create(&path, &["storey-1", "storey-2"]).unwrap();
        writer
            .write(500_000_000, [(1.0, 0.1), (0.85, 0.02)])
            .unwrap();
        writer.finish().unwrap();
        assert_eq!(
            std::fs::read_to_string(&path).unwrap(),
            "time,storey-1.mean,storey-1.std,storey-2.mean,storey-2.std\n0.5,1.0,0.1,0.85,0.02\n"
        );
    }
}
