//! The central station, which fuses received messages on its own clock.
//!
//! Sources: Huang & Yuen (2023), §6.3.3, (6.44) to (6.58); §7.3.2, (7.18) to (7.32); §7.4. The
//! information that a node has learnt is its density without the density from which it started. The
//! published product includes the start density and counts it once per node.

use super::compression::{CompressedMotion, MotionExchange};
use super::detector::{GlobalDetector, LEAST_WEIGHT, NodeDistance, PATIENCE, Weighting};
use super::gaussian::{Gaussian, Information};
use super::local::{Feedback, FeedbackRule, Lineage, LocalEstimate, base, is_within};
use crate::error::FilterError;
use crate::fading::bound_variances_mut;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Maximum number of kept answers per node.
///
/// Answers named in the last message of the node are kept beyond this limit, because its next
/// message may name them again.
const ANSWERS_KEPT: usize = 16;

/// The rule that fuses densities.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FusionRule {
    /// The product of all densities, as published. Only for comparison.
    Published,
    /// Counts the shared density once and adds the information that each node has learnt.
    PriorCorrect(Sharing),
}

impl Default for FusionRule {
    fn default() -> Self {
        Self::PriorCorrect(Sharing::default())
    }
}

/// The assumed overlap of the information that nodes learn from shared excitation.
///
/// The information of each node is divided by `γ`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sharing {
    /// `γ = N_s`: never overconfident, for any correlation (covariance intersection with equal
    /// weights).
    #[default]
    All,
    /// `γ = 1`: the nodes learn independently.
    Nothing,
    /// Any `γ` of at least 1, limited to the number of nodes.
    Factor(f64),
}

impl Sharing {
    /// Returns `γ` for `nodes` nodes, or for the sum of their weights if weights are graded.
    pub(super) fn factor(self, nodes: f64) -> f64 {
        let most = nodes.max(1.0);
        match self {
            Self::All => most,
            Self::Nothing => 1.0,
            Self::Factor(factor) => factor.clamp(1.0, most),
        }
    }
}

/// Settings of a station.
#[derive(Debug, Clone, PartialEq)]
pub struct StationSettings {
    /// Number of nodes.
    pub nodes: usize,
    /// The parameter density from which all nodes start, one sample before their first sample.
    ///
    /// The prior of a filter applies to its first sample. This density is that prior with its
    /// covariance divided by `λ`.
    pub prior: Gaussian,
    /// Growth of a variance by fading in one fusion period, `λ^(r_s/r_c)`.
    pub growth_per_period: f64,
    /// Upper limits of the variances (N_θ), as at the nodes.
    pub variance_bound: DVector<f64>,
    /// The rule that fuses densities.
    pub rule: FusionRule,
    /// The nodes' use of feedback.
    pub feedback: FeedbackRule,
    /// The exchanged motion data.
    pub motion: MotionExchange,
    /// Maximum time difference of simultaneous motion (fusion periods): half a sample.
    pub same_instant: f64,
    /// The detector of faulty nodes; `None` disables it.
    pub detector: Option<GlobalDetector>,
    /// Maximum age of a message (fusion periods), 3 by default. Older messages are dropped.
    pub stale_periods: f64,
    /// Lower and upper limits of the fused means (N_θ each).
    ///
    /// If a mean is outside these limits, the station restarts from the prior.
    pub healthy: (DVector<f64>, DVector<f64>),
}

/// The reason for the rejection of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Refusal {
    /// The node does not exist.
    UnknownNode,
    /// The sizes do not fit the structure.
    Dimension,
    /// The message contains a number that is not finite, or an invalid covariance.
    NoDensity,
    /// The message is not newer than the node's last message.
    Old,
}

impl Refusal {
    /// Returns the name of the counter for this reason.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::UnknownNode => "unknown-node",
            Self::Dimension => "dimension",
            Self::NoDensity => "no-density",
            Self::Old => "old",
        }
    }
}

/// The result of a fusion for one node.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct NodeReport {
    /// The node has sent a message since the previous fusion, and it is not stale.
    pub heard: bool,
    /// Distance of the node from the others. `None` without a detector or without a message.
    pub distance: Option<f64>,
    /// The fusion excluded the node.
    pub excluded: bool,
    /// Weight of the information that the node has learnt.
    ///
    /// It is 1 for a regular node, less for a discounted node, and 0 for an excluded node or
    /// without a message.
    pub weight: f64,
    /// The fusion ignored the node's motion, because its time differs from that of most nodes.
    pub out_of_step: bool,
}

