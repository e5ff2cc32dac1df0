//! The central station, which fuses received messages on its own clock.
//!
//! Sources: Huang & Yuen (2023), §6.3.3, (6.44) to (6.58); §7.3.2, (7.18) to (7.32); §7.4. The
//! information that a node has learnt is its density without the density from which it started. The
//! published product includes the start density and counts it once per node.

mod fuse;
mod known;
mod settings;

pub use settings::{FusionRule, Sharing, StationSettings};

use super::compression::{CompressedMotion, MotionExchange};
use super::gaussian::{Gaussian, Information};
use super::local::{Feedback, LocalEstimate, Sent};
use crate::error::FilterError;
use known::{Known, WaitingEstimate};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

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
    /// `true` if the node has sent a message since the previous fusion, and the message is not
    /// stale.
    pub heard: bool,
    /// Distance of the node from the others. `None` without a detector or without a message.
    pub distance: Option<f64>,
    /// `true` if the fusion excluded the node.
    pub excluded: bool,
    /// Weight of the information that the node has learnt.
    ///
    /// It is 1 for a regular node, less for a discounted node, and 0 for an excluded node or
    /// without a message.
    pub weight: f64,
    /// `true` if the fusion ignored the node's motion, because its time differs from that of most
    /// nodes.
    pub out_of_step: bool,
}

impl NodeReport {
    /// Returns `true` if the fusion used a message of the node.
    #[must_use]
    pub fn is_used(&self) -> bool {
        self.heard && !self.excluded
    }
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
    /// `true` if the fused density was invalid or its means were out of range, and the station
    /// restarted from the prior.
    pub restarted_from_prior: bool,
    /// `true` if the station adopted the information of its nodes. It does so after a restart if
    /// they know more than its checkpoint.
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

/// The central station of distributed identification: it fuses the densities of all nodes.
///
/// [`Station::receive`] takes the messages of the nodes, and each fusion combines the messages
/// since the previous one with the density of the station. All times are in fusion periods on the
/// clock of the station, so the station reads no clock.
///
/// An invalid or old message is rejected and changes nothing. [`Station::state`] and
/// [`Station::restore`] write and read a checkpoint, which excludes the messages since the last
/// fusion.
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
        settings.check()?;
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
        if known.has_received(message.index) {
            return Err(Refusal::Old);
        }
        let learnt = message
            .lineage
            .as_ref()
            .and_then(|lineage| known.learnt(lineage, message.index, &now, &self.settings));
        let of_unknown_past = learnt.is_none() && message.lineage.is_some();
        if let Some(learnt) = &learnt {
            known.count(message.index, learnt, &self.settings);
        }
        let before = known.waiting.take().and_then(|before| {
            let mut learnt = before.learnt?;
            learnt.fade(self.settings.growth((at - before.at).max(0.0)));
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
        known.waiting = Some(WaitingEstimate {
            at,
            learnt,
            of_unknown_past,
            motion: message.motion,
            instant,
        });
        known.own = Some(Sent {
            index: message.index,
            density: message.parameters,
        });
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
    /// If nodes were answered after the checkpoint, this station does not know the densities from
    /// which their messages start. See [`Fused::adopted`].
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
            let own = known.own.as_ref().map(|own| &own.density);
            answered.chain([own]).flatten().all(is_of_structure)
                && known
                    .counted
                    .iter()
                    .all(|counted| fits(&counted.learnt.vector, &counted.learnt.matrix))
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

    /// Restarts the clock of the station at 0, for nodes that replay a record again.
    ///
    /// The first fusion fades the density by its own time since then.
    pub fn restart_clock(&mut self) {
        self.at = None;
    }

    /// Returns `true` if the station has received message `index` of a node, or a later one.
    #[must_use]
    pub fn has_received(&self, node: usize, index: u64) -> bool {
        self.known
            .get(node)
            .is_some_and(|known| known.has_received(index))
    }

    /// Returns `true` if a node has sent a message since the last fusion.
    #[must_use]
    pub fn has_heard(&self, node: usize) -> bool {
        self.known
            .get(node)
            .is_some_and(|known| known.waiting.is_some())
    }
}

#[cfg(test)]
mod tests;
