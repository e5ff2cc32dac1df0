//! Detection of faulty nodes by comparing their parameters with those of all other nodes.
//!
//! Source: Huang & Yuen (2023), §7.4.1, (7.47) to (7.64). A sensor with a constant error looks
//! regular to its own filter, but its parameters do not fit those of the other nodes.

use super::gaussian::Gaussian;
use super::station::Sharing;
use nalgebra::DVector;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF};

/// Settings of the test that finds faulty nodes: it compares the parameters of each node with those
/// of all other nodes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GlobalDetector {
    /// Probability that the distance of a regular node stays below the limit, 0.95 in the source.
    pub screening: f64,
    /// Outlier probability at and above which a suspicious node is excluded, 0.5 in the source.
    pub exclusion: f64,
    /// `true` if the test excludes the farthest node and is repeated, instead of testing all nodes
    /// at once.
    ///
    /// One node with a gross error then makes no other node suspicious.
    pub one_at_a_time: bool,
    /// Number of consecutive regular fusions before a node is used again; 1 in the source, for
    /// immediate use.
    pub readmission: u32,
    /// The treatment of suspicious nodes.
    pub weighting: Weighting,
}

/// The treatment of suspicious nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Weighting {
    /// The fusion excludes suspicious nodes, as in the source.
    #[default]
    AllOrNothing,
    /// The learnt information of a suspicious node counts less, by [`NodeDistance::weight`].
    ///
    /// The station does not forward the node's motion until the node has completed
    /// [`GlobalDetector::readmission`] regular fusions in a row. Two conditions exclude the node
    /// until then: a weight below [`LEAST_WEIGHT`], or more than [`PATIENCE`] fusions in this
    /// state.
    Graded,
}

/// Weight below which a node is excluded; its distance is then more than about three times the
/// limit.
pub const LEAST_WEIGHT: f64 = 0.1;

/// Maximum number of fusions in which a discounted node is still used before it is regular.
///
/// One bad second then costs a node little, and a faulty sensor affects the result only for a short
/// time.
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

/// The result of the test for one node.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NodeDistance {
    /// `d`: simplified Mahalanobis distance from all other nodes, (7.52).
    pub distance: f64,
    /// `true` if the node is suspicious. The fusion excludes it, unless the detector uses
    /// [`Weighting::Graded`].
    pub excluded: bool,
    /// `min(1, limit²/d²)`, where `d` is the distance from the regular nodes; 1 for a node that is
    /// not suspicious.
    ///
    /// With variances larger by the inverse of this weight, the node would be regular.
    pub weight: f64,
}

/// Minimum number of nodes that the test keeps.
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

    /// Returns the squared distance of a node from these sums, without its own terms if it is part
    /// of them. A distance that is not a number counts as infinite, so that the node is suspicious.
    ///
    /// (7.52) assumes that the other nodes have learnt independently, so that their mean has a
    /// variance smaller by their number. However, nodes that exchange measurements have almost the
    /// same information. Their mean is as uncertain as one of them, and a node more certain than
    /// the others would look far from all. The joint information of the others therefore counts as
    /// in the fusion: `1/γ` of each.
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
        if sum.is_nan() { f64::INFINITY } else { sum }
    }
}

impl GlobalDetector {
    /// Returns the distance above which a node is suspicious, `√Φ⁻¹_χ²(screening)`, (7.53).
    #[must_use]
    pub fn limit(&self, parameters: usize) -> f64 {
        chi_squared(parameters).map_or(f64::INFINITY, |chi| chi.inverse_cdf(self.screening).sqrt())
    }

    /// Tests the nodes by their densities of the same parameters and returns the results in the
    /// same order.
    ///
    /// `sharing` is the assumed overlap of their information. The test requires at least three
    /// nodes; fewer nodes are all regular.
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
            // Without any regular node, the nodes with distances up to the median replace the
            // regular nodes.
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

/// Returns `min(1, limit²/d²)`.
fn weight(limit: f64, distance: f64) -> f64 {
    (limit / distance).powi(2).min(1.0)
}

fn chi_squared(degrees: usize) -> Option<ChiSquared> {
    ChiSquared::new(degrees as f64).ok()
}

#[cfg(test)]
mod tests;
