//! Cost of one frame and of one hour of records.
//!
//! The structure is the building of the demo, with five storeys, six channels and noise updating.
//! The second benchmark processes an hour from the rows of a record to the estimates, as `spandrel
//! estimate` does.
//!
//! The time per element is the time of one frame. At 100 Hz in real time, 10 ms are available for a
//! frame.

#![allow(
    clippy::expect_used,
    missing_docs,
    reason = "a benchmark stops where it cannot start"
)]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use spandrel_bus::{FrameBlock, Header, StreamState};
use spandrel_identify::{Identification, IdentificationInput};
use spandrel_structure::Structure;
use std::hint::black_box;
use std::path::Path;

const FRAMES: usize = 6_000;

fn identification(criterion: &mut Criterion) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let structure = Structure::read(&path).expect("the example is valid");
    let block = FrameBlock {
        header: Header {
            source: "bench".into(),
            epoch: 1,
            sequence: 0,
            time_ns: 0,
        },
        t0_ns: 0,
        sampling_rate_hz: structure.sampling_rate_hz(),
        channels: structure.channel_count() as u16,
        values: structure
            .simulator(1)
            .take(FRAMES)
            .flat_map(|frame| frame.values)
            .collect(),
        state: StreamState::Ended,
    };
    let mut group = criterion.benchmark_group("identification");
    group
        .throughput(Throughput::Elements(FRAMES as u64))
        .sample_size(10);
    group.bench_function("five storeys", |bencher| {
        bencher.iter(|| {
            let mut core =
                Identification::new(&structure, "bench").expect("the example has a filter");
            let mut outputs = Vec::new();
            core.handle(IdentificationInput::Frames(block.clone()), &mut outputs);
            black_box(outputs.len())
        });
    });
    group.finish();
}

/// Processes an hour of records block by block, in blocks of the size of a recording.
fn an_hour(criterion: &mut Criterion) {
    const HOUR: u64 = 360_000;
    const BLOCK: usize = 256;
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let structure = Structure::read(&path).expect("the example is valid");
    let channels = structure.channel_count();
    let values: Vec<f64> = structure
        .simulator(1)
        .take(HOUR as usize)
        .flat_map(|frame| frame.values)
        .collect();
    let blocks: Vec<FrameBlock> = values
        .chunks(BLOCK * channels)
        .zip((0..).step_by(BLOCK))
        .map(|(values, sequence)| FrameBlock {
            header: Header {
                source: "bench".into(),
                epoch: 1,
                sequence,
                time_ns: sequence as i64 * 10_000_000,
            },
            t0_ns: 0,
            sampling_rate_hz: structure.sampling_rate_hz(),
            channels: channels as u16,
            values: values.to_vec(),
            state: StreamState::Running,
        })
        .collect();
    let mut group = criterion.benchmark_group("estimation");
    group.throughput(Throughput::Elements(HOUR)).sample_size(10);
    group.bench_function("an hour of five storeys", |bencher| {
        bencher.iter(|| {
            let mut core =
                Identification::new(&structure, "bench").expect("the example has a filter");
            let (mut outputs, mut estimates) = (Vec::new(), 0);
            for block in &blocks {
                core.handle(IdentificationInput::Frames(block.clone()), &mut outputs);
                estimates += outputs.len();
                outputs.clear();
            }
            black_box(estimates)
        });
    });
    group.finish();
}

criterion_group!(benches, identification, an_hour);
criterion_main!(benches);
