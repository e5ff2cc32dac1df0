//! The filter of a sensor node: it uses its own channels and the station's feedback.
//!
//! Sources: Huang & Yuen (2023), §6.2, §6.3 and §7.3. A node knows only its own sample counter. If
//! nodes send only parameters, a clock offset does no harm, because no sample of a node meets
//! samples of other nodes, (7.20). An exchange of motion requires synchronised clocks.

use super::compression::{CompressedMotion, CovarianceScheme, ModalBasis, MotionExchange};
use super::gaussian::Gaussian;
use super::mean_limits::MeanLimits;
use super::samples::{SampleExchange, Shared};
use crate::error::FilterError;
use crate::extended::{ExtendedKalmanFilter, FilterState, Frame, Step};
use crate::model::{ObservationModel, ProcessModel};
use crate::outlier::{ChannelScreen, Verdict};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Maximum number of messages that feedback can still answer; older messages are dropped.
const KEPT: usize = 16;

/// The effect of the fused density on a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FeedbackRule {
    /// The fused density replaces the node's marginal density of the parameters. The node keeps its
    /// `p(x, ẋ | θ)`.
    #[default]
    Marginal,
    /// As [`FeedbackRule::Marginal`], with the covariance multiplied by the number of fused nodes.
    ///
    /// This divides the information among the nodes instead of copying it.
    Federated,
    /// The node takes the mean and keeps its covariance.
    Mean,
    /// The node ignores the fused density.
    None,
    /// The fused density overwrites parameters and motion, and their correlation is dropped, as
    /// published: (6.17) and (6.21).
    Reset,
}

/// The station's answer to one message of a node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Feedback {
    /// Index of the node's own message that this answers.
    pub answers: u64,
    /// The fused density of the parameters.
    pub parameters: Gaussian,
    /// Number of fused nodes.
    pub nodes: usize,
    /// The fused motion, if nodes exchange motion in modes.
    pub motion: Option<CompressedMotion>,
    /// Responses or samples by node, if nodes exchange them.
    pub responses: Vec<Option<CompressedMotion>>,
}

impl FeedbackRule {
    /// Returns the density that replaces the sent density; `None` if the node ignores feedback.
    pub(super) fn target(
        self,
        fused: &Gaussian,
        nodes: usize,
        sent: &Gaussian,
    ) -> Option<Gaussian> {
        match self {
            Self::Marginal | Self::Reset => Some(fused.clone()),
            Self::Federated => Some(Gaussian {
                mean: fused.mean.clone(),
                covariance: &fused.covariance * nodes.max(1) as f64,
            }),
            Self::Mean => Some(Gaussian {
                mean: fused.mean.clone(),
                covariance: sent.covariance.clone(),
            }),
            Self::None => None,
        }
    }
}

/// The density that the node held at the start of the period of its message.
///
/// The difference between the message and this density is the information that the node has learnt.
/// A lineage only names answered messages, because an answer proves that the station has received
/// them.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lineage {
    /// Index of the last message of the node that the station has answered; 0 for the prior that
    /// all nodes share.
    pub own: u64,
    /// Messages whose feedback the node has applied since it sent message `own`.
    pub answers: Vec<u64>,
}

/// The message that a node sends once per fusion period.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LocalEstimate {
    /// The node's count of fusion periods, from 1.
    pub index: u64,
    /// The node's density of the parameters.
    pub parameters: Gaussian,
    /// The density from which the node started.
    ///
    /// `None` if the node cannot name this density: after a restart or skipped samples, until the
    /// next answer. The station then counts nothing as learnt.
    pub lineage: Option<Lineage>,
    /// The node's motion in modes, as its own responses or as samples, if nodes exchange motion.
    pub motion: Option<CompressedMotion>,
    /// Time of the last sample, to which the motion belongs (fusion periods of measurement time).
    ///
    /// The origin must be the same for all nodes. [`LocalFilter::report`] writes the node's own
    /// count. A caller that knows the time replaces it.
    pub instant: f64,
}

/// Settings of a node.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeSettings {
    /// Samples in a fusion period, `r_s / r_c`, at least 1.
    pub steps_per_period: u64,
    /// The node's use of feedback.
    pub feedback: FeedbackRule,
    /// The reduction of the parameter covariance.
    pub scheme: CovarianceScheme,
    /// The exchanged motion data.
    pub motion: MotionExchange,
    /// Index of this node among all nodes, from 0.
    pub position: usize,
    /// Limits of the parameter means. A node with a mean outside restarts from its prior.
    pub healthy: MeanLimits,
}

