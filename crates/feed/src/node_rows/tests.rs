use super::*;

/// 100 Hz.
const STEP: i64 = 10_000_000;
const HALF: i64 = STEP / 2;
const WAIT: i64 = 1_000_000_000;

fn rows() -> NodeRows {
    NodeRows::new(100.0, WAIT, &[true, true])
}

/// Places and inserts samples, and returns the placement and the number of late samples.
fn put(
    rows: &mut NodeRows,
    lane: usize,
    start_ns: i64,
    values: &[f64],
    now: i64,
) -> (Placement, u64) {
    let placement = rows.place(lane, start_ns, values.len(), HALF);
    let late = match placement {
        Placement::At { row, skip, .. } => {
            let start_ns = rows.time_after(start_ns, skip);
            rows.insert(lane, row, start_ns, &values[skip..], now)
        }
        Placement::Behind => 0,
    };
    (placement, late)
}

fn at(row: i64, missing: u64, skip: usize) -> Placement {
    Placement::At { row, missing, skip }
}

fn found(rows: Vec<Row>) -> Vec<(i64, Vec<f64>)> {
    rows.into_iter()
        .map(|row| (row.time_ns, row.values))
        .collect()
}

#[test]
fn channels_that_arrive_apart_make_one_row() {
    let mut rows = rows();
    put(&mut rows, 0, 0, &[1.0, 2.0, 3.0], 0);
    assert_eq!(rows.release(0), []);
    put(&mut rows, 1, 2_000_000, &[10.0, 20.0], 5);
    assert_eq!(
        found(rows.release(5)),
        [(0, vec![1.0, 10.0]), (STEP, vec![2.0, 20.0])]
    );
}

#[test]
fn row_waits_for_a_channel_only_once() {
    let mut rows = rows();
    put(&mut rows, 0, 0, &[1.0], 0);
    assert_eq!(rows.release(WAIT - 1), []);
    let row = &rows.release(WAIT)[0];
    assert!(row.values[0] == 1.0 && row.values[1].is_nan());
    put(&mut rows, 0, STEP, &[2.0], WAIT);
    assert_eq!(rows.release(WAIT).len(), 1, "the channel is absent");
    // Its samples for rows that have gone are late. From then on, rows wait for it again.
    assert_eq!(put(&mut rows, 1, 0, &[10.0, 20.0, 30.0], WAIT).1, 2);
    assert_eq!(rows.release(WAIT), []);
    put(&mut rows, 0, 2 * STEP, &[3.0], WAIT);
    assert_eq!(found(rows.release(WAIT)), [(2 * STEP, vec![3.0, 30.0])]);
}

#[test]
fn lost_packet_leaves_its_rows_to_the_other_channel() {
    let mut rows = rows();
    put(&mut rows, 0, 0, &[1.0, 2.0, 3.0, 4.0], 0);
    put(&mut rows, 1, 0, &[10.0], 0);
    let (placement, _) = put(&mut rows, 1, 3 * STEP, &[40.0], 0);
    assert_eq!(placement, at(3, 2, 0));
    let values: Vec<String> = rows
        .release(0)
        .iter()
        .map(|row| format!("{:?}", row.values))
        .collect();
    assert_eq!(
        values,
        ["[1.0, 10.0]", "[2.0, NaN]", "[3.0, NaN]", "[4.0, 40.0]"]
    );
}

#[test]
fn drifting_clock_neither_skips_nor_doubles_rows() {
    // The clock of the instrument runs 1 % slow: 10.1 ms per sample at nominally 100 Hz.
    let mut rows = rows();
    let mut times = Vec::new();
    for packet in 0..400 {
        let start_ns = packet * 25 * 10_100_000;
        for lane in 0..2 {
            let (placement, _) = put(&mut rows, lane, start_ns, &[packet as f64; 25], 0);
            assert_eq!(placement, at(packet * 25, 0, 0));
        }
        times.extend(rows.release(0).iter().map(|row| row.time_ns));
    }
    assert_eq!(times.len(), 10_000);
    assert!(times.is_sorted());
}

#[test]
fn repeated_samples_are_recognised() {
    let mut rows = rows();
    put(&mut rows, 0, 0, &[1.0, 2.0, 3.0], 0);
    assert_eq!(rows.place(0, 0, 3, HALF), Placement::Behind);
    assert_eq!(rows.place(0, STEP, 4, HALF), at(3, 0, 2));
}

#[test]
fn long_gap_takes_no_memory() {
    let mut rows = rows();
    put(&mut rows, 0, 0, &[1.0], 0);
    let steps = 86_400 * 100;
    let (placement, _) = put(&mut rows, 0, steps * STEP, &[2.0], 0);
    assert_eq!(placement, at(steps, steps as u64 - 1, 0));
    assert_eq!(rows.pending.len(), 2);
}
