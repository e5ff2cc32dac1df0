//! Which nodes are wrong: their parameters against those of all others.
//!
//! Source: Huang & Yuen (2023), §7.4.1, (7.47) to (7.64). A sensor with a constant error looks regular to its own filter; its
//! parameters do not fit those of the other nodes.

use super::gaussian::Gaussian;
use super::station::Sharing;
use nalgebra::DVector;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF};

/// The test of the nodes against one another.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GlobalDetector {
    /// Probability below which the distance of a regular node stays, 0.95 in the source.
    pub screening: f64,
    /// Outlier probability from which on a suspicious node is left out, 0.5 in the source.
    pub exclusion: f64,
    /// Leaves out the farthest node, looks again, and so on: one gross node then makes no other suspicious.
    pub one_at_a_time: bool,
    /// Fusions in a row in which a node must be regular before it is used again; 1, as in the source, for at once.
    pub readmission: u32,
    /// What becomes of a node that is suspicious.
    pub weighting: Weighting,
}

/// What becomes of a node that is found to be suspicious.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Weighting {
    /// It is left out, as in the source.
    #[default]
    AllOrNothing,
    /// What it has learnt counts less, by [`NodeDistance::weight`], and its motion is told to nobody, until it has been regular in so many
    /// fusions in a row as it takes to be used again. It is left out until then when its weight is below [`LEAST_WEIGHT`], or that has
    /// gone on for more than [`PATIENCE`] fusions.
    Graded,
}

/// A node that counts less than this, which is farther than about three times the limit, is left out.
pub const LEAST_WEIGHT: f64 = 0.1;

/// Fusions for which a node may go without having become regular before it is left out: one bad second costs it little, and a wrong sensor
/// does not pull for longer.
pub const PATIENCE: u32 = 3;

impl Default for GlobalDetector {
    fn default() -> Self {
        Self {
            screening: 0.95,
            exclusion: 0.5,
            one_at_a_time: false,
            readmission: 1,
            weighting: Weighting::AllOrNothing,
        }
    }
}

/// What the test found of one node.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NodeDistance {
    /// `d`: simplified Mahalanobis distance from all others, (7.52).
    pub distance: f64,
    /// It is suspicious: left out of this fusion, unless weights are graded.
    pub excluded: bool,
    /// `min(1, limit²/d²)`, with the distance from the regular nodes: with errors as much larger it would be a regular node. 1 of one
    /// that is not suspicious.
    pub weight: f64,
}

/// The fewest nodes that are kept.
const FEWEST: usize = 2;

/// Sums of weights `1/v` and of weighted means.
struct Sums {
    nodes: usize,
    sharing: Sharing,
    weights: DVector<f64>,
    weighted: DVector<f64>,
}

impl Sums {
    fn of<'g>(len: usize, sharing: Sharing, nodes: impl Iterator<Item = &'g Gaussian>) -> Self {
        let mut sums = Self {
            nodes: 0,
            sharing,
            weights: DVector::zeros(len),
            weighted: DVector::zeros(len),
        };
        for node in nodes {
            sums.nodes += 1;
            for m in 0..len {
                let weight = 1.0 / node.covariance[(m, m)];
                sums.weights[m] += weight;
                sums.weighted[m] += weight * node.mean[m];
            }
        }
        sums
    }

    /// Squared distance of a node from these sums, without its own terms where it is part of them.
    ///
    /// In (7.52) the others are surer by their number, as if each had learnt by itself. Nodes that tell one another what they
    /// measure know much the same: the mean of the others is as uncertain as one of them, and a node that is surer than they are
    /// would be far from all. What the others know together is counted as it is fused, `1/γ` of each.
    fn squared_distance(&self, node: &Gaussian, is_part: bool) -> f64 {
        let mut sum = 0.0;
        let shared = self
            .sharing
            .factor((self.nodes - usize::from(is_part)) as f64);
        for m in 0..node.mean.len() {
            let (variance, mean) = (node.covariance[(m, m)], node.mean[m]);
            let own = if is_part { 1.0 / variance } else { 0.0 };
            let weight = self.weights[m] - own;
            if weight > 0.0 {
                let others = (self.weighted[m] - own * mean) / weight;
                sum += (others - mean).powi(2) / (shared / weight + variance);
            }
        }
        sum
    }
}

