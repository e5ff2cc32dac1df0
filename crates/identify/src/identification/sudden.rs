//! Sudden faults of a sensor, which the comparison of the sensors finds too late.
//!
//! A change of the parameters can explain the samples of a sensor that has just failed, so the
//! fault looks like damage. When the parameters jump, the filter is therefore repeated without one
//! sensor, from its state before the jump and with constant parameters. If the other sensors still
//! agree with its prediction, the structure has not changed, and the deviating sensor is faulty.
//! The filter then continues without this sensor. If the others deviate as well, the structure has
//! changed.
//!
//! The deviation of a sensor is the mean square of its residuals, as a share of that of the
//! predicted values. With a wrong model, a sound sensor deviates as well. The trial therefore
//! compares each deviation with that before the jump.

use super::recent::{Inputs, Recent};
use super::{Identification, Output};
use crate::estimator::{Estimator, EstimatorState};
use serde::{Deserialize, Serialize};
use spandrel_bus::{EventKind, FitVerdict};
use spandrel_faults::{ChannelHealth, Fault, Soundness};
use spandrel_filter::{FilterError, Frame, NoisePhase};

/// Time between two kept states of the filter, in fundamental periods and in seconds. The longer of
/// the two counts.
const SPAN: (f64, f64) = (6.0, 6.0);

/// Time constant of the present deviations (fundamental periods, s).
const AVERAGE: (f64, f64) = (1.0, 1.0);

/// Time for which a trial must show a fault until the sensor is left out (fundamental periods, s).
///
/// A trial that has not shown a fault for this time ends.
const CONFIRMED: (f64, f64) = (3.0, 3.0);

/// Time for which a sensor must agree until it is used again (fundamental periods, s).
const AGREED: (f64, f64) = (24.0, 10.0);

/// Share of the repeated frames that show the deviations before the jump.
const BEFORE: f64 = 1.0 / 3.0;

/// Least growth of the deviation of a faulty sensor.
const OWN: f64 = 10.0;

/// Largest growth of the deviation of any other sensor, if the structure has not changed.
///
/// Damage moves the floors beside it most. The mean over many sensors would hide them.
const OTHERS: f64 = 3.0;

/// Least number of other sensors.
const LEAST_OTHERS: usize = 2;

/// Growth of the deviation up to which a sensor agrees again.
const SOUND: f64 = 3.0;

/// Minimum mean square that the fault would cause in the present motion, as a multiple of the
/// variance of the stated noise. In weaker motion, a left-out sensor cannot show that it works
/// again.
const VISIBLE: f64 = 20.0;

/// Largest variance of a dead sensor, as a share of the mean square of the prediction.
const DEAD: f64 = 0.02;

/// Squared coherence of a sensor with its prediction from which a factor describes its fault.
const COHERENT: f64 = 0.8;

/// The search for a sudden fault, and the sensors that are left out because of one.
#[derive(Debug)]
pub(super) struct SuddenFaults {
    spans: Spans,
    /// Variance of the stated noise of each observation row.
    noise: Vec<f64>,
    /// States of the filter, the older one first. A checkpoint does not contain them.
    kept: [Option<Kept>; 2],
    trial: Option<Trial>,
    state: SuddenFaultsState,
}

/// What a checkpoint contains.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct SuddenFaultsState {
    follows_jump: bool,
    /// One entry per observation row.
    left_out: Vec<Option<LeftOut>>,
    trial: Option<TrialState>,
}

/// Lengths of time in frames.
#[derive(Debug, Clone, Copy)]
struct Spans {
    kept: u64,
    average: f64,
    confirmed: u64,
    agreed: u64,
}

#[derive(Debug)]
struct Kept {
    filter: EstimatorState,
    /// Number of frames since.
    frames: u64,
}

/// A filter without one sensor and with held parameters.
#[derive(Debug)]
struct Trial {
    filter: Estimator,
    shown: Shown,
}

/// The same trial in a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct TrialState {
    filter: EstimatorState,
    shown: Shown,
}

