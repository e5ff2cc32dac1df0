//! Tests of the simulation against closed forms, of its faults, and of its repeatability.

use super::*;
use crate::linear_form::{LinearForm, Recursion};
use spandrel_filter::{InputHold, ProcessModel};
use std::path::Path;

const DEMO: &str = include_str!("../../../../docs/examples/demo.toml");

fn parse(text: &str) -> Structure {
    Structure::parse(text, Path::new("tower.toml")).unwrap_or_else(|error| panic!("{error}"))
}

/// Returns one mass of 2 kg on a spring of 200 N/m with `α` damping.
///
/// White noise excites it, and a sensor measures its displacement.
fn oscillator(simulation: &str) -> Structure {
    parse(&format!(
        r#"
        [structure]
        name = "oscillator"
        sampling-rate-hz = 50
        [model]
        kind = "shear-building"
        masses-kg = [2]
        stiffnesses-n-per-m = [200]
        [damping]
        kind = "rayleigh"
        alpha-per-s = 0.8
        [[parameter]]
        name = "spring"
        scales = "stiffness"
        of = ["storey-1"]
        [[excitation]]
        name = "push"
        kind = "force"
        dof = 1
        std = 10
        measured-on = "push"
        [[node]]
        name = "mass"
        [[node.channel]]
        name = "push"
        quantity = "force"
        unit = "N"
        noise-std = 1e-12
        [[node.channel]]
        name = "sway"
        quantity = "displacement"
        dof = 1
        unit = "m"
        noise-std = 1e-12
        [filter]
        input-hold = "zero-order"
        {simulation}"#
    ))
}

/// Returns the response of the oscillator to a force held over a step.
///
/// It uses the complex amplitude: `x(t) = x_s + Re(c e^{st})`.
fn exact_step(k: f64, x: f64, v: f64, f: f64, t: f64) -> (f64, f64) {
    let (m, alpha) = (2.0, 0.8);
    let decay = alpha / 2.0;
    let omega = (k / m - decay * decay).sqrt();
    let rest = f / k;
    let (a, b) = (x - rest, (v + decay * (x - rest)) / omega);
    let (cos, sin, e) = ((omega * t).cos(), (omega * t).sin(), (-decay * t).exp());
    let position = rest + e * (a * cos + b * sin);
    let velocity = e * ((b * omega - a * decay) * cos - (a * omega + b * decay) * sin);
    (position, velocity)
}

#[test]
fn an_oscillator_follows_its_closed_solution() {
    let structure =
        oscillator("[[simulation.damage]]\nparameter = \"spring\"\nat-s = 4\nloss = 0.3\n");
    let (mut x, mut v) = (0.0, 0.0);
    for frame in structure.simulator(3).take(500) {
        let [force, sway] = frame.values[..] else {
            panic!("two channels")
        };
        assert!(
            (sway - x).abs() < 1e-9,
            "frame {}: {sway} instead of {x}",
            frame.index
        );
        let k = if frame.index < 200 { 200.0 } else { 140.0 };
        (x, v) = exact_step(k, x, v, force, 0.02);
    }
}

/// A force that is linear over a step is the limit of many small held steps, with second-order
/// convergence.
#[test]
fn a_first_order_hold_is_the_limit_of_small_held_steps() {
    let mut model = oscillator("").model();
    let form = LinearForm::new(&mut model, &[1.0]);
    let Recursion {
        transition,
        input,
        slope,
    } = form.recursion(0.02, &[InputHold::First]);
    let start = DVector::from_column_slice(&[0.01, -0.2]);
    let (from, to) = (3.0, -5.0);
    let whole = &transition * &start + &input * from + &slope * (to - from);
    let error = |parts: usize| {
        let small = form.recursion(0.02 / parts as f64, &[InputHold::Zero]);
        let mut state = start.clone();
        for part in 0..parts {
            let middle = from + (to - from) * (part as f64 + 0.5) / parts as f64;
            state = &small.transition * state + &small.input * middle;
        }
        (state - &whole).norm()
    };
    let (coarse, fine) = (error(8), error(16));
    assert!(
        coarse < 1e-5 && (coarse / fine - 4.0).abs() < 0.1,
        "{coarse:e} {fine:e}"
    );
}