/// The result of a fusion.
#[derive(Debug, Clone, PartialEq)]
pub struct Fused {
    /// The density of the parameters.
    pub parameters: Gaussian,
    /// The fused motion, if nodes exchange motion in modes.
    pub motion: Option<CompressedMotion>,
    /// Responses or samples of each fused node, if nodes exchange them.
    pub responses: Vec<Option<CompressedMotion>>,
    /// Number of fused nodes.
    pub used: usize,
    /// Reports by node.
    pub nodes: Vec<NodeReport>,
    /// Answers by node, to its last message. `None` without a message.
    pub feedback: Vec<Option<Feedback>>,
    /// The fused means were out of range, and the station restarted from the prior.
    pub started_anew: bool,
    /// The station adopted the information of its nodes, because they knew more from a past that it
    /// does not know.
    pub adopted: bool,
}

/// The state of a station for a checkpoint.
///
/// It contains the density and the state of each node, without the messages since the last fusion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StationState {
    known: Vec<Known>,
    fused: Information,
}

/// The station's knowledge of one node.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
struct Known {
    /// Index and density of the last message.
    own: Option<(u64, Gaussian)>,
    /// Lineage of the last message; `None` if that message had none.
    lineage: Option<Lineage>,
    /// Answered messages, and the densities that may have replaced them.
    answered: VecDeque<Answered>,
    /// Index and learnt information of the messages after the node's last start message.
    counted: VecDeque<(u64, Information)>,
    /// Message received since the last fusion. Not saved, because the station's clock restarts with
    /// each run.
    #[serde(skip)]
    waiting: Option<Waiting>,
    /// Regular fusions still required before the node is used again. With graded weights, they are
    /// required before its motion is forwarded.
    suspended: u32,
    /// Number of consecutive fusions with `suspended` above 0.
    ///
    /// It exceeds `PATIENCE` at once if the weight is below `LEAST_WEIGHT`.
    unsettled: u32,
}

/// A message of a node that was answered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Answered {
    index: u64,
    sent: Gaussian,
    /// The density that replaced it, if the node applies feedback.
    target: Option<Gaussian>,
}

#[derive(Debug, Clone, PartialEq)]
struct Waiting {
    /// Time of the message on the station's clock (fusion periods).
    at: f64,
    learnt: Option<Information>,
    /// The node started from a density that this station does not know.
    of_unknown_past: bool,
    motion: Option<CompressedMotion>,
    /// Time of the motion (fusion periods of measurement time).
    instant: f64,
}

/// The central station: one density, and its knowledge of the nodes.
#[derive(Debug, Clone)]
pub struct Station {
    settings: StationSettings,
    known: Vec<Known>,
    fused: Information,
    /// Time of the last fusion (fusion periods).
    at: Option<f64>,
}

impl Station {
    /// Creates a station at the common prior.
    ///
    /// # Errors
    /// Returns an error if the prior is not a valid density or a setting is out of range.
    pub fn new(settings: StationSettings) -> Result<Self, FilterError> {
        let fused = settings.prior.information()?;
        let expected = settings.prior.mean.len();
        for (what, found) in [
            (
                "variance bound of the station",
                settings.variance_bound.len(),
            ),
            (
                "lower limit of health of the station",
                settings.healthy.0.len(),
            ),
            (
                "upper limit of health of the station",
                settings.healthy.1.len(),
            ),
        ] {
            if found != expected {
                return Err(FilterError::Dimension {
                    what,
                    found,
                    expected,
                });
            }
        }
        let growth = settings.growth_per_period;
        if !(growth >= 1.0 && growth.is_finite()) {
            let what = "growth in a fusion period";
            return Err(FilterError::Setting {
                what,
                found: growth,
                allowed: "at least 1 and finite",
            });
        }
        if let FusionRule::PriorCorrect(Sharing::Factor(factor)) = settings.rule
            && !(factor >= 1.0 && factor.is_finite())
        {
            let what = "sharing factor";
            return Err(FilterError::Setting {
                what,
                found: factor,
                allowed: "at least 1 and finite",
            });
        }
        Ok(Self {
            known: vec![Known::default(); settings.nodes],
            settings,
            fused,
            at: None,
        })
    }