/// The outcome of feedback.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Taken {
    /// The estimate now contains the feedback.
    Applied,
    /// The feedback answers a message that is too old, already answered or never sent.
    Stale,
    /// The feedback is not a valid density, or contradicts the node's own information.
    Refused,
}

/// The state of a node for a checkpoint.
///
/// It does not contain messages and answers, because they belong to the current run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LocalState {
    filter: FilterState,
    counter: u64,
    from: Option<u64>,
    fused: Option<DVector<f64>>,
    restarts: u64,
}

/// The density of a message.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Sent {
    pub(super) index: u64,
    pub(super) density: Gaussian,
}

/// An answer that the node has applied.
#[derive(Debug, Clone, Copy)]
struct Applied {
    /// Index of the answered message.
    answers: u64,
    /// Index of the last message that the node had sent by then.
    last_sent: u64,
}

/// The filter state at the last message, and all frames since then.
#[derive(Debug, Clone)]
struct Rewind {
    index: u64,
    state: FilterState,
    /// Observations and excitation of each frame since the message.
    frames: Vec<(Vec<f64>, Vec<f64>)>,
}

/// An adaptive extended Kalman filter that takes part in a fusion.
///
/// Feedback to the last message applies at the time of that message. The node then filters the
/// subsequent samples again, so the delay of the feedback has no effect. Feedback to an earlier
/// message shifts the current estimate.
#[derive(Debug, Clone)]
pub struct LocalFilter<M> {
    filter: ExtendedKalmanFilter<M>,
    settings: NodeSettings,
    prior: Gaussian,
    counter: u64,
    /// The last messages.
    sent: VecDeque<Sent>,
    rewind: Option<Rewind>,
    /// The message from which the next one starts, 0 for the prior. `None` until an answer provides
    /// one.
    from: Option<u64>,
    /// Applied answers.
    taken: VecDeque<Applied>,
    last_sent: u64,
    last_answer: u64,
    /// Data for the exchange of samples, if nodes exchange them.
    shared: Option<Shared>,
    /// Means of the last fused density within the limits.
    fused: Option<DVector<f64>>,
    restarts: u64,
}

impl<M: ProcessModel + ObservationModel> LocalFilter<M> {
    /// Creates a node from a filter at its prior.
    ///
    /// # Errors
    /// Returns an error if a setting does not fit the filter.
    pub fn new(
        filter: ExtendedKalmanFilter<M>,
        settings: NodeSettings,
    ) -> Result<Self, FilterError> {
        let prior = filter.parameters();
        let parameters = prior.mean.len();
        if settings.steps_per_period == 0 {
            return Err(FilterError::Setting {
                what: "samples in a fusion period",
                found: 0.0,
                allowed: "at least 1",
            });
        }
        settings.healthy.check(
            parameters,
            ["lower limit of health", "upper limit of health"],
        )?;
        let expected = filter.mean().len() - parameters;
        let moving = match &settings.motion {
            MotionExchange::None => None,
            MotionExchange::Modes(basis) => Some(2 * basis.dofs()),
            MotionExchange::Responses(nodes) => match nodes.get(settings.position) {
                Some(_) => nodes
                    .iter()
                    .map(|node| node.rows().ncols())
                    .find(|columns| *columns != expected),
                None => Some(0),
            },
            MotionExchange::Samples(_) => None,
        };
        let shared = match &settings.motion {
            MotionExchange::Samples(exchange) => {
                let (found, expected) = (exchange.observations(), filter.observation_len());
                if found != expected {
                    return Err(FilterError::Dimension {
                        what: "observations of all nodes",
                        found,
                        expected,
                    });
                }
                let (steps, instants) = (settings.steps_per_period, exchange.instants());
                if !steps.is_multiple_of(instants as u64) || settings.position >= exchange.nodes() {
                    let allowed =
                        "a divisor of the samples in a fusion period, for a node that is there";
                    let what = "instants of the exchange of samples";
                    return Err(FilterError::Setting {
                        what,
                        found: instants as f64,
                        allowed,
                    });
                }
                Some(Shared::new(exchange, settings.position, steps))
            }
            _ => None,
        };
        if let Some(found) = moving.filter(|found| *found != expected) {
            return Err(FilterError::Dimension {
                what: "exchanged motion",
                found,
                expected,
            });
        }
        Ok(Self {
            filter,
            settings,
            prior,
            counter: 0,
            sent: VecDeque::with_capacity(KEPT),
            rewind: None,
            from: Some(0),
            taken: VecDeque::with_capacity(KEPT),
            last_sent: 0,
            last_answer: 0,
            shared,
            fused: None,
            restarts: 0,
        })
    }

