//! Information of a record about a linear structure by frequency, and the estimates under a wrong
//! model.
//!
//! At each frequency the sensors show `z = G f + n`. For `f`, the filter knows the measured part
//! with the spectrum `Σ_k`. It assumes that the rest is white with the covariance `Σ_u`. The
//! unpredictable part of `z` has the spectrum `Φ = G Σ_u Gᴴ + R`. One frame contains the
//! information
//!
//! `I_ij = Σ_ω Re tr(Σ_k ∂_iGᴴ Φ⁻¹ ∂_jG) + ½ Re tr(Φ⁻¹ ∂_iΦ Φ⁻¹ ∂_jΦ)`
//!
//! (Whittle 1953, *Arkiv för Matematik* 2, 423). If the truth is `G_t` and `Φ_t`, with
//! `ΔG = G_t − G`, the expected slope of the log-likelihood is
//!
//! `s_i = Σ_ω Re tr(Σ_k ∂_iGᴴ Φ⁻¹ ΔG) + ½ Re tr(Φ⁻¹ ∂_iΦ Φ⁻¹ (Φ_t + ΔG Σ_k ΔGᴴ − Φ))`.
//!
//! The estimates converge to the point where this slope vanishes (White 1982, *Econometrica*
//! 50, 1). No data are simulated.

use crate::noise_level::{NoiseLevel, NoiseSource};
use crate::spectrum::{Complexes, Frequency, Linearised, Response, complex_product, frequencies};
use crate::structure::Structure;
use nalgebra::{Complex, DMatrix, DVector, DVectorViewMut};
use rayon::prelude::*;

/// Number of frequencies whose terms are computed in parallel and then added in order. The limit
/// saves memory, and the order makes the sum the same on every machine.
const AT_ONCE: usize = 16;

/// A quantity with respect to which a model of the structure is differentiated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Direction {
    /// A parameter (from 0), a ratio to nominal.
    Parameter(usize),
    /// The logarithm of the variance of a noise level (from 0).
    Level(usize),
    /// The logarithm of the spectrum of an excitation (its level, from 0) around one octave.
    Colour { level: usize, octave: usize },
}

/// A structure with values for all its parameters and noise levels.
#[derive(Debug, Clone)]
pub(crate) struct SpectralModel<'s> {
    structure: &'s Structure,
    linearised: Linearised,
    /// Contribution of each noise level to `Σ_u` (N_f × N_f) or to the variances of the sensors
    /// (N_0).
    parts: Vec<Part>,
    /// `Σ_u` (N_f × N_f) and the diagonal of `R` (N_0).
    unknown: Complexes,
    noise: DVector<f64>,
    /// Root of `Σ_k` of each component: the measured part, 0 if no channel measures it.
    known: Vec<f64>,
}

#[derive(Debug, Clone)]
enum Part {
    Excitation(Complexes),
    Sensors(DVector<f64>),
}

/// What the sensors show at one frequency, seen through `V` with `V Φ Vᴴ = I`.
struct Whitened {
    /// `V` (N_0 × N_0) and `V G` (N_0 × N_f).
    by: Complexes,
    transfer: Complexes,
    /// `V G_t` and `V ΔG Σ_k^½` (N_0 × N_f); `None` if the model is right.
    truth: Option<[Complexes; 2]>,
    /// `ln |Φ| + tr(Φ⁻¹ Φ_t)` up to a constant.
    misfit: f64,
}

/// Information and expected slope of the log-likelihood per frame, in the order of the directions.
#[derive(Debug, Clone)]
pub(crate) struct Sums {
    pub(crate) information: DMatrix<f64>,
    pub(crate) slope: DVector<f64>,
    /// Minus twice the expected log-likelihood, up to a constant.
    pub(crate) misfit: f64,
}

