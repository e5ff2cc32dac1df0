mod restarts;

use super::known::ANSWERS_KEPT;
use super::*;
use crate::extended::{ExtendedKalmanFilter, FilterSettings, Frame};
use crate::fading::FadingFactor;
use crate::fusion::detector::PATIENCE;
use crate::fusion::local::{FeedbackRule, Lineage, LocalFilter, NodeSettings, Taken};
use crate::fusion::{
    CovarianceScheme, GlobalDetector, MeanLimits, SampleExchange, Weighting, product,
};
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::NoiseModel;
use nalgebra::DMatrix;

/// Two constants; each node observes one weighted sum of them.
///
/// The model is linear, and no motion hides the learnt information.
#[derive(Debug, Clone)]
struct Constants {
    row: [f64; 2],
    mean: [f64; 2],
}

impl ProcessModel for Constants {
    fn state_len(&self) -> usize {
        2
    }
    fn parameter_len(&self) -> usize {
        2
    }
    fn excitation_len(&self) -> usize {
        0
    }
    fn linearise_process(&mut self, _: &[f64], _: &[f64]) {}
    fn derivative(&self, out: &mut [f64]) {
        out.fill(0.0);
    }
    fn jacobian_mul(&self, _: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        out.fill(0.0);
    }
    fn excitation_matrix(&self, _: &mut DMatrix<f64>) {}
    fn rate_bound(&self) -> f64 {
        0.0
    }
}

impl ObservationModel for Constants {
    fn observation_len(&self) -> usize {
        1
    }
    fn linearise_observation(&mut self, state: &[f64], _: &[f64]) {
        self.mean.copy_from_slice(state);
    }
    fn observe(&self, out: &mut [f64]) {
        out[0] = self.row[0] * self.mean[0] + self.row[1] * self.mean[1];
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        for (column, out) in columns.as_slice().chunks_exact(2).zip(out.as_mut_slice()) {
            *out = self.row[0] * column[0] + self.row[1] * column[1];
        }
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        None
    }
}

const PERIOD: u64 = 5;
const NOISE: f64 = 0.3;

fn fading() -> FadingFactor {
    FadingFactor::from_half_life(60.0).unwrap()
}

fn prior() -> Gaussian {
    Gaussian {
        mean: DVector::from_row_slice(&[0.9, 1.1]),
        covariance: DMatrix::from_diagonal_element(2, 2, 0.04),
    }
}

fn node(row: [f64; 2], feedback: FeedbackRule) -> LocalFilter<Constants> {
    let noise = NoiseModel::known(
        DMatrix::zeros(0, 0),
        DMatrix::from_element(1, 1, NOISE * NOISE),
    );
    let std = prior().covariance.diagonal().map(f64::sqrt);
    let mut settings = FilterSettings::new(0.1, prior().mean, std, noise);
    settings.fading = fading();
    let filter = ExtendedKalmanFilter::new(
        Constants {
            row,
            mean: [0.0; 2],
        },
        settings,
    )
    .unwrap();
    let limits = MeanLimits {
        lower: DVector::repeat(2, -1e3),
        upper: DVector::repeat(2, 1e3),
    };
    let settings = NodeSettings {
        steps_per_period: PERIOD,
        feedback,
        scheme: CovarianceScheme::Full,
        motion: MotionExchange::None,
        position: 0,
        healthy: limits,
    };
    LocalFilter::new(filter, settings).unwrap()
}

fn station(nodes: usize, rule: FusionRule, feedback: FeedbackRule) -> Station {
    Station::new(StationSettings {
        nodes,
        prior: Gaussian {
            covariance: prior().covariance / fading().value(),
            ..prior()
        },
        growth_per_period: fading().value().powi(PERIOD as i32),
        variance_bound: DVector::repeat(2, f64::INFINITY),
        rule,
        feedback,
        motion: MotionExchange::None,
        same_instant: 0.5 / PERIOD as f64,
        detector: None,
        stale_periods: 3.0,
        healthy: MeanLimits {
            lower: DVector::repeat(2, 0.0),
            upper: DVector::repeat(2, 5.0),
        },
    })
    .unwrap()
}