impl GlobalDetector {
    /// Returns the distance from which on a node is suspicious, `√Φ⁻¹_χ²(screening)`, (7.53).
    #[must_use]
    pub fn limit(&self, parameters: usize) -> f64 {
        chi_squared(parameters).map_or(f64::INFINITY, |chi| chi.inverse_cdf(self.screening).sqrt())
    }

    /// Judges the nodes, which share what they know as `sharing` says, by their densities of the same parameters; the order is kept.
    /// Fewer than three are not judged.
    #[must_use]
    pub fn judge(&self, nodes: &[&Gaussian], sharing: Sharing) -> Vec<NodeDistance> {
        let parameters = nodes.first().map_or(0, |node| node.mean.len());
        let Some(chi) = chi_squared(parameters).filter(|_| nodes.len() > FEWEST) else {
            return vec![
                NodeDistance {
                    distance: 0.0,
                    excluded: false,
                    weight: 1.0
                };
                nodes.len()
            ];
        };
        let limit = chi.inverse_cdf(self.screening).sqrt();
        let all = Sums::of(parameters, sharing, nodes.iter().copied());
        let mut found: Vec<NodeDistance> = nodes
            .iter()
            .map(|node| NodeDistance {
                distance: all.squared_distance(node, true).sqrt(),
                excluded: false,
                weight: 1.0,
            })
            .collect();
        if self.one_at_a_time {
            self.delete_farthest(nodes, sharing, limit, &mut found);
            return found;
        }
        let mut regular: Vec<bool> = found.iter().map(|node| node.distance <= limit).collect();
        if !regular.contains(&true) {
            // none is left: those at or below the median stand for the regular ones
            let mut distances: Vec<f64> = found.iter().map(|node| node.distance).collect();
            distances.sort_by(f64::total_cmp);
            let median = distances[(distances.len() - 1) / 2];
            regular = found.iter().map(|node| node.distance <= median).collect();
        }
        let kept = nodes
            .iter()
            .zip(&regular)
            .filter(|(_, is)| **is)
            .map(|(node, _)| *node);
        let kept = Sums::of(parameters, sharing, kept);
        for ((node, found), regular) in nodes.iter().zip(&mut found).zip(&regular) {
            if !regular {
                let squared = kept.squared_distance(node, false);
                found.excluded = chi.cdf(squared) >= self.exclusion; // P_o^G, (7.59)
                if found.excluded {
                    found.weight = weight(limit, squared.sqrt());
                }
            }
        }
        found
    }

    fn delete_farthest(
        &self,
        nodes: &[&Gaussian],
        sharing: Sharing,
        limit: f64,
        found: &mut [NodeDistance],
    ) {
        let parameters = nodes[0].mean.len();
        loop {
            let left: Vec<usize> = (0..nodes.len())
                .filter(|index| !found[*index].excluded)
                .collect();
            if left.len() <= FEWEST {
                return;
            }
            let sums = Sums::of(parameters, sharing, left.iter().map(|index| nodes[*index]));
            for index in 0..nodes.len() {
                found[index].distance = sums
                    .squared_distance(nodes[index], !found[index].excluded)
                    .sqrt();
            }
            found
                .iter_mut()
                .filter(|found| found.excluded)
                .for_each(|found| found.weight = weight(limit, found.distance));
            let farthest = left
                .iter()
                .copied()
                .max_by(|a, b| found[*a].distance.total_cmp(&found[*b].distance));
            match farthest {
                Some(index) if found[index].distance > limit => {
                    found[index].excluded = true;
                    found[index].weight = weight(limit, found[index].distance);
                }
                Some(_) | None => return,
            }
        }
    }
}

/// `min(1, limit²/d²)`; 0 of a distance that is none.
fn weight(limit: f64, distance: f64) -> f64 {
    let weight = (limit / distance).powi(2);
    if weight.is_nan() {
        0.0
    } else {
        weight.min(1.0)
    }
}

fn chi_squared(degrees: usize) -> Option<ChiSquared> {
    ChiSquared::new(degrees as f64).ok()
}

#[cfg(test)]
mod tests;