/// Returns three floors with velocity sensors, as a shear building or with hysteretic springs under
/// small motions.
fn chain(model: &str, hold: &str, std: f64) -> Structure {
    let floors = [1, 2, 3].map(|floor| {
        format!(
            "[[node.channel]]\nname = \"floor-{floor}\"\nquantity = \"velocity\"\ndof = {floor}\n\
             unit = \"m/s\"\n\
             noise-std = 1e-30\n"
        )
    });
    parse(&format!(
        r#"
        [structure]
        name = "chain"
        sampling-rate-hz = 100
        [model]
        masses-kg = [2, 1.5, 1]
        stiffnesses-n-per-m = [900, 700, 500]
        {model}
        [damping]
        kind = "rayleigh"
        ratio = 0.02
        [[parameter]]
        name = "first"
        scales = "stiffness"
        of = ["storey-1"]
        [[excitation]]
        name = "ground"
        kind = "ground"
        std = {std:e}
        [[excitation]]
        name = "push"
        kind = "force"
        dof = 2
        std = {std:e}
        [filter]
        input-hold = "{hold}"
        [simulation]
        damage = [{{ parameter = "first", at-s = 2, loss = 0.3 }}]
        [[node]]
        name = "floors"
        {}"#,
        floors.concat()
    ))
}

const LAW: &str = "kind = \"bouc-wen\"\nmu = 1000\nkappa = 1500\neta = 2\n";

/// Springs far below their yield amplitude are linear: substeps against the exact recursion, with
/// damage.
///
/// A substep `h` has the error `(ωh)⁵/120`, which damping forgets in `1/(ζωh)` substeps. With
/// `ωh < 0.1` and ζ = 2 % the sum is 4·10⁻⁵ of the amplitude.
#[test]
fn small_motions_of_hysteretic_springs_are_those_of_a_shear_building() {
    for hold in ["zero-order", "first-order"] {
        let linear: Vec<_> = chain("kind = \"shear-building\"", hold, 1e-7)
            .simulator(1)
            .take(400)
            .collect();
        let amplitude = linear
            .iter()
            .flat_map(|frame| &frame.values)
            .fold(0.0_f64, |most, v| most.max(v.abs()));
        for drive in ["floor", "drift"] {
            let hysteretic = chain(&format!("{LAW}drive = \"{drive}\"\n"), hold, 1e-7);
            for (expected, found) in linear.iter().zip(hysteretic.simulator(1)) {
                for (expected, found) in expected.values.iter().zip(&found.values) {
                    let difference = (expected - found).abs();
                    assert!(
                        difference < 4e-5 * amplitude,
                        "{drive}, {hold}, frame {}: {difference:e}",
                        expected
                    );
                }
            }
        }
    }
}

/// No motion takes a spring beyond `(μ + κ)^(−1/η)`, and this motion reaches that limit.
#[test]
fn hysteretic_springs_yield() {
    for drive in ["floor", "drift"] {
        let mut simulator =
            chain(&format!("{LAW}drive = \"{drive}\"\n"), "zero-order", 50.0).simulator(1);
        let mut largest = 0.0_f64;
        for _ in 0..1000 {
            simulator.advance_frame();
            largest = simulator.state()[..3]
                .iter()
                .fold(largest, |most, r| most.max(r.abs()));
        }
        assert!(
            largest < 0.02 * (1.0 + 1e-12) && largest > 0.019,
            "{drive}: {largest}"
        );
    }
}

#[test]
fn the_excitation_has_the_variance_of_the_file_and_is_white() {
    let frames = 20_000;
    let force: Vec<f64> = oscillator("")
        .simulator(1)
        .take(frames)
        .map(|frame| frame.values[0])
        .collect();
    let mean_square = force.iter().map(|f| f * f).sum::<f64>() / frames as f64;
    let lagged = force.windows(2).map(|pair| pair[0] * pair[1]).sum::<f64>() / frames as f64;
    // Standard deviations of both estimates: σ² √(2/N) and σ²/√N; the tolerance is four of them.
    assert!(
        (mean_square - 100.0).abs() < 4.0 * 100.0 * (2.0 / frames as f64).sqrt(),
        "{mean_square}"
    );
    assert!(
        lagged.abs() < 4.0 * 100.0 / (frames as f64).sqrt(),
        "{lagged}"
    );
}

#[test]
fn the_same_seed_gives_the_same_bits_and_another_seed_another_motion() {
    let demo = parse(DEMO);
    let run = |seed| demo.simulator(seed).take(300).collect::<Vec<_>>();
    assert_eq!(run(5), run(5));
    assert_ne!(run(5)[10], run(6)[10]);
}

