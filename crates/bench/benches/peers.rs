//! Comparison of the filter with its peers on the same building and samples, in one run. Prints a
//! table and draws a plot on request.
//!
//! ```sh
//! # Rust only
//! cargo bench -p spandrel-bench --bench peers
//! # with the Python peers, which need the packages of python/requirements.txt
//! cargo bench -p spandrel-bench --bench peers -- --python venv/bin/python
//! # other sizes, and a plot
//! cargo bench -p spandrel-bench --bench peers -- --storeys 40,100 --plot scaling.svg
//! ```
//!
//! Without `--bench`, as in `cargo test --benches`, or with `--test`, every filter takes a few
//! steps and nothing is measured.

#![allow(
    clippy::print_stdout,
    reason = "a benchmark that is run by hand reports to who runs it"
)]

use adskalman::{
    KalmanFilterNoControl, ObservationModel, StateAndCovariance, TransitionModelLinearNoControl,
};
use kfilter::{Kalman1M, Kalman1MLinearNoInput, KalmanPredict};
use nalgebra::{Const, DMatrix, DVector, OMatrix, OVector, SMatrix};
use spandrel_bench::building::{Building, GROUND_STD, SENSOR_STD, step};
use spandrel_bench::dense::DenseFilter;
use spandrel_bench::floor::{Count, Rates};
use spandrel_bench::python;
use spandrel_bench::structures::{LinearStep, Monitored};
use spandrel_bench::table::{Row, markdown, plot};
use spandrel_bench::timing::{Times, seconds};
use std::error::Error;
use std::path::PathBuf;

/// Number of rounds in which the filters take turns, so that other load on the machine affects all
/// of them.
const ROUNDS: usize = 3;

/// Maximum difference between two filters with the same equations after the same frames, in
/// standard deviations.
const AGREEMENT: f64 = 1e-6;

#[derive(Debug, Default)]
struct Options {
    smoke: bool,
    storeys: Vec<usize>,
    python: Option<PathBuf>,
    plot: Option<PathBuf>,
}

impl Options {
    fn read() -> Result<Self, Box<dyn Error>> {
        let mut options = Self {
            storeys: vec![5, 10, 20, 40, 100, 200, 400],
            ..Self::default()
        };
        options.smoke = !std::env::args().any(|argument| argument == "--bench");
        let mut arguments = std::env::args().skip(1);
        while let Some(argument) = arguments.next() {
            let mut value = || arguments.next().ok_or(format!("{argument} needs a value"));
            match argument.as_str() {
                "--test" => options.smoke = true,
                "--storeys" => {
                    options.storeys = value()?
                        .split(',')
                        .map(str::parse)
                        .collect::<Result<_, _>>()?
                }
                "--python" => options.python = Some(from_root(&value()?)),
                "--plot" => options.plot = Some(from_root(&value()?)),
                "--bench" => {}
                _ => {
                    return Err(format!(
                        "unknown option {argument}, must be --test, --storeys, --python or --plot"
                    )
                    .into());
                }
            }
        }
        if options.smoke {
            options.storeys = vec![5];
        }
        Ok(options)
    }
}

/// Resolves a relative path from the workspace root, because Cargo runs a benchmark in the folder
/// of its crate.
fn from_root(path: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).join(path)
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::read()?;
    let rows = options
        .storeys
        .iter()
        .map(|storeys| compare(*storeys, &options))
        .collect::<Result<Vec<_>, _>>()?;
    println!(
        "\nA step of the filter of a shear building\n\n{}",
        markdown(&rows)
    );
    if let Some(path) = &options.plot {
        plot(&rows, path)?;
    }
    println!("The linear part: nothing identified, 2N states, N/5 channels\n");
    println!(
        "| storeys | steps in turn | Spandrel µs | adskalman µs | kfilter µs |\n\
         |---|---|---|---|---|"
    );
    linear::<10, 1>(5, &options)?;
    if !options.smoke {
        linear::<20, 2>(10, &options)?;
        linear::<40, 4>(20, &options)?;
    }
    println!("\nStructures that must keep up with their sensors\n");
    println!(
        "| structure | states | channels | frames per second | µs a step | shortest µs | times \
         real time |\n|---|---|---|---|---|---|---|"
    );
    keep_up(&options)
}