    /// Receives a message of a node for time `at` (fusion periods on the station's clock).
    ///
    /// # Errors
    /// Returns the reason if the message is invalid or old. The station is then unchanged.
    pub fn receive(&mut self, node: usize, message: LocalEstimate, at: f64) -> Result<(), Refusal> {
        let parameters = self.settings.prior.mean.len();
        let growth = self.settings.growth_per_period;
        let prior = &self.settings.prior;
        let known = self.known.get_mut(node).ok_or(Refusal::UnknownNode)?;
        if message.parameters.mean.len() != parameters
            || message.parameters.covariance.shape() != (parameters, parameters)
        {
            return Err(Refusal::Dimension);
        }
        let now = message
            .parameters
            .information()
            .map_err(|_| Refusal::NoDensity)?;
        let motion_is_sound = match (&message.motion, &self.settings.motion) {
            (None, _) => true,
            (Some(_), MotionExchange::None) => false,
            (Some(motion), MotionExchange::Modes(basis)) => motion.is_sound(2 * basis.modes()),
            (Some(motion), MotionExchange::Responses(nodes)) => nodes
                .get(node)
                .is_some_and(|node| motion.is_sound(node.rows().nrows())),
            (Some(motion), MotionExchange::Samples(exchange)) => {
                exchange.is_sound(node, motion.mean.as_slice())
            }
        };
        if !(motion_is_sound && at.is_finite() && message.instant.is_finite()) {
            return Err(Refusal::NoDensity);
        }
        if known
            .own
            .as_ref()
            .is_some_and(|(index, _)| message.index <= *index)
        {
            return Err(Refusal::Old);
        }
        let learnt = message.lineage.as_ref().and_then(|lineage| {
            let (from, shifts) = known.start(lineage, prior)?;
            let mut from = base(from, &shifts, message.index, growth).ok()?;
            bound(&mut from, &self.settings.variance_bound);
            let mut learnt = now.clone();
            learnt.add(-1.0, &from);
            known.counted.retain(|(index, _)| *index > lineage.own);
            for (index, counted) in &known.counted {
                learnt.add(-1.0 / growth.powf((message.index - index) as f64), counted);
            }
            Some(learnt)
        });
        let of_unknown_past = learnt.is_none() && message.lineage.is_some();
        if let Some(learnt) = &learnt {
            known.count(message.index, learnt, growth);
        }
        let before = known.waiting.take().and_then(|before| {
            let mut learnt = before.learnt?;
            learnt.fade(growth.powf((at - before.at).max(0.0)));
            Some(learnt)
        });
        let learnt = match (learnt, before) {
            (Some(mut learnt), Some(before)) => {
                learnt.add(1.0, &before);
                Some(learnt)
            }
            (learnt, before) => learnt.or(before),
        };
        let instant = message.instant;
        known.waiting = Some(Waiting {
            at,
            learnt,
            of_unknown_past,
            motion: message.motion,
            instant,
        });
        known.own = Some((message.index, message.parameters));
        if message.lineage.is_none() {
            known.counted.clear();
        }
        known.lineage = message.lineage;
        Ok(())
    }

    /// Returns the state for a checkpoint, preferably after a fusion; messages since the last
    /// fusion are not included.
    #[must_use]
    pub fn state(&self) -> StationState {
        StationState {
            known: self.known.clone(),
            fused: self.fused.clone(),
        }
    }

