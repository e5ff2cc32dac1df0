//! One fusion: the station judges the nodes, fuses their densities and motion, and answers them.

use super::known::{Answered, WaitingEstimate, bound};
use super::{Fused, FusionRule, NodeReport, Sharing, Station};
use crate::fusion::compression::{CompressedMotion, MotionExchange};
use crate::fusion::detector::{LEAST_WEIGHT, NodeDistance, PATIENCE, Weighting};
use crate::fusion::gaussian::{Gaussian, Information};
use crate::fusion::local::Feedback;
use nalgebra::DVector;

/// The messages of one fusion, with the reports on their nodes.
struct Round {
    /// Time of the fusion (fusion periods on the station's clock).
    at: f64,
    /// Messages by node; `None` if missing or stale.
    waiting: Vec<Option<WaitingEstimate>>,
    /// Reports by node.
    reports: Vec<NodeReport>,
}

impl Round {
    /// Returns the nodes with a message that is not stale.
    fn heard(&self) -> Vec<usize> {
        self.nodes(|report| report.heard)
    }

    /// Returns the nodes with a message that are not excluded.
    fn used(&self) -> Vec<usize> {
        self.nodes(NodeReport::is_used)
    }

    fn nodes(&self, counts: impl Fn(&NodeReport) -> bool) -> Vec<usize> {
        let reports = self.reports.iter().enumerate();
        reports
            .filter(|(_, report)| counts(report))
            .map(|(node, _)| node)
            .collect()
    }

    /// Returns the age of a message (fusion periods), 0 for a message of the future.
    fn age(&self, waiting: &WaitingEstimate) -> f64 {
        (self.at - waiting.at).max(0.0)
    }

    /// Returns the median time of the motions.
    ///
    /// A wrong clock can move it only to the time of another node.
    fn instant_of_most(&self, used: &[usize]) -> f64 {
        let with_motion = used.iter().filter_map(|index| {
            self.waiting[*index]
                .as_ref()
                .filter(|waiting| waiting.motion.is_some())
        });
        let mut instants: Vec<f64> = with_motion.map(|waiting| waiting.instant).collect();
        instants.sort_by(f64::total_cmp);
        instants.get(instants.len() / 2).copied().unwrap_or(0.0)
    }
}

/// The motion that a fusion sends to the nodes.
struct FusedMotion {
    /// The fused motion, if nodes exchange motion in modes.
    modes: Option<CompressedMotion>,
    /// Responses or samples of each fused node, if nodes exchange them.
    responses: Vec<Option<CompressedMotion>>,
    /// Time of the motion (fusion periods of measurement time).
    instant: f64,
}

impl Station {
    /// Fuses the received messages at time `at` (fusion periods on the station's clock).
    ///
    /// Messages that arrive later wait for the next fusion. Without any message, the density only
    /// fades. The result is always a valid density: if the sum is invalid, the fusion reduces the
    /// learnt information, if necessary to zero.
    pub fn fuse(&mut self, at: f64) -> Fused {
        let elapsed = self.at.map_or(at, |before| at - before).max(0.0);
        self.at = Some(at);
        self.fused.fade(self.settings.growth(elapsed));
        bound(&mut self.fused, &self.settings.variance_bound);

        let mut round = self.begin_round(at);
        self.judge(&mut round);
        let used = round.used();
        let adopted = self.adopt(&used, &round);
        let healthy = self
            .add_learnt(&used, &round)
            .filter(|density| self.settings.healthy.contain(&density.mean));
        let restarted_from_prior = healthy.is_none();
        let parameters = healthy.unwrap_or_else(|| self.settings.prior.clone());
        if restarted_from_prior && let Ok(prior) = self.settings.prior.information() {
            self.fused = prior;
        }
        let motion = self.fuse_motion(&used, &mut round);
        let feedback = self.answer(&round, &parameters, used.len(), &motion);
        Fused {
            parameters,
            motion: motion.modes,
            responses: motion.responses,
            used: used.len(),
            nodes: round.reports,
            feedback,
            restarted_from_prior,
            adopted,
        }
    }

