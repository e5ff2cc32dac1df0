//! CSV records as tables of text, so that the program reads exactly what a test changes.

use std::ops::Range;
use std::path::{Path, PathBuf};

/// A record: the time in its first column, then a column per channel.
#[derive(Clone)]
pub struct Record {
    path: PathBuf,
    header: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Record {
    pub fn read(path: &Path) -> Self {
        let text = std::fs::read_to_string(path)
            .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let mut lines = text
            .lines()
            .map(|line| line.split(',').map(str::to_owned).collect::<Vec<_>>());
        let header = lines.next().unwrap();
        Self {
            path: path.to_owned(),
            header,
            rows: lines.collect(),
        }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the number of rows.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Returns the names of the columns without the time.
    pub fn channels(&self) -> &[String] {
        &self.header[1..]
    }

    /// Returns the time of a row (ns).
    pub fn time_ns(&self, row: usize) -> i64 {
        (self.rows[row][0].parse::<f64>().unwrap() * 1e9).round() as i64
    }

    /// Returns the value of a channel by its name, NaN for an empty field.
    pub fn value(&self, row: usize, channel: &str) -> f64 {
        let text = &self.rows[row][self.column(channel)];
        if text.is_empty() {
            f64::NAN
        } else {
            text.parse().unwrap()
        }
    }

    /// Empties the fields of a channel.
    pub fn remove(&mut self, channel: &str, rows: Range<usize>) -> &mut Self {
        let column = self.column(channel);
        for row in &mut self.rows[rows] {
            row[column].clear();
        }
        self
    }

    /// Changes the values of a channel. The row number counts from the start of the record.
    pub fn change(
        &mut self,
        channel: &str,
        rows: Range<usize>,
        change: impl Fn(usize, f64) -> f64,
    ) -> &mut Self {
        let column = self.column(channel);
        for row in rows {
            let value: f64 = self.rows[row][column].parse().unwrap();
            self.rows[row][column] = change(row, value).to_string();
        }
        self
    }

    /// Shifts the values of a channel from row `first` on by `rows` rows, to later rows if
    /// positive. Fields without a source value become empty.
    pub fn shift(&mut self, channel: &str, first: usize, rows: isize) -> &mut Self {
        let column = self.column(channel);
        let before: Vec<String> = self.rows.iter().map(|row| row[column].clone()).collect();
        for row in first..self.rows.len() {
            let from = row.checked_add_signed(-rows).filter(|from| *from >= first);
            self.rows[row][column] = from
                .and_then(|from| before.get(from))
                .cloned()
                .unwrap_or_default();
        }
        self
    }

    /// Removes whole rows.
    pub fn cut(&mut self, rows: Range<usize>) -> &mut Self {
        self.rows.drain(rows);
        self
    }

    /// Delays the rows from `first` on by some seconds.
    pub fn delay_from(&mut self, first: usize, seconds: f64) -> &mut Self {
        for row in first..self.rows.len() {
            let time_s = self.time_ns(row) as f64 * 1e-9 + seconds;
            self.rows[row][0] = format!("{time_s:.6}");
        }
        self
    }

    /// Writes the table next to its original file.
    pub fn save_as(&mut self, name: &str) -> &Self {
        self.path = self.path.with_file_name(name);
        let lines = std::iter::once(&self.header)
            .chain(&self.rows)
            .map(|fields| fields.join(",") + "\n");
        std::fs::write(&self.path, lines.collect::<String>()).unwrap();
        self
    }

    /// Writes the table as `record.csv` in a folder.
    pub fn save_as_copy(&mut self, folder: &Path) -> &Self {
        self.path = folder.join("none");
        self.save_as("record.csv")
    }

    /// Returns the record with values rounded to this number of decimals.
    pub fn rounded(mut self, decimals: usize) -> Self {
        for field in self.rows.iter_mut().flat_map(|row| &mut row[1..]) {
            if let Ok(value) = field.parse::<f64>() {
                *field = format!("{value:.decimals$}");
            }
        }
        self
    }

    fn column(&self, channel: &str) -> usize {
        let found = self.header.iter().position(|name| name == channel);
        found.unwrap_or_else(|| panic!("no column {channel} in {:?}", self.header))
    }
}