    /// Restores the state of a checkpoint; the clock of the station restarts at 0.
    ///
    /// The first fusion fades the density by its own time since this restart of the clock.
    ///
    /// Messages of nodes that were answered after the checkpoint start from a past that this
    /// station does not know, see [`Fused::adopted`].
    ///
    /// # Errors
    /// Returns an error if the state does not fit the settings. The station is then unchanged.
    pub fn restore(&mut self, state: StationState) -> Result<(), FilterError> {
        let n = self.settings.prior.mean.len();
        let fits = |vector: &DVector<f64>, matrix: &DMatrix<f64>| {
            vector.len() == n && matrix.shape() == (n, n)
        };
        let is_of_structure = |density: &Gaussian| fits(&density.mean, &density.covariance);
        let all_fit = state.known.iter().all(|known| {
            let answered = known
                .answered
                .iter()
                .flat_map(|answered| [Some(&answered.sent), answered.target.as_ref()]);
            let own = known.own.as_ref().map(|(_, density)| density);
            answered.chain([own]).flatten().all(is_of_structure)
                && known
                    .counted
                    .iter()
                    .all(|(_, learnt)| fits(&learnt.vector, &learnt.matrix))
        });
        if state.known.len() != self.known.len() {
            let (found, expected) = (state.known.len(), self.known.len());
            return Err(FilterError::Dimension {
                what: "nodes of a checkpoint",
                found,
                expected,
            });
        }
        if !(all_fit && fits(&state.fused.vector, &state.fused.matrix)) {
            let found = state.fused.vector.len();
            return Err(FilterError::Dimension {
                what: "densities of a checkpoint",
                found,
                expected: n,
            });
        }
        state.fused.gaussian()?;
        (self.known, self.fused, self.at) = (state.known, state.fused, None);
        Ok(())
    }

    /// Deletes all knowledge of a node that has restarted, because its message indices restart.
    pub fn forget(&mut self, node: usize) {
        if let Some(known) = self.known.get_mut(node) {
            *known = Known::default();
        }
    }

    /// Returns the time of the last fusion (fusion periods).
    #[must_use]
    pub fn last_fusion(&self) -> Option<f64> {
        self.at
    }

    /// Returns `true` if a node has sent a message since the last fusion.
    #[must_use]
    pub fn has_heard(&self, node: usize) -> bool {
        self.known
            .get(node)
            .is_some_and(|known| known.waiting.is_some())
    }

    /// Fuses the received messages at time `at` (fusion periods on the station's clock).
    ///
    /// Messages that arrive later wait for the next fusion. Without any message, the density only
    /// fades. The result is always a valid density: if the sum is invalid, the fusion reduces the
    /// learnt information, if necessary to zero.
    pub fn fuse(&mut self, at: f64) -> Fused {
        let growth = self.settings.growth_per_period;
        let elapsed = self.at.map_or(at, |before| at - before).max(0.0);
        self.at = Some(at);
        self.fused.fade(growth.powf(elapsed));
        bound(&mut self.fused, &self.settings.variance_bound);

        let mut nodes = vec![NodeReport::default(); self.known.len()];
        let mut heard: Vec<usize> = Vec::with_capacity(nodes.len());
        let mut waiting: Vec<Option<Waiting>> = self
            .known
            .iter_mut()
            .map(|known| known.waiting.take())
            .collect();
        for (index, slot) in waiting.iter_mut().enumerate() {
            if slot
                .as_ref()
                .is_some_and(|waiting| at - waiting.at <= self.settings.stale_periods)
            {
                nodes[index].heard = true;
                nodes[index].weight = 1.0;
                heard.push(index);
            } else {
                *slot = None;
            }
        }
        self.judge(&heard, &mut nodes);
        let used: Vec<usize> = heard
            .iter()
            .copied()
            .filter(|index| !nodes[*index].excluded)
            .collect();
        let adopted = self.adopt(&used, &waiting, at);
        let mut parameters = self.add_learnt((&used, &nodes), &waiting, at);
        let started_anew = !is_within(&parameters.mean, &self.settings.healthy);
        if started_anew && let Ok(prior) = self.settings.prior.information() {
            (self.fused, parameters) = (prior, self.settings.prior.clone());
        }
        let instant = instant_of_most(&used, &waiting);
        for index in &used {
            nodes[*index].out_of_step = waiting[*index].as_ref().is_some_and(|waiting| {
                waiting.motion.is_some() && !self.is_same(instant, waiting.instant)
            });
        }
        let in_step: Vec<usize> = used
            .iter()
            .copied()
            .filter(|index| !nodes[*index].out_of_step)
            .collect();
        let motion = self.fuse_motion((&in_step, &nodes), &waiting);
        let mut responses = Vec::new();
        if let MotionExchange::Responses(_) | MotionExchange::Samples(_) = self.settings.motion {
            responses.resize(nodes.len(), None);
            // A faulty node's motion pulls the other nodes towards its error, so that it looks
            // regular. The station forwards its motion only after enough regular fusions.
            for index in used
                .iter()
                .filter(|index| self.known[**index].suspended == 0)
            {
                responses[*index] = waiting[*index]
                    .as_ref()
                    .and_then(|waiting| waiting.motion.clone());
            }
        }
        let feedback = self.answer(
            &heard,
            &parameters,
            used.len(),
            (motion.as_ref(), &responses),
            (instant, &waiting),
        );
        Fused {
            parameters,
            motion,
            responses,
            used: used.len(),
            nodes,
            feedback,
            started_anew,
            adopted,
        }
    }

