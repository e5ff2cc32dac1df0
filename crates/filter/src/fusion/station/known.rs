//! The station's knowledge of one node, from its messages and the answers to them.

use super::StationSettings;
use crate::error::FilterError;
use crate::fading::bound_variances_mut;
use crate::fusion::compression::CompressedMotion;
use crate::fusion::gaussian::{Gaussian, Information};
use crate::fusion::local::{Lineage, Sent};
use nalgebra::DVector;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Maximum number of kept answers per node.
///
/// Answers named in the last message of the node are kept beyond this limit, because its next
/// message may name them again.
pub(super) const ANSWERS_KEPT: usize = 16;

/// The station's knowledge of one node.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Known {
    /// The last message.
    pub(super) own: Option<Sent>,
    /// Lineage of the last message; `None` if that message had none.
    pub(super) lineage: Option<Lineage>,
    /// Answered messages, and the densities that may have replaced them.
    pub(super) answered: VecDeque<Answered>,
    /// Information of the messages after the message that the lineage names as `own`.
    pub(super) counted: VecDeque<Counted>,
    /// Message received since the last fusion. Not saved, because the station's clock restarts with
    /// each run.
    #[serde(skip)]
    pub(super) waiting: Option<WaitingEstimate>,
    /// Regular fusions still required before the node is used again. With graded weights, they are
    /// required before its motion is forwarded.
    pub(super) suspended: u32,
    /// Number of consecutive fusions with `suspended` above 0.
    ///
    /// It exceeds `PATIENCE` at once if the weight is below `LEAST_WEIGHT`.
    pub(super) unsettled: u32,
}

/// A message of a node that was answered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Answered {
    pub(super) index: u64,
    pub(super) sent: Gaussian,
    /// The density that replaced it, if the node applies feedback.
    pub(super) target: Option<Gaussian>,
}

/// A message of a node that waits for the next fusion.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct WaitingEstimate {
    /// Time of the message on the station's clock (fusion periods).
    pub(super) at: f64,
    pub(super) learnt: Option<Information>,
    /// `true` if the node started from a density that this station does not know.
    pub(super) of_unknown_past: bool,
    pub(super) motion: Option<CompressedMotion>,
    /// Time of the motion (fusion periods of measurement time).
    pub(super) instant: f64,
}

/// The learnt information of a message.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Counted {
    pub(super) index: u64,
    pub(super) learnt: Information,
}

/// The density from which a node started towards its message: a density of its own, and the answers
/// that it has applied since then.
pub(super) struct NodeStart<'k> {
    /// Index of the own message; 0 for the prior that all nodes share.
    index: u64,
    density: &'k Gaussian,
    shifts: Vec<Shift<'k>>,
}

/// An answer that a node has applied.
struct Shift<'k> {
    /// Index of the answered message.
    index: u64,
    /// The density that replaced the sent one.
    target: &'k Gaussian,
    sent: &'k Gaussian,
}

impl NodeStart<'_> {
    /// Returns the information of the density, faded to period `index`.
    fn faded_to(&self, index: u64, settings: &StationSettings) -> Result<Information, FilterError> {
        let growth = |since: u64| settings.growth(index.saturating_sub(since) as f64);
        let mut start = self.density.information()?;
        start.fade(growth(self.index));
        for shift in &self.shifts {
            start.add(1.0 / growth(shift.index), &shift.target.information()?);
            start.add(-1.0 / growth(shift.index), &shift.sent.information()?);
        }
        Ok(start)
    }
}

impl Known {
    /// Returns `true` if message `index` or a later one has been received.
    pub(super) fn has_received(&self, index: u64) -> bool {
        self.own.as_ref().is_some_and(|own| index <= own.index)
    }

    /// Returns the density from which the node started. `None` if unknown.
    pub(super) fn start<'k>(
        &'k self,
        lineage: &Lineage,
        prior: &'k Gaussian,
    ) -> Option<NodeStart<'k>> {
        let find = |index: u64| {
            self.answered
                .iter()
                .find(|answered| answered.index == index)
        };
        let density = match lineage.own {
            0 => prior,
            own => &find(own)?.sent,
        };
        let shift = |index: &u64| {
            let answered = find(*index)?;
            Some(Shift {
                index: answered.index,
                target: answered.target.as_ref()?,
                sent: &answered.sent,
            })
        };
        Some(NodeStart {
            index: lineage.own,
            density,
            shifts: lineage.answers.iter().map(shift).collect::<Option<_>>()?,
        })
    }

    /// Returns the information that the node has learnt with the message `index`, whose information
    /// is `now`. `None` if its start is unknown.
    ///
    /// Forgets the counted messages before the start.
    pub(super) fn learnt(
        &mut self,
        lineage: &Lineage,
        index: u64,
        now: &Information,
        settings: &StationSettings,
    ) -> Option<Information> {
        let start = self.start(lineage, &settings.prior)?;
        let mut from = start.faded_to(index, settings).ok()?;
        bound(&mut from, &settings.variance_bound);
        let mut learnt = now.clone();
        learnt.add(-1.0, &from);
        self.counted.retain(|counted| counted.index > lineage.own);
        for counted in &self.counted {
            let age = settings.growth((index - counted.index) as f64);
            learnt.add(-1.0 / age, &counted.learnt);
        }
        Some(learnt)
    }

    /// Records the information of a message, to subtract it from later messages that start before
    /// it.
    pub(super) fn count(&mut self, index: u64, learnt: &Information, settings: &StationSettings) {
        self.counted.push_back(Counted {
            index,
            learnt: learnt.clone(),
        });
        // Messages without an answered message between them merge into one sum, because no later
        // message can start between them. There are therefore no more sums than answers.
        let mut sums: VecDeque<Counted> = VecDeque::with_capacity(self.counted.len());
        for mut counted in std::mem::take(&mut self.counted) {
            let index = counted.index;
            let apart = |before: u64| {
                self.answered
                    .iter()
                    .any(|answered| (before..index).contains(&answered.index))
            };
            if let Some(before) = sums.back().filter(|before| !apart(before.index)) {
                let age = settings.growth((index - before.index) as f64);
                counted.learnt.add(1.0 / age, &before.learnt);
                sums.pop_back();
            }
            sums.push_back(counted);
        }
        self.counted = sums;
    }

    pub(super) fn note_answer(&mut self, answered: Answered) {
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

/// Limits the variances to their bounds, as the nodes do in each step.
pub(super) fn bound(information: &mut Information, bounds: &DVector<f64>) {
    let Ok(mut density) = information.gaussian() else {
        return;
    };
    if bound_variances_mut(&mut density.covariance, bounds) > 0
        && let Ok(bounded) = density.information()
    {
        *information = bounded;
    }
}