/// Measures one building.
fn compare(storeys: usize, options: &Options) -> Result<Row, Box<dyn Error>> {
    let volume = storeys * storeys;
    let (warm, frames) = if options.smoke {
        (1, 2)
    } else {
        (150, (400_000 / volume).clamp(30, 2_000))
    };
    let peer_frames = if options.smoke {
        3
    } else {
        (4_000_000 / (volume * storeys)).clamp(3, 200)
    };
    let building = Building::new(storeys, warm + ROUNDS * frames)?;
    let (mut filter, mut known) = (building.filter()?, building.plain_filter()?);
    let mut dense = DenseFilter::new(building.structure.model(), building.plain_settings());
    let [mut of_filter, mut of_known, mut of_dense] = [(); 3].map(|()| Times::default());
    for samples in &building.frames[..warm] {
        step(&mut filter, samples)?;
    }
    let mut taken = 0;
    for round in 0..ROUNDS {
        for samples in &building.frames[warm + round * frames..warm + (round + 1) * frames] {
            let (time_s, result) = seconds(|| step(&mut filter, samples));
            result?;
            of_filter.push(time_s);
        }
        while taken < peer_frames * (round + 1) / ROUNDS {
            let samples = &building.frames[taken];
            let (time_s, result) = seconds(|| dense.step(samples));
            result.ok_or("the dense filter has diverged")?;
            step(&mut known, samples)?;
            if taken > 0 {
                of_dense.push(time_s); // excludes the first frame, which has no prediction
            }
            taken += 1;
        }
    }
    let std = dense.covariance().diagonal().map(f64::sqrt);
    let agree = |name: &str, mean: &DVector<f64>| {
        let off = (mean - known.mean()).component_div(&std).amax();
        if off < AGREEMENT {
            Ok(())
        } else {
            Err(format!(
                "{storeys} storeys, {name}: off by {off:e} deviations"
            ))
        }
    };
    agree("dense nalgebra", dense.mean())?;
    let mut python = [f64::NAN; 2];
    if let Some(interpreter) = &options.python {
        for peer in python::run(interpreter, &building, peer_frames)? {
            agree(&peer.name, &DVector::from_vec(peer.mean))?;
            python[usize::from(peer.name == "numpy")] = peer.times.median();
        }
    }
    for samples in building.frames[taken..].iter().take(frames) {
        let (time_s, result) = seconds(|| step(&mut known, samples));
        result?;
        of_known.push(time_s);
    }
    let terms = filter
        .transition_term_count()
        .ok_or("a chain has a proportional form")?;
    let count = Count::of(&building, terms);
    let rates = Rates::measure(count.bytes);
    println!(
        "{storeys} storeys: {:.2} Mflop, {:.2} MB a step; {:.1} Gflop/s, {:.1} GB/s; shortest \
         step {:.1} µs",
        count.flops / 1e6,
        count.bytes / 1e6,
        rates.flops_per_s / 1e9,
        rates.bytes_per_s / 1e9,
        of_filter.shortest() * 1e6
    );
    Ok(Row {
        storeys,
        spandrel: of_filter.median(),
        spandrel_known: of_known.median(),
        floor: rates.least_seconds(count),
        dense: of_dense.median(),
        filterpy: python[0],
        numpy: python[1],
    })
}

/// A linear system in the form that adskalman expects.
struct Fixed<const N: usize, const M: usize> {
    transition: [SMatrix<f64, N, N>; 2],
    process_noise: SMatrix<f64, N, N>,
    observation: SMatrix<f64, M, N>,
    observation_transposed: SMatrix<f64, N, M>,
    sensor_noise: SMatrix<f64, M, M>,
}

impl<const N: usize, const M: usize> Fixed<N, M> {
    fn new(step: &LinearStep) -> Self {
        let transition = fixed(&step.transition);
        let observation = SMatrix::from_column_slice(step.observation.as_slice());
        Self {
            transition: [transition, transition.transpose()],
            process_noise: fixed(&step.process_noise),
            observation,
            observation_transposed: observation.transpose(),
            sensor_noise: SMatrix::identity() * SENSOR_STD * SENSOR_STD,
        }
    }
}

fn fixed<const N: usize>(matrix: &DMatrix<f64>) -> SMatrix<f64, N, N> {
    SMatrix::from_column_slice(matrix.as_slice())
}

impl<const N: usize, const M: usize> TransitionModelLinearNoControl<f64, Const<N>> for Fixed<N, M> {
    fn F(&self) -> &OMatrix<f64, Const<N>, Const<N>> {
        &self.transition[0]
    }
    fn FT(&self) -> &OMatrix<f64, Const<N>, Const<N>> {
        &self.transition[1]
    }
    fn Q(&self) -> &OMatrix<f64, Const<N>, Const<N>> {
        &self.process_noise
    }
}

impl<const N: usize, const M: usize> ObservationModel<f64, Const<N>, Const<M>> for Fixed<N, M>
where
    Const<M>: nalgebra::DimMin<Const<M>, Output = Const<M>>,
{
    fn H(&self) -> &OMatrix<f64, Const<M>, Const<N>> {
        &self.observation
    }
    fn HT(&self) -> &OMatrix<f64, Const<N>, Const<M>> {
        &self.observation_transposed
    }
    fn R(&self) -> &OMatrix<f64, Const<M>, Const<M>> {
        &self.sensor_noise
    }
}

