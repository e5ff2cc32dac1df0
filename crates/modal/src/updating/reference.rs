//! The reference of the stiffnesses, from the epochs of the commissioning.
//!
//! The mean frequencies and shapes of the commissioning calibrate the model: the stiffnesses x_ref
//! are the most probable ones under the prior and a stated error of the model. Later epochs are
//! compared with the measured means, so that the error of the model cancels to first order. The
//! calibrated model only provides the sensitivities.

use super::observation::{Frame, SeenMode};
use super::part_model::{ModeLine, PartModel};
use super::scatter::{Deviation, Level, Of, levels, rms};
use crate::ModalError;
use crate::tracking::LEAST_PRESENCE;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Standard deviation of the error of the model in ln f, of each mode and of all in common: masses
/// that are wrong by some 5 to 10 %.
const FREQUENCY_ERROR: f64 = 0.03;
/// Standard deviation of the error of the model in the values of a shape of unit norm.
const SHAPE_ERROR: f64 = 0.1;
/// Largest |Δ ln f| between a declared mode and the mode of the model as designed.
const LARGEST_DISTANCE: f64 = 0.35;
/// Smallest MAC between them.
const LEAST_MAC: f64 = 0.4;
/// Scale of 1 − MAC that counts as much as [`LARGEST_DISTANCE`].
const MAC_SCALE: f64 = 0.6;
/// Relative distance of two frequencies of the model below which the shapes are not used. They turn
/// into each other after small changes.
const LEAST_GAP: f64 = 0.02;
/// Largest number of steps of the calibration, and the largest change of ln k in each.
const STEPS: usize = 40;
const LARGEST_STEP: f64 = 0.3;
/// Change of ln k below which the calibration ends.
const SETTLED: f64 = 1e-10;

/// Settings of the update of stiffnesses.
#[derive(Debug, Clone, PartialEq)]
pub struct UpdateSettings {
    /// Number of epochs of the commissioning, at least 1.
    pub commissioning_epochs: usize,
    /// Standard deviation of ln of the stiffness of each part, relative to nominal, before any
    /// data.
    pub prior_std: Vec<f64>,
}

/// Reference of the modes and stiffnesses, learnt in the commissioning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UpdateReference {
    /// Number of epochs of the commissioning.
    pub epochs: usize,
    /// Calibrated ln of the stiffness of each part, relative to nominal.
    pub ln_stiffness: DVector<f64>,
    /// Standard deviation of the calibrated ln of the stiffness of each part, including the error
    /// of the model.
    pub ln_stiffness_std: DVector<f64>,
    /// In the order of the declared modes; `None` for a mode that is not used.
    pub(crate) modes: Vec<Option<ReferenceMode>>,
    pub(crate) frequency_levels: Vec<Level>,
    pub(crate) shape_levels: Vec<Level>,
}

/// A mode of the commissioning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ReferenceMode {
    pub(crate) ln_frequency: f64,
    /// Mean stated variance of ln f of an epoch.
    pub(crate) variance: f64,
    /// Number of epochs with the mode.
    pub(crate) count: f64,
    /// The mode of the model at all degrees of freedom.
    pub(crate) whole: DVector<f64>,
    /// Its number, from 0.
    pub(crate) of_model: usize,
    pub(crate) shape: Option<ReferenceShape>,
}

/// A shape of the commissioning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ReferenceShape {
    pub(crate) frame: Frame,
    /// Mean stated covariance of the deviation of an epoch.
    pub(crate) covariance: DMatrix<f64>,
    pub(crate) count: f64,
}

/// A mode of the model and what its shape is compared with.
pub(crate) struct Predicted {
    pub(crate) line: ModeLine,
    /// Deviation of the model's shape from the measured one, and its derivatives.
    pub(crate) shape: Option<(DVector<f64>, DMatrix<f64>)>,
}

