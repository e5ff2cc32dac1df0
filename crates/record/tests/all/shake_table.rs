//! Reads the aligned records of the three-storey shake table, if they are available.
//!
//! Source: STAIRlab/mdof, `notebooks/uploads/mini_shake_table`, BSD-2-Clause (Chrystal Chern,
//! 2023).

use std::path::PathBuf;

use crate::skip::records_or_skip;
use spandrel_record::{
    ChannelColumn, ColumnMapping, OffsetRemoval, Quantity, RecordReader, Recording,
};

/// File, number of rows and channels. The number of rows is that of `wc -l` minus the header.
const RECORDS: [(&str, usize, &[&str]); 8] = [
    ("flexible-northridge.csv", 12116, THREE_STOREYS),
    ("flexible-sine1.0.csv", 19339, THREE_STOREYS),
    ("flexible-sine2.0.csv", 11716, THREE_STOREYS),
    ("onestorey-elcentro1.csv", 2560, ONE_STOREY),
    ("onestorey-northridge1.csv", 3526, ONE_STOREY),
    ("stiff-northridge.csv", 12599, THREE_STOREYS),
    ("stiff-sine1.0.csv", 5899, THREE_STOREYS),
    ("stiff-sine2.0.csv", 8020, THREE_STOREYS),
];
const THREE_STOREYS: &[&str] = &["ground", "floor1", "floor2", "floor3"];
const ONE_STOREY: &[&str] = &["ground", "top"];

/// Returns the folder of the records, or skips the test.
fn folder_or_skip() -> Option<PathBuf> {
    records_or_skip("mini-shake-table/aligned")
}

fn mapping(channels: &[&str]) -> ColumnMapping {
    let columns = channels.iter().map(|channel| {
        ChannelColumn::new(*channel)
            .with_column(format!("{channel}_mps2"))
            .with_unit("m/s2", Quantity::Acceleration)
            .unwrap()
    });
    ColumnMapping::new(columns.collect()).with_time_column("time_s")
}

#[test]
fn shake_table_records_are_read_completely_at_120_hz() {
    let Some(folder) = folder_or_skip() else {
        return;
    };
    for (file, rows, channels) in RECORDS {
        let mut recording =
            Recording::open(&folder.join(file), &mapping(channels), OffsetRemoval::Keep).unwrap();
        assert_eq!(
            recording.check_sampling_rate(120.0).unwrap(),
            120.0,
            "{file}"
        );
        let mut count = 0_i64;
        while let Some(row) = recording.next_row().unwrap() {
            // Each sample is on the 120 Hz grid, except for rounding to 1 µs in the file.
            let on_grid_ns = (count as f64 * 1e9 / 120.0).round() as i64;
            assert!(
                (row.time_ns - on_grid_ns).abs() <= 500,
                "{file}: row {count} is at {} ns",
                row.time_ns
            );
            assert!(
                row.values.iter().all(|value| value.abs() < 40.0),
                "{file}: row {count}: {:?}",
                row.values
            );
            count += 1;
        }
        assert_eq!(count, rows as i64, "{file}");
    }
}

#[test]
fn offset_removal_removes_the_tilt_of_the_sensors() {
    let Some(folder) = folder_or_skip() else {
        return;
    };
    let offset = OffsetRemoval::MeanOfFirst { seconds: 1.0 };
    let mut recording = Recording::open(
        &folder.join("stiff-northridge.csv"),
        &mapping(THREE_STOREYS),
        offset,
    )
    .unwrap();
    assert!(recording.offsets().iter().flatten().count() == 4);
    let mut sum = [0.0; 4];
    for _ in 0..120 {
        let row = recording.next_row().unwrap().unwrap();
        sum.iter_mut()
            .zip(row.values)
            .for_each(|(sum, value)| *sum += value);
    }
    assert!(
        sum.iter().all(|sum| sum.abs() < 1e-9),
        "sum of the first second: {sum:?}"
    );
}