    /// Sets the index of the first sample within its fusion period (from 0).
    ///
    /// The periods of all nodes then end at the same samples. Callers must call this before the
    /// first sample.
    pub fn begin_at(&mut self, sample: u64) {
        self.counter = sample % self.settings.steps_per_period;
        // All nodes share the prior at the start of a period. It has faded since then.
        let mut prior = self.filter.parameters();
        prior.covariance *= self
            .filter
            .settings()
            .fading
            .value()
            .powf(self.counter as f64);
        if self.filter.replace_parameters(&prior).is_err() {
            self.from = None;
        }
    }

    /// Returns the state for a checkpoint.
    #[must_use]
    pub fn state(&self) -> LocalState {
        LocalState {
            filter: self.filter.state().clone(),
            counter: self.counter,
            from: self.from,
            fused: self.fused.clone(),
            restarts: self.restarts,
        }
    }

    /// Restores a checkpoint in a new run.
    ///
    /// The station may already know information that the node learnt before and after the
    /// checkpoint. The node therefore reports nothing as learnt until the station has answered a
    /// message of this run.
    ///
    /// # Errors
    /// Returns an error if the state does not fit the filter. The node is then unchanged.
    pub fn restore(&mut self, state: LocalState) -> Result<(), FilterError> {
        let LocalState {
            filter,
            counter,
            from,
            fused,
            restarts,
        } = state;
        let expected = self.prior.mean.len();
        if let Some(found) = fused
            .as_ref()
            .map(DVector::len)
            .filter(|found| *found != expected)
        {
            return Err(FilterError::Dimension {
                what: "fused means of a checkpoint",
                found,
                expected,
            });
        }
        self.filter.restore(filter)?;
        let last = counter / self.settings.steps_per_period;
        (self.counter, self.last_sent, self.last_answer) = (counter, last, last);
        // The station does not know messages of a previous run, so it counts nothing for their
        // indices. It does know the prior (index 0) and would count everything twice.
        self.from = from.filter(|own| *own > 0);
        (self.fused, self.restarts) = (fused, restarts);
        self.sent.clear();
        self.taken.clear();
        self.rewind = None;
        self.shared.iter_mut().for_each(Shared::skip);
        Ok(())
    }

    /// Processes one frame of the node's own observations.
    ///
    /// If the filter diverges, it restarts, the frame is lost and the result is `None`.
    ///
    /// # Errors
    /// Returns an error if the frame does not fit the model.
    pub fn step(&mut self, frame: Frame<'_>) -> Result<Option<Step>, FilterError> {
        let Some(mut shared) = self.shared.take() else {
            return self.step_all(frame);
        };
        let (found, expected) = (frame.observations.len(), shared.own.len());
        if found != expected {
            self.shared = Some(shared);
            return Err(FilterError::Dimension {
                what: "observations of a frame",
                found,
                expected,
            });
        }
        shared.frame[shared.own.clone()].copy_from_slice(frame.observations);
        let step = self.step_all(Frame {
            observations: &shared.frame,
            ..frame
        });
        if let Ok(step) = &step {
            if step.is_none() {
                shared.forget();
            } else if let Some(running) = &mut shared.running {
                running
                    .frames
                    .push((shared.frame.clone(), frame.excitation.to_vec()));
            }
            let steps = self.settings.steps_per_period;
            let screens = self
                .filter
                .outliers()
                .map(|outliers| &outliers.channels()[shared.own.clone()]);
            let used = |channel: usize| {
                screens.is_none_or(|screens| screens[channel].verdict() == Verdict::Regular)
            };
            let told = frame
                .observations
                .iter()
                .enumerate()
                .map(|(channel, sample)| match used(channel) {
                    true => *sample,
                    false => f64::NAN,
                });
            shared.tell((self.counter - 1) % steps + 1, told);
        }
        self.shared = Some(shared);
        step
    }