#[test]
fn station_restarts_from_the_prior_after_an_implausible_fusion() {
    let mut station = station(2, FusionRule::Published, FeedbackRule::Marginal);
    let message = |index, mean: [f64; 2]| LocalEstimate {
        index,
        parameters: Gaussian {
            mean: DVector::from_row_slice(&mean),
            covariance: DMatrix::from_diagonal_element(2, 2, 1e-6),
        },
        lineage: Some(Lineage {
            own: index - 1,
            answers: Vec::new(),
        }),
        motion: None,
        instant: index as f64,
    };
    for node in 0..2 {
        station.receive(node, message(1, [1.0, 1.1]), 1.0).unwrap();
    }
    let fused = station.fuse(1.0);
    assert!(!fused.restarted_from_prior && (fused.parameters.mean[1] - 1.1).abs() < 1e-9);
    for node in 0..2 {
        station.receive(node, message(2, [1.0, -9.0]), 2.0).unwrap();
    }
    let fused = station.fuse(2.0);
    assert!(fused.restarted_from_prior);
    assert_eq!(fused.parameters.mean, prior().mean);
    // The nodes also receive the prior.
    assert_eq!(
        fused.feedback[0].as_ref().unwrap().parameters.mean,
        prior().mean
    );
}

/// Returns a reproducible datum of node `k` at `step`, without a pattern.
fn datum(k: usize, step: u64, row: [f64; 2]) -> f64 {
    let noise = ((step as f64 * 12.9898 + k as f64 * 78.233).sin() * 43_758.547).fract() - 0.5;
    row[0] * 1.05 + row[1] * 0.93 + NOISE * 2.0 * noise
}

/// The filter with the data of all nodes, in information form.
struct Centralised(Information);

impl Centralised {
    fn step(&mut self, step: u64, rows: &[[f64; 2]]) {
        if step > 0 {
            self.0.fade(fading().value());
        }
        for (k, row) in rows.iter().enumerate() {
            let row_vector = DVector::from_row_slice(row);
            self.0.matrix += &row_vector * row_vector.transpose() / (NOISE * NOISE);
            self.0.vector += row_vector * datum(k, step, *row) / (NOISE * NOISE);
        }
    }
}

const ROWS: [[f64; 2]; 4] = [[1.0, 0.2], [0.3, 1.0], [1.0, -0.5], [0.0, 0.7]];

/// Runs four nodes for forty periods and returns the distances from the centralised filter.
///
/// Feedback reaches node `k` `lag(k, step)` samples after the station sent it. The distances are
/// those of the fused means and, relative, of the covariances.
fn distance_from_centralised(
    feedback: FeedbackRule,
    lag: impl Fn(usize, u64) -> u64,
) -> (f64, f64) {
    let mut nodes: Vec<_> = ROWS.iter().map(|row| node(*row, feedback)).collect();
    let mut station = station(4, FusionRule::PriorCorrect(Sharing::Nothing), feedback);
    let mut centralised = Centralised(prior().information().unwrap());
    let mut under_way: Vec<(u64, usize, Feedback)> = Vec::new();
    let mut worst = (0.0_f64, 0.0_f64);
    for step in 0..40 * PERIOD {
        centralised.step(step, &ROWS);
        for (k, node) in nodes.iter_mut().enumerate() {
            node.step(Frame {
                observations: &[datum(k, step, ROWS[k])],
                excitation: &[],
            })
            .unwrap();
        }
        under_way.retain(|(due, k, feedback)| {
            if *due <= step {
                assert_eq!(
                    nodes[*k].take(feedback),
                    Taken::Applied,
                    "step {step}, node {k}"
                );
            }
            *due > step
        });
        if (step + 1).is_multiple_of(PERIOD) {
            let period = ((step + 1) / PERIOD) as f64;
            for (k, node) in nodes.iter_mut().enumerate() {
                station.receive(k, node.report(), period).unwrap();
            }
            let fused = station.fuse(period);
            assert_eq!(fused.used, 4);
            let expected = centralised.0.gaussian().unwrap();
            worst.0 = worst
                .0
                .max((&fused.parameters.mean - &expected.mean).amax());
            let off = (&fused.parameters.covariance - &expected.covariance).amax()
                / expected.covariance.amax();
            worst.1 = worst.1.max(off);
            for (k, answer) in fused.feedback.into_iter().enumerate() {
                let answer = answer.unwrap();
                match lag(k, step) {
                    0 => assert_eq!(nodes[k].take(&answer), Taken::Applied),
                    u64::MAX => {} // lost
                    lag => under_way.push((step + lag, k, answer)),
                }
            }
        }
    }
    worst
}