impl<'s> SpectralModel<'s> {
    /// Creates the model at `theta` (ratios to nominal), with a variance for each noise level.
    pub(crate) fn new(structure: &'s Structure, theta: &[f64], variances: &[f64]) -> Self {
        let parts: Vec<Part> = structure
            .noise_levels
            .iter()
            .zip(variances)
            .map(|(level, variance)| part(structure, level, *variance))
            .collect();
        let inputs = structure.excitation_channels.len();
        let mut unknown = Complexes::zeros(inputs, inputs);
        let mut noise = DVector::zeros(structure.observation_channels.len());
        for part in &parts {
            match part {
                Part::Excitation(covariance) => unknown += covariance,
                Part::Sensors(variances) => noise += variances,
            }
        }
        let known = |excitation: &crate::Excitation| {
            let known = excitation
                .channel()
                .map_or(0.0, |_| excitation.std().hypot(excitation.unknown_std()));
            std::iter::repeat_n(known, excitation.component_len())
        };
        let known = structure.excitations.iter().flat_map(known).collect();
        Self {
            structure,
            linearised: Linearised::new(structure, theta),
            parts,
            unknown,
            noise,
            known,
        }
    }

    /// Sums the information of the model about `directions` over all frequencies, for data from
    /// `truth`.
    ///
    /// The parameters come first in `directions`. If `truth` is `None`, the model is right. The
    /// result is `None` if some frequency has no finite response.
    pub(crate) fn sums(&self, truth: Option<&Self>, directions: &[Direction]) -> Option<Sums> {
        let mut products = DMatrix::zeros(directions.len() + 1, directions.len() + 1);
        let mut misfit = 0.0;
        let slopes = self.linearised.slopes(self.structure);
        for some in self.frequencies(truth).chunks(AT_ONCE) {
            let responses = self.linearised.responses(&slopes, some)?;
            let term = |(frequency, own): (&Frequency, &Response)| {
                let (product, misfit) = self.products(truth, own, frequency.omega, directions)?;
                Some((frequency.weight, product, misfit))
            };
            let terms: Vec<_> = some.par_iter().zip(&responses).map(term).collect();
            for term in terms {
                let (weight, product, at) = term?;
                misfit += weight * at;
                products += product * weight;
            }
        }
        let known = directions.len();
        Some(Sums {
            information: products.view((0, 0), (known, known)).into_owned(),
            slope: products.view((0, known), (known, 1)).column(0).into_owned(),
            misfit,
        })
    }

    /// Returns the misfit of [`Sums`] alone, for data from `truth`.
    pub(crate) fn misfit(&self, truth: &Self) -> Option<f64> {
        let term = |frequency: &Frequency| {
            let transfer = self.linearised.transfer(frequency.omega)?;
            let whitened = self.whitened(Some(truth), &transfer, frequency.omega)?;
            Some(frequency.weight * whitened.misfit)
        };
        let terms: Vec<_> = self.frequencies(Some(truth)).par_iter().map(term).collect();
        terms.into_iter().sum()
    }

    /// Returns the frequencies that resolve the resonances of the model and of the truth.
    fn frequencies(&self, truth: Option<&Self>) -> Vec<Frequency> {
        let resolved: Vec<&Linearised> = std::iter::once(self)
            .chain(truth)
            .map(|model| &model.linearised)
            .collect();
        frequencies(&resolved, self.structure.step_s())
    }