    /// Processes one frame of all observations of the filter.
    fn step_all(&mut self, frame: Frame<'_>) -> Result<Option<Step>, FilterError> {
        self.filter.check_frame(frame)?;
        self.counter += 1;
        let longest = self.settings.steps_per_period as usize;
        self.rewind = self
            .rewind
            .take()
            .filter(|rewind| rewind.frames.len() < longest);
        if let Some(rewind) = &mut self.rewind {
            rewind
                .frames
                .push((frame.observations.to_vec(), frame.excitation.to_vec()));
        }
        match self.filter.step(frame) {
            Ok(step) => Ok(Some(step)),
            Err(_diverged) => {
                self.start_anew();
                Ok(None)
            }
        }
    }

    /// Returns the outlier screening state of the node's own observations, in their order.
    ///
    /// Empty if outlier screening is disabled.
    #[must_use]
    pub fn screens(&self) -> &[ChannelScreen] {
        let all = self
            .filter
            .outliers()
            .map_or(&[][..], |outliers| outliers.channels());
        match &self.shared {
            Some(shared) => all.get(shared.own.clone()).unwrap_or_default(),
            None => all,
        }
    }

    /// Returns `true` if a fusion period has just ended.
    #[must_use]
    pub fn is_due(&self) -> bool {
        self.counter > 0 && self.counter.is_multiple_of(self.settings.steps_per_period)
    }

    /// Returns the message to send now; a node outside its limits restarts first.
    pub fn report(&mut self) -> LocalEstimate {
        if !self.is_healthy() {
            self.start_anew();
        }
        let index = self.counter / self.settings.steps_per_period;
        let mut parameters = self.filter.parameters();
        parameters.covariance = self.settings.scheme.reduce(&parameters.covariance);
        let answers = |own: u64| {
            self.taken
                .iter()
                .filter(|applied| applied.last_sent >= own)
                .map(|applied| applied.answers)
                .collect()
        };
        let lineage = self.from.map(|own| Lineage {
            own,
            answers: answers(own),
        });
        self.last_sent = index;
        if self.sent.len() == KEPT {
            self.sent.pop_front();
        }
        self.sent.push_back(Sent {
            index,
            density: parameters.clone(),
        });
        self.rewind = Some(Rewind {
            index,
            state: self.filter.state().clone(),
            frames: Vec::new(),
        });
        let (mean, covariance) = (self.filter.mean(), self.filter.covariance());
        let motion = match &self.settings.motion {
            MotionExchange::None => None,
            MotionExchange::Modes(basis) => Some(basis.compress(mean, covariance)),
            MotionExchange::Responses(nodes) => {
                Some(nodes[self.settings.position].compress(mean, covariance))
            }
            MotionExchange::Samples(_) => self.shared.as_mut().map(|shared| {
                let told =
                    shared.end_period(index, self.settings.steps_per_period, self.filter.state());
                CompressedMotion {
                    mean: told.into(),
                    variance: DVector::zeros(0),
                }
            }),
        };
        LocalEstimate {
            index,
            parameters,
            lineage,
            motion,
            instant: index as f64,
        }
    }

    /// Applies the station's answer to one of the node's messages, however late.
    pub fn take(&mut self, feedback: &Feedback) -> Taken {
        let sent = self.sent.iter().find(|sent| sent.index == feedback.answers);
        let Some(sent) = sent.filter(|_| feedback.answers > self.last_answer) else {
            return Taken::Stale;
        };
        let sent = sent.density.clone();
        if feedback.parameters.information().is_err() {
            return Taken::Refused;
        }
        let rewind = self
            .rewind
            .take_if(|rewind| rewind.index == feedback.answers);
        let taken = match rewind {
            Some(rewind) => self.take_then(rewind, feedback, &sent),
            None => self.take_now(feedback, &sent),
        };
        if taken.is_err() {
            return Taken::Refused;
        }
        self.from = Some(feedback.answers);
        self.taken
            .retain(|applied| applied.last_sent >= feedback.answers);
        if self.settings.feedback != FeedbackRule::None {
            self.taken.push_back(Applied {
                answers: feedback.answers,
                last_sent: self.last_sent,
            });
        }
        if self.settings.healthy.contain(&feedback.parameters.mean) {
            self.fused = Some(feedback.parameters.mean.clone());
        }
        self.last_answer = feedback.answers;
        self.sent.retain(|sent| sent.index > feedback.answers);
        Taken::Applied
    }

