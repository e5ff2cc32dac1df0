//! What one frame costs: the demo's building, five storeys, six channels, noise updating on.
//!
//! The time per element is that of one frame; 100 Hz in real time leaves 10 ms for it.

#![allow(clippy::expect_used, missing_docs, reason = "a benchmark stops where it cannot start")]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use spandrel_bus::{FrameBlock, Header, StreamState};
use spandrel_identify::{Identification, Input};
use spandrel_structure::Structure;
use std::hint::black_box;
use std::path::Path;

const FRAMES: usize = 6_000;

fn identification(criterion: &mut Criterion) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let structure = Structure::read(&path).expect("the example is valid");
    let block = FrameBlock {
        header: Header { source: "bench".into(), epoch: 1, sequence: 0, time_ns: 0 },
        t0_ns: 0,
        sampling_rate_hz: structure.sampling_rate_hz(),
        channels: structure.channel_count() as u16,
        values: structure.simulator(1).take(FRAMES).flat_map(|frame| frame.values).collect(),
        state: StreamState::Ended,
    };
    let mut group = criterion.benchmark_group("identification");
    group.throughput(Throughput::Elements(FRAMES as u64)).sample_size(10);
    group.bench_function("five storeys", |bencher| {
        bencher.iter(|| {
            let mut core = Identification::new(&structure, "bench").expect("the example has a filter");
            let mut outputs = Vec::new();
            core.handle(Input::Frames(block.clone()), &mut outputs);
            black_box(outputs.len())
        });
    });
    group.finish();
}

criterion_group!(benches, identification);
criterion_main!(benches);
