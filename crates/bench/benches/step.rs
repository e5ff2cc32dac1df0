//! Cost of the stages of a step, measured by steps with more and more stages, and the share of the
//! model.
//!
//! A prediction alone has no samples. An update has samples and known noise levels. Further steps
//! identify the noise levels and screen for outliers. The time per element is the time of one step.

#![allow(
    clippy::expect_used,
    missing_docs,
    reason = "a benchmark stops where it cannot start"
)]

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use nalgebra::DMatrix;
use spandrel_bench::building::Building;
use spandrel_bench::structures::Monitored;
use spandrel_filter::{
    ExtendedKalmanFilter, FilterSettings, Frame, ObservationModel, OutlierSettings, ProcessModel,
};
use spandrel_structure::StructureModel;
use std::hint::black_box;

/// Number of steps taken together from a warm state.
///
/// There are enough steps that the first ones, which start with a cold cache, hardly count. There
/// are few enough that a filter without samples does not diverge.
const STEPS: usize = 100;

fn warm(building: &Building, settings: FilterSettings) -> ExtendedKalmanFilter<StructureModel> {
    let mut filter =
        ExtendedKalmanFilter::new(building.structure.model(), settings).expect("the settings fit");
    for samples in &building.frames {
        filter
            .step(Frame {
                observations: samples,
                excitation: &[0.0],
            })
            .expect("the filter follows");
    }
    filter
}

fn stages(criterion: &mut Criterion) {
    for storeys in [5, 40, 100] {
        let building = Building::new(storeys, 200).expect("the building is valid");
        let nothing = vec![f64::NAN; building.frames[0].len()];
        let identified = building.settings.clone();
        let known = building.plain_settings();
        let screened = FilterSettings {
            outliers: Some(OutlierSettings::for_period(30.0)),
            ..identified.clone()
        };
        let runs = [
            ("prediction", known.clone(), true),
            ("and update", known, false),
            ("and noise levels", identified, false),
            ("and outliers", screened, false),
        ];
        let mut group = criterion.benchmark_group(format!("{storeys} storeys"));
        group
            .throughput(Throughput::Elements(STEPS as u64))
            .sample_size(20);
        for (name, settings, blind) in runs {
            let filter = warm(&building, settings);
            group.bench_function(name, |bencher| {
                bencher.iter_batched_ref(
                    || filter.clone(),
                    |filter| {
                        for samples in &building.frames[..STEPS] {
                            let observations = if blind { &nothing } else { samples };
                            let frame = Frame {
                                observations,
                                excitation: &[0.0],
                            };
                            black_box(filter.step(frame).expect("the filter follows"));
                        }
                    },
                    BatchSize::PerIteration,
                );
            });
        }
        group.finish();
    }
}

fn model(criterion: &mut Criterion) {
    let building = Building::new(40, 50).expect("the building is valid");
    let filter = warm(&building, building.plain_settings());
    let mut model = building.structure.model();
    let (n, channels) = (model.state_len(), model.observation_len());
    let (mut product, mut observed) = (DMatrix::zeros(n, n), DMatrix::zeros(channels, n));
    let mut group = criterion.benchmark_group("model of 40 storeys");
    group.sample_size(20);
    group.bench_function("linearise the process", |bencher| {
        bencher.iter(|| model.linearise_process(black_box(filter.mean().as_slice()), &[0.0]));
    });
    group.bench_function("linearise the observation", |bencher| {
        bencher.iter(|| model.linearise_observation(black_box(filter.mean().as_slice()), &[0.0]));
    });
    group.bench_function("Jacobian times a covariance", |bencher| {
        bencher.iter(|| model.jacobian_mul(black_box(filter.covariance()), &mut product));
    });
    group.bench_function("observation Jacobian times a covariance", |bencher| {
        bencher
            .iter(|| model.observation_jacobian_mul(black_box(filter.covariance()), &mut observed));
    });
    group.finish();
}

fn larger(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("larger structures");
    group.sample_size(10);
    for monitored in [
        Monitored::bridge(20).expect("the example is valid"),
        Monitored::tower(5).expect("the example is valid"),
        Monitored::dome(20).expect("the example is valid"),
    ] {
        let mut index = 0;
        if monitored.structure.has_classes() {
            let mut bank = monitored.bank().expect("there are eight components");
            group.bench_function(monitored.name, |bencher| {
                bencher.iter(|| {
                    index += 1;
                    black_box(bank.step(monitored.frame(index)).expect("the bank follows"))
                });
            });
        } else {
            let mut filter = monitored.filter().expect("the example has a filter");
            group.bench_function(monitored.name, |bencher| {
                bencher.iter(|| {
                    index += 1;
                    black_box(
                        filter
                            .step(monitored.frame(index))
                            .expect("the filter follows"),
                    )
                });
            });
        }
    }
    group.finish();
}

criterion_group!(benches, stages, model, larger);
criterion_main!(benches);
