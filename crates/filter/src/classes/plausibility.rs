//! The posterior probabilities of model classes, as logarithms.
//!
//! Source: Huang & Yuen (2023), (5.13) to (5.21). The state consists of logarithms: without a
//! floor, the plausibility of a class that does not fit underflows within seconds.

use serde::{Deserialize, Serialize};

/// Distance of a lost class without a floor below the least plausible other class (nats).
const LOST: f64 = 1000.0;

/// The plausibility of each class, all positive with sum 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plausibilities {
    /// `ln P` of each class.
    logarithms: Vec<f64>,
}

impl Plausibilities {
    /// Returns equal plausibilities for `classes` classes, 1/`classes` each: Huang & Yuen (2023),
    /// (5.17).
    #[must_use]
    pub fn uniform(classes: usize) -> Self {
        Self {
            logarithms: vec![-(classes as f64).ln(); classes],
        }
    }

    /// Creates plausibilities from the probabilities of the classes, in the order of the classes.
    ///
    /// The probabilities must sum to 1. This function does not check or normalise them.
    #[must_use]
    pub fn from_probabilities(probabilities: &[f64]) -> Self {
        Self {
            logarithms: probabilities.iter().map(|p| p.ln()).collect(),
        }
    }

    /// Updates the plausibilities with the log evidence `ln p(z | D, C)` of every class `C`.
    /// Returns the log evidence `ln p(z | D)` of all classes. Here `z` is the measurement of this
    /// frame and `D` are the data before it.
    ///
    /// The evidence of a diverged filter is minus infinity. No plausibility falls below `floor`; 0
    /// means no floor. If every filter has diverged, nothing changes and the result is minus
    /// infinity.
    pub fn update(&mut self, log_evidences: &[f64], floor: f64) -> f64 {
        let joint = self
            .logarithms
            .iter()
            .zip(log_evidences)
            .map(|(prior, evidence)| prior + evidence);
        let largest = joint.clone().fold(f64::NEG_INFINITY, f64::max);
        if largest == f64::NEG_INFINITY {
            return largest;
        }
        // Each term first loses the largest value, and only then the logarithm of the sum. The log
        // evidence of an outlier of hundreds of standard deviations is about −10⁵ nats. In the
        // other order, this magnitude would limit the sum of the plausibilities to ten correct
        // digits.
        let rest = joint.map(|l| (l - largest).exp()).sum::<f64>().ln();
        let mut least = f64::INFINITY;
        for (prior, evidence) in self.logarithms.iter_mut().zip(log_evidences) {
            *prior = (*prior + evidence - largest) - rest;
            if prior.is_finite() {
                least = least.min(*prior);
            }
        }
        for logarithm in &mut self.logarithms {
            if !logarithm.is_finite() {
                *logarithm = least - LOST;
            }
        }
        if floor > 0.0 {
            self.raise(floor);
        }
        largest + rest
    }

    /// Raises all plausibilities below the floor to the floor, and scales the others so that the
    /// sum stays 1.
    ///
    /// Scaling can push another plausibility below the floor, so the function repeats. With a floor
    /// below `1/N` it needs at most `N` rounds.
    fn raise(&mut self, floor: f64) {
        let ln_floor = floor.ln();
        for _ in 0..self.logarithms.len() {
            let is_floored = |l: f64| l <= ln_floor;
            let floored = self.logarithms.iter().filter(|l| is_floored(**l)).count();
            if floored == 0 {
                return;
            }
            let others: f64 = self
                .logarithms
                .iter()
                .filter(|l| !is_floored(**l))
                .map(|l| l.exp())
                .sum();
            let scale = ((1.0 - floor * floored as f64) / others).ln();
            for logarithm in &mut self.logarithms {
                *logarithm = if is_floored(*logarithm) {
                    ln_floor
                } else {
                    *logarithm + scale
                };
            }
            if !self.logarithms.iter().any(|l| *l < ln_floor) {
                return;
            }
        }
    }

    /// Returns the plausibility of one class.
    #[must_use]
    pub fn of(&self, class: usize) -> f64 {
        self.logarithms[class].exp()
    }

