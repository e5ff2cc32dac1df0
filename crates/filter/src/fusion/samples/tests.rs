use super::*;
use crate::error::FilterError;
use crate::extended::{ExtendedKalmanFilter, FilterSettings, Frame};
use crate::fading::FadingFactor;
use crate::fusion::{
    Feedback, FeedbackRule, Gaussian, LocalFilter, MeanLimits, MotionExchange, NodeSettings, Taken,
};
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::NoiseModel;
use nalgebra::{DMatrix, DVector};

/// Two constants and two channels, each a weighted sum of them.
#[derive(Debug, Clone)]
struct Constants {
    mean: [f64; 2],
}

const ROWS: [[f64; 2]; 2] = [[1.0, 0.2], [-0.3, 1.0]];
const STEPS: u64 = 6;
const INSTANTS: usize = 3;
const NOISE: f64 = 0.3;

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
        2
    }
    fn linearise_observation(&mut self, state: &[f64], _: &[f64]) {
        self.mean.copy_from_slice(state);
    }
    fn observe(&self, out: &mut [f64]) {
        for (out, row) in out.iter_mut().zip(ROWS) {
            *out = row[0] * self.mean[0] + row[1] * self.mean[1];
        }
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        for (column, out) in columns
            .as_slice()
            .chunks_exact(2)
            .zip(out.as_mut_slice().chunks_exact_mut(2))
        {
            for (out, row) in out.iter_mut().zip(ROWS) {
                *out = row[0] * column[0] + row[1] * column[1];
            }
        }
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        None
    }
}

fn fading() -> FadingFactor {
    FadingFactor::from_half_life(60.0).unwrap()
}

fn filter() -> ExtendedKalmanFilter<Constants> {
    let noise = NoiseModel::known(
        DMatrix::zeros(0, 0),
        DMatrix::from_diagonal_element(2, 2, NOISE * NOISE),
    );
    let prior = DVector::from_row_slice(&[0.9, 1.1]);
    let mut settings = FilterSettings::new(0.1, prior, DVector::repeat(2, 0.2), noise);
    settings.fading = fading();
    ExtendedKalmanFilter::new(Constants { mean: [0.0; 2] }, settings).unwrap()
}

fn node(position: usize) -> Result<LocalFilter<Constants>, FilterError> {
    let settings = NodeSettings {
        steps_per_period: STEPS,
        feedback: FeedbackRule::Marginal,
        scheme: crate::fusion::CovarianceScheme::Full,
        motion: MotionExchange::Samples(SampleExchange::new(&[1, 1], INSTANTS)),
        position,
        healthy: MeanLimits {
            lower: DVector::repeat(2, -10.0),
            upper: DVector::repeat(2, 10.0),
        },
    };
    LocalFilter::new(filter(), settings)
}

fn datum(channel: usize, step: u64) -> f64 {
    let noise =
        ((step as f64 * 12.9898 + channel as f64 * 78.233).sin() * 43_758.547).fract() - 0.5;
    ROWS[channel][0] * 1.05 + ROWS[channel][1] * 0.93 + NOISE * noise
}

/// Runs both nodes for a period and returns their messages.
fn run_period(
    nodes: &mut [LocalFilter<Constants>],
    first: u64,
) -> Vec<crate::fusion::LocalEstimate> {
    let run = |(channel, node): (usize, &mut LocalFilter<Constants>)| {
        for step in first..first + STEPS {
            node.step(Frame {
                observations: &[datum(channel, step)],
                excitation: &[],
            })
            .unwrap();
        }
        node.report()
    };
    nodes.iter_mut().enumerate().map(run).collect()
}

fn answer(index: u64, parameters: &Gaussian, told: &[crate::fusion::LocalEstimate]) -> Feedback {
    Feedback {
        answers: index,
        parameters: parameters.clone(),
        nodes: told.len(),
        motion: None,
        responses: told
            .iter()
            .map(|estimate| estimate.motion.clone())
            .collect(),
    }
}