impl UpdateReference {
    /// Learns the reference from the epochs of a commissioning.
    ///
    /// Each epoch lists the declared modes in the same order, with `None` for a mode that was not
    /// found. The order is not checked.
    ///
    /// # Errors
    /// Returns an error if no mode is present often enough and resembles a mode of the model, or if
    /// a decomposition fails.
    pub fn learn(
        model: &PartModel,
        settings: &UpdateSettings,
        epochs: &[Vec<Option<SeenMode>>],
    ) -> Result<Self, ModalError> {
        let count = epochs.iter().map(Vec::len).max().unwrap_or(0);
        let of_mode = |mode: usize| -> Vec<&SeenMode> {
            epochs
                .iter()
                .filter_map(|epoch| epoch.get(mode)?.as_ref())
                .collect()
        };
        let least = LEAST_PRESENCE * epochs.len() as f64;
        let mut modes: Vec<Option<ReferenceMode>> = (0..count)
            .map(of_mode)
            .map(|seen| {
                (!seen.is_empty() && seen.len() as f64 >= least).then(|| mean(&seen, model))
            })
            .collect();
        assign(model, &mut modes)?;
        let mut reference = Self {
            epochs: epochs.len(),
            ln_stiffness: DVector::zeros(model.parts()),
            ln_stiffness_std: DVector::from_column_slice(&settings.prior_std),
            modes,
            frequency_levels: Vec::new(),
            shape_levels: Vec::new(),
        };
        reference.scatter(epochs);
        reference.calibrate(model, settings)?;
        Ok(reference)
    }

    /// Returns the reference that a commissioning is expected to give, if the model is right.
    ///
    /// `modes` are the declared frequencies with the standard deviations of one epoch (Hz), and
    /// `shape_std` the standard deviation of each value of a shape, relative to its largest value.
    /// The scatter between epochs is that of the prior.
    ///
    /// # Errors
    /// Returns an error if no declared frequency is near one of the model, or if a decomposition
    /// fails.
    pub fn expected(
        model: &PartModel,
        settings: &UpdateSettings,
        modes: &[(f64, f64)],
        shape_std: Option<f64>,
    ) -> Result<Self, ModalError> {
        let declared = modes.iter().map(|(frequency_hz, std_hz)| {
            Some(ReferenceMode {
                ln_frequency: frequency_hz.ln(),
                variance: (std_hz / frequency_hz).powi(2),
                count: settings.commissioning_epochs as f64,
                whole: DVector::zeros(0),
                of_model: 0,
                shape: None,
            })
        });
        let mut modes: Vec<Option<ReferenceMode>> = declared.collect();
        assign(model, &mut modes)?;
        for mode in modes.iter_mut().flatten() {
            let shape = model.seen(&DMatrix::from_column_slice(
                mode.whole.len(),
                1,
                mode.whole.as_slice(),
            ));
            let shape = shape.column(0).into_owned();
            let Some((std, frame)) = shape_std.zip(Frame::new(&shape)) else {
                continue;
            };
            let variance = (std * frame.shape.amax()).powi(2);
            mode.shape = Some(ReferenceShape {
                covariance: frame.covariance(&DVector::from_element(shape.len(), variance)),
                frame,
                count: mode.count,
            });
        }
        Ok(Self {
            epochs: settings.commissioning_epochs,
            ln_stiffness: DVector::zeros(model.parts()),
            ln_stiffness_std: DVector::from_column_slice(&settings.prior_std),
            modes,
            frequency_levels: levels(Of::Frequencies, &[], 1),
            shape_levels: levels(Of::Shapes, &[], 1),
        })
    }

    /// Returns for each declared mode the number of the mode of the model, from 0. `None` for a
    /// mode that is not used.
    pub fn of_model(&self) -> impl Iterator<Item = Option<usize>> {
        self.modes
            .iter()
            .map(|mode| mode.as_ref().map(|mode| mode.of_model))
    }

    /// Returns the standard deviation of ln f between epochs beyond the stated one, that each mode
    /// has for itself.
    #[must_use]
    pub fn frequency_scatter(&self) -> f64 {
        rms(&self.frequency_levels)
    }

    /// Returns the standard deviation of the values of a shape of unit norm between epochs beyond
    /// the stated one.
    #[must_use]
    pub fn shape_scatter(&self) -> f64 {
        rms(&self.shape_levels)
    }