    /// Returns the view through `V` at one frequency, where the model has the given transfer `G`.
    ///
    /// With `R^-½ G = Q [T; 0]` and `I + T Σ_u Tᴴ = C Cᴴ`, `V = [C⁻¹, 0; 0, I] Qᴴ R^-½`. `V G` is
    /// then zero but for its first N_f rows.
    fn whitened(&self, truth: Option<&Self>, transfer: &Complexes, omega: f64) -> Option<Whitened> {
        let (outputs, inputs) = transfer.shape();
        let first = outputs.min(inputs);
        let scale = self
            .noise
            .map(|variance| Complex::from(variance.sqrt().recip()));
        let mut by = Complexes::from_diagonal(&scale);
        let qr = (&by * transfer).qr();
        qr.q_tr_mul(&mut by);
        let t = qr.r();
        let inner = Complexes::identity(first, first) + &t * &self.unknown * t.adjoint();
        let c = inner.cholesky()?.unpack();
        let mut seen = Complexes::zeros(outputs, inputs);
        seen.rows_mut(0, first).copy_from(&t);
        for rows in [&mut by, &mut seen] {
            c.solve_lower_triangular_mut(&mut rows.rows_mut(0, first));
        }
        let size = |factor: &Complexes| factor.diagonal().map(|entry| entry.re.ln()).sum();
        let mut whitened = Whitened {
            misfit: self.noise.map(f64::ln).sum() + 2.0 * size(&c),
            transfer: seen,
            truth: None,
            by,
        };
        if let Some(truth) = truth {
            let other = truth.linearised.transfer(omega)?;
            let error = scaled_columns(&(&other - transfer), &self.known); // ΔG Σ_k^½
            let [other, error] = [&whitened.by * other, &whitened.by * error];
            let unknown = |seen: &Complexes, covariance: &Complexes| {
                (seen * covariance).dotc(seen).re // tr(V G Σ_u Gᴴ Vᴴ)
            };
            let noise = (0..outputs).map(|row| {
                let excess = truth.noise[row] - self.noise[row];
                excess * whitened.by.column(row).norm_squared()
            });
            whitened.misfit += unknown(&other, &truth.unknown)
                - unknown(&whitened.transfer, &self.unknown)
                + error.norm_squared()
                + noise.sum::<f64>();
            whitened.truth = Some([other, error]);
        }
        Some(whitened)
    }

    /// Returns the terms of the sums for all pairs of directions, with the truth as the last one,
    /// and the misfit.
    ///
    /// The misfit is `ln |Φ| + tr(Φ⁻¹ Φ_t)`, in which `Φ_t` includes the part that the known
    /// excitation leaves unexplained.
    ///
    /// The terms are products of real columns. All matrices are seen through `V`. `V ∂Φ Vᴴ` of a
    /// parameter is then zero outside its first N_f rows and columns, and no more of it is
    /// computed.
    fn products(
        &self,
        truth: Option<&Self>,
        own: &Response,
        omega: f64,
        directions: &[Direction],
    ) -> Option<(DMatrix<f64>, f64)> {
        let seen = self.whitened(truth, &own.transfer, omega)?;
        let slopes = complex_product(&seen.by, &own.slopes); // V ∂G
        let (outputs, inputs) = own.transfer.shape();
        let parameters = directions
            .iter()
            .take_while(|direction| matches!(direction, Direction::Parameter(_)))
            .count();
        let (all, first) = (directions.len() + 1, inputs.min(outputs));
        let remaining = (outputs - first) * (outputs - first);
        let rows = outputs * outputs - remaining + 2 * outputs * inputs;
        let mut columns = DMatrix::zeros(rows, all);
        let mut others = DMatrix::zeros(remaining, all - parameters);
        let mut put = |at: usize, of_phi: &Complexes, of_g: Option<&Complexes>| {
            let column = columns.column_mut(at);
            let other = at.checked_sub(parameters);
            stack(of_phi, of_g, column, other.map(|at| others.column_mut(at)));
        };
        for (at, direction) in directions.iter().enumerate() {
            let (of_phi, of_g) = self.derivatives(&seen, &slopes, *direction, omega);
            put(at, &of_phi, of_g.as_ref());
        }
        if let (Some(truth), Some([other, error])) = (truth, &seen.truth) {
            let mut excess = other * &truth.unknown * other.adjoint() + error * error.adjoint()
                - &seen.transfer * &self.unknown * seen.transfer.adjoint();
            excess += diagonal_whitened(&(&truth.noise - &self.noise), &seen.by);
            put(directions.len(), &excess, Some(error));
        }
        let mut products = columns.transpose() * columns;
        let mut of_others = products.view_range_mut(parameters.., parameters..);
        of_others += others.transpose() * &others;
        Some((products, seen.misfit))
    }