#[test]
fn the_motion_does_not_depend_on_the_faults() {
    let clean: Vec<_> = oscillator("").simulator(2).take(400).collect();
    let faulty: Vec<_> = oscillator("[simulation]\ndropped-share = 0.2\n")
        .simulator(2)
        .take(400)
        .collect();
    let (mut dropped, mut all) = (0, 0);
    for (clean, faulty) in clean.iter().zip(&faulty) {
        for (clean, faulty) in clean.values.iter().zip(&faulty.values) {
            all += 1;
            dropped += usize::from(faulty.is_nan());
            assert!(faulty.is_nan() || faulty == clean);
        }
    }
    // Binomial: four standard deviations.
    let (share, expected) = (dropped as f64 / all as f64, 0.2);
    assert!(
        (share - expected).abs() < 4.0 * (0.2 * 0.8 / all as f64).sqrt(),
        "{share}"
    );
}

#[test]
fn spikes_have_the_requested_share_and_height() {
    let structure = oscillator("[simulation]\nspike-share = 0.05\nspike-height = 1e13\n");
    // 1e13 standard deviations of 1e-12 are 10 N, or 10 m: far beyond any displacement.
    let spikes = structure
        .simulator(4)
        .take(4000)
        .filter(|frame| frame.values[1].abs() > 5.0)
        .count();
    let four_deviations = 4.0 * (0.05 * 0.95 * 4000.0_f64).sqrt();
    assert!((spikes as f64 - 200.0).abs() < four_deviations, "{spikes}");
}

#[test]
fn a_slower_node_has_a_value_in_every_other_frame() {
    let node = "[[node]]\nname = \"floor-1\"";
    let structure = parse(&DEMO.replacen(node, &format!("{node}\nsampling-rate-hz = 50"), 1));
    for frame in structure.simulator(1).take(20) {
        assert_eq!(frame.values[1].is_nan(), frame.index % 2 == 1);
        assert!(frame.values[2].is_finite());
    }
}

#[test]
fn the_truth_follows_the_damage() {
    let demo = parse(DEMO);
    assert_eq!(demo.true_parameters(5999), [1.0; 6]);
    assert_eq!(demo.true_parameters(6000)[1], 0.85);
    let noisy = Structure::read(Path::new("../../docs/examples/noisy.toml")).unwrap();
    // 10 % over 30 s from 60 s on, then 5 % of another storey at 120 s.
    let half = noisy.true_parameters(7500)[0];
    assert!((half - 0.95).abs() < 1e-12, "{half}");
    assert_eq!(noisy.true_parameters(12_000)[0], 0.9);
    assert_eq!(noisy.true_parameters(12_000)[2], 0.95);
}

/// `W` has its maximum, 2, at `t_a + t_b`, and is 1 before `t_a`: Huang & Yuen (2023), §3.4.
#[test]
fn a_modulated_excitation_swells_to_twice_its_amplitude() {
    let modulation = crate::simulation_plan::Modulation {
        start_s: 100.0,
        rise_s: 20.0,
    };
    assert_eq!(modulation.amplitude(50.0), 1.0);
    assert_eq!(modulation.amplitude(120.0), 2.0);
    assert!(modulation.amplitude(119.0) < 2.0 && modulation.amplitude(121.0) < 2.0);
}

/// Over a very short step, the recursion moves the state by its rate of change.
#[test]
fn the_recursion_is_the_integral_of_the_process() {
    let mut model = oscillator("").model();
    let form = LinearForm::new(&mut model, &[1.0]);
    let h = 1e-6;
    let recursion = form.recursion(h, &[InputHold::Zero]);
    let state = [0.3, -0.1, 1.0];
    model.linearise_process(&state, &[4.0]);
    let mut rate = [0.0; 3];
    model.derivative(&mut rate);
    let moved =
        &recursion.transition * DVector::from_column_slice(&state[..2]) + &recursion.input * 4.0;
    for i in 0..2 {
        assert!(((moved[i] - state[i]) / h - rate[i]).abs() < 1e-4, "{i}");
    }
}

#[test]
fn modulated_excitation_swells_as_declared() {
    // s = (t − 20)/10: 1 before 20 s, 2 at 30 s, then decaying.
    let structure = oscillator("[simulation]\nmodulation = { start-s = 20, rise-s = 10 }\n");
    let push: Vec<f64> = structure
        .simulator(4)
        .take(6000)
        .map(|frame| frame.values[0])
        .collect();
    let rms =
        |from: usize| (push[from..from + 200].iter().map(|f| f * f).sum::<f64>() / 200.0).sqrt();
    for (time_s, expected) in [
        (10, 1.0),
        (30, 2.0),
        (50, 1.0 + 3.0 * (-2.0_f64).exp()),
        (100, 1.0 + 8.0 * (-7.0_f64).exp()),
    ] {
        // 200 samples: the estimated standard deviation has a standard deviation of 5 %.
        let found = rms(50 * time_s - 100) / 10.0;
        assert!(
            (found / expected - 1.0).abs() < 0.2,
            "{time_s} s: {found} instead of {expected}"
        );
    }
}
