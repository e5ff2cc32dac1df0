//! The change of each stiffness since the commissioning, from the modes of one epoch.
//!
//! The deviations y of ln f and of the shapes from their means are compared with those of the
//! model, y = h(d) + e, with d the change of ln k. The covariance of e has
//!
//! - the stated covariances of the epoch and of the mean
//! - the scatter between epochs, whose variance has a few levels with probabilities
//! - the error of the model's effect: a share of the predicted deviations
//!
//! d has a normal prior. The posterior is a mixture of normal distributions, one for each pair of
//! levels. h is linearised anew at the posterior mean.

use super::observation::SeenMode;
use super::part_model::PartModel;
use super::reference::{Predicted, ReferenceMode, UpdateReference};
use super::scatter::{Level, Of};
use crate::ModalError;
use crate::normal::normal_cdf;
use nalgebra::{DMatrix, DVector};

/// Prior standard deviation of the change of ln k of a part.
const CHANGE_STD: f64 = 0.15;
/// Error of a predicted deviation, as a share of the root mean square of all of its kind.
const EFFECT_ERROR: f64 = 0.3;
/// Number of linearisations.
const LINEARISATIONS: usize = 3;
/// Range in which h is linearised.
const SMALLEST_CHANGE: f64 = -1.5;
const LARGEST_CHANGE: f64 = 0.7;
/// Probability at which a loss counts as found.
const FOUND: f64 = 0.99;
/// Its quantile of the normal distribution.
const FOUND_QUANTILE: f64 = 2.326_347_874_040_841;
/// Smallest share of a change that the estimate shows on average. Below it, the prior decides.
const LEAST_GAIN: f64 = 0.5;

/// The change of ln k of each part since the commissioning.
#[derive(Debug, Clone, PartialEq)]
pub struct StiffnessChange {
    components: Vec<Component>,
}

#[derive(Debug, Clone, PartialEq)]
struct Component {
    weight: f64,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
}

/// How precisely an epoch determines the change of each stiffness.
#[derive(Debug, Clone, PartialEq)]
pub struct UpdatePrecision {
    covariance: DMatrix<f64>,
}

/// Deviations of one kind with a common scatter: y, H and the covariance without the scatter.
struct Rows {
    of: Of,
    misfit: DVector<f64>,
    slope: DMatrix<f64>,
    stated: DMatrix<f64>,
    /// Variance of the scatter of this epoch and of the mean, per τ².
    scatter: f64,
}

/// The information of rows about d at one level of scatter.
struct Told {
    information: DMatrix<f64>,
    pull: DVector<f64>,
    /// Logarithm of the likelihood at d = 0, without its constant.
    log_likelihood: f64,
}

impl UpdateReference {
    /// Estimates the change of the stiffnesses from the modes of an epoch.
    ///
    /// The declared modes are in the order of the commissioning. A missing mode, or a shape of
    /// other channels, takes no part. Without any mode, the result is the prior.
    ///
    /// # Errors
    /// Returns an error if a decomposition fails.
    pub fn change(
        &self,
        model: &PartModel,
        epoch: &[Option<SeenMode>],
    ) -> Result<StiffnessChange, ModalError> {
        let start = self.predict(model, &self.ln_stiffness)?;
        let used = self.modes.iter().zip(epoch);
        let seen: Vec<Option<&SeenMode>> = used
            .filter(|(mode, _)| mode.is_some())
            .map(|(_, seen)| seen.as_ref())
            .collect();
        let mut at = DVector::zeros(model.parts());
        let mut change = None;
        for _ in 0..LINEARISATIONS {
            let here = self.predict(model, &(&self.ln_stiffness + &at))?;
            let rows = self.rows(&start, &here, &at, &seen);
            let found = self.posterior(&rows, model.parts())?;
            at = found.means();
            at.apply(|value| *value = value.clamp(SMALLEST_CHANGE, LARGEST_CHANGE));
            change = Some(found);
        }
        change.ok_or(ModalError::Model)
    }