    /// Returns the plausibility of every class.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = f64> {
        self.logarithms.iter().map(|l| l.exp())
    }

    /// Returns `ln P` of every class.
    #[must_use]
    pub fn logarithms(&self) -> &[f64] {
        &self.logarithms
    }

    /// Returns the index of the most plausible class, (5.32), the first one in a tie.
    #[must_use]
    pub fn leader(&self) -> usize {
        let mut leader = 0;
        for (class, logarithm) in self.logarithms.iter().enumerate() {
            if *logarithm > self.logarithms[leader] {
                leader = class;
            }
        }
        leader
    }

    /// Returns `true` if at least two classes share the highest plausibility.
    #[must_use]
    pub fn is_tied(&self) -> bool {
        let most = self.logarithms[self.leader()];
        self.logarithms.iter().filter(|l| **l == most).count() > 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_agree_with_bayes_rule() {
        // ch5 §5 A1: with plain probabilities, and with evidences that underflow as probabilities
        let (prior, evidences) = ([0.2, 0.3, 0.5], [-3.0, -1.0, -2.0]);
        let joint: Vec<f64> = prior
            .iter()
            .zip(&evidences)
            .map(|(p, l): (&f64, &f64)| p * l.exp())
            .collect();
        let sum: f64 = joint.iter().sum();
        for (offset, tolerance) in [(0.0, 1e-12), (-1e5, 1e-9)] {
            let mut plausibilities = Plausibilities::from_probabilities(&prior);
            let log_evidence = plausibilities.update(&evidences.map(|l| l + offset), 0.0);
            assert!((log_evidence - sum.ln() - offset).abs() < 1e-9);
            for (found, joint) in plausibilities.iter().zip(&joint) {
                assert!((found - joint / sum).abs() < tolerance);
            }
        }
    }

    #[test]
    fn floor_raises_three_of_five_and_keeps_the_sum() {
        // ch5 §5 A2: scaling the others pushes a third class below the floor
        let mut plausibilities =
            Plausibilities::from_probabilities(&[0.9998, 1.5e-4, 1e-30, 4.99e-5, 1e-5]);
        plausibilities.update(&[0.0; 5], 1e-4);
        let found: Vec<f64> = plausibilities.iter().collect();
        for (found, expected) in found.iter().zip([0.99955, 1.4996e-4, 1e-4, 1e-4, 1e-4]) {
            assert!((found / expected - 1.0).abs() < 1e-4, "{found} {expected}");
        }
        assert!((found.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!(found.iter().all(|p| *p >= 1e-4 * (1.0 - 1e-12)));
    }

    /// Returns the number of steps until the second class leads.
    ///
    /// The first class was better by `gap` nats in the preceding `steps` steps.
    fn switching_delay(steps: usize, gap: f64, floor: f64) -> usize {
        let mut plausibilities = Plausibilities::uniform(2);
        for _ in 0..steps {
            plausibilities.update(&[0.0, -gap], floor);
        }
        let mut delay = 0;
        while plausibilities.of(1) <= plausibilities.of(0) {
            plausibilities.update(&[-gap, 0.0], floor);
            delay += 1;
        }
        delay
    }

    #[test]
    fn floor_shortens_the_return_of_a_class() {
        // ch5 §5 A3: without a floor, the return takes as long as the former lead. With a floor, it
        // takes ln(9999)/0.05 steps.
        let delay = switching_delay(2000, 0.05, 0.0);
        assert!(delay.abs_diff(2001) <= 1, "{delay}");
        let delay = switching_delay(20_000, 0.05, 1e-4);
        assert!(delay.abs_diff(185) <= 1, "{delay}");
    }

    #[test]
    fn lost_class_is_the_least_plausible_and_can_lead_again() {
        let mut plausibilities = Plausibilities::uniform(3);
        plausibilities.update(&[0.0, f64::NEG_INFINITY, -5.0], 0.0);
        assert!(plausibilities.logarithms()[1].is_finite());
        assert!(plausibilities.of(1) < plausibilities.of(2));
        plausibilities.update(&[0.0, 2000.0, 0.0], 0.0);
        assert_eq!(plausibilities.leader(), 1);
    }

    #[test]
    fn nothing_changes_when_every_class_is_lost() {
        let mut plausibilities = Plausibilities::from_probabilities(&[0.25, 0.75]);
        assert_eq!(
            plausibilities.update(&[f64::NEG_INFINITY; 2], 1e-4),
            f64::NEG_INFINITY
        );
        assert!((plausibilities.of(1) - 0.75).abs() < 1e-15);
    }
}
