//! The central station: fuses on its own clock with what has arrived.
//!
//! Sources: Huang & Yuen (2023), §6.3.3, (6.44) to (6.58); §7.3.2, (7.18) to (7.32); §7.4. What a node has learnt is its density
//! without the density that it started from; the published product leaves that in and counts it once for every node.

use super::compression::{CompressedMotion, MotionExchange};
use super::detector::{GlobalDetector, NodeDistance};
use super::gaussian::{Gaussian, Information};
use super::local::{Feedback, FeedbackRule, LocalEstimate, base, is_within};
use crate::error::FilterError;
use crate::fading::bound_variances_mut;
use nalgebra::DVector;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Answers to a node that its next message may refer to.
const ANSWERS_KEPT: usize = 16;

/// How densities are fused.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FusionRule {
    /// The product of all densities, as published: only for comparison.
    Published,
    /// What all share is counted once, and what each has learnt is added.
    PriorCorrect(Sharing),
}

impl Default for FusionRule {
    fn default() -> Self {
        Self::PriorCorrect(Sharing::default())
    }
}

/// How far nodes learn the same from the excitation that they share: what each has learnt counts `1/γ`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sharing {
    /// `γ = N_s`: never overconfident, whatever the correlation (covariance intersection with equal weights).
    #[default]
    All,
    /// `γ = 1`: nodes learn independently.
    Nothing,
    /// Any `γ` from 1 up; at most the number of nodes counts.
    Factor(f64),
}

impl Sharing {
    fn factor(self, nodes: usize) -> f64 {
        let most = nodes.max(1) as f64;
        match self {
            Self::All => most,
            Self::Nothing => 1.0,
            Self::Factor(factor) => factor.clamp(1.0, most),
        }
    }
}

/// All that a station needs to know.
#[derive(Debug, Clone, PartialEq)]
pub struct StationSettings {
    /// Number of nodes.
    pub nodes: usize,
    /// The density of the parameters that all nodes start from, a sample before their first: a filter's prior, which is for
    /// its first sample, with its covariance over `λ`.
    pub prior: Gaussian,
    /// What forgetting makes of a variance in a fusion period, `λ^(r_s/r_c)`.
    pub growth_per_period: f64,
    /// No variance exceeds this (N_θ), as at the nodes.
    pub variance_bound: DVector<f64>,
    /// How densities are fused.
    pub rule: FusionRule,
    /// What the nodes do with the result.
    pub feedback: FeedbackRule,
    /// What nodes tell one another of the motion.
    pub motion: MotionExchange,
    /// The test of the nodes, if there is one.
    pub detector: Option<GlobalDetector>,
    /// A message older than this (fusion periods) is dropped, 3 by default.
    pub stale_periods: f64,
    /// Fused means outside these (N_θ each) make the station start anew from the prior.
    pub healthy: (DVector<f64>, DVector<f64>),
}

/// Why a message of a node was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Refusal {
    /// There is no such node.
    UnknownNode,
    /// Its sizes are not those of the structure.
    Dimension,
    /// It holds numbers that are not finite, or a covariance that is none.
    NoDensity,
    /// It is not newer than what the node has sent before.
    Old,
}

impl Refusal {
    /// Returns the word under which it is counted.
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

/// What a fusion found of one node.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct NodeReport {
    /// It had sent something since the fusion before, not too old.
    pub heard: bool,
    /// Its distance from the others, where nodes are tested and it was heard.
    pub distance: Option<f64>,
    /// It was left out.
    pub excluded: bool,
}

/// What a fusion gave.
#[derive(Debug, Clone, PartialEq)]
pub struct Fused {
    /// The density of the parameters.
    pub parameters: Gaussian,
    /// The motion, where nodes send it in modes.
    pub motion: Option<CompressedMotion>,
    /// By node: its responses or samples, where nodes send them and it was fused.
    pub responses: Vec<Option<CompressedMotion>>,
    /// Number of nodes that were fused.
    pub used: usize,
    /// By node.
    pub nodes: Vec<NodeReport>,
    /// By node: the answer to its last message, if there is one.
    pub feedback: Vec<Option<Feedback>>,
    /// What came out was no sound value, and the station began anew from the prior.
    pub started_anew: bool,
}

/// A node as the station knows it.
#[derive(Debug, Clone, Default)]
struct Known {
    /// index and density of its last message
    own: Option<(u64, Gaussian)>,
    /// answers that it may have taken since: index, what replaced, what was replaced
    shifts: VecDeque<(u64, Gaussian, Gaussian)>,
    /// what has come since the last fusion
    waiting: Option<Waiting>,
    /// fusions in which it has to be regular yet before it is used again
    suspended: u32,
}

#[derive(Debug, Clone)]
struct Waiting {
    /// time of the message on the station's clock (fusion periods)
    at: f64,
    learnt: Option<Information>,
    motion: Option<CompressedMotion>,
}

/// The state of the station: one density, and what it knows of its nodes.
#[derive(Debug, Clone)]
pub struct Station {
    settings: StationSettings,
    known: Vec<Known>,
    fused: Information,
    /// time of the last fusion (fusion periods)
    at: Option<f64>,
}