    /// Returns the filter.
    #[must_use]
    pub fn filter(&self) -> &ExtendedKalmanFilter<M> {
        &self.filter
    }

    /// Returns the number of samples in a fusion period.
    #[must_use]
    pub fn steps_per_period(&self) -> u64 {
        self.settings.steps_per_period
    }

    /// Returns the number of restarts of the filter.
    #[must_use]
    pub fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Discards the motion after a gap of `steps` samples that is too long to bridge.
    ///
    /// Everything else remains.
    pub fn skip(&mut self, steps: u64) {
        self.counter += steps;
        if steps > 0 {
            // The filter did not fade in the gap, as the station would assume.
            self.from = None;
        }
        self.filter.forget_motion();
        self.rewind = None;
        self.shared.iter_mut().for_each(Shared::skip);
    }

    /// Applies the feedback at the time of the message and filters all subsequent frames again.
    fn take_then(
        &mut self,
        rewind: Rewind,
        feedback: &Feedback,
        sent: &Gaussian,
    ) -> Result<(), FilterError> {
        let now = self.filter.state().clone();
        let mut taken = self
            .filter
            .restore(rewind.state)
            .and_then(|()| self.take_at_once(feedback, sent));
        let fused = self.shared.is_some().then(|| self.filter.state().clone());
        for (observations, excitation) in rewind.frames {
            if taken.is_ok() {
                taken = self
                    .filter
                    .step(Frame {
                        observations: &observations,
                        excitation: &excitation,
                    })
                    .map(|_step| ());
            }
        }
        if taken.is_err() {
            self.filter.restore(now)?;
            return taken;
        }
        // The period starts from the fused density only if the node keeps it. A refused answer
        // would otherwise count in the next exchange of samples.
        let running = self
            .shared
            .as_mut()
            .and_then(|shared| shared.running.as_mut());
        if let Some((running, fused)) = running.zip(fused) {
            running.state = fused;
        }
        Ok(())
    }

    fn take_at_once(&mut self, feedback: &Feedback, sent: &Gaussian) -> Result<(), FilterError> {
        let Some(target) =
            self.settings
                .feedback
                .target(&feedback.parameters, feedback.nodes, sent)
        else {
            return Ok(());
        };
        match (
            self.settings.feedback,
            &self.settings.motion,
            &feedback.motion,
        ) {
            (FeedbackRule::Reset, MotionExchange::Modes(basis), Some(motion)) => {
                reset(&mut self.filter, basis, motion, &feedback.parameters)
            }
            (_, MotionExchange::Responses(nodes), _) => {
                self.filter.replace_parameters(&target)?;
                let others = nodes.iter().zip(&feedback.responses).enumerate();
                for (_, (node, sent)) in
                    others.filter(|(position, _)| *position != self.settings.position)
                {
                    let Some(motion) = sent
                        .as_ref()
                        .filter(|motion| motion.is_sound(node.rows().nrows()))
                    else {
                        continue;
                    };
                    self.filter
                        .observe_motion(node.rows(), &motion.mean, &motion.variance)?;
                }
                Ok(())
            }
            (_, MotionExchange::Samples(exchange), _) => {
                let exchange = exchange.clone();
                let target = self.learn_from_samples(&exchange, feedback, target)?;
                self.filter.replace_parameters(&target)
            }
            _ => self.filter.replace_parameters(&target),
        }
    }