    /// Takes the messages that wait for a fusion at time `at`, without stale ones.
    fn begin_round(&mut self, at: f64) -> Round {
        let mut reports = vec![NodeReport::default(); self.known.len()];
        let mut waiting: Vec<Option<WaitingEstimate>> = self
            .known
            .iter_mut()
            .map(|known| known.waiting.take())
            .collect();
        for (report, slot) in reports.iter_mut().zip(&mut waiting) {
            if slot
                .as_ref()
                .is_some_and(|waiting| at - waiting.at <= self.settings.stale_periods)
            {
                report.heard = true;
                report.weight = 1.0;
            } else {
                *slot = None;
            }
        }
        Round {
            at,
            waiting,
            reports,
        }
    }

    fn is_same(&self, instant: f64, other: f64) -> bool {
        (instant - other).abs() <= self.settings.same_instant
    }

    /// Adopts the information of nodes that start from a density unknown to this station. Returns
    /// `true` if it did.
    ///
    /// This requires that at least half of the used nodes start from such a density, and that they
    /// know more than the station. Without this step, a restarted station would answer with its
    /// prior.
    ///
    /// All these nodes were answered with the same density, so their mean information counts
    /// nothing twice.
    fn adopt(&mut self, used: &[usize], round: &Round) -> bool {
        let strangers: Vec<(&WaitingEstimate, &Gaussian)> = used
            .iter()
            .filter_map(|index| {
                round.waiting[*index]
                    .as_ref()
                    .zip(self.known[*index].own.as_ref())
            })
            .filter_map(|(waiting, own)| waiting.of_unknown_past.then_some((waiting, &own.density)))
            .collect();
        if 2 * strangers.len() < used.len().max(1) {
            return false;
        }
        let mut mean = Information::none(self.settings.prior.mean.len());
        for (waiting, density) in &strangers {
            if let Ok(information) = density.information() {
                let age = self.settings.growth(round.age(waiting));
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
        let adopts = share < 1.0 && self.settings.healthy.contain(&theirs.mean);
        if adopts {
            self.fused = mean;
        }
        adopts
    }

    /// Compares the densities of the nodes, and excludes or discounts suspicious ones.
    fn judge(&mut self, round: &mut Round) {
        let Some(detector) = &self.settings.detector else {
            return;
        };
        let readmission = detector.readmission.max(1);
        let heard = round.heard();
        let densities: Vec<&Gaussian> = heard
            .iter()
            .filter_map(|index| self.known[*index].own.as_ref().map(|own| &own.density))
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
            let report = &mut round.reports[*index];
            report.distance = Some(distance);
            report.excluded = is_out;
            report.weight = if is_out { 0.0 } else { weight };
        }
    }

    /// Makes the fused density the state, and returns it. `None` if no valid density is left.
    ///
    /// The information that a node has learnt counts with its weight over `γ`. `γ` depends on the
    /// sum of the weights. As the weight of a node approaches zero, the result therefore approaches
    /// a fusion without it.
    fn add_learnt(&mut self, used: &[usize], round: &Round) -> Option<Gaussian> {
        let age = |waiting: &WaitingEstimate| self.settings.growth(round.age(waiting));
        let fused = match self.settings.rule {
            FusionRule::Published => {
                let mut product = Information::none(self.settings.prior.mean.len());
                for index in used {
                    if let (Some(waiting), Some(own)) =
                        (&round.waiting[*index], &self.known[*index].own)
                        && let Ok(information) = own.density.information()
                    {
                        product.add(round.reports[*index].weight / age(waiting), &information);
                    }
                }
                product.gaussian().ok().map(|density| (product, density))
            }
            FusionRule::PriorCorrect(sharing) => {
                // An invalid sum counts too much information. The second factor is the most
                // cautious one.
                let learnt = |index: &&usize| {
                    round.waiting[**index]
                        .as_ref()
                        .is_some_and(|waiting| waiting.learnt.is_some())
                };
                let learning = used
                    .iter()
                    .filter(learnt)
                    .map(|index| round.reports[*index].weight)
                    .sum();
                let factors = [sharing.factor(learning), Sharing::All.factor(learning)];
                factors.into_iter().find_map(|factor| {
                    let mut sum = self.fused.clone();
                    for index in used {
                        if let Some(waiting) = &round.waiting[*index]
                            && let Some(learnt) = &waiting.learnt
                        {
                            let counted = round.reports[*index].weight / (factor * age(waiting));
                            sum.add(counted, learnt);
                        }
                    }
                    sum.gaussian().ok().map(|density| (sum, density))
                })
            }
        };
        if let Some((information, density)) = fused {
            self.fused = information;
            return Some(density);
        }
        // The previous density, faded, is valid.
        self.fused.gaussian().ok()
    }

    /// Fuses the motion of the used nodes, and marks nodes whose motion has another time.
    fn fuse_motion(&self, used: &[usize], round: &mut Round) -> FusedMotion {
        let instant = round.instant_of_most(used);
        for index in used {
            round.reports[*index].out_of_step =
                round.waiting[*index].as_ref().is_some_and(|waiting| {
                    waiting.motion.is_some() && !self.is_same(instant, waiting.instant)
                });
        }
        let mut in_step = used.to_vec();
        in_step.retain(|index| !round.reports[*index].out_of_step);
        let mut responses = Vec::new();
        if let MotionExchange::Responses(_) | MotionExchange::Samples(_) = self.settings.motion {
            responses.resize(round.reports.len(), None);
            // A faulty node's motion pulls the other nodes towards its error, so that it looks
            // regular. The station forwards its motion only after enough regular fusions.
            for index in used
                .iter()
                .filter(|index| self.known[**index].suspended == 0)
            {
                responses[*index] = round.waiting[*index]
                    .as_ref()
                    .and_then(|waiting| waiting.motion.clone());
            }
        }
        FusedMotion {
            modes: self.fuse_modes(&in_step, round),
            responses,
            instant,
        }
    }

    /// Weights each coordinate by the inverse variances, (6.44) to (6.48), and multiplies the fused
    /// variance by `γ`.
    fn fuse_modes(&self, used: &[usize], round: &Round) -> Option<CompressedMotion> {
        let MotionExchange::Modes(basis) = &self.settings.motion else {
            return None;
        };
        let len = 2 * basis.modes();
        let (mut weights, mut weighted) = (DVector::zeros(len), DVector::zeros(len));
        let mut count = 0.0;
        for index in used {
            let Some(motion) = round.waiting[*index]
                .as_ref()
                .and_then(|waiting| waiting.motion.as_ref())
            else {
                continue;
            };
            let weight = round.reports[*index].weight;
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

    /// Returns the answers by node. `None` for a node without a message.
    fn answer(
        &mut self,
        round: &Round,
        fused: &Gaussian,
        used: usize,
        motion: &FusedMotion,
    ) -> Vec<Option<Feedback>> {
        let of = |node: usize| round.waiting[node].as_ref().map(|waiting| waiting.instant);
        let mut feedback = vec![None; self.known.len()];
        for index in round.heard() {
            let own_instant = of(index).unwrap_or(motion.instant);
            // Motion of another time would be taken for the motion at the answered message.
            let modes = motion
                .modes
                .as_ref()
                .filter(|_| self.is_same(motion.instant, own_instant))
                .cloned();
            let same = |node: usize| of(node).is_some_and(|other| self.is_same(own_instant, other));
            let responses = motion.responses.iter().enumerate();
            let responses = responses
                .map(|(node, told)| told.clone().filter(|_| same(node)))
                .collect();
            let known = &mut self.known[index];
            let Some(own) = known.own.clone() else {
                continue;
            };
            let target = self.settings.feedback.target(fused, used, &own.density);
            known.note_answer(Answered {
                index: own.index,
                sent: own.density,
                target,
            });
            feedback[index] = Some(Feedback {
                answers: own.index,
                parameters: fused.clone(),
                nodes: used,
                motion: modes,
                responses,
            });
        }
        feedback
    }
}
