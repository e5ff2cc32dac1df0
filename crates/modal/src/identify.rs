//! Modes of one epoch.

use crate::cluster::clusters;
use crate::covariance::EpochCovariances;
use crate::law::smallest_uncertainty;
use crate::perturbation::{Change, Perturbations};
use crate::realisation::{Model, Pole, Realisation};
use crate::shape::{largest, phase_collinearity};
use crate::stream::Epoch;
use crate::{ModalError, Uncertainty};
use nalgebra::{Complex, DVector};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// Highest damping ratio of a mode.
pub const HIGHEST_DAMPING: f64 = 0.1;
/// Lowest damping ratio of a candidate. The pole of a sine scatters around 0.
const LOWEST_CANDIDATE: f64 = -0.005;
/// Damping ratio below which a pole may be a machine, if its standard deviation is also smaller.
/// Structures have more.
pub const MACHINE_DAMPING: f64 = 0.001;
/// Largest standard deviation of a frequency, relative to it. A pole that is known less precisely
/// says nothing.
const LARGEST_DEVIATION: f64 = 0.05;
/// Number of poles of a cluster whose deviations are compared.
const COMPARED: usize = 5;
/// Minimum ratio of the damping ratio of a certain mode to the standard deviation of this damping
/// ratio. In simulations, most modes below it are spurious.
pub const CERTAIN_DAMPING: f64 = 2.0;
/// Spectral kurtosis below which a line of the spectrum is a sine, if its pole has almost no
/// damping: halfway from 0 (random motion) to −1 (a sine).
pub const MACHINE_KURTOSIS: f64 = -0.5;
/// Spectral kurtosis below which a line is a sine with any damping of its pole. A machine beside a
/// mode shares its pole. Random motion is below with a probability of 0.002 for
/// [`LEAST_SEGMENTS`] independent segments.
const LINE_KURTOSIS: f64 = -0.75;
/// Least number of segments for which [`LINE_KURTOSIS`] holds.
const LEAST_SEGMENTS: usize = 15;

/// Kind of motion that a stable pole represents.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// A mode of the structure.
    Mode,
    /// A periodic excitation: an amplitude that hardly varies.
    Machine,
}

/// A mode of one epoch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Mode {
    /// Kind of motion that the poles represent: a mode of the structure or a machine.
    pub source: Source,
    /// Natural frequency (Hz).
    pub frequency_hz: f64,
    /// Standard deviation of the frequency (Hz).
    pub frequency_std_hz: f64,
    /// Damping ratio, as a share of critical damping (0.01 = 1 %).
    pub damping: f64,
    /// Standard deviation of the damping ratio.
    pub damping_std: f64,
    /// Positions of the channels of the shape: those that take part in the epoch.
    pub channels: Vec<usize>,
    /// Shape at these channels, in their units. The channel with the largest amplitude has 1.
    pub shape: DVector<Complex<f64>>,
    /// Standard deviation of the real part of each value of the shape.
    pub shape_std: Vec<f64>,
    /// Modal phase collinearity, 0 to 1. A real (normal) mode shape has 1: all channels move in
    /// phase or in antiphase.
    pub collinearity: f64,
    /// Band in which the mode was identified (Hz).
    pub band_hz: (f64, f64),
    /// Share of the model orders with a pole of this mode, 0 to 1.
    pub orders: f64,
    /// Spectral kurtosis at the frequency: 0 for random motion, −1 for a sine. `None` without a
    /// spectrum.
    pub kurtosis: Option<f64>,
}

/// Modes and poles of one epoch.
#[derive(Debug, Clone, PartialEq)]
pub struct Identified {
    /// Modes and machines, in order of frequency.
    pub modes: Vec<Mode>,
    /// Poles of all orders with a damping ratio from −0.005 to 0.1 in the band, in order of order
    /// and frequency.
    pub poles: Vec<Pole>,
    /// Singular values of the block Hankel matrix, in descending order.
    pub singular_values: Vec<f64>,
}

/// Identifies the modes of an epoch.
///
/// # Errors
/// Returns an error if fewer than two channels or no reference are usable, or if a decomposition
/// does not converge.
pub fn identify(epoch: &Epoch) -> Result<Identified, ModalError> {
    let covariances = &epoch.covariances;
    let usable = covariances.outputs.len();
    if usable < 2 || covariances.reference_of.is_empty() {
        return Err(ModalError::Channels {
            found: usable.min(covariances.reference_of.len()),
            at_least: 2,
        });
    }
    let mean = covariances.mean();
    let hankel = covariances.hankel(&mean);
    let realisation = Realisation::new(hankel, usable, epoch.rate_hz, epoch.highest_order)?;
    let models = models(&realisation)?;
    let poles: Vec<Vec<Pole>> = models
        .iter()
        .map(|model| candidates(&realisation, model, epoch.band_hz))
        .collect();
    let perturbations = Perturbations::new(&realisation, covariances, &mean);
    let modes = clusters(&poles)
        .iter()
        .filter_map(|cluster| {
            let (pole, changes) = representative(cluster, &models, &perturbations)?;
            mode(
                epoch,
                pole,
                &changes,
                cluster.len() as f64 / models.len() as f64,
            )
        })
        .collect();
    Ok(Identified {
        modes,
        poles: poles.into_iter().flatten().collect(),
        singular_values: realisation.svd.s,
    })
}

/// Returns the models of orders 2, 4, 6 and so on.
fn models(realisation: &Realisation) -> Result<Vec<Model>, ModalError> {
    let mut models = Vec::new();
    for order in (2..=realisation.highest_order()).step_by(2) {
        models.extend(realisation.model(order)?);
    }
    Ok(models)
}

