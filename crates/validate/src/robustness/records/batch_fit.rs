//! Reference for a record: a batch fit of one stiffness ratio to the whole record, without any
//! filter.
//!
//! The response of the model to the measured ground motion is integrated for a given ratio. The fit
//! is the ratio with the smallest squared difference from the record. The same integration creates
//! records of a damaged structure.

use nalgebra::{DMatrix, DVector};
use spandrel_filter::{BandLimit, ObservationModel, ProcessModel};
use spandrel_sensor::Row;
use spandrel_structure::Structure;

/// Range and tolerance of the search for a ratio. Far from 1, the squared difference of a short
/// record has other minima.
const RANGE: (f64, f64) = (0.5, 1.6);
const TOLERANCE: f64 = 1e-4;

/// Response of a linear structure to the recorded excitation.
pub(super) struct Replay<'s> {
    structure: &'s Structure,
}

/// The exact recursion over one step for an excitation that is linear between samples: x' = Φ x +
/// Γ₀ f + Γ₁ (f' − f), z = H x + D f.
struct Recursion {
    transition: DMatrix<f64>,
    held: DMatrix<f64>,
    ramp: DMatrix<f64>,
    observation: DMatrix<f64>,
    direct: DMatrix<f64>,
}

impl Recursion {
    fn new(structure: &Structure, theta: &[f64]) -> Self {
        let mut model = structure.model();
        let (all, inputs, outputs) = (
            model.state_len(),
            model.excitation_len(),
            model.observation_len(),
        );
        let n = all - theta.len();
        let mut rest = vec![0.0; n];
        rest.extend_from_slice(theta);
        let none = vec![0.0; inputs];
        let identity = DMatrix::identity(all, n);
        let (mut jacobian, mut input) = (DMatrix::zeros(all, n), DMatrix::zeros(all, inputs));
        model.linearise_process(&rest, &none);
        model.jacobian_mul(&identity, &mut jacobian);
        model.excitation_matrix(&mut input);
        let mut observation = DMatrix::zeros(outputs, n);
        model.linearise_observation(&rest, &none);
        model.observation_jacobian_mul(&identity, &mut observation);
        // The matrix exp([[A, B, 0], [0, 0, I], [0, 0, 0]]·Δt) contains Φ, Γ₀ and, up to the factor
        // Δt, Γ₁. Source: C. F. Van Loan, Computing integrals involving the matrix exponential,
        // IEEE Trans. Autom. Control 23 (1978), 395-404.
        let step_s = structure.step_s();
        let mut block = DMatrix::zeros(n + 2 * inputs, n + 2 * inputs);
        block
            .view_mut((0, 0), (n, n))
            .copy_from(&(jacobian.rows(0, n) * step_s));
        block
            .view_mut((0, n), (n, inputs))
            .copy_from(&(input.rows(0, n) * step_s));
        block
            .view_mut((n, n + inputs), (inputs, inputs))
            .fill_with_identity();
        let exponential = block.exp();
        Self {
            transition: exponential.view((0, 0), (n, n)).into_owned(),
            held: exponential.view((0, n), (n, inputs)).into_owned(),
            ramp: exponential.view((0, n + inputs), (n, inputs)).into_owned(),
            direct: direct(&mut model, &rest),
            observation,
        }
    }
}

/// Returns the direct effect of each component of the excitation on the observed channels.
fn direct(model: &mut impl ObservationModelWithInputs, rest: &[f64]) -> DMatrix<f64> {
    let (inputs, outputs) = (model.excitation_len(), model.observation_len());
    let mut direct = DMatrix::zeros(outputs, inputs);
    for input in 0..inputs {
        let mut excitation = vec![0.0; inputs];
        excitation[input] = 1.0;
        let mut observed = vec![0.0; outputs];
        model.linearise_observation(rest, &excitation);
        model.observe(&mut observed);
        direct.set_column(input, &DVector::from_vec(observed));
    }
    direct
}

/// A model that describes both the process and the observation.
trait ObservationModelWithInputs: ProcessModel + ObservationModel {}

impl<M: ProcessModel + ObservationModel> ObservationModelWithInputs for M {}

impl<'s> Replay<'s> {
    pub(super) fn new(structure: &'s Structure) -> Self {
        Self { structure }
    }

    /// Returns the observed channels (frames × channels, SI) of a structure with these stiffness
    /// ratios, from rest.
    ///
    /// A missing sample of the excitation counts as 0.
    pub(super) fn response(&self, rows: &[Row], theta: &[f64]) -> Vec<DVector<f64>> {
        let recursion = Recursion::new(self.structure, theta);
        let mut state = DVector::zeros(recursion.transition.nrows());
        let mut before: Option<DVector<f64>> = None;
        let mut responses = Vec::with_capacity(rows.len());
        for row in rows {
            let now = self.excitation(row);
            if let Some(before) = before {
                state = &recursion.transition * state
                    + &recursion.held * &before
                    + &recursion.ramp * (&now - &before);
            }
            responses.push(&recursion.observation * &state + &recursion.direct * &now);
            before = Some(now);
        }
        responses
    }