    fn is_same(&self, instant: f64, other: f64) -> bool {
        (instant - other).abs() <= self.settings.same_instant
    }

    /// Adopts the information of nodes whose past this station does not know. Returns `true` if it
    /// did.
    ///
    /// This requires that at least half of the used nodes have such a past, and that they know more
    /// than the station. Otherwise, a restarted station would answer with its prior.
    ///
    /// All these nodes were answered with the same density, so their mean information counts
    /// nothing twice.
    fn adopt(&mut self, used: &[usize], waiting: &[Option<Waiting>], at: f64) -> bool {
        let strangers: Vec<(&Waiting, &Gaussian)> = used
            .iter()
            .filter_map(|index| {
                waiting[*index]
                    .as_ref()
                    .zip(self.known[*index].own.as_ref())
            })
            .filter_map(|(waiting, (_, density))| {
                waiting.of_unknown_past.then_some((waiting, density))
            })
            .collect();
        if 2 * strangers.len() < used.len().max(1) {
            return false;
        }
        let growth = self.settings.growth_per_period;
        let mut mean = Information::none(self.settings.prior.mean.len());
        for (waiting, density) in &strangers {
            if let Ok(information) = density.information() {
                let age = growth.powf((at - waiting.at).max(0.0));
                mean.add(1.0 / (age * strangers.len() as f64), &information);
            }
        }
        let Ok((theirs, ours)) = mean
            .gaussian()
            .and_then(|theirs| Ok((theirs, self.fused.gaussian()?)))
        else {
            return false;
        };
        // The mean ratio of the variances shows whether the nodes or the station knows more.
        let share = theirs
            .covariance
            .diagonal()
            .component_div(&ours.covariance.diagonal())
            .mean();
        let adopts = share < 1.0 && is_within(&theirs.mean, &self.settings.healthy);
        if adopts {
            self.fused = mean;
        }
        adopts
    }

    fn judge(&mut self, heard: &[usize], nodes: &mut [NodeReport]) {
        let Some(detector) = &self.settings.detector else {
            return;
        };
        let readmission = detector.readmission.max(1);
        let densities: Vec<&Gaussian> = heard
            .iter()
            .filter_map(|index| self.known[*index].own.as_ref().map(|(_, density)| density))
            .collect();
        let sharing = match self.settings.rule {
            FusionRule::Published => Sharing::Nothing,
            FusionRule::PriorCorrect(sharing) => sharing,
        };
        for (index, found) in heard.iter().zip(detector.judge(&densities, sharing)) {
            let NodeDistance {
                distance,
                excluded,
                weight,
            } = found;
            let known = &mut self.known[*index];
            let is_suspicious = match detector.weighting {
                Weighting::AllOrNothing => excluded,
                Weighting::Graded => weight < 1.0,
            };
            known.suspended = if is_suspicious {
                readmission
            } else {
                known.suspended.saturating_sub(1)
            };
            known.unsettled = match (known.suspended, weight < LEAST_WEIGHT) {
                (0, _) => 0,
                (_, true) => PATIENCE + 1,
                (_, false) => known.unsettled.saturating_add(1),
            };
            let is_out = match detector.weighting {
                Weighting::AllOrNothing => known.suspended > 0,
                Weighting::Graded => known.unsettled > PATIENCE,
            };
            let report = &mut nodes[*index];
            report.distance = Some(distance);
            report.excluded = is_out;
            report.weight = if is_out { 0.0 } else { weight };
        }
    }