    /// Filters the period before the answered message again, now with the samples of all nodes.
    ///
    /// Returns `target` with the additional information about the parameters. Without such samples,
    /// nothing changes.
    fn learn_from_samples(
        &mut self,
        exchange: &SampleExchange,
        feedback: &Feedback,
        target: Gaussian,
    ) -> Result<Gaussian, FilterError> {
        let ended = self.shared.as_mut().and_then(|shared| shared.ended.take());
        let Some((period, every)) =
            ended.zip(self.shared.as_ref().map(|shared| shared.every as usize))
        else {
            return Ok(target);
        };
        if period.index + 1 != feedback.answers {
            return Ok(target);
        }
        let without = self.filter.state().clone();
        let own = self.filter.parameters();
        self.filter.restore(period.state)?;
        let mut filtered = Ok(());
        for (number, (mut observations, excitation)) in period.frames.into_iter().enumerate() {
            if (number + 1) % every == 0 {
                let instant = (number + 1) / every - 1;
                for (node, told) in feedback.responses.iter().enumerate() {
                    let Some(told) = told.as_ref().filter(|_| node != self.settings.position)
                    else {
                        continue;
                    };
                    let channels = exchange.channels(node);
                    if exchange.is_sound(node, told.mean.as_slice()) {
                        let start = instant * channels.len();
                        let told = &told.mean.as_slice()[start..start + channels.len()];
                        observations[channels].copy_from_slice(told);
                    }
                }
            }
            filtered = filtered.and_then(|()| {
                let frame = Frame {
                    observations: &observations,
                    excitation: &excitation,
                };
                self.filter.step(frame).map(|_step| ())
            });
        }
        let learnt = filtered.and_then(|()| {
            let mut information = target.information()?;
            information.add(1.0, &self.filter.parameters().information()?);
            information.add(-1.0, &own.information()?);
            information.gaussian()
        });
        match learnt {
            Ok(learnt) if self.settings.healthy.contain(&learnt.mean) => Ok(learnt),
            // The samples of other nodes contradict this node's information, so it ignores them.
            Ok(_) | Err(_) => {
                self.filter.restore(without)?;
                Ok(target)
            }
        }
    }

    /// Adds `target − sent`, faded since the message, to the current information about the
    /// parameters.
    fn take_now(&mut self, feedback: &Feedback, sent: &Gaussian) -> Result<(), FilterError> {
        let Some(target) =
            self.settings
                .feedback
                .target(&feedback.parameters, feedback.nodes, sent)
        else {
            return Ok(());
        };
        let late = self.counter - feedback.answers * self.settings.steps_per_period;
        let growth = self.filter.settings().fading.value().powf(late as f64);
        let mut now = self.filter.parameters().information()?;
        now.add(1.0 / growth, &target.information()?);
        now.add(-1.0 / growth, &sent.information()?);
        self.filter.replace_parameters(&now.gaussian()?)
    }

    fn is_healthy(&self) -> bool {
        let parameters = self.filter.parameters();
        self.settings.healthy.contain(&parameters.mean) && parameters.information().is_ok()
    }

    /// Returns to the prior, with the parameters at the last fused means.
    fn start_anew(&mut self) {
        self.restarts += 1;
        self.filter.restart();
        if let Some(mean) = &self.fused {
            let anew = Gaussian {
                mean: mean.clone(),
                covariance: self.prior.covariance.clone(),
            };
            // A prior without uncertainty stays unchanged.
            let _ = self.filter.replace_parameters(&anew);
        }
        self.sent.clear();
        self.taken.clear();
        (self.from, self.rewind) = (None, None);
        self.shared.iter_mut().for_each(Shared::forget);
    }
}

/// Overwrites parameters and motion, (6.17) and (6.21); the cross-covariances become zero.
fn reset<M: ProcessModel + ObservationModel>(
    filter: &mut ExtendedKalmanFilter<M>,
    basis: &ModalBasis,
    motion: &CompressedMotion,
    parameters: &Gaussian,
) -> Result<(), FilterError> {
    let (n, moving) = (filter.mean().len(), 2 * basis.dofs());
    let kept = 2 * basis.modes();
    if !motion.is_sound(kept) {
        return Err(FilterError::Dimension {
            what: "fused motion",
            found: motion.mean.len(),
            expected: kept,
        });
    }
    let mut mean = DVector::zeros(n);
    mean.rows_mut(0, moving)
        .copy_from(&basis.extract(&motion.mean));
    mean.rows_mut(moving, n - moving)
        .copy_from(&parameters.mean);
    let mut covariance = DMatrix::zeros(n, n);
    covariance
        .view_mut((0, 0), (moving, moving))
        .copy_from(&basis.extract_covariance(&motion.variance));
    covariance
        .view_mut((moving, moving), (n - moving, n - moving))
        .copy_from(&parameters.covariance);
    filter.replace_state(&mean, &covariance)
}