    /// Returns how precisely an epoch like those of the commissioning determines each change.
    ///
    /// # Errors
    /// Returns an error if a decomposition fails.
    pub fn precision(&self, model: &PartModel) -> Result<UpdatePrecision, ModalError> {
        let start = self.predict(model, &self.ln_stiffness)?;
        let none = DVector::zeros(model.parts());
        let usual: Vec<SeenMode> = self.modes.iter().flatten().map(usual).collect();
        let seen: Vec<Option<&SeenMode>> = usual.iter().map(Some).collect();
        let mut rows = self.rows(&start, &start, &none, &seen);
        for rows in &mut rows {
            rows.misfit.fill(0.0);
        }
        let found = self.posterior(&rows, model.parts())?;
        let mut covariance = DMatrix::zeros(model.parts(), model.parts());
        // The deviations of such an epoch say nothing about the level of the scatter.
        let pairs = self.pairs();
        let weights: f64 = pairs.iter().map(|(weight, ..)| weight).sum();
        for (component, (weight, ..)) in found.components.iter().zip(&pairs) {
            covariance += &component.covariance * (weight / weights);
        }
        Ok(UpdatePrecision { covariance })
    }

    /// Returns the rows of the frequencies and of each shape.
    fn rows(
        &self,
        start: &[Predicted],
        here: &[Predicted],
        at: &DVector<f64>,
        seen: &[Option<&SeenMode>],
    ) -> Vec<Rows> {
        let parts = at.len();
        let modes = self.modes.iter().flatten().zip(seen);
        let modes: Vec<(usize, &ReferenceMode, &SeenMode)> = modes
            .enumerate()
            .filter_map(|(position, (mode, seen))| Some((position, mode, (*seen)?)))
            .collect();
        let mut frequencies = Rows {
            of: Of::Frequencies,
            misfit: DVector::zeros(modes.len()),
            slope: DMatrix::zeros(modes.len(), parts),
            stated: DMatrix::zeros(modes.len(), modes.len()),
            scatter: 1.0 + 1.0 / self.epochs.max(1) as f64,
        };
        let mut effects = DVector::zeros(modes.len());
        let mut shapes = Vec::new();
        for (row, (position, mode, seen)) in modes.iter().enumerate() {
            let (from, to) = (&start[*position], &here[*position]);
            let slope = &to.line.ln_frequency_by;
            effects[row] = to.line.ln_frequency - from.line.ln_frequency;
            let measured = seen.ln_frequency - mode.ln_frequency;
            frequencies.misfit[row] = measured - effects[row] + slope.dot(at);
            frequencies.slope.row_mut(row).copy_from(&slope.transpose());
            frequencies.stated[(row, row)] = seen.variance + mode.variance / mode.count;
            let of_shape = shape_rows(mode, seen, from, to, at);
            shapes.extend(of_shape);
        }
        add_effect_error(&mut frequencies.stated, effects.norm_squared(), modes.len());
        let squares: f64 = shapes.iter().map(|(_, effect)| effect.norm_squared()).sum();
        let values: usize = shapes.iter().map(|(_, effect)| effect.len()).sum();
        let shapes = shapes.into_iter().map(|(mut rows, _)| {
            add_effect_error(&mut rows.stated, squares, values);
            rows
        });
        std::iter::once(frequencies)
            .filter(|rows| !rows.misfit.is_empty())
            .chain(shapes)
            .collect()
    }

    /// Returns all pairs of levels with their probabilities.
    fn pairs(&self) -> Vec<(f64, &Level, &Level)> {
        let frequencies = self.frequency_levels.iter();
        frequencies
            .flat_map(|of_frequencies| {
                self.shape_levels.iter().map(move |of_shapes| {
                    let weight = of_frequencies.weight * of_shapes.weight;
                    (weight, of_frequencies, of_shapes)
                })
            })
            .collect()
    }