    /// Makes the fused density the state, and returns it.
    ///
    /// The information that a node has learnt counts with its weight over `γ`. `γ` depends on the
    /// sum of the weights. As the weight of a node approaches zero, the result therefore approaches
    /// a fusion without it.
    fn add_learnt(
        &mut self,
        (used, nodes): (&[usize], &[NodeReport]),
        waiting: &[Option<Waiting>],
        at: f64,
    ) -> Gaussian {
        let growth = self.settings.growth_per_period;
        let age = |waiting: &Waiting| growth.powf((at - waiting.at).max(0.0));
        let fused = match self.settings.rule {
            FusionRule::Published => {
                let mut product = Information::none(self.settings.prior.mean.len());
                for index in used {
                    if let (Some(waiting), Some((_, density))) =
                        (&waiting[*index], &self.known[*index].own)
                        && let Ok(information) = density.information()
                    {
                        product.add(nodes[*index].weight / age(waiting), &information);
                    }
                }
                product.gaussian().ok().map(|density| (product, density))
            }
            FusionRule::PriorCorrect(sharing) => {
                // An invalid sum counts too much information. The second factor is the most
                // cautious one.
                let learnt = |index: &&usize| {
                    waiting[**index]
                        .as_ref()
                        .is_some_and(|waiting| waiting.learnt.is_some())
                };
                let learning = used
                    .iter()
                    .filter(learnt)
                    .map(|index| nodes[*index].weight)
                    .sum();
                let factors = [sharing.factor(learning), Sharing::All.factor(learning)];
                factors.into_iter().find_map(|factor| {
                    let mut sum = self.fused.clone();
                    for index in used {
                        if let Some(Waiting {
                            learnt: Some(learnt),
                            ..
                        }) = &waiting[*index]
                        {
                            let counted = nodes[*index].weight
                                / (factor * waiting[*index].as_ref().map_or(1.0, age));
                            sum.add(counted, learnt);
                        }
                    }
                    sum.gaussian().ok().map(|density| (sum, density))
                })
            }
        };
        if let Some((information, density)) = fused {
            self.fused = information;
            return density;
        }
        // The previous density, faded, is valid.
        self.fused
            .gaussian()
            .unwrap_or_else(|_| self.settings.prior.clone())
    }

    /// Weights each coordinate by the inverse variances, (6.44) to (6.48), and multiplies the fused
    /// variance by `γ`.
    fn fuse_motion(
        &self,
        (used, nodes): (&[usize], &[NodeReport]),
        waiting: &[Option<Waiting>],
    ) -> Option<CompressedMotion> {
        let MotionExchange::Modes(basis) = &self.settings.motion else {
            return None;
        };
        let len = 2 * basis.modes();
        let (mut weights, mut weighted) = (DVector::zeros(len), DVector::zeros(len));
        let mut count = 0.0;
        for index in used {
            let Some(motion) = waiting[*index]
                .as_ref()
                .and_then(|waiting| waiting.motion.as_ref())
            else {
                continue;
            };
            let weight = nodes[*index].weight;
            count += weight;
            for j in 0..len {
                weights[j] += weight / motion.variance[j];
                weighted[j] += weight * motion.mean[j] / motion.variance[j];
            }
        }
        let factor = match self.settings.rule {
            FusionRule::Published => 1.0,
            FusionRule::PriorCorrect(sharing) => sharing.factor(count),
        };
        (count > 0.0).then(|| CompressedMotion {
            mean: weighted.component_div(&weights),
            variance: weights.map(|weight| factor / weight),
        })
    }