#[test]
fn independent_gains_give_the_centralised_filter_for_every_feedback() {
    for feedback in [
        FeedbackRule::Marginal,
        FeedbackRule::Federated,
        FeedbackRule::None,
        FeedbackRule::Mean,
    ] {
        let at_once = distance_from_centralised(feedback, |_, _| 0);
        let late = distance_from_centralised(feedback, |k, _| 1 + 2 * k as u64);
        let irregular = distance_from_centralised(feedback, |k, step| {
            if (step + k as u64).is_multiple_of(3) {
                u64::MAX
            } else {
                2
            }
        });
        for (case, (mean, covariance)) in [
            ("at once", at_once),
            ("late", late),
            ("irregular", irregular),
        ] {
            assert!(
                mean < 1e-10 && covariance < 1e-10,
                "{feedback:?}, {case}: {mean:e}, {covariance:e}"
            );
        }
    }
}

#[test]
fn sixteen_copies_of_the_prior_fuse_to_the_prior() {
    // ch6 §5, check 5
    let message = |index| LocalEstimate {
        index,
        parameters: Gaussian {
            covariance: prior().covariance * fading().value().powi(PERIOD as i32 - 1),
            ..prior()
        },
        lineage: Some(Lineage {
            own: 0,
            answers: Vec::new(),
        }),
        motion: None,
        instant: index as f64,
    };
    let faded = message(1).parameters;
    for sharing in [Sharing::All, Sharing::Nothing, Sharing::Factor(4.0)] {
        let mut station = station(
            16,
            FusionRule::PriorCorrect(sharing),
            FeedbackRule::Marginal,
        );
        for node in 0..16 {
            station.receive(node, message(1), 1.0).unwrap();
        }
        let fused = station.fuse(1.0).parameters;
        assert!((fused.mean - &faded.mean).amax() < 1e-10);
        assert!((fused.covariance - &faded.covariance).amax() < 1e-10);
    }
    let mut station = station(16, FusionRule::Published, FeedbackRule::Reset);
    for node in 0..16 {
        station.receive(node, message(1), 1.0).unwrap();
    }
    let fused = station.fuse(1.0).parameters;
    assert!((fused.covariance * 16.0 - &faded.covariance).amax() < 1e-10);
    let (direct, _) = product(&vec![faded; 16]).unwrap();
    assert!((fused.mean - direct.mean).amax() < 1e-10);
}

#[test]
fn invalid_messages_are_rejected_and_change_nothing() {
    let mut station = station(2, FusionRule::default(), FeedbackRule::Marginal);
    let good = LocalEstimate {
        index: 1,
        parameters: prior(),
        lineage: Some(Lineage {
            own: 0,
            answers: Vec::new(),
        }),
        motion: None,
        instant: 1.0,
    };
    let with = |parameters| LocalEstimate {
        parameters,
        ..good.clone()
    };
    let nan = Gaussian {
        mean: DVector::from_row_slice(&[f64::NAN, 1.0]),
        ..prior()
    };
    let indefinite = Gaussian {
        covariance: DMatrix::from_row_slice(2, 2, &[1.0, 2.0, 2.0, 1.0]),
        ..prior()
    };
    let longer = Gaussian {
        mean: DVector::zeros(3),
        covariance: DMatrix::identity(3, 3),
    };
    assert_eq!(
        station.receive(7, good.clone(), 1.0),
        Err(Refusal::UnknownNode)
    );
    assert_eq!(station.receive(0, with(nan), 1.0), Err(Refusal::NoDensity));
    assert_eq!(
        station.receive(0, with(indefinite), 1.0),
        Err(Refusal::NoDensity)
    );
    assert_eq!(
        station.receive(0, with(longer), 1.0),
        Err(Refusal::Dimension)
    );
    assert!(!station.has_heard(0));
    station.receive(0, good.clone(), 1.0).unwrap();
    assert_eq!(
        station.receive(0, good.clone(), 1.0),
        Err(Refusal::Old),
        "a repeat"
    );
    assert!(station.has_heard(0));
    station.forget(0);
    station.receive(0, good, 1.0).unwrap();
}

#[test]
fn variances_grow_up_to_their_bound_without_messages() {
    let mut station = station(2, FusionRule::default(), FeedbackRule::Marginal);
    station.settings.variance_bound = DVector::repeat(2, 0.05);
    let first = station.fuse(1.0).parameters;
    assert!(first.covariance[(0, 0)] > 0.04 && first.covariance[(0, 0)] < 0.05);
    let last = station.fuse(100.0);
    assert!((last.parameters.covariance[(1, 1)] - 0.05).abs() < 1e-12);
    assert_eq!(last.used, 0);
    assert!((last.parameters.mean - prior().mean).amax() < 1e-12);
}