    fn posterior(&self, rows: &[Rows], parts: usize) -> Result<StiffnessChange, ModalError> {
        let failed = ModalError::NotConverged {
            what: "update of the stiffnesses",
        };
        let told = |of: Of, levels: &[Level]| -> Option<Vec<Told>> {
            let of_kind = || rows.iter().filter(|rows| rows.of == of);
            let at_level = |level: &Level| {
                let mut sum = Told {
                    information: DMatrix::zeros(parts, parts),
                    pull: DVector::zeros(parts),
                    log_likelihood: 0.0,
                };
                for rows in of_kind() {
                    sum.add(rows, level.variance)?;
                }
                Some(sum)
            };
            levels.iter().map(at_level).collect()
        };
        let of_frequencies = told(Of::Frequencies, &self.frequency_levels);
        let of_shapes = told(Of::Shapes, &self.shape_levels);
        let (of_frequencies, of_shapes) = of_frequencies.zip(of_shapes).ok_or(failed.clone())?;
        let prior = DMatrix::from_diagonal_element(parts, parts, CHANGE_STD.powi(-2));
        let both = of_frequencies
            .iter()
            .flat_map(|frequencies| of_shapes.iter().map(move |shapes| (frequencies, shapes)));
        let mut logs = Vec::new();
        let mut components = Vec::new();
        for ((weight, ..), (frequencies, shapes)) in self.pairs().into_iter().zip(both) {
            let information = &prior + &frequencies.information + &shapes.information;
            let factor = information.cholesky().ok_or_else(|| failed.clone())?;
            let pull = &frequencies.pull + &shapes.pull;
            let mean = factor.solve(&pull);
            let determinant: f64 = factor.l_dirty().diagonal().iter().map(|l| l.ln()).sum();
            let evidence =
                frequencies.log_likelihood + shapes.log_likelihood + 0.5 * pull.dot(&mean)
                    - determinant;
            logs.push(weight.ln() + evidence);
            components.push(Component {
                weight: 0.0,
                mean,
                covariance: factor.inverse(),
            });
        }
        let highest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let sum: f64 = logs.iter().map(|log| (log - highest).exp()).sum();
        for (component, log) in components.iter_mut().zip(logs) {
            component.weight = (log - highest).exp() / sum;
        }
        Ok(StiffnessChange { components })
    }
}

impl Told {
    /// Adds rows at a level of scatter. `None` if their covariance is not positive definite.
    fn add(&mut self, rows: &Rows, variance: f64) -> Option<()> {
        let pattern = rows.of.pattern(rows.misfit.len());
        let covariance = &rows.stated + pattern * (rows.scatter * variance);
        let lower = covariance.cholesky()?.unpack();
        let slope = lower.solve_lower_triangular(&rows.slope)?;
        let misfit = lower.solve_lower_triangular(&rows.misfit)?;
        let determinant: f64 = lower.diagonal().iter().map(|entry| entry.ln()).sum();
        self.information += slope.tr_mul(&slope);
        self.pull += slope.tr_mul(&misfit);
        self.log_likelihood -= determinant + 0.5 * misfit.norm_squared();
        Some(())
    }
}

/// Returns the rows of a shape with the effect of the change, if it is known now and then.
fn shape_rows(
    mode: &ReferenceMode,
    seen: &SeenMode,
    from: &Predicted,
    to: &Predicted,
    at: &DVector<f64>,
) -> Option<(Rows, DVector<f64>)> {
    let reference = mode.shape.as_ref()?;
    let seen = seen.shape.as_ref()?;
    let ((before, _), (now, slope)) = from.shape.as_ref().zip(to.shape.as_ref())?;
    if seen.values.len() != reference.frame.shape.len() {
        return None;
    }
    let effect = now - before;
    let stated = reference.frame.covariance(&seen.variances);
    let rows = Rows {
        of: Of::Shapes,
        misfit: reference.frame.deviation(&seen.values)? - &effect + slope * at,
        slope: slope.clone(),
        stated: stated + &reference.covariance / reference.count,
        scatter: 1.0 + 1.0 / reference.count,
    };
    Some((rows, effect))
}

fn add_effect_error(stated: &mut DMatrix<f64>, squares: f64, values: usize) {
    let variance = EFFECT_ERROR.powi(2) * squares / values.max(1) as f64;
    for position in 0..stated.nrows() {
        stated[(position, position)] += variance;
    }
}

/// Returns an epoch of a mode whose deviations are the usual ones.
fn usual(mode: &ReferenceMode) -> SeenMode {
    let shape = mode.shape.as_ref().map(|reference| {
        let len = reference.frame.shape.len();
        let variance = reference.covariance.trace() / (len - 1) as f64;
        crate::updating::observation::SeenShape {
            values: reference.frame.shape.clone(),
            variances: DVector::from_element(len, variance),
        }
    });
    SeenMode {
        ln_frequency: mode.ln_frequency,
        variance: mode.variance,
        shape,
    }
}