#[test]
fn shared_samples_are_whole_multiples_of_the_unit() {
    let exponent = unit_exponent(NOISE);
    assert_eq!(
        (exponent, unit_exponent(0.25), unit_exponent(0.249)),
        (-5, -5, -6)
    );
    let exchange = SampleExchange::new(&[2, 3], 1).rounded_to(vec![exponent, -2, 3, 4, 5]);
    assert_eq!(
        (exchange.unit_exponents(0), exchange.unit_exponents(1)),
        (&[exponent, -2][..], &[3, 4, 5][..])
    );
    let mut shared = Shared::new(&exchange, 0, 1);
    let huge = 0.25 * f64::from(i32::MAX) * 1.01;
    for (told, expected) in [
        ([0.1, 0.1], [0.09375, 0.0]),
        ([-1.7, 0.126], [-1.6875, 0.25]),
        ([f64::NAN, huge], [f64::NAN; 2]),
    ] {
        shared.tell(1, told.into_iter());
        for (found, expected) in shared.outgoing.iter().zip(expected) {
            assert!(
                *found == expected || (found.is_nan() && expected.is_nan()),
                "{told:?}: {found}"
            );
        }
    }
}

#[test]
fn node_sends_its_samples_at_the_instants() {
    let mut nodes = [node(0).unwrap(), node(1).unwrap()];
    for period in 0..2 {
        let told = run_period(&mut nodes, period * STEPS);
        for (channel, estimate) in told.iter().enumerate() {
            let motion = estimate.motion.as_ref().unwrap();
            let expected = [1, 3, 5].map(|step| datum(channel, period * STEPS + step));
            assert_eq!(
                (motion.mean.as_slice(), motion.variance.len()),
                (&expected[..], 0)
            );
        }
    }
}

#[test]
fn samples_of_other_nodes_are_learnt_as_if_received_in_time() {
    let mut nodes = [node(0).unwrap(), node(1).unwrap()];
    // The first message starts the first whole period.
    let told = run_period(&mut nodes, 0);
    let fused = Gaussian {
        mean: DVector::from_row_slice(&[1.0, 1.0]),
        covariance: DMatrix::from_row_slice(2, 2, &[0.02, 0.005, 0.005, 0.03]),
    };
    nodes
        .iter_mut()
        .for_each(|node| assert_eq!(node.take(&answer(1, &fused, &told)), Taken::Applied));
    let told = run_period(&mut nodes, STEPS);
    let own = told[0].parameters.information().unwrap();

    // The reference filter continues from the fused density and uses all samples that the other
    // node sent.
    let mut all = filter();
    all.step(Frame {
        observations: &[f64::NAN; 2],
        excitation: &[],
    })
    .unwrap();
    all.replace_parameters(&fused).unwrap();
    for step in STEPS..2 * STEPS {
        let other = if (step + 1 - STEPS).is_multiple_of(2) {
            datum(1, step)
        } else {
            f64::NAN
        };
        all.step(Frame {
            observations: &[datum(0, step), other],
            excitation: &[],
        })
        .unwrap();
    }
    let again = Gaussian {
        mean: DVector::from_row_slice(&[1.02, 0.95]),
        covariance: DMatrix::from_row_slice(2, 2, &[0.015, 0.002, 0.002, 0.02]),
    };
    assert_eq!(nodes[0].take(&answer(2, &again, &told)), Taken::Applied);
    let mut expected = again.information().unwrap();
    expected.add(1.0, &all.parameters().information().unwrap());
    expected.add(-1.0, &own);
    let (expected, found) = (expected.gaussian().unwrap(), nodes[0].filter().parameters());
    assert!(
        (&found.mean - &expected.mean).amax() < 1e-10,
        "{found:?} {expected:?}"
    );
    assert!((&found.covariance - &expected.covariance).amax() < 1e-10);
    assert!(
        (&found.covariance - &again.covariance).amax() > 1e-4,
        "nothing was learnt"
    );
}