    /// Returns the modes of the model at stiffnesses of `ln_stiffness`, in the order of the used
    /// modes.
    pub(crate) fn predict(
        &self,
        model: &PartModel,
        ln_stiffness: &DVector<f64>,
    ) -> Result<Vec<Predicted>, ModalError> {
        let used: Vec<&ReferenceMode> = self.modes.iter().flatten().collect();
        let followed: Vec<DVector<f64>> = used.iter().map(|mode| mode.whole.clone()).collect();
        let lines = model.lines(ln_stiffness, &followed)?.into_iter().zip(used);
        let predicted = lines.map(|(line, mode)| {
            let shape = mode.shape.as_ref().filter(|_| line.gap > LEAST_GAP);
            let shape = shape.and_then(|reference| {
                let frame = &reference.frame;
                let deviation = frame.deviation(&line.shape)?;
                let along = line.shape.dot(&frame.shape);
                let slope = (frame.basis.tr_mul(&line.shape_by)
                    - &deviation * frame.shape.tr_mul(&line.shape_by))
                    / along;
                Some((deviation, slope))
            });
            Predicted { line, shape }
        });
        Ok(predicted.collect())
    }

    /// Determines the scatter between the epochs.
    fn scatter(&mut self, epochs: &[Vec<Option<SeenMode>>]) {
        let (mut of_frequencies, mut of_shapes) = (Vec::new(), Vec::new());
        for epoch in epochs {
            let pairs = self.modes.iter().zip(epoch);
            let pairs: Vec<(&ReferenceMode, &SeenMode)> = pairs
                .filter_map(|(mode, seen)| mode.as_ref().zip(seen.as_ref()))
                .collect();
            let values = pairs
                .iter()
                .map(|(mode, seen)| seen.ln_frequency - mode.ln_frequency);
            let variances = pairs.iter().map(|(_, seen)| seen.variance);
            of_frequencies.push(Deviation {
                values: DVector::from_iterator(pairs.len(), values),
                stated: DMatrix::from_diagonal(&DVector::from_iterator(pairs.len(), variances)),
            });
            of_shapes.extend(pairs.iter().filter_map(|(mode, seen)| {
                let (reference, seen) = mode.shape.as_ref().zip(seen.shape.as_ref())?;
                Some(Deviation {
                    values: reference.frame.deviation(&seen.values)?,
                    stated: reference.frame.covariance(&seen.variances),
                })
            }));
        }
        self.frequency_levels = levels(Of::Frequencies, &of_frequencies, epochs.len());
        self.shape_levels = levels(Of::Shapes, &of_shapes, epochs.len());
    }

    /// Finds the most probable stiffnesses by Gauss-Newton steps.
    fn calibrate(
        &mut self,
        model: &PartModel,
        settings: &UpdateSettings,
    ) -> Result<(), ModalError> {
        let prior = settings.prior_std.iter().map(|std| std.powi(-2));
        let prior = DVector::from_iterator(model.parts(), prior);
        let mut x = self.ln_stiffness.clone();
        let mut covariance = DMatrix::zeros(0, 0);
        for _ in 0..STEPS {
            let (information, pull) = self.fit(&self.predict(model, &x)?)?;
            let Some(factor) = (information + DMatrix::from_diagonal(&prior)).cholesky() else {
                return Err(ModalError::NotConverged {
                    what: "calibration of the model",
                });
            };
            let mut step = factor.solve(&(pull - prior.component_mul(&x)));
            step *= (LARGEST_STEP / step.amax()).min(1.0);
            x += &step;
            covariance = factor.inverse();
            if step.amax() < SETTLED {
                break;
            }
        }
        self.ln_stiffness_std = covariance.diagonal().map(f64::sqrt);
        self.ln_stiffness = x;
        // The modes of the calibrated model are those that later epochs follow.
        let lines = self.predict(model, &self.ln_stiffness)?;
        for (mode, predicted) in self.modes.iter_mut().flatten().zip(lines) {
            mode.whole = predicted.line.whole;
        }
        Ok(())
    }