    /// Returns the common ratio of all parameters whose response is closest to the rows from index
    /// `from` on.
    ///
    /// Also returns the unexplained share of the mean square. Both apply to the declared frequency
    /// band.
    pub(super) fn fit(&self, rows: &[Row], from: usize) -> (f64, f64) {
        let rows = &self.limited(rows);
        let parameters = self.structure.parameters().len();
        let observed = self.structure.observation_channels();
        let squares = |row: &Row| {
            observed
                .iter()
                .map(|channel| row.values[*channel].powi(2))
                .sum::<f64>()
        };
        let whole: f64 = rows
            .iter()
            .skip(from)
            .map(squares)
            .filter(|square| square.is_finite())
            .sum();
        let mut misfit = |ratio: f64| self.misfit(rows, &vec![ratio; parameters], from) / whole;
        let ratio = least(RANGE, TOLERANCE, &mut misfit);
        (ratio, misfit(ratio))
    }

    fn misfit(&self, rows: &[Row], theta: &[f64], from: usize) -> f64 {
        let responses = self.response(rows, theta);
        let of_row = |(row, response): (&Row, &DVector<f64>)| -> f64 {
            let channels = self
                .structure
                .observation_channels()
                .iter()
                .zip(response.iter());
            channels
                .map(|(channel, value)| (row.values[*channel] - value).powi(2))
                .sum()
        };
        rows.iter()
            .zip(&responses)
            .skip(from)
            .map(of_row)
            .filter(|square| square.is_finite())
            .sum()
    }

    /// Returns the rows limited to the declared band. A linear structure obeys the same equation if
    /// input and output pass the same filter.
    fn limited(&self, rows: &[Row]) -> Vec<Row> {
        let mut rows = rows.to_vec();
        let rate_hz = self.structure.sampling_rate_hz();
        let declared = self.structure.band_limit();
        let filter = declared.and_then(|declared| {
            BandLimit::low_pass(
                declared.order,
                declared.frequency_hz,
                rate_hz,
                rows.first()?.values.len(),
            )
            .ok()
        });
        if let Some(mut filter) = filter {
            rows.iter_mut()
                .for_each(|row| filter.apply(&mut row.values));
        }
        rows
    }

    fn excitation(&self, row: &Row) -> DVector<f64> {
        let channels = self.structure.excitation_channels();
        let value = |channel: &Option<usize>| {
            channel
                .and_then(|c| row.values.get(c).copied())
                .unwrap_or(0.0)
        };
        let values = channels
            .iter()
            .map(value)
            .map(|value| if value.is_finite() { value } else { 0.0 });
        DVector::from_iterator(channels.len(), values)
    }
}

/// Returns the position of the minimum: a coarse search, then golden sections of the best interval.
fn least((low, high): (f64, f64), tolerance: f64, of: &mut impl FnMut(f64) -> f64) -> f64 {
    const COARSE: usize = 20;
    let width = (high - low) / (COARSE - 1) as f64;
    let place = |index: usize| low + width * index as f64;
    let values: Vec<f64> = (0..COARSE).map(|index| of(place(index))).collect();
    let best = (0..COARSE)
        .min_by(|a, b| values[*a].total_cmp(&values[*b]))
        .unwrap_or(0);
    let (mut a, mut b) = (
        (place(best) - width).max(low),
        (place(best) + width).min(high),
    );
    let golden = (5f64.sqrt() - 1.0) / 2.0;
    while b - a > tolerance {
        let (left, right) = (b - golden * (b - a), a + golden * (b - a));
        if of(left) < of(right) {
            b = right;
        } else {
            a = left;
        }
    }
    (a + b) / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    /// Returns rows simulated with the file of the bridge by `spandrel-structure`, which uses
    /// another recursion.
    fn simulated(structure: &Structure) -> Vec<Row> {
        let frames = structure.clean_simulator(1).take(3000);
        frames
            .map(|frame| Row {
                time_ns: frame.index as i64 * 10_000_000,
                values: frame.values,
            })
            .collect()
    }

    #[test]
    fn fit_of_a_simulated_record_returns_the_simulated_stiffness() {
        let structure = Structure::parse(
            crate::robustness::records::bridge::FILE,
            Path::new("bridge.toml"),
        )
        .unwrap();
        let (ratio, left) = Replay::new(&structure).fit(&simulated(&structure), 0);
        // The low-pass filter assumes that the first value of a channel lasted for ever. The
        // structure instead starts at rest.
        assert!(
            (ratio - 1.0).abs() < 1e-3 && left < 1e-3,
            "{ratio}, leaves {left}"
        );
    }

    #[test]
    fn response_agrees_with_the_simulator() {
        let structure = Structure::parse(
            crate::robustness::records::bridge::FILE,
            Path::new("bridge.toml"),
        )
        .unwrap();
        let rows = simulated(&structure);
        let responses = Replay::new(&structure).response(&rows, &[1.0]);
        let observed = structure.observation_channels();
        let largest = rows
            .iter()
            .map(|row| row.values[observed[1]].abs())
            .fold(0.0, f64::max);
        for (row, response) in rows.iter().zip(&responses).skip(1) {
            assert!(
                (row.values[observed[1]] - response[1]).abs() < 1e-6 * largest,
                "{row:?} {response}"
            );
        }
    }
}