    /// Returns `V ∂Φ Vᴴ` and `V ∂G Σ_k^½` in a direction, from `V ∂G` (`slopes`) of all parameters.
    ///
    /// The first has only the columns that can differ from zero. The second is `None` if it is
    /// zero.
    fn derivatives(
        &self,
        seen: &Whitened,
        slopes: &Complexes,
        direction: Direction,
        omega: f64,
    ) -> (Complexes, Option<Complexes>) {
        match direction {
            Direction::Parameter(parameter) => {
                let (outputs, inputs) = seen.transfer.shape();
                let slope = slopes.columns(parameter * inputs, inputs).into_owned();
                let first = outputs.min(inputs);
                let transfer = seen.transfer.rows(0, first);
                let mut of_phi = &slope * &self.unknown * transfer.adjoint(); // V ∂G Σ_u Gᴴ Vᴴ
                let mirrored = of_phi.rows(0, first).adjoint();
                let mut top = of_phi.rows_mut(0, first);
                top += mirrored;
                (of_phi, Some(scaled_columns(&slope, &self.known)))
            }
            Direction::Level(level) => (self.parts[level].whitened(seen), None),
            Direction::Colour { level, octave } => {
                let share = self.structure.octave_share(octave, omega);
                let whole = self.parts[level].whitened(seen);
                (whole * Complex::new(share, 0.0), None)
            }
        }
    }

    /// Returns the standard deviation of each observation row without sensor noise, and a frequency
    /// limit.
    ///
    /// The `share` of all motion, weighted by sensor noise, is below this limit (rad/s).
    pub(crate) fn motion(&self, share: f64) -> Option<(DVector<f64>, f64)> {
        let mut excitation = self.unknown.clone();
        self.known
            .iter()
            .enumerate()
            .for_each(|(input, known)| excitation[(input, input)] += known * known);
        let mut variances = DVector::zeros(self.noise.len());
        let mut seen = Vec::new();
        for Frequency { omega, weight } in frequencies(&[&self.linearised], self.structure.step_s())
        {
            let g = self.linearised.transfer(omega)?;
            let spectrum = (&g * &excitation * g.adjoint())
                .diagonal()
                .map(|entry| entry.re * weight);
            seen.push((omega, spectrum.component_div(&self.noise).sum()));
            variances += spectrum;
        }
        let all: f64 = seen.iter().map(|(_, part)| part).sum();
        let mut below = 0.0;
        let reached = seen.iter().find(|(_, part)| {
            below += part;
            below >= share * all
        });
        Some((variances.map(f64::sqrt), reached?.0))
    }
}

impl Part {
    /// Returns its contribution to `V Φ Vᴴ` (N_0 × N_0).
    fn whitened(&self, seen: &Whitened) -> Complexes {
        match self {
            Self::Excitation(covariance) => &seen.transfer * covariance * seen.transfer.adjoint(),
            Self::Sensors(variances) => diagonal_whitened(variances, &seen.by),
        }
    }
}

/// Returns `V D Vᴴ` for a diagonal `D`, from `V`.
fn diagonal_whitened(diagonal: &DVector<f64>, whiten: &Complexes) -> Complexes {
    let own: Vec<usize> = (0..diagonal.len())
        .filter(|row| diagonal[*row] != 0.0)
        .collect();
    let entries: Vec<f64> = own.iter().map(|row| diagonal[*row]).collect();
    let columns = whiten.select_columns(&own);
    complex_product(&scaled_columns(&columns, &entries), &columns.adjoint())
}

fn part(structure: &Structure, level: &NoiseLevel, variance: f64) -> Part {
    match level.source() {
        NoiseSource::Excitation(index) => Part::Excitation(
            structure
                .excitation_pattern(*index)
                .map(|entry| Complex::new(entry * variance, 0.0)),
        ),
        NoiseSource::Sensors(rows) => {
            let every = structure.frames_per_sample();
            let mut variances = DVector::zeros(structure.observation_channels.len());
            for row in rows {
                // A slower node contains as much information as a node with a proportionally larger
                // variance at each frame.
                variances[*row] = variance * every[structure.observation_channels[*row]] as f64;
            }
            Part::Sensors(variances)
        }
    }
}