/// What a trial has shown.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Shown {
    /// Observation row that the filter does not use.
    row: usize,
    /// Deviation of each row before the jump.
    before: Vec<f64>,
    now: Vec<Deviation>,
    /// The row that is not used, over the successive frames that show a fault.
    with_fault: Deviation,
    /// Successive frames that show a fault, and that do not.
    faulty: u64,
    open: u64,
}

/// A sensor that is left out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct LeftOut {
    fault: Fault,
    /// Deviation before the fault, and with it.
    before: f64,
    with_fault: f64,
    now: Deviation,
    /// Successive frames in which the sensor agrees.
    agrees: u64,
}

/// Mean of the measured values of a row, and mean squares of its residuals, predictions and
/// measured values, and of the product of the last two.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Deviation {
    mean: f64,
    residual: f64,
    predicted: f64,
    measured: f64,
    product: f64,
}

impl Deviation {
    fn add(&mut self, weight: f64, measured: f64, predicted: f64) {
        if measured.is_nan() {
            return;
        }
        let residual = measured - predicted;
        for (mean, value) in [
            (&mut self.mean, measured),
            (&mut self.residual, residual * residual),
            (&mut self.predicted, predicted * predicted),
            (&mut self.measured, measured * measured),
            (&mut self.product, measured * predicted),
        ] {
            *mean += weight * (value - *mean);
        }
    }

    /// NaN before the first sample.
    fn share(&self) -> f64 {
        self.residual / self.predicted
    }

    fn fault(&self) -> Fault {
        let gain = self.product / self.predicted;
        let coherence = self.product * self.product / (self.predicted * self.measured);
        let variance = self.measured - self.mean * self.mean;
        if variance < DEAD * self.predicted {
            Fault::Dead
        } else if coherence < COHERENT || !coherence.is_finite() {
            Fault::Disturbed
        } else if gain < 0.0 {
            Fault::Sign(-gain)
        } else {
            Fault::Gain(gain)
        }
    }
}

/// What a trial decides after a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Decision {
    Open,
    Ended,
    Faulty,
}

impl Shown {
    /// Returns the factor by which the deviation of a row has grown.
    fn growth(&self, row: usize) -> f64 {
        self.now[row].share() / self.before[row]
    }

    /// Adds the measured and the predicted values of a frame.
    fn take(&mut self, spans: &Spans, measured: &[f64], predicted: &[f64]) -> Decision {
        add(&mut self.now, 1.0 / spans.average, measured, predicted);
        let others = (0..self.now.len()).filter(|row| *row != self.row);
        let growths = others.map(|row| self.growth(row));
        let growths: Vec<f64> = growths.filter(|growth| growth.is_finite()).collect();
        let others_agree =
            growths.len() >= LEAST_OTHERS && growths.iter().all(|growth| *growth < OTHERS);
        if others_agree && self.growth(self.row) > OWN {
            (self.faulty, self.open) = (self.faulty + 1, 0);
            let weight = 1.0 / self.faulty as f64;
            self.with_fault
                .add(weight, measured[self.row], predicted[self.row]);
        } else {
            (self.faulty, self.open) = (0, self.open + 1);
        }
        match () {
            () if self.faulty >= spans.confirmed => Decision::Faulty,
            () if self.open >= spans.confirmed => Decision::Ended,
            () => Decision::Open,
        }
    }
}

/// A filter that has repeated the latest frames with held parameters, and the deviations of its
/// rows.
struct Repeated {
    filter: Estimator,
    /// Shares before the jump.
    before: Vec<f64>,
    now: Vec<Deviation>,
}

impl Repeated {
    /// Repeats the frames since a kept state, without the samples of `row`. `None` if this is
    /// impossible.
    fn of(
        estimator: &Estimator,
        kept: &Kept,
        recent: &Recent,
        row: Option<usize>,
        average: f64,
    ) -> Option<Self> {
        let frames = kept.frames as usize;
        if recent.len() < frames {
            return None;
        }
        let mut filter = estimator.resumed(&kept.filter)?;
        let first = (BEFORE * frames as f64) as usize;
        let mut before = vec![Deviation::default(); filter.predicted().len()];
        let mut now = before.clone();
        let mut number = 0;
        let repeated: Result<(), FilterError> = recent.repeat(frames, |inputs| {
            step(&mut filter, inputs, row)?;
            number += 1;
            let (means, weight) = match number <= first {
                true => (&mut before, 1.0 / number as f64),
                false => (&mut now, 1.0 / average.min((number - first) as f64)),
            };
            add(means, weight, inputs.observations, filter.predicted());
            Ok(())
        });
        repeated.ok()?;
        Some(Self {
            filter,
            before: before.iter().map(Deviation::share).collect(),
            now,
        })
    }