/// Returns the same system in the form that kfilter expects. Its covariance starts at the
/// covariance of the process noise.
fn of_kfilter<const N: usize, const M: usize>(
    step: &LinearStep,
) -> Kalman1MLinearNoInput<f64, N, M> {
    let square = |matrix: &DMatrix<f64>| {
        kfilter_nalgebra::SMatrix::<f64, N, N>::from_column_slice(matrix.as_slice())
    };
    Kalman1M::new(
        square(&step.transition),
        square(&step.process_noise),
        kfilter_nalgebra::SMatrix::from_column_slice(step.observation.as_slice()),
        kfilter_nalgebra::SMatrix::identity() * (SENSOR_STD * SENSOR_STD),
        kfilter_nalgebra::SVector::zeros(),
    )
}

/// Measures the linear part, for sizes that the crates with fixed sizes support.
fn linear<const N: usize, const M: usize>(
    storeys: usize,
    options: &Options,
) -> Result<(), Box<dyn Error>>
where
    Const<M>: nalgebra::DimMin<Const<M>, Output = Const<M>>,
{
    let frames = if options.smoke { 3 } else { 2_000 };
    let building = Building::linear(storeys, frames)?;
    let mut filter = building.plain_filter()?;
    let step_s = building.settings.step_s;
    let of_step = LinearStep::new(&building.structure, step_s, GROUND_STD * GROUND_STD);
    let model = Fixed::<N, M>::new(&of_step);
    let prior = building.settings.prior_std.map(|std| std * std);
    let prior = fixed::<N>(&DMatrix::from_diagonal(&prior));
    let peer = KalmanFilterNoControl::new(&model, &model);
    let mut estimate = StateAndCovariance::new(OVector::<f64, Const<N>>::zeros(), prior);
    let mut single = of_kfilter::<N, M>(&of_step);
    // First with many steps of a filter in sequence, so that its data is in the cache, then with
    // one step at a time.
    for together in [frames.div_ceil(ROUNDS), 1] {
        let [mut by_filter, mut by_adskalman, mut by_kfilter] = [(); 3].map(|()| Times::default());
        for samples in building.frames.chunks(together) {
            for samples in samples {
                let (time_s, result) = seconds(|| step(&mut filter, samples));
                result?;
                by_filter.push(time_s);
            }
            for samples in samples {
                let datum = OVector::<f64, Const<M>>::from_column_slice(samples);
                let (time_s, result) = seconds(|| peer.step(&estimate, &datum));
                estimate = result.map_err(|error| format!("adskalman: {error:?}"))?;
                by_adskalman.push(time_s);
            }
            for samples in samples {
                let datum = kfilter_nalgebra::SVector::<f64, M>::from_column_slice(samples);
                let (time_s, result) = seconds(|| {
                    let _ = single.predict(); // a linear prediction cannot fail
                    single.update(datum).map(|_| ())
                });
                result.map_err(|error| format!("kfilter: {error:?}"))?;
                by_kfilter.push(time_s);
            }
        }
        let [filter, adskalman, kfilter] =
            [by_filter, by_adskalman, by_kfilter].map(|times| times.median() * 1e6);
        println!("| {storeys} | {together} | {filter:.2} | {adskalman:.2} | {kfilter:.2} |");
    }
    Ok(())
}

/// Measures the time per frame of each of the large structures.
fn keep_up(options: &Options) -> Result<(), Box<dyn Error>> {
    let frames = |many: usize| if options.smoke { 2 } else { many };
    for monitored in [
        Monitored::bridge(frames(1_500))?,
        Monitored::tower(frames(30))?,
    ] {
        let mut filter = monitored.filter()?;
        let mut times = Times::default();
        for index in 0..monitored.frames.len() {
            let (time_s, result) = seconds(|| filter.step(monitored.frame(index)).map(|_| ()));
            result?;
            if index > 0 {
                times.push(time_s); // excludes the first frame, which has no prediction
            }
        }
        report(&monitored, filter.mean().len(), &times);
    }
    let dome = Monitored::dome(frames(2_000))?;
    let mut bank = dome.bank()?;
    let mut times = Times::default();
    for index in 0..dome.frames.len() {
        let (time_s, result) = seconds(|| bank.step(dome.frame(index)).map(|_| ()));
        result?;
        if index > 0 {
            times.push(time_s);
        }
    }
    report(&dome, bank.filter(0).mean().len(), &times);
    Ok(())
}

fn report(monitored: &Monitored, states: usize, times: &Times) {
    let time_s = times.median();
    let rate_hz = monitored.structure.sampling_rate_hz();
    println!(
        "| {} | {states} | {} | {rate_hz} | {:.0} | {:.0} | {:.1} |",
        monitored.name,
        monitored.structure.observation_channels().len(),
        time_s * 1e6,
        times.shortest() * 1e6,
        1.0 / (rate_hz * time_s)
    );
}