impl Station {
    /// Makes a station at the common prior.
    ///
    /// # Errors
    /// When the prior is no density or a setting is out of range.
    pub fn new(settings: StationSettings) -> Result<Self, FilterError> {
        let fused = settings.prior.information()?;
        let expected = settings.prior.mean.len();
        for (what, found) in [
            ("variance bound of the station", settings.variance_bound.len()),
            ("lower limit of health of the station", settings.healthy.0.len()),
            ("upper limit of health of the station", settings.healthy.1.len()),
        ] {
            if found != expected {
                return Err(FilterError::Dimension { what, found, expected });
            }
        }
        let growth = settings.growth_per_period;
        if !(growth >= 1.0 && growth.is_finite()) {
            let what = "growth in a fusion period";
            return Err(FilterError::Setting { what, found: growth, allowed: "at least 1 and finite" });
        }
        if let FusionRule::PriorCorrect(Sharing::Factor(factor)) = settings.rule
            && !(factor >= 1.0 && factor.is_finite())
        {
            let what = "sharing factor";
            return Err(FilterError::Setting { what, found: factor, allowed: "at least 1 and finite" });
        }
        Ok(Self { known: vec![Known::default(); settings.nodes], settings, fused, at: None })
    }

    /// Takes a message of a node that belongs to time `at` (fusion periods on the station's clock).
    ///
    /// # Errors
    /// When the message is of no use; the station is then as it was.
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
        let now = message.parameters.information().map_err(|_| Refusal::NoDensity)?;
        let motion_is_sound = match (&message.motion, &self.settings.motion) {
            (None, _) => true,
            (Some(_), MotionExchange::None) => false,
            (Some(motion), MotionExchange::Modes(basis)) => motion.is_sound(2 * basis.modes()),
            (Some(motion), MotionExchange::Responses(nodes)) => {
                nodes.get(node).is_some_and(|node| motion.is_sound(node.rows().nrows()))
            }
            (Some(motion), MotionExchange::Samples(exchange)) => exchange.is_sound(node, motion.mean.as_slice()),
        };
        if !(motion_is_sound && at.is_finite()) {
            return Err(Refusal::NoDensity);
        }
        if known.own.as_ref().is_some_and(|(index, _)| message.index <= *index) {
            return Err(Refusal::Old);
        }
        // what the node started from; unknown when a message of it was lost, or after it began anew
        let learnt = message.lineage.as_ref().and_then(|lineage| {
            let own = match &known.own {
                Some((index, density)) if *index == lineage.own => (*index, density),
                None if lineage.own == 0 => (0, prior),
                Some(_) | None => return None,
            };
            let shifts: Vec<_> =
                known.shifts.iter().filter(|(answered, ..)| lineage.answers.contains(answered)).cloned().collect();
            if shifts.len() != lineage.answers.len() {
                return None;
            }
            let mut from = base(own, &shifts, message.index, growth).ok()?;
            bound(&mut from, &self.settings.variance_bound);
            let mut learnt = now.clone();
            learnt.add(-1.0, &from);
            Some(learnt)
        });
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
        known.waiting = Some(Waiting { at, learnt, motion: message.motion });
        known.own = Some((message.index, message.parameters));
        if let Some(lineage) = message.lineage {
            known.shifts.retain(|(answered, ..)| *answered > lineage.answers.last().copied().unwrap_or(0));
        } else {
            known.shifts.clear();
        }
        Ok(())
    }

    /// Forgets a node that has begun a new life: its numbers start anew.
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

    /// Returns whether a node has sent something since the last fusion.
    #[must_use]
    pub fn has_heard(&self, node: usize) -> bool {
        self.known.get(node).is_some_and(|known| known.waiting.is_some())
    }

    /// Fuses what has arrived, at time `at` (fusion periods on the station's clock); later messages wait for the next one.
    ///
    /// Without any message what is known fades. The result is always a density: sums that are none are made more cautious,
    /// up to leaving out what the nodes have learnt.
    pub fn fuse(&mut self, at: f64) -> Fused {
        let growth = self.settings.growth_per_period;
        let elapsed = self.at.map_or(at, |before| at - before).max(0.0);
        self.at = Some(at);
        self.fused.fade(growth.powf(elapsed));
        bound(&mut self.fused, &self.settings.variance_bound);

        let mut nodes = vec![NodeReport::default(); self.known.len()];
        let mut heard: Vec<usize> = Vec::with_capacity(nodes.len());
        let mut waiting: Vec<Option<Waiting>> = self.known.iter_mut().map(|known| known.waiting.take()).collect();
        for (index, slot) in waiting.iter_mut().enumerate() {
            if slot.as_ref().is_some_and(|waiting| at - waiting.at <= self.settings.stale_periods) {
                nodes[index].heard = true;
                heard.push(index);
            } else {
                *slot = None;
            }
        }
        self.judge(&heard, &mut nodes);
        let used: Vec<usize> = heard.iter().copied().filter(|index| !nodes[*index].excluded).collect();
        let mut parameters = self.add_learnt(&used, &waiting, at);
        let started_anew = !is_within(&parameters.mean, &self.settings.healthy);
        if started_anew && let Ok(prior) = self.settings.prior.information() {
            (self.fused, parameters) = (prior, self.settings.prior.clone());
        }
        let motion = self.fuse_motion(&used, &waiting);
        let mut responses = Vec::new();
        if let MotionExchange::Responses(_) | MotionExchange::Samples(_) = self.settings.motion {
            responses.resize(nodes.len(), None);
            for index in &used {
                responses[*index] = waiting[*index].as_ref().and_then(|waiting| waiting.motion.clone());
            }
        }
        let feedback = self.answer(&heard, &parameters, used.len(), (motion.as_ref(), &responses));
        Fused { parameters, motion, responses, used: used.len(), nodes, feedback, started_anew }
    }

    fn judge(&mut self, heard: &[usize], nodes: &mut [NodeReport]) {
        let Some(detector) = &self.settings.detector else { return };
        let readmission = detector.readmission.max(1);
        let densities: Vec<&Gaussian> =
            heard.iter().filter_map(|index| self.known[*index].own.as_ref().map(|(_, density)| density)).collect();
        for (index, NodeDistance { distance, excluded }) in heard.iter().zip(detector.judge(&densities)) {
            let suspended = &mut self.known[*index].suspended;
            *suspended = if excluded { readmission } else { suspended.saturating_sub(1) };
            nodes[*index].distance = Some(distance);
            nodes[*index].excluded = *suspended > 0;
        }
    }

    /// Makes the fused density the state, and returns it.
    fn add_learnt(&mut self, used: &[usize], waiting: &[Option<Waiting>], at: f64) -> Gaussian {
        let growth = self.settings.growth_per_period;
        let age = |waiting: &Waiting| growth.powf((at - waiting.at).max(0.0));
        let fused = match self.settings.rule {
            FusionRule::Published => {
                let mut product = Information::none(self.settings.prior.mean.len());
                for index in used {
                    if let (Some(waiting), Some((_, density))) = (&waiting[*index], &self.known[*index].own)
                        && let Ok(information) = density.information()
                    {
                        product.add(1.0 / age(waiting), &information);
                    }
                }
                product.gaussian().ok().map(|density| (product, density))
            }
            FusionRule::PriorCorrect(sharing) => {
                // a sum that is no density is one that counts too much
                let factors = [sharing.factor(used.len()), Sharing::All.factor(used.len())];
                factors.into_iter().find_map(|factor| {
                    let mut sum = self.fused.clone();
                    for index in used {
                        if let Some(Waiting { learnt: Some(learnt), .. }) = &waiting[*index] {
                            sum.add(1.0 / (factor * waiting[*index].as_ref().map_or(1.0, age)), learnt);
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
        // what was known before, faded, is a density
        self.fused.gaussian().unwrap_or_else(|_| self.settings.prior.clone())
    }

    /// Weighs each coordinate by the variances, (6.44) to (6.48); the variance is that of nodes that share all.
    fn fuse_motion(&self, used: &[usize], waiting: &[Option<Waiting>]) -> Option<CompressedMotion> {
        let MotionExchange::Modes(basis) = &self.settings.motion else { return None };
        let len = 2 * basis.modes();
        let (mut weights, mut weighted) = (DVector::zeros(len), DVector::zeros(len));
        let mut count = 0;
        for index in used {
            let Some(motion) = waiting[*index].as_ref().and_then(|waiting| waiting.motion.as_ref()) else { continue };
            count += 1;
            for j in 0..len {
                weights[j] += 1.0 / motion.variance[j];
                weighted[j] += motion.mean[j] / motion.variance[j];
            }
        }
        let factor = match self.settings.rule {
            FusionRule::Published => 1.0,
            FusionRule::PriorCorrect(sharing) => sharing.factor(count),
        };
        (count > 0).then(|| CompressedMotion {
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
    ) -> Vec<Option<Feedback>> {
        let mut feedback = vec![None; self.known.len()];
        for index in heard {
            let known = &mut self.known[*index];
            let Some((answers, sent)) = &known.own else { continue };
            if let Some(target) = self.settings.feedback.target(fused, used, sent) {
                if known.shifts.len() == ANSWERS_KEPT {
                    known.shifts.pop_front();
                }
                known.shifts.push_back((*answers, target, sent.clone()));
            }
            feedback[*index] = Some(Feedback {
                answers: *answers,
                parameters: fused.clone(),
                nodes: used,
                motion: motion.cloned(),
                responses: responses.to_vec(),
            });
        }
        feedback
    }
}

/// Keeps variances below their bounds, as the nodes do at each step.
fn bound(information: &mut Information, bounds: &DVector<f64>) {
    let Ok(mut density) = information.gaussian() else { return };
    if bound_variances_mut(&mut density.covariance, bounds) > 0
        && let Ok(bounded) = density.information()
    {
        *information = bounded;
    }
}

#[cfg(test)]
mod tests;