    /// Returns the row whose deviation has grown most.
    fn most_deviating(&self) -> Option<usize> {
        let growths = self.now.iter().map(Deviation::share).zip(&self.before);
        let growths = growths.map(|(now, before)| now / before).enumerate();
        let known = growths.filter(|(_, growth)| growth.is_finite());
        let most = known.max_by(|(_, a), (_, b)| a.total_cmp(b));
        most.map(|(row, _)| row)
    }
}

/// Steps a filter without the samples of a row, and with held parameters.
fn step(filter: &mut Estimator, inputs: Inputs<'_>, row: Option<usize>) -> Result<(), FilterError> {
    let mut observations = inputs.observations.to_vec();
    if let Some(row) = row {
        observations[row] = f64::NAN;
    }
    filter.set_teaching(false);
    filter.set_reliability(inputs.shares)?;
    filter.step(Frame {
        observations: &observations,
        excitation: inputs.excitation,
    })?;
    Ok(())
}

fn add(means: &mut [Deviation], weight: f64, measured: &[f64], predicted: &[f64]) {
    for ((mean, measured), predicted) in means.iter_mut().zip(measured).zip(predicted) {
        mean.add(weight, *measured, *predicted);
    }
}

impl SuddenFaults {
    /// `noise` contains the variance of the stated noise of each observation row.
    pub(super) fn new(noise: Vec<f64>, period_s: f64, rate_hz: f64) -> Self {
        let frames = |(periods, s): (f64, f64)| rate_hz * (periods * period_s).max(s);
        Self {
            spans: Spans {
                kept: frames(SPAN) as u64,
                average: frames(AVERAGE),
                confirmed: frames(CONFIRMED) as u64,
                agreed: frames(AGREED) as u64,
            },
            kept: [None, None],
            trial: None,
            state: SuddenFaultsState {
                follows_jump: false,
                left_out: vec![None; noise.len()],
                trial: None,
            },
            noise,
        }
    }

    /// Returns `true` if a sensor that is still used seems to be faulty.
    pub(super) fn is_in_doubt(&self) -> bool {
        let shown = self.trial.as_ref().map(|trial| &trial.shown);
        shown.is_some_and(|shown| shown.faulty as f64 >= self.spans.average)
    }

    /// Discards the kept states and the trial, because the next frames do not follow them.
    pub(super) fn forget(&mut self) {
        self.kept = [None, None];
        self.trial = None;
    }

    /// Keeps the state of a filter that can be trusted.
    fn keep(&mut self, estimator: &Estimator, is_trusted: bool) {
        for kept in self.kept.iter_mut().flatten() {
            kept.frames += 1;
        }
        let is_due = { self.kept[1].as_ref() }.is_none_or(|kept| kept.frames >= self.spans.kept);
        if !is_due {
            return;
        }
        if !is_trusted {
            self.kept = [None, None];
            return;
        }
        self.kept.swap(0, 1);
        self.kept[1] = Some(Kept {
            filter: estimator.state(),
            frames: 0,
        });
    }

    /// Begins a trial without the sensor that deviates most.
    fn begin(&mut self, estimator: &Estimator, recent: &Recent) {
        let Some(kept) = self.kept[0].take() else {
            return;
        };
        let average = self.spans.average;
        let all = Repeated::of(estimator, &kept, recent, None, average);
        let Some(row) = all.and_then(|all| all.most_deviating()) else {
            return;
        };
        let without = Repeated::of(estimator, &kept, recent, Some(row), average);
        self.trial = without.map(|without| Trial {
            filter: without.filter,
            shown: Shown {
                row,
                before: without.before,
                now: without.now,
                with_fault: Deviation::default(),
                faulty: 0,
                open: 0,
            },
        });
    }