/// Regression: after a gap of 85 minutes with a half-life of 10 s, the factor of the fading
/// overflowed. The station lost its means, and counted the bound of a node as learnt.
#[test]
fn means_survive_any_gap_and_nothing_is_learnt_in_it() {
    let mut station = station(1, FusionRule::default(), FeedbackRule::Marginal);
    station.settings.variance_bound = DVector::repeat(2, 0.05);
    let message = |index, own, variance| LocalEstimate {
        index,
        parameters: Gaussian {
            mean: DVector::from_row_slice(&[0.7, 1.2]),
            covariance: DMatrix::from_diagonal_element(2, 2, variance),
        },
        lineage: Some(Lineage {
            own,
            answers: vec![own; usize::from(own > 0)],
        }),
        motion: None,
        instant: index as f64,
    };
    station.receive(0, message(1, 0, 1e-8), 1.0).unwrap();
    let before = station.fuse(1.0).parameters;
    assert!((&before.mean - DVector::from_row_slice(&[0.7, 1.2])).amax() < 1e-6);
    let periods = 100_000;
    let at = 1.0 + periods as f64;
    let fused = station.fuse(at);
    assert!(!fused.restarted_from_prior);
    let is_same = |after: Gaussian| {
        (&after.mean - &before.mean).amax() < 1e-9
            && (0..2).all(|j| (after.covariance[(j, j)] - 0.05).abs() < 1e-9)
    };
    assert!(is_same(fused.parameters));
    // The variances of the node have grown to their bound, so it has learnt nothing since its first
    // message.
    let last = message(2 + periods, 1, 0.05);
    station.receive(0, last, at + 1.0).unwrap();
    assert!(is_same(station.fuse(at + 1.0).parameters));
}

#[test]
fn stale_message_is_not_used() {
    let mut station = station(1, FusionRule::default(), FeedbackRule::Marginal);
    let message = LocalEstimate {
        index: 1,
        parameters: prior(),
        lineage: Some(Lineage {
            own: 0,
            answers: Vec::new(),
        }),
        motion: None,
        instant: 1.0,
    };
    station.receive(0, message, 1.0).unwrap();
    let fused = station.fuse(5.0);
    assert!(!fused.nodes[0].heard);
    assert!(fused.feedback[0].is_none());
}

/// Runs two nodes that learn independently; messages of the second node arrive only in periods with
/// `hears(period)`.
///
/// Returns the fused covariances minus those of the centralised filter.
fn more_uncertain_than_centralised(
    feedback: FeedbackRule,
    hears: impl Fn(u64) -> bool,
) -> Vec<DMatrix<f64>> {
    let mut nodes = [node(ROWS[0], feedback), node(ROWS[1], feedback)];
    let mut station = station(2, FusionRule::PriorCorrect(Sharing::Nothing), feedback);
    let mut centralised = Centralised(prior().information().unwrap());
    let mut differences = Vec::new();
    for step in 0..60 * PERIOD {
        centralised.step(step, &ROWS[..2]);
        for (k, node) in nodes.iter_mut().enumerate() {
            node.step(Frame {
                observations: &[datum(k, step, ROWS[k])],
                excitation: &[],
            })
            .unwrap();
        }
        if (step + 1).is_multiple_of(PERIOD) {
            let period = (step + 1) / PERIOD;
            for (k, node) in nodes.iter_mut().enumerate() {
                let report = node.report();
                if k == 0 || hears(period) {
                    station.receive(k, report, period as f64).unwrap();
                }
            }
            let fused = station.fuse(period as f64);
            for (node, answer) in nodes.iter_mut().zip(&fused.feedback) {
                if let Some(answer) = answer {
                    assert_eq!(node.take(answer), Taken::Applied);
                }
            }
            differences
                .push(fused.parameters.covariance - centralised.0.gaussian().unwrap().covariance);
        }
    }
    differences
}

/// Regression test: a lost message must not lose the information learnt until then.
#[test]
fn information_counts_exactly_once_after_lost_messages() {
    let runs: [fn(u64) -> bool; 3] = [
        |period| period.is_multiple_of(2),
        |period| period.is_multiple_of(7),
        |period| period % 9 > 5,
    ];
    for feedback in [
        FeedbackRule::None,
        FeedbackRule::Marginal,
        FeedbackRule::Federated,
    ] {
        for hears in runs {
            for (period, more) in (1..).zip(more_uncertain_than_centralised(feedback, hears)) {
                assert!(
                    more.clone().symmetric_eigen().eigenvalues.min() > -1e-9,
                    "{feedback:?}, period {period}"
                );
                // A received message contains everything that lost messages contained.
                assert!(
                    !hears(period) || more.amax() < 1e-9,
                    "{feedback:?}, period {period}: {:e}",
                    more.amax()
                );
            }
        }
    }
}