impl StiffnessChange {
    fn means(&self) -> DVector<f64> {
        let parts = self.components.first().map_or(0, |first| first.mean.len());
        let weighted = self.components.iter();
        weighted.fold(DVector::zeros(parts), |sum, component| {
            sum + &component.mean * component.weight
        })
    }

    /// Returns the number of parts.
    #[must_use]
    pub fn parts(&self) -> usize {
        self.components.first().map_or(0, |first| first.mean.len())
    }

    /// Returns the mean of the change of ln k of a part. 0 for a part that does not exist.
    #[must_use]
    pub fn mean(&self, part: usize) -> f64 {
        self.of(part).map(|(weight, mean, _)| weight * mean).sum()
    }

    /// Returns the standard deviation of the change of ln k of a part.
    #[must_use]
    pub fn std(&self, part: usize) -> f64 {
        let mean = self.mean(part);
        let of = self.of(part);
        let square: f64 = of
            .map(|(weight, own, std)| weight * (std * std + (own - mean).powi(2)))
            .sum();
        square.sqrt()
    }

    /// Returns the probability that the change of ln k of a part is below `value`.
    #[must_use]
    pub fn cdf(&self, part: usize, value: f64) -> f64 {
        self.of(part)
            .map(|(weight, mean, std)| weight * normal_cdf((value - mean) / std))
            .sum()
    }

    /// Returns the probability that a part has lost more than `loss` of its stiffness, a share from
    /// 0 to below 1.
    #[must_use]
    pub fn probability_of_loss(&self, part: usize, loss: f64) -> f64 {
        self.cdf(part, (1.0 - loss).ln())
    }

    /// Returns the value that the change of ln k of a part does not exceed with `probability`.
    #[must_use]
    pub fn quantile(&self, part: usize, probability: f64) -> f64 {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for (_, mean, std) in self.of(part) {
            low = low.min(mean - WIDEST * std);
            high = high.max(mean + WIDEST * std);
        }
        for _ in 0..BISECTIONS {
            let middle = 0.5 * (low + high);
            match self.cdf(part, middle) < probability {
                true => low = middle,
                false => high = middle,
            }
        }
        0.5 * (low + high)
    }

    /// Returns weight, mean and standard deviation of each component of a part.
    fn of(&self, part: usize) -> impl Iterator<Item = (f64, f64, f64)> {
        self.components.iter().filter_map(move |component| {
            let mean = component.mean.get(part)?;
            let std = component.covariance.get((part, part))?.sqrt();
            Some((component.weight, *mean, std))
        })
    }
}

/// Half-width of the search for a quantile, in standard deviations.
const WIDEST: f64 = 10.0;
/// Number of halvings of this range, until it is below the accuracy of numbers.
const BISECTIONS: usize = 60;

impl UpdatePrecision {
    /// Returns the standard deviation of the change of ln k of a part.
    #[must_use]
    pub fn std(&self, part: usize) -> f64 {
        self.covariance
            .get((part, part))
            .map_or(f64::NAN, |square| square.sqrt())
    }

    /// Returns the loss of stiffness of a part, as a share, that one epoch shows with a probability
    /// of 0.99 in half of the cases. `None` if the modes do not show the part: less than half of a
    /// change then appears in its estimate.
    #[must_use]
    pub fn smallest_loss(&self, part: usize) -> Option<f64> {
        let std = self.std(part);
        let gain = 1.0 - (std / CHANGE_STD).powi(2);
        (gain >= LEAST_GAIN).then(|| 1.0 - (-FOUND_QUANTILE * std / gain).exp())
    }

    /// Returns the correlation of the changes of two parts. Near −1, the modes determine their sum,
    /// but not which of them has changed.
    #[must_use]
    pub fn correlation(&self, one: usize, other: usize) -> f64 {
        let product = self.std(one) * self.std(other);
        self.covariance
            .get((one, other))
            .map_or(f64::NAN, |entry| entry / product)
    }

    /// Returns the probability at which [`Self::smallest_loss()`] counts a loss as found.
    #[must_use]
    pub fn found_at() -> f64 {
        FOUND
    }
}

#[cfg(test)]
mod tests;
