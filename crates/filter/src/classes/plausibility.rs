//! The posterior probabilities of model classes, by logarithms.
//!
//! Source: Huang & Yuen (2023), (5.13) to (5.21). Logarithms are carried from step to step: without a floor a class that
//! does not fit has a plausibility too small for a number within seconds.

use serde::{Deserialize, Serialize};

/// How far below the others a class without a floor starts after its filter was lost (nats).
const LOST: f64 = 1000.0;

/// Plausibility of each class: positive, with sum 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plausibilities {
    /// `ln P` of each class.
    logarithms: Vec<f64>,
}

impl Plausibilities {
    /// Gives every class the same, (5.17).
    #[must_use]
    pub fn uniform(classes: usize) -> Self {
        Self {
            logarithms: vec![-(classes as f64).ln(); classes],
        }
    }

    /// Takes the given probabilities, which must have the sum 1.
    #[must_use]
    pub fn from_probabilities(probabilities: &[f64]) -> Self {
        Self {
            logarithms: probabilities.iter().map(|p| p.ln()).collect(),
        }
    }

    /// Takes `ln p(z | D, C)` of every class, minus infinity where its filter was lost; returns `ln p(z | D)`.
    ///
    /// No plausibility is left below `floor`; 0 is none. When every class is lost, nothing changes and the result is minus
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
        // beside the largest: of evidences of 10⁵ nats, as an outlier of hundreds of deviations has, nothing but differences
        // must be left before the sum is taken, or it is 1 to ten digits only
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

    /// Lifts what is below the floor onto it, and scales the others so that the sum stays 1.
    ///
    /// Scaling may push another one below: then once more. A floor below `1/N` ends after `N` rounds at most.
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

    /// Returns the most plausible class, (5.32); the first of several.
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

    /// Tells whether two classes are the most plausible ones.
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
    fn logarithms_give_what_bayes_gives() {
        // ch5 §5 A1: by plain numbers, and with evidences that no number holds
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
    fn floor_lifts_three_of_five_and_keeps_the_sum() {
        // ch5 §5 A2: scaling the others pushes a third one below the floor
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

    /// Returns after how many steps the second class leads, when the first was better by `gap` nats for `steps`.
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
    fn floor_lets_a_class_come_back_at_once() {
        // ch5 §5 A3: as long as it was hopeless without a floor, ln(9999)/0.05 steps with it
        let delay = switching_delay(2000, 0.05, 0.0);
        assert!(delay.abs_diff(2001) <= 1, "{delay}");
        let delay = switching_delay(20_000, 0.05, 1e-4);
        assert!(delay.abs_diff(185) <= 1, "{delay}");
    }

    #[test]
    fn lost_class_is_the_least_plausible_and_comes_back() {
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