/// Regression test: a node without answers must not name messages that the station has not
/// received.
///
/// The station would then count nothing from this node.
#[test]
fn node_without_replies_sends_all_that_it_learns() {
    let mut nodes = [
        node(ROWS[0], FeedbackRule::Marginal),
        node(ROWS[1], FeedbackRule::Marginal),
    ];
    let mut station = station(
        2,
        FusionRule::PriorCorrect(Sharing::Nothing),
        FeedbackRule::Marginal,
    );
    let mut centralised = Centralised(prior().information().unwrap());
    for step in 0..60 * PERIOD {
        centralised.step(step, &ROWS[..2]);
        for (k, node) in nodes.iter_mut().enumerate() {
            node.step(Frame {
                observations: &[datum(k, step, ROWS[k])],
                excitation: &[],
            })
            .unwrap();
        }
        if (step + 1).is_multiple_of(PERIOD) {
            let period = (step + 1) / PERIOD;
            for (k, node) in nodes.iter_mut().enumerate() {
                let report = node.report();
                if k == 0 || !period.is_multiple_of(3) {
                    station.receive(k, report, period as f64).unwrap();
                }
            }
            let fused = station.fuse(period as f64);
            nodes[0].take(fused.feedback[0].as_ref().unwrap());
            let off = fused.parameters.covariance - centralised.0.gaussian().unwrap().covariance;
            assert!(
                period.is_multiple_of(3) || off.amax() < 1e-9,
                "period {period}: {:e}",
                off.amax()
            );
            assert!(
                station.known[1].counted.len() <= ANSWERS_KEPT + 2,
                "{}",
                station.known[1].counted.len()
            );
            assert!(station.known[1].answered.len() <= ANSWERS_KEPT + 1);
        }
    }
}

#[test]
fn nodes_without_new_information_do_not_weaken_the_information_of_others() {
    let mut station = station(4, FusionRule::default(), FeedbackRule::Marginal);
    let learnt = Gaussian {
        covariance: prior().covariance * 0.5,
        ..prior()
    };
    let message = |lineage| LocalEstimate {
        index: 1,
        parameters: learnt.clone(),
        lineage,
        motion: None,
        instant: 1.0,
    };
    station
        .receive(
            0,
            message(Some(Lineage {
                own: 0,
                answers: Vec::new(),
            })),
            1.0,
        )
        .unwrap();
    for node in 1..4 {
        station.receive(node, message(None), 1.0).unwrap();
    }
    let fused = station.fuse(1.0);
    assert_eq!(fused.used, 4);
    assert!(
        (fused.parameters.covariance - learnt.covariance).amax() < 1e-12,
        "of one that learns, all counts"
    );
}

/// Regression test: a node that starts within a period must not report as if it had run the whole
/// period.
///
/// The information of this period would then be lost.
#[test]
fn node_that_starts_within_a_period_counts_its_information_exactly_once() {
    const LATE: u64 = 2;
    let mut nodes = [
        node(ROWS[0], FeedbackRule::Marginal),
        node(ROWS[1], FeedbackRule::Marginal),
    ];
    nodes[1].begin_at(LATE);
    let mut station = station(
        2,
        FusionRule::PriorCorrect(Sharing::Nothing),
        FeedbackRule::Marginal,
    );
    let mut centralised = Centralised(prior().information().unwrap());
    for step in 0..40 * PERIOD {
        centralised.step(step, if step < LATE { &ROWS[..1] } else { &ROWS[..2] });
        for (k, node) in nodes
            .iter_mut()
            .enumerate()
            .filter(|(k, _)| *k == 0 || step >= LATE)
        {
            node.step(Frame {
                observations: &[datum(k, step, ROWS[k])],
                excitation: &[],
            })
            .unwrap();
        }
        assert_eq!(nodes[0].is_due(), nodes[1].is_due());
        if nodes[0].is_due() {
            let period = (step + 1) / PERIOD;
            for (k, node) in nodes.iter_mut().enumerate() {
                let report = node.report();
                assert_eq!((report.index, report.lineage.is_some()), (period, true));
                station.receive(k, report, period as f64).unwrap();
            }
            let fused = station.fuse(period as f64);
            for (node, answer) in nodes.iter_mut().zip(&fused.feedback) {
                assert_eq!(node.take(answer.as_ref().unwrap()), Taken::Applied);
            }
            let all = centralised.0.gaussian().unwrap();
            let off =
                (&fused.parameters.covariance - &all.covariance).amax() / all.covariance.amax();
            assert!(off < 1e-10, "period {period}: covariance off by {off:e}");
            let off = (&fused.parameters.mean - &all.mean).amax();
            assert!(off < 1e-10, "period {period}: mean off by {off:e}");
        }
    }
}