    /// Compares the rows that are left out, with their measured `value`, with their predictions.
    /// Returns the rows that are used again.
    fn compare_left_out(&mut self, value: impl Fn(usize) -> f64, predicted: &[f64]) -> Vec<usize> {
        let mut back = Vec::new();
        for (row, entry) in self.state.left_out.iter_mut().enumerate() {
            let Some(left_out) = entry else { continue };
            let weight = 1.0 / self.spans.average;
            let measured = value(row);
            left_out.now.add(weight, measured, predicted[row]);
            let (now, noise) = (left_out.now, self.noise[row]);
            let is_visible = left_out.with_fault * now.predicted > VISIBLE * noise;
            let agrees = now.residual < SOUND * (left_out.before * now.predicted + noise);
            if !agrees {
                left_out.agrees = 0;
            } else if is_visible && !measured.is_nan() {
                left_out.agrees += 1;
            }
            if left_out.agrees >= self.spans.agreed {
                *entry = None;
                back.push(row);
            }
        }
        back
    }

    pub(super) fn state(&self) -> SuddenFaultsState {
        let trial = self.trial.as_ref().map(|trial| TrialState {
            filter: trial.filter.state(),
            shown: trial.shown.clone(),
        });
        SuddenFaultsState {
            trial,
            ..self.state.clone()
        }
    }

    /// Returns `false`, and changes nothing, if the state belongs to other channels.
    pub(super) fn restore(&mut self, mut state: SuddenFaultsState, estimator: &Estimator) -> bool {
        let rows = self.noise.len();
        let fits = |trial: &TrialState| {
            let shown = &trial.shown;
            shown.row < rows && shown.before.len() == rows && shown.now.len() == rows
        };
        if state.left_out.len() != rows || !state.trial.as_ref().is_none_or(fits) {
            return false;
        }
        self.forget();
        self.trial = state.trial.take().and_then(|trial| {
            let filter = estimator.resumed(&trial.filter)?;
            Some(Trial {
                filter,
                shown: trial.shown,
            })
        });
        self.state = state;
        true
    }
}

impl Identification {
    /// Searches for a sudden fault of a sensor after a frame. `restarted` states whether the filter
    /// has restarted at this frame.
    pub(super) fn find_sudden_faults(
        &mut self,
        time_ns: i64,
        restarted: bool,
        outputs: &mut Vec<Output>,
    ) {
        if self.recent.is_off()
            || self.estimator.predicted().is_empty()
            || self.estimator.outliers().is_some()
        {
            return;
        }
        let value = |row: usize| self.frame[self.observation_channels[row]];
        let predicted = self.estimator.predicted();
        for row in self.sudden.compare_left_out(value, predicted) {
            let channel = self.channel_names[self.observation_channels[row]].clone();
            outputs.push(self.event_of(
                channel.as_str(),
                time_ns,
                EventKind::ChannelBack,
                "the sensor is used again",
                "its samples agree with the other sensors again",
            ));
        }
        let fit = self.estimator.fit();
        let began = fit.follows_jump() && !self.sudden.state.follows_jump;
        self.sudden.state.follows_jump = fit.follows_jump();
        if restarted || self.recent.len() == 0 {
            self.sudden.forget();
            return;
        }
        if let Some(mut trial) = self.sudden.trial.take() {
            let inputs = Inputs {
                observations: &self.observations,
                excitation: &self.excitation,
                shares: self.reliability.shares(),
                teaches: false,
            };
            if step(&mut trial.filter, inputs, Some(trial.shown.row)).is_err() {
                return;
            }
            let predicted = trial.filter.predicted();
            match trial
                .shown
                .take(&self.sudden.spans, &self.observations, predicted)
            {
                Decision::Open => self.sudden.trial = Some(trial),
                Decision::Ended => {}
                Decision::Faulty => self.continue_without(time_ns, trial, outputs),
            }
            return;
        }
        if began {
            self.sudden.begin(&self.estimator, &self.recent);
            self.sudden.kept = [None, None];
            return;
        }
        let is_trusted = !fit.follows_jump()
            && self.settling == 0
            && self.estimator.noise().phase == NoisePhase::Working
            && super::fit::judged(&self.estimator)
                .is_some_and(|judged| judged.verdict != FitVerdict::Contradicted);
        self.sudden.keep(&self.estimator, is_trusted);
    }