#[test]
fn missing_or_invalid_samples_of_others_are_ignored() {
    let mut nodes = [node(0).unwrap(), node(1).unwrap()];
    let told = run_period(&mut nodes, 0);
    let fused = Gaussian {
        mean: DVector::repeat(2, 1.0),
        covariance: DMatrix::from_diagonal_element(2, 2, 0.02),
    };
    nodes[0].take(&answer(1, &fused, &told));
    let mut told = run_period(&mut nodes, STEPS);
    let missing = [
        vec![f64::NAN; INSTANTS],
        vec![1.0; INSTANTS + 1],
        vec![f64::INFINITY; INSTANTS],
    ];
    for samples in missing {
        let mut node = nodes[0].clone();
        told[1].motion.as_mut().unwrap().mean = samples.into();
        assert_eq!(node.take(&answer(2, &fused, &told)), Taken::Applied);
        let found = node.filter().parameters();
        assert!(
            (&found.mean - &fused.mean).amax() < 1e-12
                && (&found.covariance - &fused.covariance).amax() < 1e-12
        );
    }
}

/// Regression: an answer that the node refused, because it could not filter the later frames, still
/// became the start of the period. The next exchange of samples then counted the answer again.
#[test]
fn refused_answer_does_not_change_the_start_of_the_period() {
    let fused = |mean: f64| Gaussian {
        mean: DVector::repeat(2, mean),
        covariance: DMatrix::from_diagonal_element(2, 2, 0.02),
    };
    let run = |refused: Option<&Gaussian>| {
        let mut nodes = [node(0).unwrap(), node(1).unwrap()];
        let told = run_period(&mut nodes, 0);
        let step = |node: &mut LocalFilter<Constants>, step| {
            let frame = Frame {
                observations: &[datum(0, step)],
                excitation: &[],
            };
            node.step(frame).unwrap();
        };
        step(&mut nodes[0], STEPS);
        if let Some(refused) = refused {
            let taken = nodes[0].take(&answer(1, refused, &told));
            assert_eq!(taken, Taken::Refused);
        }
        (STEPS + 1..2 * STEPS).for_each(|number| step(&mut nodes[0], number));
        let mut told = vec![nodes[0].report(), told[1].clone()];
        told[1].motion.as_mut().unwrap().mean = vec![datum(1, STEPS); INSTANTS].into();
        let taken = nodes[0].take(&answer(2, &fused(1.0), &told));
        assert_eq!(taken, Taken::Applied);
        nodes[0].filter().parameters()
    };
    // The squares of the innovations of the later frame overflow.
    assert_eq!(run(Some(&fused(1e200))), run(None));
}

#[test]
fn number_of_instants_must_divide_the_samples_of_a_period() {
    let of = |instants| NodeSettings {
        steps_per_period: STEPS,
        feedback: FeedbackRule::Marginal,
        scheme: crate::fusion::CovarianceScheme::Full,
        motion: MotionExchange::Samples(SampleExchange::new(&[1, 1], instants)),
        position: 0,
        healthy: MeanLimits {
            lower: DVector::repeat(2, -10.0),
            upper: DVector::repeat(2, 10.0),
        },
    };
    assert!(LocalFilter::new(filter(), of(4)).is_err());
    assert!(LocalFilter::new(filter(), of(2)).is_ok());
}

/// Regression test: samples before a gap must not be sent as samples of a later period.
#[test]
fn samples_before_a_gap_are_not_sent_after_it() {
    let mut node = node(0).unwrap();
    for step in 0..4 {
        node.step(Frame {
            observations: &[datum(0, step)],
            excitation: &[],
        })
        .unwrap();
    }
    node.skip(STEPS);
    for step in 4 + STEPS..2 * STEPS {
        node.step(Frame {
            observations: &[datum(0, step)],
            excitation: &[],
        })
        .unwrap();
    }
    assert!(node.is_due());
    let told = node.report().motion.unwrap().mean;
    assert!(told[0].is_nan() && told[1].is_nan(), "{told}");
    assert_eq!(told[2], datum(0, 2 * STEPS - 1));
}

#[test]
fn node_that_starts_within_a_period_sends_samples_at_the_same_instants() {
    let mut node = node(0).unwrap();
    node.begin_at(3);
    for step in 3..STEPS {
        node.step(Frame {
            observations: &[datum(0, step)],
            excitation: &[],
        })
        .unwrap();
    }
    assert!(node.is_due());
    let told = node.report().motion.unwrap().mean;
    assert!(told[0].is_nan());
    assert_eq!([told[1], told[2]], [datum(0, 3), datum(0, 5)]);
}