/// Regression test: a filter must not combine samples of different instants.
#[test]
fn motion_is_sent_only_to_nodes_of_the_same_instant() {
    let mut station = station(3, FusionRule::default(), FeedbackRule::Marginal);
    station.settings.motion = MotionExchange::Samples(SampleExchange::new(&[1, 1, 1], 1));
    let message = |instant: f64| LocalEstimate {
        index: 1,
        parameters: prior(),
        lineage: Some(Lineage {
            own: 0,
            answers: Vec::new(),
        }),
        motion: Some(CompressedMotion {
            mean: DVector::repeat(1, instant),
            variance: DVector::zeros(0),
        }),
        instant,
    };
    let sample = 1.0 / PERIOD as f64;
    // In step; off by less than half a sample; late, from the previous period.
    for (node, instant) in [7.0, 7.0 + 0.4 * sample, 6.0].into_iter().enumerate() {
        station.receive(node, message(instant), 7.0).unwrap();
    }
    let fused = station.fuse(7.0);
    assert_eq!(fused.used, 3, "the density of the late one counts");
    let told = |node: usize| -> Vec<bool> {
        fused.feedback[node]
            .as_ref()
            .unwrap()
            .responses
            .iter()
            .map(Option::is_some)
            .collect()
    };
    assert_eq!(
        [told(0), told(1), told(2)],
        [
            [true, true, false],
            [true, true, false],
            [false, false, true]
        ]
    );
    assert_eq!(
        fused
            .nodes
            .iter()
            .map(|node| node.out_of_step)
            .collect::<Vec<_>>(),
        [false, false, true]
    );
}

/// Regression test: a restarted station must not answer with its prior, because the nodes would
/// lose their information.
#[test]
fn restarted_station_adopts_the_information_of_the_nodes() {
    let feedback = FeedbackRule::Marginal;
    let mut nodes: Vec<_> = ROWS.iter().map(|row| node(*row, feedback)).collect();
    let rule = FusionRule::PriorCorrect(Sharing::Nothing);
    let mut running = station(4, rule, feedback);
    let mut centralised = Centralised(prior().information().unwrap());
    let mut before = prior();
    for step in 0..40 * PERIOD {
        centralised.step(step, &ROWS);
        for (k, node) in nodes.iter_mut().enumerate() {
            node.step(Frame {
                observations: &[datum(k, step, ROWS[k])],
                excitation: &[],
            })
            .unwrap();
        }
        if !nodes[0].is_due() {
            continue;
        }
        let period = (step + 1) / PERIOD;
        if period == 20 {
            running = station(4, rule, feedback);
        }
        for (k, node) in nodes.iter_mut().enumerate() {
            running.receive(k, node.report(), period as f64).unwrap();
        }
        let fused = running.fuse(period as f64);
        assert_eq!(fused.adopted, period == 20);
        let all = centralised.0.gaussian().unwrap();
        let more = &fused.parameters.covariance - &all.covariance;
        assert!(
            more.symmetric_eigen().eigenvalues.min() > -1e-9,
            "period {period}"
        );
        if period == 20 {
            // The former density has faded by one period, and the nodes have learnt since then.
            let growth = fading().value().powi(PERIOD as i32);
            let faded: Gaussian = Gaussian {
                covariance: &before.covariance * growth,
                ..before.clone()
            };
            let lost = faded.covariance - &fused.parameters.covariance;
            assert!(
                lost.symmetric_eigen().eigenvalues.min() > -1e-9,
                "it knows less than the nodes did before"
            );
        }
        for (node, answer) in nodes.iter_mut().zip(&fused.feedback) {
            assert_eq!(node.take(answer.as_ref().unwrap()), Taken::Applied);
        }
        before = fused.parameters;
    }
}