    /// Continues with the filter of a trial, and leaves out its sensor.
    fn continue_without(&mut self, time_ns: i64, trial: Trial, outputs: &mut Vec<Output>) {
        let Trial { filter, shown } = trial;
        let row = shown.row;
        let fault = shown.with_fault.fault();
        self.estimator = filter;
        self.sudden.state.follows_jump = false;
        self.sudden.state.left_out[row] = Some(LeftOut {
            fault,
            before: shown.before[row],
            with_fault: shown.with_fault.share(),
            now: shown.now[row],
            agrees: 0,
        });
        let channel = self.channel_names[self.observation_channels[row]].clone();
        outputs.push(self.event_of(
            channel.as_str(),
            time_ns,
            EventKind::ChannelExcluded,
            &format!("the sensor {}: its samples are not used", fault.words()),
            "without it, the other sensors measure what the model predicts with unchanged \
             parameters",
        ));
    }

    /// Returns `true` if an observation row is left out because of a sudden fault.
    pub(super) fn leaves_out(&self, row: usize) -> bool {
        self.sudden.state.left_out[row].is_some()
    }

    /// Returns `true` if a channel of a frame is left out because of a sudden fault.
    pub(super) fn has_sudden_fault(&self, channel: usize) -> bool {
        self.sudden_fault(channel).is_some()
    }

    fn sudden_fault(&self, channel: usize) -> Option<Fault> {
        let left_out = self.sudden.state.left_out[self.row_of(channel)?];
        left_out.map(|left_out| left_out.fault)
    }

    /// Leaves a channel to the check of the sensors, which has found a fault as well.
    pub(super) fn leave_to_check(&mut self, channel: usize) {
        if let Some(row) = self.row_of(channel) {
            self.sudden.state.left_out[row] = None;
        }
    }

    /// Returns the observation row of a channel of a frame. `None` if it measures no response.
    pub(super) fn row_of(&self, channel: usize) -> Option<usize> {
        let mut rows = self.observation_channels.iter();
        rows.position(|of_row| *of_row == channel)
    }

    /// Returns the health of a channel of a frame, with its sudden faults. `None` if it is not
    /// checked.
    pub(super) fn health(&self, channel: usize) -> Option<ChannelHealth> {
        let health = self.check.health()[channel]?;
        Some(match self.sudden_fault(channel) {
            Some(fault) if health.soundness != Soundness::Faulty => ChannelHealth {
                soundness: Soundness::Faulty,
                probability: 1.0,
                fault: Some(fault),
                ..health
            },
            Some(_) | None => health,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Deviation of every row before the jump.
    const BEFORE_JUMP: f64 = 0.01;

    /// Returns what a trial without row 0 decides at once if the deviations have grown by these
    /// factors.
    fn decision(growths: &[f64]) -> Decision {
        let rows = growths.len();
        let mut shown = Shown {
            row: 0,
            before: vec![BEFORE_JUMP; rows],
            now: vec![Deviation::default(); rows],
            with_fault: Deviation::default(),
            faulty: 0,
            open: 0,
        };
        let spans = Spans {
            kept: 1,
            average: 1.0,
            confirmed: 1,
            agreed: 1,
        };
        let measured = growths
            .iter()
            .map(|growth| 1.0 + (growth * BEFORE_JUMP).sqrt());
        let measured: Vec<f64> = measured.collect();
        shown.take(&spans, &measured, &vec![1.0; rows])
    }

    #[test]
    fn one_neighbour_among_many_sensors_shows_that_the_structure_has_changed() {
        let mut growths = vec![20.0; 1];
        growths.resize(20, 1.0);
        assert_eq!(decision(&growths), Decision::Faulty);
        growths[1] = 8.0;
        assert_eq!(decision(&growths), Decision::Ended);
    }

    #[test]
    fn small_deviation_and_few_others_show_no_fault() {
        assert_eq!(decision(&[9.0, 1.0, 1.0]), Decision::Ended);
        assert_eq!(decision(&[20.0, 1.0]), Decision::Ended);
        assert_eq!(decision(&[20.0, 1.0, 1.0]), Decision::Faulty);
    }
}