fn candidates(realisation: &Realisation, model: &Model, band_hz: (f64, f64)) -> Vec<Pole> {
    let mut poles = realisation.poles(model);
    poles.retain(|pole| {
        pole.damping > LOWEST_CANDIDATE
            && pole.damping < HIGHEST_DAMPING
            && pole.frequency_hz > band_hz.0
            && pole.frequency_hz < band_hz.1
    });
    poles
}

/// Returns the pole that represents a cluster, with its changes.
///
/// At some orders, a spurious pole next to the mode multiplies the standard deviation. Of the poles
/// in the middle half of the frequencies, [`COMPARED`] ones are compared, evenly spread over their
/// orders. The one with the smallest standard deviation of the damping ratio represents the
/// cluster.
fn representative<'p>(
    cluster: &'p [Pole],
    models: &[Model],
    perturbations: &Perturbations<'_>,
) -> Option<(&'p Pole, Vec<Change>)> {
    let mut sorted: Vec<&Pole> = cluster.iter().collect();
    sorted.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
    let quarter = sorted.len() / 4;
    let middle = &mut sorted[quarter..cluster.len() - quarter];
    middle.sort_by_key(|pole| pole.order);
    let compared = COMPARED.min(middle.len());
    let candidates = (0..compared).filter_map(|k| {
        let pole = middle[(2 * k + 1) * middle.len() / (2 * compared)];
        let model = models.iter().find(|model| model.order == pole.order)?;
        let changes = perturbations.changes(model, pole)?;
        let deviation = std(changes.iter().map(|change| change.damping));
        Some((deviation, pole, changes))
    });
    let best = candidates.min_by(|(a, ..), (b, ..)| a.total_cmp(b));
    best.map(|(_, pole, changes)| (pole, changes))
}

/// Returns the mode of a pole, or `None` if it is neither a mode nor a machine.
fn mode(epoch: &Epoch, pole: &Pole, changes: &[Change], orders: f64) -> Option<Mode> {
    let kurtosis = epoch
        .spectrum
        .as_ref()
        .and_then(|spectrum| spectrum.kurtosis(pole.frequency_hz));
    let found = Uncertainty {
        frequency_hz: std(changes.iter().map(|change| change.frequency_hz)),
        damping: std(changes.iter().map(|change| change.damping)),
    };
    let is_undamped = pole.damping.abs() < MACHINE_DAMPING
        && found.damping < MACHINE_DAMPING
        && kurtosis.is_some_and(|kurtosis| kurtosis < MACHINE_KURTOSIS);
    let is_machine = is_undamped || has_line(epoch, pole, kurtosis);
    let is_certain = found.frequency_hz < LARGEST_DEVIATION * pole.frequency_hz
        && found.damping < HIGHEST_DAMPING;
    if !is_certain || (pole.damping <= 0.0 && !is_machine) {
        return None;
    }
    let law = smallest_uncertainty(pole.frequency_hz, pole.damping, epoch.length_s);
    let (shape, shape_std) = normalised(&epoch.covariances, pole, changes);
    Some(Mode {
        source: if is_machine {
            Source::Machine
        } else {
            Source::Mode
        },
        frequency_hz: pole.frequency_hz,
        frequency_std_hz: found.frequency_hz.max(law.frequency_hz),
        damping: pole.damping,
        damping_std: found.damping.max(law.damping),
        collinearity: phase_collinearity(&shape),
        channels: epoch.covariances.outputs.clone(),
        shape,
        shape_std,
        band_hz: epoch.band_hz,
        orders,
        kurtosis,
    })
}

/// Returns `true` if the amplitude at the frequency of a pole varies too little for random motion.
///
/// The motion of a mode that decays more slowly than within a segment is correlated from segment to
/// segment. Its amplitude may hardly vary, so it does not count.
fn has_line(epoch: &Epoch, pole: &Pole, kurtosis: Option<f64>) -> bool {
    epoch.spectrum.as_ref().is_some_and(|spectrum| {
        let decay_rate_hz = TAU * pole.damping * pole.frequency_hz;
        spectrum.segments() >= LEAST_SEGMENTS
            && decay_rate_hz > spectrum.step_hz()
            && kurtosis.is_some_and(|kurtosis| kurtosis < LINE_KURTOSIS)
    })
}

/// Returns the standard deviation of a mean of blocks from the first-order changes with each block,
/// σ² = Σ Δ² / (B (B − 1)) (12). The changes sum to zero.
fn std(changes: impl ExactSizeIterator<Item = f64>) -> f64 {
    let blocks = changes.len() as f64;
    let squares: f64 = changes.map(|change| change * change).sum();
    (squares / (blocks * (blocks - 1.0))).sqrt()
}

/// Returns the shape in the units of the channels, with 1 at the channel of the largest amplitude,
/// and the standard deviation of its real parts.
fn normalised(
    covariances: &EpochCovariances,
    pole: &Pole,
    changes: &[Change],
) -> (DVector<Complex<f64>>, Vec<f64>) {
    let in_units = |shape: &DVector<Complex<f64>>| {
        DVector::from_fn(shape.len(), |row, _| shape[row] * covariances.std[row])
    };
    let shape = in_units(&pole.shape);
    let top = largest(&shape);
    let scale = shape[top];
    let normalised = shape.map(|value| value / scale);
    // Δ(φ_c/φ_top) = (Δφ_c − (φ_c/φ_top) Δφ_top) / φ_top
    let deltas: Vec<DVector<Complex<f64>>> = changes
        .iter()
        .map(|change| {
            let delta = in_units(&change.shape);
            (&delta - &normalised * delta[top]).map(|value| value / scale)
        })
        .collect();
    let stds = (0..shape.len())
        .map(|row| std(deltas.iter().map(|delta| delta[row].re)))
        .collect();
    (normalised, stds)
}