#[test]
fn excluded_node_is_used_again_after_the_declared_number_of_regular_fusions() {
    for (readmission, expected) in [
        (1, [true, false, false, false]),
        (3, [true, true, true, false]),
    ] {
        let mut station = station(4, FusionRule::default(), FeedbackRule::Marginal);
        station.settings.detector = Some(GlobalDetector {
            readmission,
            one_at_a_time: true,
            ..GlobalDetector::default()
        });
        let mut found = Vec::new();
        for index in 1..=4_u64 {
            for node in 0..4 {
                let wrong = if node == 2 && index == 1 { 1.0 } else { 0.0 };
                let message = LocalEstimate {
                    index,
                    parameters: Gaussian {
                        mean: DVector::from_row_slice(&[1.0 + wrong, 1.0]),
                        covariance: DMatrix::from_diagonal_element(2, 2, 1e-3),
                    },
                    lineage: None,
                    motion: None,
                    instant: index as f64,
                };
                station.receive(node, message, index as f64).unwrap();
            }
            let fused = station.fuse(index as f64);
            assert!(
                fused
                    .nodes
                    .iter()
                    .enumerate()
                    .all(|(node, report)| node == 2 || !report.excluded)
            );
            found.push(fused.nodes[2].excluded);
        }
        assert_eq!(found, expected);
    }
}

/// Returns a station of four nodes with a detector of the given weighting.
fn testing_station(weighting: Weighting) -> Station {
    let mut station = station(4, FusionRule::default(), FeedbackRule::Marginal);
    station.settings.detector = Some(GlobalDetector {
        screening: 0.999,
        one_at_a_time: true,
        weighting,
        ..GlobalDetector::default()
    });
    station
}

#[test]
fn graded_weights_of_regular_nodes_change_no_bit() {
    let run = |detector: Option<GlobalDetector>| {
        let mut nodes: Vec<_> = ROWS
            .iter()
            .map(|row| node(*row, FeedbackRule::Marginal))
            .collect();
        let mut station = station(4, FusionRule::default(), FeedbackRule::Marginal);
        station.settings.detector = detector;
        let mut all = Vec::new();
        for step in 0..30 * PERIOD {
            for (k, node) in nodes.iter_mut().enumerate() {
                node.step(Frame {
                    observations: &[datum(k, step, ROWS[k])],
                    excitation: &[],
                })
                .unwrap();
            }
            if nodes[0].is_due() {
                let period = (step + 1) as f64 / PERIOD as f64;
                for (k, node) in nodes.iter_mut().enumerate() {
                    station.receive(k, node.report(), period).unwrap();
                }
                let fused = station.fuse(period);
                for (node, answer) in nodes.iter_mut().zip(&fused.feedback) {
                    node.take(answer.as_ref().unwrap());
                }
                assert!(
                    fused
                        .nodes
                        .iter()
                        .all(|node| node.weight == 1.0 && !node.excluded),
                    "period {period}"
                );
                all.push(fused.parameters);
            }
        }
        all
    };
    let with = |weighting| testing_station(weighting).settings.detector;
    let graded = run(with(Weighting::Graded));
    assert_eq!(graded, run(with(Weighting::AllOrNothing)));
    assert_eq!(graded, run(None));
}

/// Returns the shift of the fused mean, and the weight of one node of four whose mean is off by
/// `off`.
///
/// All nodes have learnt the same amount since the prior.
fn moved_by(off: f64, weighting: Weighting) -> (f64, f64) {
    let mut station = testing_station(weighting);
    for node in 0..4 {
        let off = if node == 2 { off } else { 0.0 };
        let message = LocalEstimate {
            index: 1,
            parameters: Gaussian {
                mean: &prior().mean + DVector::from_row_slice(&[off, 0.0]),
                covariance: prior().covariance * 0.5,
            },
            lineage: Some(Lineage {
                own: 0,
                answers: Vec::new(),
            }),
            motion: None,
            instant: 1.0,
        };
        station.receive(node, message, 1.0).unwrap();
    }
    let fused = station.fuse(1.0);
    (
        fused.parameters.mean[0] - prior().mean[0],
        fused.nodes[2].weight,
    )
}