/// Returns `X` with each column scaled by its factor.
fn scaled_columns(x: &Complexes, factors: &[f64]) -> Complexes {
    let mut scaled = x.clone();
    for (mut column, factor) in scaled.column_iter_mut().zip(factors) {
        column *= Complex::new(*factor, 0.0);
    }
    scaled
}

/// Writes a Hermitian matrix with weight ½, and a matrix with weight 1, into real columns of zeros.
///
/// The Hermitian matrix has all rows, and possibly only its first columns. Its entries above the
/// diagonal repeat those below it, which count twice instead. Its last entries fill `other`.
fn stack(
    half: &Complexes,
    full: Option<&Complexes>,
    mut column: DVectorViewMut<'_, f64>,
    other: Option<DVectorViewMut<'_, f64>>,
) {
    let mut entries = Vec::with_capacity(half.len());
    for at in 0..half.ncols() {
        entries.push(half[(at, at)].re * 0.5_f64.sqrt());
        for row in at + 1..half.nrows() {
            entries.extend([half[(row, at)].re, half[(row, at)].im]);
        }
    }
    let first = entries.len() - other.as_ref().map_or(0, DVectorViewMut::len);
    column.rows_mut(0, first).copy_from_slice(&entries[..first]);
    if let Some(mut other) = other {
        other.copy_from_slice(&entries[first..]);
    }
    for (place, entry) in full.into_iter().flatten().enumerate() {
        column[first + 2 * place] = entry.re;
        column[first + 2 * place + 1] = entry.im;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::information::Information;
    use std::path::Path;

    const DEMO: &str = include_str!("../../../docs/examples/demo.toml");
    const OUTPUT_ONLY: &str = include_str!("../../../docs/examples/output-only.toml");

    fn parse(text: &str) -> Structure {
        Structure::parse(text, Path::new("example.toml")).unwrap_or_else(|error| panic!("{error}"))
    }

    /// Returns `Φ` (N_0 × N_0), the spectrum of the unpredictable part.
    fn unpredicted(model: &SpectralModel<'_>, transfer: &Complexes) -> Complexes {
        transfer * &model.unknown * transfer.adjoint()
            + Complexes::from_diagonal(&model.noise.map(Complex::from))
    }

    /// Returns the sums as the formulas of this module state them, without whitening.
    fn plain(
        model: &SpectralModel<'_>,
        truth: &SpectralModel<'_>,
        directions: &[Direction],
    ) -> (DMatrix<f64>, DVector<f64>) {
        let len = directions.len();
        let (mut information, mut slope) = (DMatrix::zeros(len, len), DVector::zeros(len));
        let resolved = [&model.linearised, &truth.linearised];
        let slopes = model.linearised.slopes(model.structure);
        let squared = model.known.iter().map(|known| Complex::from(known * known));
        let known = Complexes::from_diagonal(&DVector::from_iterator(model.known.len(), squared));
        for frequency in frequencies(&resolved, model.structure.step_s()) {
            let found = model.linearised.responses(&slopes, &[frequency]).unwrap();
            let g = &found[0].transfer;
            let other = truth.linearised.transfer(frequency.omega).unwrap();
            let phi = unpredicted(model, g);
            let inverse = phi.clone().try_inverse().unwrap();
            let error = &other - g;
            let excess = unpredicted(truth, &other) + &error * &known * error.adjoint() - phi;
            let of_part = |level: usize| match &model.parts[level] {
                Part::Excitation(covariance) => g * covariance * g.adjoint(),
                Part::Sensors(variances) => Complexes::from_diagonal(&variances.map(Complex::from)),
            };
            let derivatives = |direction: &Direction| match direction {
                Direction::Parameter(parameter) => {
                    let inputs = g.ncols();
                    let of_g = found[0].slopes.columns(*parameter * inputs, inputs);
                    let of_g = of_g.into_owned();
                    let half = &of_g * &model.unknown * g.adjoint();
                    (&half + half.adjoint(), of_g)
                }
                Direction::Level(level) => (of_part(*level), &error * Complex::from(0.0)),
                Direction::Colour { level, octave } => {
                    let share = model.structure.octave_share(*octave, frequency.omega);
                    let of_phi = of_part(*level) * Complex::from(share);
                    (of_phi, &error * Complex::from(0.0))
                }
            };
            let all: Vec<_> = directions.iter().map(derivatives).collect();
            let term =
                |(of_phi, of_g): &(Complexes, Complexes), by_phi: &Complexes, by_g: &Complexes| {
                    let full: Complexes = &known * of_g.adjoint() * &inverse * by_g;
                    let half: Complexes = &inverse * of_phi * &inverse * by_phi;
                    frequency.weight * (full.trace().re + 0.5 * half.trace().re)
                };
            for (row, own) in all.iter().enumerate() {
                slope[row] += term(own, &excess, &error);
                for (column, (by_phi, by_g)) in all.iter().enumerate() {
                    information[(row, column)] += term(own, by_phi, by_g);
                }
            }
        }
        (information, slope)
    }

    #[test]
    fn sums_are_those_of_the_formulas() {
        for text in [DEMO, OUTPUT_ONLY] {
            let structure = parse(text);
            let mut other = structure.clone();
            other.system.damping = structure.system.damping.times(1.5);
            let (means, variances) = (structure.prior_means(), structure.expected_variances());
            let louder: Vec<f64> = variances.iter().map(|variance| 1.3 * variance).collect();
            let model = SpectralModel::new(&structure, &means, &variances);
            let truth = SpectralModel::new(&other, &means, &louder);
            let mut directions: Vec<Direction> =
                (0..means.len()).map(Direction::Parameter).collect();
            for level in 0..variances.len() {
                directions.push(Direction::Level(level));
                directions.push(Direction::Colour { level, octave: 2 });
            }
            let found = model.sums(Some(&truth), &directions).unwrap();
            let (information, slope) = plain(&model, &truth, &directions);
            // Relative to the diagonal, because the directions have different units.
            let scale = |index: usize| information[(index, index)].sqrt();
            for row in (0..directions.len()).filter(|row| scale(*row) > 0.0) {
                let apart = (found.slope[row] - slope[row]).abs();
                assert!(
                    apart < 1e-8 * scale(row),
                    "slope {:?}: {apart}",
                    directions[row]
                );
                for column in (0..directions.len()).filter(|column| scale(*column) > 0.0) {
                    let entry = (row, column);
                    let apart = (found.information[entry] - information[entry]).abs();
                    assert!(
                        apart < 1e-8 * scale(row) * scale(column),
                        "{:?} with {:?}: {apart}",
                        directions[row],
                        directions[column]
                    );
                }
            }
        }
    }

    /// Both methods count the same information: one in time with filters on simulated data, the
    /// other by frequency without data.
    #[test]
    fn spectral_information_agrees_with_that_of_the_innovations() {
        for text in [DEMO, OUTPUT_ONLY] {
            let structure = parse(text);
            let simulated = Information::expected(&structure, 6000, 1, &|_| {})
                .unwrap()
                .held;
            let means: Vec<f64> = structure
                .parameters
                .iter()
                .map(crate::Parameter::mean)
                .collect();
            let model = SpectralModel::new(&structure, &means, &structure.expected_variances());
            let theta = means.len();
            let levels = (0..structure.noise_levels.len()).map(Direction::Level);
            let directions: Vec<Direction> =
                (0..theta).map(Direction::Parameter).chain(levels).collect();
            let Sums {
                information, slope, ..
            } = model.sums(Some(&model), &directions).unwrap();
            for index in 0..directions.len() {
                let (found, expected) = (information[(index, index)], simulated[(index, index)]);
                // 60 s of a 1 Hz mode with 2 % damping contain about ten independent amplitudes.
                // The measured excitation's share therefore deviates by 20 %. A held excitation is
                // also 2 % weaker at 10 Hz.
                assert!(
                    (found / expected - 1.0).abs() < 0.5,
                    "{:?}: {found} for {expected}",
                    directions[index]
                );
            }
            assert!(slope.amax() < 1e-9, "the truth pulls nothing: {slope}");
        }
    }
}
