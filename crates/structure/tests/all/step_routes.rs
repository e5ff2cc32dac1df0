//! Compares the step by blocks with the step by the Jacobian as an operator, for proportional
//! damping.

use crate::by_operator::ByOperator;
use crate::structures::{building_with_masses, example, parse, small_tower, text_of};
use nalgebra::DVector;
use spandrel_filter::{ExtendedKalmanFilter, FilterState, Frame, ProcessModel};
use spandrel_structure::{SimulatedFrame, Structure, StructureModel};

/// Two filters on the same frames: by blocks and by the operator.
struct Routes {
    structure: Structure,
    blocks: ExtendedKalmanFilter<StructureModel>,
    operator: ExtendedKalmanFilter<ByOperator>,
}

impl Routes {
    /// Starts both filters with every parameter up to 30 % off, in directions that depend on
    /// `seed`.
    fn new(structure: Structure, seed: u64) -> Self {
        let mut settings = structure.filter_settings().unwrap();
        let physical = settings.prior_mean.len() - structure.parameters().len();
        for (index, mean) in settings.prior_mean.iter_mut().skip(physical).enumerate() {
            *mean *= 1.0 + 0.3 * (seed as f64 * 7.3 + 2.1 * index as f64).sin();
        }
        let model = structure.model();
        assert!(
            model.proportional_form().is_some()
                && ByOperator(model.clone()).proportional_form().is_none()
        );
        let operator =
            ExtendedKalmanFilter::new(ByOperator(model.clone()), settings.clone()).unwrap();
        Self {
            blocks: ExtendedKalmanFilter::new(model, settings).unwrap(),
            structure,
            operator,
        }
    }

    fn samples(&self, frame: &SimulatedFrame) -> (Vec<f64>, Vec<f64>) {
        let observations = self
            .structure
            .observation_channels()
            .iter()
            .map(|c| frame.values[*c])
            .collect();
        let excitation = self
            .structure
            .excitation_channels()
            .iter()
            .map(|c| c.map_or(0.0, |c| frame.values[c]))
            .collect();
        (observations, excitation)
    }

    fn step_blocks(&mut self, frame: &SimulatedFrame) {
        let (observations, excitation) = self.samples(frame);
        self.blocks
            .step(Frame {
                observations: &observations,
                excitation: &excitation,
            })
            .unwrap();
    }

    fn step_operator(&mut self, frame: &SimulatedFrame) {
        let (observations, excitation) = self.samples(frame);
        self.operator
            .step(Frame {
                observations: &observations,
                excitation: &excitation,
            })
            .unwrap();
    }

    /// Returns the largest differences of mean and covariance, in standard deviations of the
    /// operator filter.
    fn differences(&self) -> (f64, f64) {
        let std: DVector<f64> = self.operator.covariance().diagonal().map(f64::sqrt);
        let mean = (self.blocks.mean() - self.operator.mean())
            .component_div(&std)
            .amax();
        let difference = self.blocks.covariance() - self.operator.covariance();
        (
            mean,
            difference.component_div(&(&std * std.transpose())).amax(),
        )
    }
}

fn structures() -> Vec<(&'static str, Structure)> {
    let lumped_bridge = text_of("three-pier-bridge")
        .replace("kind = \"frame\"", "kind = \"frame\"\nmass = \"lumped\"");
    let consistent_truss = text_of("fourteen-bay-truss").replace(
        "kind = \"truss\"",
        "kind = \"truss\"\nmass = \"consistent\"",
    );
    vec![
        ("five storeys", example("demo")),
        ("noisy storeys", example("noisy")),
        (
            "fifty storeys with damping parameters",
            example("high-rise"),
        ),
        ("storeys with scaled masses", building_with_masses()),
        ("matrices", example("matrices")),
        ("frame, consistent mass", example("three-pier-bridge")),
        (
            "frame, lumped mass",
            parse("three-pier-bridge", &lumped_bridge),
        ),
        ("truss, lumped mass", example("fourteen-bay-truss")),
        (
            "truss, consistent mass",
            parse("fourteen-bay-truss", &consistent_truss),
        ),
        ("tower", small_tower()),
    ]
}

/// Compares single steps from the state of a filter after some frames, for random parameters.
///
/// One step has no samples and so tests the prediction alone; the other has samples. The rounding
/// error of the operator grows with each substep.
#[test]
fn one_step_is_the_same_by_blocks_and_by_the_operator() {
    for (what, structure) in structures() {
        for seed in 0..3 {
            let frames: Vec<SimulatedFrame> = structure.simulator(seed).take(22).collect();
            let mut routes = Routes::new(structure.clone(), seed);
            frames[..20]
                .iter()
                .for_each(|frame| routes.step_blocks(frame));
            let state: FilterState = routes.blocks.state().clone();
            let reach = structure.model().rate_bound() * routes.blocks.settings().step_s;
            let tolerance = if reach < 1.5 { 1e-12 } else { 1e-11 };
            for (samples, mut frame) in [("no", frames[20].clone()), ("all", frames[20].clone())] {
                if samples == "no" {
                    frame.values.fill(f64::NAN);
                }
                routes.blocks.restore(state.clone()).unwrap();
                routes.operator.restore(state.clone()).unwrap();
                routes.step_blocks(&frame);
                routes.step_operator(&frame);
                let (mean, covariance) = routes.differences();
                assert!(
                    mean < tolerance && covariance < tolerance,
                    "{what}, seed {seed}, {samples} samples: mean off by {mean:e}, covariance by \
                     {covariance:e}"
                );
            }
        }
    }
}

/// Rounding errors do not accumulate, because the filter forgets them like old data.
#[track_caller]
fn assert_same_run(structure: Structure, frames: usize) {
    let mut routes = Routes::new(structure, 1);
    for frame in routes.structure.clone().simulator(1).take(frames) {
        routes.step_blocks(&frame);
        routes.step_operator(&frame);
    }
    let (mean, covariance) = routes.differences();
    assert!(
        mean < 1e-9 && covariance < 1e-9,
        "mean off by {mean:e}, covariance by {covariance:e}"
    );
}

#[test]
fn a_long_run_of_the_demo_is_the_same_by_blocks_and_by_the_operator() {
    assert_same_run(example("demo"), 10_000);
}

#[test]
fn a_run_of_the_bridge_is_the_same_by_blocks_and_by_the_operator() {
    assert_same_run(example("three-pier-bridge"), 1_000);
}

#[test]
#[ignore = "half a minute by the operator"]
fn a_long_run_of_the_bridge_is_the_same_by_blocks_and_by_the_operator() {
    assert_same_run(example("three-pier-bridge"), 10_000);
}