#[test]
fn influence_of_a_node_decreases_with_its_distance() {
    // Two variances of 0.02, of the node and of the others together; χ² with two degrees of
    // freedom.
    let limit = (-2.0 * 0.001_f64.ln() * 0.04).sqrt();
    let mut before = f64::INFINITY;
    for times in [0.99_f64, 1.2, 1.5, 2.0, 3.0] {
        let weight = if times < 1.0 { 1.0 } else { times.powi(-2) };
        let (moved, found) = moved_by(times * limit, Weighting::Graded);
        assert!((found - weight).abs() < 1e-9, "{times}: {found}");
        // The other nodes have weight 1, and γ is the sum of the weights.
        let expected = weight / (3.0 + weight) * times * limit;
        assert!(
            (moved - expected).abs() < 1e-9 && moved < before,
            "{times}: {moved}, expected {expected}"
        );
        before = moved;
    }
    assert_eq!(
        moved_by(0.99 * limit, Weighting::AllOrNothing),
        moved_by(0.99 * limit, Weighting::Graded)
    );
    // A graded node is excluded beyond √10 times the limit, an ungraded node directly at the limit.
    for (times, weighting) in [
        (3.2, Weighting::Graded),
        (100.0, Weighting::Graded),
        (1.01, Weighting::AllOrNothing),
    ] {
        let (moved, weight) = moved_by(times * limit, weighting);
        assert!(
            moved.abs() < 1e-12 && weight == 0.0,
            "{times}: {moved}, {weight}"
        );
    }
}

#[test]
fn permanently_discounted_node_is_excluded_until_it_is_regular_again() {
    let mut station = testing_station(Weighting::Graded);
    station.settings.detector.as_mut().unwrap().readmission = 3;
    let mut found = Vec::new();
    for index in 1..=20_u64 {
        for node in 0..4 {
            // Off by one and a half times the limit until the fifteenth fusion.
            let off = if node == 2 && index <= 15 {
                1.5 * (-2.0 * 0.001_f64.ln() * 0.04).sqrt()
            } else {
                0.0
            };
            let message = LocalEstimate {
                index,
                parameters: Gaussian {
                    mean: DVector::from_row_slice(&[1.0 + off, 1.0]),
                    covariance: DMatrix::from_diagonal_element(2, 2, 0.02),
                },
                lineage: None,
                motion: None,
                instant: index as f64,
            };
            station.receive(node, message, index as f64).unwrap();
        }
        let fused = station.fuse(index as f64);
        let weights: Vec<f64> = fused.nodes.iter().map(|node| node.weight).collect();
        assert_eq!((weights[0], weights[1], weights[3]), (1.0, 1.0, 1.0));
        assert_eq!(fused.nodes[2].excluded, weights[2] == 0.0);
        found.push(weights[2]);
    }
    let patience = PATIENCE as usize;
    assert!(
        found[..patience]
            .iter()
            .all(|weight| (weight - 1.0 / 2.25).abs() < 1e-9),
        "{found:?}"
    );
    assert!(
        found[patience..17].iter().all(|weight| *weight == 0.0),
        "{found:?}"
    );
    assert!(
        found[17..].iter().all(|weight| *weight == 1.0),
        "the third regular fusion uses it again: {found:?}"
    );
}

/// Regression test: suspicious nodes must not send their motion to the others.
///
/// In a simulation, three biased nodes sent their responses between exclusions. They pulled the
/// others towards their bias and were never detected again.
#[test]
fn motion_of_a_discounted_node_is_shared_after_enough_regular_fusions() {
    let mut station = testing_station(Weighting::Graded);
    station.settings.detector.as_mut().unwrap().readmission = 2;
    station.settings.motion = MotionExchange::Samples(SampleExchange::new(&[1, 1, 1, 1], 1));
    for (index, (off, is_told)) in
        (1..).zip([(1.5, false), (0.0, false), (0.0, true), (1.5, false)])
    {
        for node in 0..4 {
            let off = if node == 2 {
                off * (-2.0 * 0.001_f64.ln() * 0.04).sqrt()
            } else {
                0.0
            };
            let message = LocalEstimate {
                index,
                parameters: Gaussian {
                    mean: DVector::from_row_slice(&[1.0 + off, 1.0]),
                    covariance: DMatrix::from_diagonal_element(2, 2, 0.02),
                },
                lineage: None,
                motion: Some(CompressedMotion {
                    mean: DVector::repeat(1, 0.5),
                    variance: DVector::zeros(0),
                }),
                instant: index as f64,
            };
            station.receive(node, message, index as f64).unwrap();
        }
        let fused = station.fuse(index as f64);
        assert!(
            !fused.nodes[2].excluded && (fused.nodes[2].weight < 1.0) == (off > 0.0),
            "fusion {index}"
        );
        let told: Vec<bool> = fused.responses.iter().map(Option::is_some).collect();
        assert_eq!(told, [true, true, is_told, true], "fusion {index}");
    }
}