    fn answer(
        &mut self,
        heard: &[usize],
        fused: &Gaussian,
        used: usize,
        (motion, responses): (Option<&CompressedMotion>, &[Option<CompressedMotion>]),
        (instant, waiting): (f64, &[Option<Waiting>]),
    ) -> Vec<Option<Feedback>> {
        let of = |node: usize| waiting[node].as_ref().map(|waiting| waiting.instant);
        let mut feedback = vec![None; self.known.len()];
        for index in heard {
            let own_instant = of(*index).unwrap_or(instant);
            // Motion of another time would be taken for the motion at the answered message.
            let motion = motion
                .filter(|_| self.is_same(instant, own_instant))
                .cloned();
            let same = |node: usize| of(node).is_some_and(|other| self.is_same(own_instant, other));
            let responses = responses.iter().enumerate();
            let responses = responses
                .map(|(node, told)| told.clone().filter(|_| same(node)))
                .collect();
            let known = &mut self.known[*index];
            let Some((answers, sent)) = known.own.clone() else {
                continue;
            };
            let target = self.settings.feedback.target(fused, used, &sent);
            known.note_answer(Answered {
                index: answers,
                sent,
                target,
            });
            feedback[*index] = Some(Feedback {
                answers,
                parameters: fused.clone(),
                nodes: used,
                motion,
                responses,
            });
        }
        feedback
    }
}

impl Known {
    /// Returns the node's start: its own message and the changes by answers since then. `None` if
    /// unknown.
    fn start<'k>(
        &'k self,
        lineage: &Lineage,
        prior: &'k Gaussian,
    ) -> Option<((u64, &'k Gaussian), Vec<Shift>)> {
        let find = |index: u64| {
            self.answered
                .iter()
                .find(|answered| answered.index == index)
        };
        let own = match lineage.own {
            0 => (0, prior),
            own => (own, &find(own)?.sent),
        };
        let shift = |answered: &u64| {
            let answered = find(*answered)?;
            Some((
                answered.index,
                answered.target.clone()?,
                answered.sent.clone(),
            ))
        };
        Some((
            own,
            lineage.answers.iter().map(shift).collect::<Option<_>>()?,
        ))
    }

    /// Records the information of a message, to subtract it from later messages that start before
    /// it.
    fn count(&mut self, index: u64, learnt: &Information, growth: f64) {
        self.counted.push_back((index, learnt.clone()));
        // Messages without an answered message between them merge into one sum, because no later
        // message can start between them. There are therefore no more sums than answers.
        let mut sums: VecDeque<(u64, Information)> = VecDeque::with_capacity(self.counted.len());
        for (index, mut learnt) in std::mem::take(&mut self.counted) {
            let apart = |before: u64| {
                self.answered
                    .iter()
                    .any(|answered| (before..index).contains(&answered.index))
            };
            if let Some((before, sum)) = sums.back().filter(|(before, _)| !apart(*before)) {
                learnt.add(1.0 / growth.powf((index - before) as f64), sum);
                sums.pop_back();
            }
            sums.push_back((index, learnt));
        }
        self.counted = sums;
    }

    fn note_answer(&mut self, answered: Answered) {
        self.answered.push_back(answered);
        let named = self
            .lineage
            .iter()
            .flat_map(|lineage| lineage.answers.iter().chain([&lineage.own]));
        let named: Vec<u64> = named.copied().collect();
        // Later messages do not name answers before the start of the last message.
        let first = named.iter().copied().min().unwrap_or(0);
        self.answered.retain(|answered| answered.index >= first);
        if self.answered.len() > ANSWERS_KEPT
            && let Some(oldest) = self
                .answered
                .iter()
                .position(|answered| !named.contains(&answered.index))
        {
            self.answered.remove(oldest);
        }
    }
}

/// An answer that a node has applied: index of the message, the replacing density, the replaced
/// density.
type Shift = (u64, Gaussian, Gaussian);

/// Returns the median time of the motions.
///
/// A wrong clock can move it only to the time of another node.
fn instant_of_most(used: &[usize], waiting: &[Option<Waiting>]) -> f64 {
    let with_motion = used.iter().filter_map(|index| {
        waiting[*index]
            .as_ref()
            .filter(|waiting| waiting.motion.is_some())
    });
    let mut instants: Vec<f64> = with_motion.map(|waiting| waiting.instant).collect();
    instants.sort_by(f64::total_cmp);
    instants.get(instants.len() / 2).copied().unwrap_or(0.0)
}

/// Limits the variances to their bounds, as the nodes do in each step.
fn bound(information: &mut Information, bounds: &DVector<f64>) {
    let Ok(mut density) = information.gaussian() else {
        return;
    };
    if bound_variances_mut(&mut density.covariance, bounds) > 0
        && let Ok(bounded) = density.information()
    {
        *information = bounded;
    }
}

#[cfg(test)]
mod tests;