    /// Returns the information of the means about x, and its pull.
    fn fit(&self, predicted: &[Predicted]) -> Result<(DMatrix<f64>, DVector<f64>), ModalError> {
        let failed = ModalError::NotConverged {
            what: "calibration of the model",
        };
        let used: Vec<&ReferenceMode> = self.modes.iter().flatten().collect();
        let parts = self.ln_stiffness.len();
        let rows = DMatrix::from_fn(used.len(), parts, |mode, part| {
            predicted[mode].line.ln_frequency_by[part]
        });
        let misfit = DVector::from_fn(used.len(), |mode, _| {
            used[mode].ln_frequency - predicted[mode].line.ln_frequency
        });
        let one = FREQUENCY_ERROR.powi(2);
        let mut error = DMatrix::from_element(used.len(), used.len(), one);
        for (position, mode) in used.iter().enumerate() {
            error[(position, position)] += one + mode.variance / mode.count;
        }
        let factor = error.cholesky().ok_or_else(|| failed.clone())?;
        let mut information = rows.tr_mul(&factor.solve(&rows));
        let mut pull = rows.tr_mul(&factor.solve(&misfit));
        for (mode, predicted) in used.iter().zip(predicted) {
            let Some((reference, (deviation, slope))) =
                mode.shape.as_ref().zip(predicted.shape.as_ref())
            else {
                continue;
            };
            let len = deviation.len();
            let error = DMatrix::identity(len, len) * SHAPE_ERROR.powi(2)
                + &reference.covariance / reference.count;
            let factor = error.cholesky().ok_or_else(|| failed.clone())?;
            information += slope.tr_mul(&factor.solve(slope));
            pull -= slope.tr_mul(&factor.solve(deviation));
        }
        Ok((information, pull))
    }
}

/// Returns the means of a mode over the epochs with it.
fn mean(seen: &[&SeenMode], model: &PartModel) -> ReferenceMode {
    let count = seen.len() as f64;
    let of = |value: fn(&SeenMode) -> f64| seen.iter().map(|seen| value(seen)).sum::<f64>() / count;
    let shapes = seen.iter().filter_map(|seen| seen.shape.as_ref());
    let shapes: Vec<_> = shapes
        .filter(|shape| shape.values.len() == model.channels())
        .collect();
    let sum = shapes.first().map(|first| {
        let aligned = shapes.iter().map(|shape| {
            let sign = shape.values.dot(&first.values).signum();
            &shape.values * sign
        });
        aligned.fold(DVector::zeros(model.channels()), |sum, shape| sum + shape)
    });
    let shape = sum.as_ref().and_then(Frame::new).map(|frame| {
        let count = shapes.len() as f64;
        let none = DMatrix::zeros(frame.basis.ncols(), frame.basis.ncols());
        let stated = shapes
            .iter()
            .map(|shape| frame.covariance(&shape.variances));
        ReferenceShape {
            covariance: stated.fold(none, |sum, stated| sum + stated) / count,
            frame,
            count,
        }
    });
    ReferenceMode {
        ln_frequency: of(|seen| seen.ln_frequency),
        variance: of(|seen| seen.variance),
        count,
        whole: DVector::zeros(0),
        of_model: 0,
        shape,
    }
}

/// Assigns each mode to the mode of the model as designed that it resembles most, at most one to
/// each, and drops those that resemble none.
fn assign(model: &PartModel, modes: &mut [Option<ReferenceMode>]) -> Result<(), ModalError> {
    let (frequencies_hz, shapes) = model.whole_modes(&DVector::zeros(model.parts()))?;
    let seen = model.seen(&shapes);
    let mut costs = Vec::new();
    for (position, mode) in modes.iter().enumerate() {
        let Some(mode) = mode else { continue };
        for (of_model, frequency_hz) in frequencies_hz.iter().enumerate() {
            let distance = (mode.ln_frequency - frequency_hz.ln()).abs() / LARGEST_DISTANCE;
            let mac = mode.shape.as_ref().map_or(1.0, |shape| {
                let column = seen.column(of_model);
                let along = column.dot(&shape.frame.shape);
                let square = column.norm_squared();
                if square > 0.0 {
                    along * along / square
                } else {
                    0.0
                }
            });
            if distance < 1.0 && mac > LEAST_MAC {
                let cost = distance.powi(2) + ((1.0 - mac) / MAC_SCALE).powi(2);
                costs.push((cost, position, of_model));
            }
        }
    }
    costs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut mode_of = vec![None; modes.len()];
    for (_, position, of_model) in costs {
        if mode_of[position].is_none() && !mode_of.contains(&Some(of_model)) {
            mode_of[position] = Some(of_model);
        }
    }
    for (mode, of_model) in modes.iter_mut().zip(mode_of) {
        *mode = mode
            .take()
            .zip(of_model)
            .map(|(mode, of_model)| ReferenceMode {
                whole: shapes.column(of_model).into_owned(),
                of_model,
                ..mode
            });
    }
    match modes.iter().any(Option::is_some) {
        true => Ok(()),
        false => Err(ModalError::NoModelMode),
    }
}
